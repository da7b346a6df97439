//! One surface from several views.
//!
//! A view's depth map is a sheet of triangles. Where it is seen at a slant its few pixels are stretched over much surface:
//! from aside that smears. So a piece of the surface is taken from the first view that looks at it well enough, else from
//! the one that looks at it best.

use glam::{DVec2, DVec3};
use risorius_formats::Camera;

/// Neighbours whose depths differ by more than this share are not joined.
const EDGE: f32 = 0.03;
/// How far apart the pixels are whose depths tell the surface's slant: depths have steps.
const REACH: usize = 4;
/// Cosine of the slant from which on an earlier view is good enough for those after it …
const GOOD: f64 = 0.6;
/// … which it need not be for itself: sheets overlap a little rather than gape.
const GOOD_FOR_ITSELF: f64 = 0.5;
/// How much better another view has to look at a piece to have it alone.
const BETTER: f64 = 1.25;
/// Two views see the same surface where their distances to it differ by less than this share.
const SAME: f64 = 0.02;

/// What a view saw of the head.
pub(super) struct Sheet<'a> {
    camera: &'a Camera,
    /// Distance along each pixel's ray; 0 where there is no head.
    depth: &'a [f32],
    /// Cosine of the angle between ray and surface at each pixel.
    facing: Vec<f64>,
}

impl<'a> Sheet<'a> {
    pub(super) fn new(camera: &'a Camera, depth: &'a [f32]) -> Self {
        let mut sheet = Self { camera, depth, facing: Vec::new() };
        sheet.facing = (0..depth.len()).map(|i| sheet.slant(i).unwrap_or(0.0)).collect();
        sheet
    }

    fn width(&self) -> usize {
        self.camera.intrinsics.width as usize
    }

    fn point(&self, pixel: usize) -> Option<DVec3> {
        let depth = f64::from(self.depth[pixel]);
        let (x, y) = ((pixel % self.width()) as f64, (pixel / self.width()) as f64);
        let direction = self.camera.ray_direction(DVec2::new(x + 0.5, y + 0.5))?;
        (depth > 0.0).then(|| self.camera.center() + direction * depth)
    }

    /// Whether pixels belong to one surface.
    fn joined(&self, a: usize, b: usize) -> bool {
        let (a, b) = (self.depth[a], self.depth[b]);
        a > 0.0 && b > 0.0 && (a - b).abs() <= EDGE * a.min(b)
    }

    /// The way from a pixel's farthest joined neighbour on one side to that on the other, at most `REACH` steps each.
    fn across(&self, pixel: usize, stride: usize, before: usize, after: usize) -> Option<DVec3> {
        let walk = |most: usize, next: &dyn Fn(usize) -> usize| {
            let mut at = pixel;
            for _ in 0..most.min(REACH) {
                if !self.joined(at, next(at)) {
                    break;
                }
                at = next(at);
            }
            at
        };
        let (low, high) = (walk(before, &|i| i - stride), walk(after, &|i| i + stride));
        if low == high { None } else { Some(self.point(high)? - self.point(low)?) }
    }

    fn slant(&self, pixel: usize) -> Option<f64> {
        let (width, height) = (self.width(), self.depth.len() / self.width());
        let (x, y) = (pixel % width, pixel / width);
        let right = self.across(pixel, 1, x, width - 1 - x)?;
        let down = self.across(pixel, width, y, height - 1 - y)?;
        let normal = right.cross(down).try_normalize()?;
        Some((self.point(pixel)? - self.camera.center()).normalize().dot(normal).abs())
    }

    /// How straight the view looks at a piece of surface; `None` where it does not see it.
    fn sees(&self, point: DVec3) -> Option<f64> {
        if self.camera.camera_from_world.transform_point(point).z <= 0.0 {
            return None;
        }
        let pixel = self.camera.project(point);
        let (width, height) = (self.width(), self.depth.len() / self.width());
        let inside = pixel.x >= 0.0 && pixel.y >= 0.0 && pixel.x < width as f64 && pixel.y < height as f64;
        let at = inside.then(|| pixel.y as usize * width + pixel.x as usize)?;
        let (there, distance) = (f64::from(self.depth[at]), (point - self.camera.center()).length());
        (there > 0.0 && (there - distance).abs() < SAME * distance).then(|| self.facing[at])
    }
}

/// The triangles of sheet `own` that no other sheet has better: pixels at their corners.
pub(super) fn triangles(sheets: &[Sheet<'_>], own: usize) -> Vec<[usize; 3]> {
    let sheet = &sheets[own];
    let width = sheet.width();
    let mut kept = Vec::new();
    for a in (0..sheet.depth.len().saturating_sub(width)).filter(|a| a % width + 1 < width) {
        let (b, c, d) = (a + 1, a + width, a + width + 1);
        for corners in [[a, c, b], [b, c, d]] {
            let [p, q, r] = corners;
            if !(sheet.joined(p, q) && sheet.joined(q, r) && sheet.joined(p, r)) {
                continue;
            }
            let [Some(p), Some(q), Some(r)] = corners.map(|i| sheet.point(i)) else { continue };
            let middle = (p + q + r) / 3.0;
            let facing = corners.iter().map(|&i| sheet.facing[i]).sum::<f64>() / 3.0;
            let better = |(other, them): (usize, &Sheet<'_>)| {
                let theirs = if other == own { None } else { them.sees(middle) };
                theirs.is_some_and(|theirs| {
                    (other < own && theirs >= GOOD) || (facing < GOOD_FOR_ITSELF && theirs > facing * BETTER)
                })
            };
            if !sheets.iter().enumerate().any(better) {
                kept.push(corners);
            }
        }
    }
    kept
}

#[cfg(test)]
mod tests {
    use glam::DMat3;
    use risorius_formats::{Intrinsics, Isometry};

    use super::*;

    /// A camera at distance 4 that looks at the origin, turned about y.
    fn camera(yaw: f64) -> Camera {
        let camera_from_world = Isometry::new(DMat3::from_rotation_y(yaw), DVec3::new(0.0, 0.0, 4.0));
        Camera { intrinsics: Intrinsics::pinhole(64, 64, 100.0), camera_from_world }
    }

    /// Distances to the unit ball.
    fn ball(camera: &Camera) -> Vec<f32> {
        let eye = camera.center();
        (0..64 * 64)
            .map(|i| {
                let d = camera.ray_direction(DVec2::new(f64::from(i % 64) + 0.5, f64::from(i / 64) + 0.5)).unwrap();
                let (b, c) = (eye.dot(d), eye.length_squared() - 1.0);
                let inside = b * b - c;
                if inside > 0.0 { (-b - inside.sqrt()) as f32 } else { 0.0 }
            })
            .collect()
    }

    #[test]
    fn sheets_cover_a_ball_once_and_reach_farther_than_one() {
        let cameras = [0.0, 0.6, -0.6].map(camera);
        let depths = cameras.each_ref().map(ball);
        let sheets: Vec<Sheet<'_>> =
            cameras.iter().zip(&depths).map(|(camera, depth)| Sheet::new(camera, depth)).collect();
        let area = |sheet: &Sheet<'_>, triangles: &[[usize; 3]]| -> f64 {
            let corner = |i: usize| sheet.point(i).unwrap();
            triangles
                .iter()
                .map(|t| (corner(t[1]) - corner(t[0])).cross(corner(t[2]) - corner(t[0])).length() / 2.0)
                .sum()
        };
        let alone = area(&sheets[0], &triangles(&sheets[..1], 0));
        let each: Vec<f64> = (0..3).map(|own| area(&sheets[own], &triangles(&sheets, own))).collect();
        assert!(each.iter().all(|a| *a > 0.2), "{each:?}");
        let together: f64 = each.iter().sum();
        assert!(together > 1.15 * alone, "{together} {alone}");
        // A ball's half and a bit, with a little overlap.
        assert!(together < 2.0 * std::f64::consts::PI * 1.5, "{together}");
        // From 40 degrees aside, where the outermost view still sees all but the limb, next to nothing is bare; a sheet of the
        // middle view alone leaves a broad crescent.
        let aside = camera(0.7);
        let seen = ball(&aside);
        let bare = |sheets: &[Sheet<'_>]| {
            let mut hits = vec![false; 64 * 64];
            for (own, sheet) in sheets.iter().enumerate() {
                for point in triangles(sheets, own).iter().flatten().map(|&i| sheet.point(i).unwrap()) {
                    let pixel = aside.project(point);
                    hits[pixel.y as usize * 64 + pixel.x as usize] = true;
                }
            }
            let near = |i: usize| [i, i - 1, i + 1, i - 64, i + 64].iter().any(|&j| hits[j]);
            (65..64 * 63).filter(|&i| seen[i] > 0.0 && seen[i - 1] > 0.0 && seen[i + 1] > 0.0 && !near(i)).count()
        };
        let count = seen.iter().filter(|d| **d > 0.0).count();
        let (all, one) = (bare(&sheets), bare(&sheets[..1]));
        assert!(all * 33 < count && one * 8 > count, "of {count} pixels {all} are bare, {one} with one sheet");
    }

    #[test]
    fn a_sheet_across_an_edge_is_cut() {
        let camera = camera(0.0);
        let depth: Vec<f32> = (0..64 * 64).map(|i| if i % 64 < 32 { 3.0 } else { 4.0 }).collect();
        let kept = triangles(&[Sheet::new(&camera, &depth)], 0);
        assert!(!kept.is_empty() && kept.iter().all(|t| t.iter().all(|i| (i % 64 < 32) == (t[0] % 64 < 32))));
    }
}
