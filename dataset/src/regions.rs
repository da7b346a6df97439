//! Region masks from landmarks: brows and forehead, eyes and cheeks, mouth and lower face (paper §III-B, figure 3;
//! geometry: fact sheet §6.3).
//!
//! With brow points `b`, the eye points `e` below them and the mid-points `m` between, region 1 lies between `m` and
//! `t = b + λ (b − m)`, region 3 is the jaw up to the nose bridge, and region 2 is what lies between the two.

use glam::{DVec2, DVec3};
use risorius_formats::mask::LabelImage;
use risorius_formats::nerfies::{Polygon, Polygons};
use risorius_formats::{Camera, Landmarks68};

/// How far region 1 reaches above the brow, in distances from the mid-point to the brow.
pub const LAMBDA: f64 = 1.0;
/// How far region 1 reaches beyond the ends of the brows, in brow lengths.
pub const EPSILON: f64 = 0.25;
/// A region below this share of the frame is no region.
pub const MIN_AREA_SHARE: f64 = 0.001;
/// Landmarks may leave the frame by this share of its side.
pub const MAX_OUTSIDE_SHARE: f64 = 0.1;

/// Beyond this yaw the far side of the face is out of sight and its outline slides along the contour, degrees.
pub const MAX_YAW_DEG: f64 = 60.0;
/// Landmarks farther than this from the projected mean face (median, in projected outer-eye distances) are elsewhere.
pub const MAX_OFF_FACE: f64 = 0.35;

/// The brow points from image left to image right.
const BROWS: [usize; 10] = [17, 18, 19, 20, 21, 22, 23, 24, 25, 26];
/// The eye points below them; a pair stands for its middle.
const EYES: [(usize, usize); 10] =
    [(36, 36), (37, 37), (37, 38), (38, 38), (39, 39), (42, 42), (43, 43), (43, 44), (44, 44), (45, 45)];

type Point = [f64; 2];

/// The kinds of region that landmarks can outline.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Shape {
    /// Region 1: brows and forehead.
    Brow,
    /// Region 2: eyes, nose root, cheeks.
    Eye,
    /// Region 3: mouth and lower face.
    Mouth,
}

impl Shape {
    /// The shape that a region's name stands for.
    pub fn from_name(name: &str) -> Option<Self> {
        match name {
            "brow" => Some(Self::Brow),
            "eye" => Some(Self::Eye),
            "mouth" => Some(Self::Mouth),
            _ => None,
        }
    }

    /// Where two shapes claim a pixel the larger number wins: mouth before brow before eye.
    fn strength(self) -> u8 {
        match self {
            Self::Eye => 0,
            Self::Brow => 1,
            Self::Mouth => 2,
        }
    }
}

/// One region of a dataset: where it is and what it is called in the polygon files.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RegionStyle {
    /// Its outline.
    pub shape: Shape,
    /// The name of its polygons: the group's first AU.
    pub polygon_label: String,
    /// Its label in label images.
    pub label: u8,
}

/// Why a frame has no region masks.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Rejection {
    /// The table has no landmarks for the frame.
    NoLandmarks,
    /// A landmark is farther outside the frame than [`MAX_OUTSIDE_SHARE`].
    OutsideFrame,
    /// An outline crosses itself: the face is turned too far.
    SelfIntersection,
    /// A region covers less than [`MIN_AREA_SHARE`] of the frame.
    TooSmall,
    /// The camera stands beyond [`MAX_YAW_DEG`] at the side of the face.
    TurnedAway,
    /// The landmarks are not where the camera sees the face: the tracker was on something else, or the pose is wrong.
    OffFace,
}

impl Rejection {
    /// A short, stable name.
    pub fn name(self) -> &'static str {
        match self {
            Self::NoLandmarks => "no-landmarks",
            Self::OutsideFrame => "outside-frame",
            Self::SelfIntersection => "self-intersection",
            Self::TooSmall => "too-small",
            Self::TurnedAway => "turned-away",
            Self::OffFace => "off-face",
        }
    }
}

/// The outline of `shape`, pixels of the full-size frame.
pub fn outline(shape: Shape, landmarks: &Landmarks68) -> Vec<Point> {
    let l = |k: usize| landmarks.points_px[k].map(f64::from);
    let eye = |(a, b): (usize, usize)| middle(l(a), l(b));
    let brow: Vec<Point> = BROWS.iter().map(|&k| l(k)).collect();
    let mut mid: Vec<Point> = BROWS.iter().zip(EYES).map(|(&k, e)| middle(l(k), eye(e))).collect();
    let mut top: Vec<Point> = brow.iter().zip(&mid).map(|(&b, &m)| along(m, b, 1.0 + LAMBDA)).collect();
    for (outer, inner) in [(0, 4), (9, 5)] {
        let shift = [EPSILON * (brow[outer][0] - brow[inner][0]), EPSILON * (brow[outer][1] - brow[inner][1])];
        for points in [&mut mid, &mut top] {
            points[outer] = [points[outer][0] + shift[0], points[outer][1] + shift[1]];
        }
    }
    match shape {
        Shape::Brow => top.into_iter().chain(mid.into_iter().rev()).collect(),
        Shape::Mouth => (3..=13).chain([28]).map(l).collect(),
        Shape::Eye => {
            // The hull of all points without regions 1 and 3, as one ring: along the mid-points, down the convex side
            // of the face, over the nose bridge, up the other side.
            let right = hull_chain(mid[9], &[16, 15, 14].map(l), l(13));
            let left = hull_chain(l(3), &[2, 1, 0].map(l), mid[0]);
            mid.into_iter().chain(right).chain([l(13), l(28), l(3)]).chain(left).collect()
        }
    }
}

/// The corners strictly between `from` and `to` of the hull's chain over `points`, which lies left of the way from
/// `from` to `to` as seen on the screen (y down): outside the face when going clockwise.
fn hull_chain(from: Point, points: &[Point], to: Point) -> Vec<Point> {
    let mut chain = vec![from];
    for &p in points.iter().chain([&to]) {
        while chain.len() >= 2 && cross(chain[chain.len() - 2], chain[chain.len() - 1], p) <= 0.0 {
            chain.pop();
        }
        chain.push(p);
    }
    chain[1..chain.len() - 1].to_vec()
}

fn middle(a: Point, b: Point) -> Point {
    along(a, b, 0.5)
}

fn along(a: Point, b: Point, t: f64) -> Point {
    [a[0] + t * (b[0] - a[0]), a[1] + t * (b[1] - a[1])]
}

/// Positive where a, b, c turn clockwise on the screen (y down).
fn cross(a: Point, b: Point, c: Point) -> f64 {
    (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
}

/// Whether two sides of the closed polygon that share no corner touch or cross.
pub fn self_intersects(points: &[Point]) -> bool {
    let n = points.len();
    let side = |i: usize| (points[i], points[(i + 1) % n]);
    (0..n).any(|i| {
        (i + 2..n).filter(|&j| (j + 1) % n != i).any(|j| {
            let ((a, b), (c, d)) = (side(i), side(j));
            let (s1, s2) = (cross(a, b, c), cross(a, b, d));
            let (s3, s4) = (cross(c, d, a), cross(c, d, b));
            s1 * s2 <= 0.0
                && s3 * s4 <= 0.0
                && !(s1 == 0.0 && s2 == 0.0 && s3 == 0.0 && s4 == 0.0 && !overlap(a, b, c, d))
        })
    })
}

/// Whether the boxes of two collinear sides meet.
fn overlap(a: Point, b: Point, c: Point, d: Point) -> bool {
    (0..2).all(|k| a[k].min(b[k]) <= c[k].max(d[k]) && c[k].min(d[k]) <= a[k].max(b[k]))
}

/// The area of the closed polygon, square pixels (shoelace formula).
pub fn area(points: &[Point]) -> f64 {
    let n = points.len();
    let twice: f64 = (0..n).map(|i| (points[i], points[(i + 1) % n])).map(|(a, b)| a[0] * b[1] - a[1] * b[0]).sum();
    twice.abs() * 0.5
}

/// The outlines of all regions of a frame of `width` × `height` pixels, or why there are none.
pub fn polygons(
    landmarks: Option<&Landmarks68>,
    styles: &[RegionStyle],
    width: u32,
    height: u32,
) -> Result<Polygons, Rejection> {
    let landmarks = landmarks.ok_or(Rejection::NoLandmarks)?;
    let [left, top, right, bottom] = landmarks.bounds_px().map(f64::from);
    let (w, h) = (f64::from(width), f64::from(height));
    let (mx, my) = (MAX_OUTSIDE_SHARE * w, MAX_OUTSIDE_SHARE * h);
    // A box does not see a single point that is no number, and neither does the area.
    if !(landmarks.is_finite() && left >= -mx && top >= -my && right <= w + mx && bottom <= h + my) {
        return Err(Rejection::OutsideFrame);
    }
    let mut result = Vec::with_capacity(styles.len());
    for style in styles {
        // Hundredths of a pixel: what is painted is exactly what the file says.
        let points: Vec<Point> =
            outline(style.shape, landmarks).into_iter().map(|p| p.map(|v| (v * 100.0).round() / 100.0)).collect();
        if self_intersects(&points) {
            return Err(Rejection::SelfIntersection);
        }
        if area(&points) < MIN_AREA_SHARE * w * h {
            return Err(Rejection::TooSmall);
        }
        result.push(Polygon { label: style.polygon_label.clone(), points_px: points });
    }
    Ok(Polygons { polygons: result, image_path: None, image_size: Some([width, height]) })
}

/// Whether landmarks and camera agree on where the face is and that it can be seen.
///
/// `face_in_world`: the triangulated mean face, 68 points; `view_deg`: yaw and pitch of the camera. What is not known is
/// not checked.
pub fn check_view(
    landmarks: Option<&Landmarks68>,
    face_in_world: &[DVec3],
    camera: &Camera,
    view_deg: Option<[f64; 2]>,
) -> Result<(), Rejection> {
    let (Some(landmarks), 68) = (landmarks, face_in_world.len()) else { return Ok(()) };
    if view_deg.is_some_and(|[yaw, _]| yaw.abs() > MAX_YAW_DEG) {
        return Err(Rejection::TurnedAway);
    }
    let projected: Vec<DVec2> = face_in_world.iter().map(|&p| camera.project(p)).collect();
    let eyes = projected[36].distance(projected[45]);
    let mut away: Vec<f64> = projected
        .iter()
        .zip(&landmarks.points_px)
        .map(|(p, l)| p.distance(DVec2::new(f64::from(l[0]), f64::from(l[1]))))
        .collect();
    away.sort_unstable_by(f64::total_cmp);
    // The median: an open mouth moves its own points far, and nothing else. Written so that a NaN is off.
    if away[34] <= MAX_OFF_FACE * eyes { Ok(()) } else { Err(Rejection::OffFace) }
}

/// The label image of `polygons` at `1/divisor` of a `width` × `height` frame: a partition, mouth before brow before eye.
pub fn label_image(polygons: &Polygons, styles: &[RegionStyle], divisor: u32, width: u32, height: u32) -> LabelImage {
    let mut order: Vec<_> = styles.iter().collect();
    order.sort_by_key(|s| s.shape.strength());
    let paint: Vec<_> = order.iter().map(|s| (s.polygon_label.as_str(), s.label)).collect();
    polygons.label_image(&paint, divisor, width, height)
}

#[cfg(test)]
#[path = "regions_tests.rs"]
mod tests;
