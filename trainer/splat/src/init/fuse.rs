//! Depth maps to one cloud: pixels on which several maps agree, gathered in voxels.

use glam::DVec3;
use rayon::prelude::*;
use risorius_formats::Isometry;

use super::view::View;

/// Maps that a pixel is compared with.
const COMPARED: usize = 6;
/// How many of them must agree.
const AGREEING: usize = 2;

/// The depth map of a view.
#[derive(Clone, Debug)]
pub(crate) struct DepthMap<'a> {
    /// The picture.
    pub(crate) view: &'a View,
    /// Where it was taken from.
    pub(crate) pose: Isometry,
    /// Per pixel, 1/m; 0 where unknown.
    pub(crate) inverse: Vec<f32>,
}

/// A point of a surface.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Point {
    /// Where, metres.
    pub(crate) at: DVec3,
    /// Towards the camera, or zero where the surface is rough.
    pub(crate) normal: DVec3,
    /// 0–255.
    pub(crate) rgb: [u8; 3],
}

impl DepthMap<'_> {
    fn point(&self, x: usize, y: usize, from_camera: &Isometry) -> Option<(DVec3, f64)> {
        let inverse = f64::from(self.inverse[y * self.view.width + x]);
        (inverse > 0.0).then(|| (from_camera.transform_point(self.view.ray(x, y) / inverse), inverse))
    }

    /// How the depth of `point` compares with this map: the inverse depth there less its own; `None` where the map does
    /// not see it.
    fn compare(&self, point: DVec3) -> Option<(f64, f64)> {
        let p = self.pose.transform_point(point);
        let found = f64::from(self.inverse[self.view.pixel_of(p)?]);
        (found > 0.0).then(|| (found, 1.0 / p.z))
    }
}

/// What counts as the same inverse depth, for planes `step` apart.
fn tolerance(inverse: f64, step: f64) -> f64 {
    (0.012 * inverse).max(1.02 * step)
}

/// The points on which maps agree, map after map.
pub(crate) fn agreed(maps: &[DepthMap<'_>], step: f64) -> Vec<Point> {
    let of = |index: usize| {
        let map = &maps[index];
        let center = map.pose.camera_center();
        let mut others: Vec<usize> = (0..maps.len()).filter(|&j| j != index).collect();
        let far = |j: usize| (maps[j].pose.camera_center() - center).length();
        others.sort_by(|&a, &b| far(a).total_cmp(&far(b)).then(a.cmp(&b)));
        others.truncate(COMPARED);
        points_of(map, &others.iter().map(|&j| &maps[j]).collect::<Vec<_>>(), step)
    };
    (0..maps.len()).into_par_iter().map(of).collect::<Vec<_>>().concat()
}

fn points_of(map: &DepthMap<'_>, others: &[&DepthMap<'_>], step: f64) -> Vec<Point> {
    let (width, height) = (map.view.width, map.view.height);
    let from_camera = map.pose.inverse();
    let needed = AGREEING.min(others.len().max(1));
    let mut points: Vec<Option<(DVec3, f64)>> = vec![None; width * height];
    for y in 0..height {
        for x in 0..width {
            points[y * width + x] = map.point(x, y, &from_camera).filter(|&(at, inverse)| {
                let agrees = |other: &&&DepthMap<'_>| {
                    other.compare(at).is_some_and(|(found, own)| (found - own).abs() < tolerance(inverse, step))
                };
                others.iter().filter(agrees).count() >= needed
            });
        }
    }
    let center = map.pose.camera_center();
    let mut list = Vec::new();
    for y in 0..height {
        for x in 0..width {
            let Some((at, inverse)) = points[y * width + x] else { continue };
            let near = |x: Option<usize>, y: Option<usize>| {
                let (x, y) = (x.filter(|&x| x < width)?, y.filter(|&y| y < height)?);
                points[y * width + x].filter(|p| (p.1 / inverse - 1.0).abs() < 0.05).map(|p| p.0)
            };
            let edge = |a: Option<DVec3>, b: Option<DVec3>| match (a, b) {
                (Some(a), Some(b)) => b - a,
                (Some(a), None) => at - a,
                (None, Some(b)) => b - at,
                (None, None) => DVec3::ZERO,
            };
            let across = edge(near(x.checked_sub(2), Some(y)), near(Some(x + 2), Some(y)));
            let down = edge(near(Some(x), y.checked_sub(2)), near(Some(x), Some(y + 2)));
            let normal = across.cross(down).normalize_or_zero();
            let normal = if normal.dot(center - at) < 0.0 { -normal } else { normal };
            list.push(Point { at, normal, rgb: map.view.rgb[y * width + x] });
        }
    }
    list
}

/// Points that share a voxel, as one.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Surfel {
    /// Where, metres.
    pub(crate) at: DVec3,
    /// Unit normal.
    pub(crate) normal: DVec3,
    /// 0–1.
    pub(crate) color: [f32; 3],
    /// Side of its voxel, metres.
    pub(crate) voxel: f64,
}

/// Side of the voxel at a place, metres.
pub(crate) type VoxelAt<'a> = &'a (dyn Fn(DVec3) -> f64 + Sync);

/// The means of points in each voxel that at least `hits` points fall in; `toward` is where cameras are.
///
/// The side that `voxel_at` gives is rounded to a power of ⁴√2 times `unit`, so that neighbours share a grid.
pub(crate) fn in_voxels(points: &[Point], voxel_at: VoxelAt<'_>, unit: f64, hits: usize, toward: DVec3) -> Vec<Surfel> {
    let key = |(i, p): (usize, &Point)| {
        let level = (4.0 * (voxel_at(p.at) / unit).log2()).round().clamp(-16.0, 80.0);
        let side = unit * (0.25 * level).exp2();
        let cell = (p.at / side).floor().clamp(DVec3::splat(-500_000.0), DVec3::splat(500_000.0));
        let [x, y, z] = cell.to_array().map(|v| (v + 524_288.0) as u64);
        ((level as i64 + 16) as u8, (z << 40) | (y << 20) | x, i as u32)
    };
    let mut keys: Vec<(u8, u64, u32)> =
        points.par_iter().enumerate().filter(|(_, p)| p.at.is_finite()).map(key).collect();
    keys.par_sort_unstable();
    let groups: Vec<&[(u8, u64, u32)]> = keys.chunk_by(|a, b| (a.0, a.1) == (b.0, b.1)).collect();
    let surfel = |group: &&[(u8, u64, u32)]| {
        let (mut at, mut normal, mut color) = (DVec3::ZERO, DVec3::ZERO, DVec3::ZERO);
        for &(.., i) in *group {
            let p = &points[i as usize];
            at += p.at;
            normal += p.normal;
            color += DVec3::from(p.rgb.map(f64::from));
        }
        let n = group.len() as f64;
        let at = at / n;
        let facing = (toward - at).normalize_or(DVec3::Z);
        let normal = normal.try_normalize().filter(|_| normal.length() > 0.2 * n).unwrap_or(facing);
        let color = (color / (255.0 * n)).to_array().map(|v| v as f32);
        let voxel = unit * (0.25 * (f64::from(group[0].0) - 16.0)).exp2();
        Surfel { at, normal, color, voxel }
    };
    groups.par_iter().filter(|g| g.len() >= hits).map(surfel).collect()
}

/// Leaves out surfels that more maps see through than agree with.
pub(crate) fn keep_opaque(surfels: &mut Vec<Surfel>, maps: &[DepthMap<'_>], step: f64) {
    let keep: Vec<bool> = surfels
        .par_iter()
        .map(|s| {
            let (mut agree, mut through) = (0, 0);
            for (found, own) in maps.iter().filter_map(|m| m.compare(s.at)) {
                let slack = 2.0 * tolerance(own, step);
                agree += usize::from((found - own).abs() < slack);
                through += usize::from(found < own - 2.0 * slack);
            }
            agree >= through
        })
        .collect();
    let mut keep = keep.into_iter();
    surfels.retain(|_| keep.next().unwrap_or(true));
}
