use proptest::prelude::*;
use risorius_formats::nerfies::fill_polygon;

use super::*;

pub(crate) fn styles() -> Vec<RegionStyle> {
    [(Shape::Brow, "AU01"), (Shape::Eye, "AU05"), (Shape::Mouth, "AU10")]
        .into_iter()
        .zip(1..)
        .map(|((shape, name), label)| RegionStyle { shape, polygon_label: name.to_owned(), label })
        .collect()
}

/// A schematic face, 100 units wide, its middle at (0, 0).
pub(crate) fn face(scale: f32, cx: f32, cy: f32) -> Landmarks68 {
    let mut p = [[0.0f32; 2]; 68];
    for (k, q) in p.iter_mut().enumerate().take(17) {
        let a = std::f32::consts::PI * (1.0 - k as f32 / 16.0);
        *q = [50.0 * a.cos(), -5.0 + 60.0 * a.sin()];
    }
    for k in 0..5 {
        let lift = [0.0, 3.0, 5.0, 4.0, 2.0];
        p[17 + k] = [-38.0 + 7.0 * k as f32, -22.0 - lift[k]];
        p[26 - k] = [38.0 - 7.0 * k as f32, -22.0 - lift[k]];
    }
    for k in 0..4 {
        p[27 + k] = [0.0, -10.0 + 6.0 * k as f32];
    }
    for k in 0..5 {
        p[31 + k] = [-8.0 + 4.0 * k as f32, 12.0];
    }
    for (k, q) in
        [(0, [-9.0, 0.0]), (1, [-3.0, -3.0]), (2, [3.0, -3.0]), (3, [9.0, 0.0]), (4, [3.0, 2.0]), (5, [-3.0, 2.0])]
    {
        p[36 + k] = [-22.0 + q[0], -10.0 + q[1]];
        p[42 + k] = [22.0 + q[0], -10.0 + q[1]];
    }
    for k in 0..12 {
        let a = std::f32::consts::PI * (1.0 + k as f32 / 6.0);
        p[48 + k] = [18.0 * a.cos(), 28.0 + 8.0 * a.sin()];
    }
    for k in 0..8 {
        let a = std::f32::consts::PI * (1.0 + k as f32 / 4.0);
        p[60 + k] = [12.0 * a.cos(), 28.0 + 3.0 * a.sin()];
    }
    Landmarks68 { points_px: p.map(|[x, y]| [cx + scale * x, cy + scale * y]) }
}

/// The hull of all points, for comparison.
fn hull(points: &[Point]) -> Vec<Point> {
    let points: Vec<_> = points.iter().map(|&p| DVec2::from(p)).collect();
    risorius_formats::polygon::convex_hull(&points).iter().map(DVec2::to_array).collect()
}

#[test]
fn landmarks_lie_in_their_regions() {
    let face = face(4.0, 250.0, 240.0);
    let polygons = polygons(Some(&face), &styles(), 500, 520).unwrap();
    let image = label_image(&polygons, &styles(), 1, 500, 520);
    let at = |k: usize| image.get(face.points_px[k][0] as u32, face.points_px[k][1] as u32);
    assert!((17..27).all(|k| at(k) == 1), "brows");
    assert!((36..48).all(|k| at(k) == 2), "eyes");
    assert!((31..36).chain(48..68).all(|k| at(k) == 3), "nose base and mouth");
    assert_eq!(image.get(2, 2), 0);
    for label in 1..=3 {
        assert!(image.share(label) > 0.02, "{label}");
    }
}

#[test]
fn region_2_is_the_hull_without_the_other_two() {
    let face = face(4.0, 250.0, 240.0);
    let (w, h) = (500u32, 520u32);
    let polygons = polygons(Some(&face), &styles(), w, h).unwrap();
    let image = label_image(&polygons, &styles(), 1, w, h);
    let mid = &outline(Shape::Eye, &face)[..10];
    let others = [0usize, 1, 2, 3, 13, 14, 15, 16, 28].map(|k| face.points_px[k].map(f64::from));
    let all: Vec<Point> = mid.iter().copied().chain(others).collect();
    let mut expected = LabelImage::new(w, h);
    for (points, label) in [(hull(&all), 2u8), (outline(Shape::Brow, &face), 1), (outline(Shape::Mouth, &face), 3)] {
        fill_polygon(&points, w, h, |y, xs| {
            for x in xs {
                expected.labels[(y * w + x) as usize] = label;
            }
        });
    }
    let different = image.labels.iter().zip(&expected.labels).filter(|(a, b)| a != b).count();
    // Slivers along the rounded corners only.
    assert!(different < 100, "{different} pixels");
}

#[test]
fn reduced_label_images_are_the_same_regions() {
    let polygons = polygons(Some(&face(4.0, 250.0, 240.0)), &styles(), 504, 520).unwrap();
    let full = label_image(&polygons, &styles(), 1, 504, 520);
    let small = label_image(&polygons, &styles(), 4, 126, 130);
    for label in 0..=3 {
        assert!((full.share(label) - small.share(label)).abs() < 0.004, "{label}");
    }
}

#[test]
fn frames_are_rejected_for_their_reasons() {
    let check = |l: Option<&Landmarks68>| polygons(l, &styles(), 500, 520).map(|_| ());
    assert_eq!(check(None), Err(Rejection::NoLandmarks));
    assert_eq!(check(Some(&face(4.0, 100.0, 240.0))), Err(Rejection::OutsideFrame));
    assert_eq!(check(Some(&face(0.3, 250.0, 240.0))), Err(Rejection::TooSmall));
    let mut turned = face(4.0, 250.0, 240.0);
    // The nose bridge in front of the far cheek, as in a profile.
    turned.points_px[28][0] -= 230.0;
    assert_eq!(check(Some(&turned)), Err(Rejection::SelfIntersection));
    let mut broken = face(4.0, 250.0, 240.0);
    broken.points_px[8][1] = f32::INFINITY;
    assert_eq!(check(Some(&broken)), Err(Rejection::OutsideFrame));
    assert_eq!(check(Some(&face(4.0, 240.0, 240.0))), Ok(()));
}

#[test]
fn crossings_and_areas() {
    let square = [[0.0, 0.0], [4.0, 0.0], [4.0, 4.0], [0.0, 4.0]];
    assert!(!self_intersects(&square));
    assert_eq!(area(&square), 16.0);
    assert!(self_intersects(&[[0.0, 0.0], [4.0, 4.0], [4.0, 0.0], [0.0, 4.0]]));
    // A corner that touches another side.
    assert!(self_intersects(&[[0.0, 0.0], [4.0, 0.0], [4.0, 4.0], [2.0, 0.0], [0.0, 4.0]]));
    // Sides in one line that do not meet.
    assert!(!self_intersects(&[
        [0.0, 0.0],
        [1.0, 0.0],
        [1.0, 1.0],
        [2.0, 1.0],
        [2.0, 0.0],
        [3.0, 0.0],
        [3.0, 3.0],
        [0.0, 3.0]
    ]));
}

proptest! {
    #[test]
    fn polygons_of_usual_faces_hardly_overlap(noise in prop::collection::vec(-1.5f32..1.5, 136), scale in 2f32..5.0) {
        let mut face = face(scale, 260.0, 260.0);
        for (p, n) in face.points_px.iter_mut().flatten().zip(noise) {
            *p += n;
        }
        let (w, h) = (520u32, 560u32);
        if let Ok(polygons) = polygons(Some(&face), &styles(), w, h) {
            let mut count = vec![0u8; (w * h) as usize];
            for polygon in &polygons.polygons {
                fill_polygon(&polygon.points_px, w, h, |y, xs| xs.for_each(|x| count[(y * w + x) as usize] += 1));
            }
            let covered = count.iter().filter(|&&c| c > 0).count();
            let twice = count.iter().filter(|&&c| c > 1).count();
            prop_assert!((twice as f64) < 0.002 * covered as f64, "{} of {}", twice, covered);
        }
    }
}
