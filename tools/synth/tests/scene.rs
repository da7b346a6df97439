//! The scene against itself: determinism, landmarks on the face, and regions that leave each other alone.
#![expect(clippy::unwrap_used, reason = "a test fails by panicking")]

use std::sync::LazyLock;

use glam::{DVec2, DVec3};
use risorius_formats::au::OPENFACE_INTENSITIES;
use risorius_formats::{ActionUnit, Camera, Isometry, RegionTable};
use risorius_synth::{
    BROW_LABEL, EYE_LABEL, Expression, MOUTH_LABEL, Person, RenderedView, Scene, camera_at, driver_head, lens,
    openface_pose,
};

static SCENE: LazyLock<Scene> = LazyLock::new(|| Scene::new(Person::subject(1), 1));

fn camera(yaw_degrees: f64, pitch_degrees: f64) -> Camera {
    camera_at(
        lens(270, 480),
        yaw_degrees.to_radians(),
        pitch_degrees.to_radians(),
        0.55,
        DVec3::new(0.0, 0.002, 0.02),
        0.0,
    )
}

#[test]
fn the_same_scene_gives_the_same_bytes() {
    let (camera, expression) = (camera(17.0, -8.0), Expression::of(&[(12, 3.0), (26, 2.0), (1, 4.0)]));
    let first = SCENE.render(&camera, &expression);
    let again = Scene::new(Person::subject(1), 1);
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
    let second = pool.install(|| again.render(&camera, &expression));
    assert_eq!(first.rgb, second.rgb);
    assert_eq!(first.depth, second.depth);
    assert_eq!(first.labels, second.labels);
    let other = Scene::new(Person::subject(2), 1).render(&camera, &expression);
    assert_ne!(first.rgb, other.rgb, "the seed does nothing");
}

fn head_within(view: &RenderedView, pixel: DVec2, reach: i64) -> bool {
    let (width, height) = (i64::from(view.rgb.width()), i64::from(view.rgb.height()));
    let (x, y) = (pixel.x.floor() as i64, pixel.y.floor() as i64);
    (-reach..=reach).any(|dy| {
        (-reach..=reach).any(|dx| {
            let (x, y) = (x + dx, y + dy);
            (0..width).contains(&x) && (0..height).contains(&y) && view.head[(y * width + x) as usize]
        })
    })
}

/// The smallest depth around a pixel: a landmark on a lip's edge may round into the opening.
fn nearest_depth(view: &RenderedView, pixel: DVec2) -> f64 {
    let (x, y) = (pixel.x as usize, pixel.y as usize);
    let around = (y - 1..=y + 1).flat_map(|y| (x - 1..=x + 1).map(move |x| y * 270 + x));
    around.fold(f64::MAX, |m, i| m.min(f64::from(view.depth[i])))
}

#[test]
fn landmarks_lie_on_the_face() {
    for (yaw, pitch) in [(0.0, 0.0), (30.0, 12.0), (-30.0, -12.0), (15.0, -14.0)] {
        for expression in [
            Expression::NEUTRAL,
            Expression::of(&[(12, 5.0), (26, 5.0), (2, 5.0)]),
            Expression::of(&[(45, 5.0), (15, 4.0)]),
        ] {
            let camera = camera(yaw, pitch);
            let view = SCENE.render(&camera, &expression);
            for (i, point) in SCENE.landmarks(&expression).into_iter().enumerate() {
                let pixel = camera.project(point);
                assert!(head_within(&view, pixel, 1), "landmark {i} at {pixel} is off the head, {yaw}° {pitch}°");
                // Nothing but the head itself may stand before a landmark, and the landmark never before the head.
                let depth = nearest_depth(&view, pixel);
                let z = camera.camera_from_world.transform_point(point).z;
                assert!(z > depth - 0.008, "landmark {i} floats {} mm before the face", (depth - z) * 1000.0);
            }
        }
    }
}

#[test]
fn frontal_landmarks_are_where_the_picture_shows_them() {
    let camera = camera(0.0, 0.0);
    let view = SCENE.render(&camera, &Expression::NEUTRAL);
    let points = SCENE.landmarks(&Expression::NEUTRAL);
    for (i, point) in points.iter().enumerate().skip(17) {
        let pixel = camera.project(*point);
        let depth = f64::from(view.depth[pixel.y as usize * 270 + pixel.x as usize]);
        let z = camera.camera_from_world.transform_point(*point).z;
        assert!((z - depth).abs() < 0.006, "landmark {i} is {:.1} mm from the surface", (z - depth) * 1000.0);
    }
    // Image-left is the subject's right; OpenFace's order runs to the image's right.
    assert!(points[0].x < 0.0 && points[36].x < points[39].x && points[48].x < points[54].x);
    assert!(points[19].y > points[37].y && points[51].y > points[57].y && points[8].y < points[57].y);
}

fn label_of(unit: ActionUnit) -> u8 {
    RegionTable::paper().region_of(unit).unwrap() as u8 + 1
}

#[test]
fn every_au_changes_its_region_and_leaves_the_others_alone() {
    for (yaw, pitch) in [(0.0, 0.0), (28.0, -10.0)] {
        let camera = camera(yaw, pitch);
        let neutral = SCENE.render(&camera, &Expression::NEUTRAL);
        for unit in OPENFACE_INTENSITIES {
            let moved = SCENE.render(&camera, &Expression::NEUTRAL.with(unit, 5.0));
            let own = label_of(unit);
            let mut changed_inside = 0;
            for (i, (before, after)) in neutral.rgb.pixels().zip(moved.rgb.pixels()).enumerate() {
                let (was, is) = (neutral.labels.labels[i], moved.labels.labels[i]);
                let inside = was == own || is == own;
                if before != after {
                    changed_inside += usize::from(inside);
                    let other =
                        [BROW_LABEL, EYE_LABEL, MOUTH_LABEL].into_iter().any(|l| l != own && (was == l || is == l));
                    assert!(!other, "{unit} changes pixel {},{} of region {was}→{is}", i % 270, i / 270);
                }
            }
            assert!(changed_inside >= 20, "{unit} changes only {changed_inside} pixels of its region");
        }
    }
}

#[test]
fn aus_of_different_regions_add_up() {
    // With both, each region looks as it does with its own alone.
    let camera = camera(0.0, 0.0);
    let both = SCENE.render(&camera, &Expression::of(&[(2, 4.0), (12, 4.0)]));
    for (alone, label) in [(Expression::of(&[(2, 4.0)]), BROW_LABEL), (Expression::of(&[(12, 4.0)]), MOUTH_LABEL)] {
        let alone = SCENE.render(&camera, &alone);
        assert!(both.labels.share(label) > 0.02);
        let same = both.labels.labels.iter().enumerate().filter(|(_, l)| **l == label).all(|(i, _)| {
            let (x, y) = ((i % 270) as u32, (i / 270) as u32);
            both.rgb.get_pixel(x, y) == alone.rgb.get_pixel(x, y)
        });
        assert!(same, "region {label} depends on another region's AU");
    }
}

#[test]
fn the_head_pose_is_openfaces() {
    let straight = openface_pose(&camera(0.0, 0.0).camera_from_world, &Isometry::IDENTITY);
    assert!((straight.rotation - glam::DMat3::IDENTITY).abs_diff_eq(glam::DMat3::ZERO, 1e-12));
    assert!(straight.translation.z > 500.0 && straight.translation.x.abs() < 1e-9);
    let (camera, turned) = (camera(20.0, 5.0), driver_head(40, 180));
    let pose = openface_pose(&camera.camera_from_world, &turned);
    let scene = &*SCENE;
    for point in scene.landmarks(&Expression::NEUTRAL) {
        // The same point by the pose (OpenFace's axes, millimetres) and by camera and head.
        let by_pose = pose.transform_point(DVec3::new(point.x, -point.y, -point.z) * 1000.0);
        let pixel = camera.intrinsics.project(by_pose);
        let expected = camera.project(turned.transform_point(point));
        assert!((pixel - expected).length() < 1e-9);
    }
}
