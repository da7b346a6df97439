//! Known answers: a textured plane and sphere, a face that moves by known AUs, a head that sways by known poses; and
//! data that say nothing.

use glam::{DMat3, DVec2, DVec3};
use risorius_formats::camera::Distortion;
use risorius_formats::{Camera, Intrinsics, Isometry};

use super::{Seed, StartSettings, StereoSettings, start};
use crate::scene::{Frame, Scene, rotation_from_vector};

/// AUs of the face.
const AUS: usize = 3;

/// Fewer views than in earnest.
fn settings() -> StartSettings {
    StartSettings { stereo: StereoSettings { head_views: 6, room_views: 8, ..StereoSettings::default() } }
}

struct Picture {
    camera: Camera,
    head: Isometry,
    rgb: Vec<u8>,
    labels: Option<Vec<u8>>,
    activations: Option<Vec<f32>>,
    landmarks: Option<[[f32; 2]; 68]>,
}

fn scene(pictures: &[Picture]) -> Scene<'_> {
    let frame = |p: &'_ Picture| -> (Camera, Isometry) { (p.camera, p.head) };
    let frames = pictures.iter().map(|p| {
        let (camera, room_from_head) = frame(p);
        Frame {
            camera,
            room_from_head,
            rgb: &p.rgb,
            valid: None,
            labels: p.labels.as_deref(),
            activations: p.activations.clone(),
            landmarks_px: p.landmarks,
        }
    });
    Scene {
        frames: frames.collect(),
        region_of: vec![0, 1, 2],
        also_in: Vec::new(),
        regions: 3,
        face_radius_m: 0.1,
        head_hull: None,
        plate: None,
        neutral_frame: 0,
    }
}

/// A number from 0 to 1 that looks random.
fn noise(n: u64) -> f64 {
    let mut x = n.wrapping_mul(0x9e37_79b9_7f4a_7c15) ^ 0x1234_5678_9abc_def1;
    x ^= x >> 29;
    x = x.wrapping_mul(0xbf58_476d_1ce4_e5b9);
    x ^= x >> 32;
    (x >> 11) as f64 / (1u64 << 53) as f64
}

/// A camera that looks at the origin from in front, `i` of `n` around, 0.5 m away.
fn camera(i: usize, n: usize) -> Camera {
    let a = 2.0 * std::f64::consts::PI * i as f64 / n as f64;
    let reach = 0.06 + 0.1 * noise(i as u64);
    let center = DVec3::new(reach * a.cos(), reach * a.sin(), -0.5);
    let z = -center.normalize();
    let x = DVec3::Y.cross(z).normalize();
    let rotation = DMat3::from_cols(x, z.cross(x), z).transpose();
    let intrinsics = Intrinsics::pinhole(160, 200, 340.0);
    Camera { intrinsics, camera_from_world: Isometry::new(rotation, -(rotation * center)) }
}

/// Blotches of some millimetres.
fn texture(p: DVec3) -> f64 {
    let wave = |f: f64, s: f64| (f * p.x + s).sin() * (f * p.y + 2.0 * s).sin() + (f * p.z + s).cos();
    (wave(210.0, 0.3) + wave(370.0, 1.1) + wave(640.0, 2.3)) / 12.0 + 0.5
}

/// Pictures of a sphere of 8 cm before a wall 0.6 m behind, or of the wall alone.
fn pictures(n: usize, sphere: bool, distortion: Distortion) -> Vec<Picture> {
    let of = |i: usize| {
        let mut camera = camera(i, n);
        camera.intrinsics.distortion = distortion;
        let center = camera.camera_from_world.camera_center();
        let mut rgb = Vec::new();
        for y in 0..camera.intrinsics.height {
            for x in 0..camera.intrinsics.width {
                let ideal = camera.intrinsics.unproject(DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5)).unwrap();
                let ray = (camera.camera_from_world.rotation.transpose() * ideal.extend(1.0)).normalize();
                let (b, c) = (center.dot(ray), center.length_squared() - 0.08 * 0.08);
                let hit = if sphere && b * b > c { -b - (b * b - c).sqrt() } else { (0.6 - center.z) / ray.z };
                let p = center + hit * ray;
                let scale = if p.z > 0.3 { 0.4 } else { 1.0 };
                rgb.extend([(255.0 * texture(p * scale).clamp(0.0, 1.0)) as u8; 3]);
            }
        }
        Picture { camera, head: Isometry::IDENTITY, rgb, labels: None, activations: None, landmarks: None }
    };
    (0..n).map(of).collect()
}

fn mean(seed: &Seed) -> DVec3 {
    DVec3::from(seed.mean.map(f64::from))
}

#[test]
fn a_sphere_before_a_wall_is_found_at_its_depth() {
    let pictures = pictures(24, true, Distortion::default());
    let found = start(&scene(&pictures), &settings(), &|_| {});
    let (near, far): (Vec<&Seed>, Vec<&Seed>) = found.seeds.iter().partition(|s| s.mean[2] < 0.3);
    assert!(near.len() > 800 && far.len() > 1500, "{} and {}", near.len(), far.len());
    let mut off: Vec<f64> = near.iter().map(|s| (mean(s).length() - 0.08).abs()).collect();
    off.sort_by(f64::total_cmp);
    assert!(off[off.len() / 2] < 0.001 && off[off.len() * 9 / 10] < 0.004, "{:?}", off[off.len() * 9 / 10]);
    let mut off: Vec<f64> = far.iter().map(|s| (f64::from(s.mean[2]) - 0.6).abs()).collect();
    off.sort_by(f64::total_cmp);
    assert!(off[off.len() / 2] < 0.01, "{}", off[off.len() / 2]);
    // Normals look out of the sphere, colours are those of its texture.
    let facing = near.iter().filter(|s| mean(s).normalize().dot(DVec3::from(s.normal.map(f64::from))) > 0.9).count();
    assert!(facing * 10 > near.len() * 8, "{facing} of {}", near.len());
    let close = near.iter().filter(|s| (f64::from(s.color[0]) - texture(mean(s))).abs() < 0.15).count();
    assert!(close * 10 > near.len() * 8, "{close} of {}", near.len());
    // The sphere is in the head, the wall is not.
    let of_head = near.iter().filter(|s| s.head_weight > 0.3).count();
    assert!(of_head * 20 > near.len() * 19, "{of_head} of {}", near.len());
    assert!(far.iter().all(|s| s.head_weight == 0.0));
}

#[test]
fn any_number_of_threads_and_a_distorted_lens_give_the_same_surface() {
    let bent = Distortion { radial: [-0.12, 0.05, 0.0], ..Distortion::default() };
    let pictures = pictures(16, true, bent);
    let scene = scene(&pictures);
    let run = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| start(&scene, &settings(), &|_| {}))
    };
    let found = run(1);
    assert_eq!(found, run(3));
    let mut off: Vec<f64> =
        found.seeds.iter().filter(|s| s.mean[2] < 0.3).map(|s| (mean(s).length() - 0.08).abs()).collect();
    off.sort_by(f64::total_cmp);
    assert!(off.len() > 600 && off[off.len() / 2] < 0.0015, "{} {:?}", off.len(), off.get(off.len() / 2));
}

/// Landmarks of a head: on an ellipsoid, in rows.
fn rest(l: usize) -> DVec3 {
    // The corners of eyes and mouth where a face has them, the rest spread.
    let (x, y) = match l {
        36..=41 => (-0.045 + 0.006 * (l - 36) as f64, -0.03 + 0.004 * ((l % 3) as f64 - 1.0)),
        42..=47 => (0.015 + 0.006 * (l - 42) as f64, -0.03 + 0.004 * ((l % 3) as f64 - 1.0)),
        48..=67 => {
            let a = 2.0 * std::f64::consts::PI * (l - 48) as f64 / 12.0;
            let size = if l < 60 { 1.0 } else { 0.8 };
            (-0.025 * size * a.cos(), 0.04 - 0.008 * size * a.sin())
        }
        _ => (0.14 * (noise(2 * l as u64) - 0.5), 0.16 * (noise(2 * l as u64 + 1) - 0.5)),
    };
    DVec3::new(x, y, 4.0 * (x * x + y * y) - if (27..36).contains(&l) { 0.03 } else { 0.01 })
}

/// What AU `k` does: the skull's landmarks stay.
fn delta(k: usize, l: usize) -> DVec3 {
    if super::rigid::SKULL.contains(&l) || l % AUS != k {
        return DVec3::ZERO;
    }
    let n = (l * AUS + k) as u64;
    0.01 * (DVec3::new(noise(n + 500), noise(n + 600), noise(n + 700)) - 0.5)
}

/// Tracked pictures without texture; `sway` is the head's pose at frame `i`.
fn tracked(n: usize, noise_px: f64, sway: impl Fn(usize) -> Isometry) -> Vec<Picture> {
    let of = |i: usize| {
        let camera = camera(i, 40);
        let a: Vec<f32> = (0..AUS).map(|k| (noise((i * AUS + k) as u64 + 9000) * 1.6 - 0.6).max(0.0) as f32).collect();
        let head = sway(i);
        let landmarks = std::array::from_fn(|l| {
            let at = rest(l) + (0..AUS).map(|k| delta(k, l) * f64::from(a[k])).sum::<DVec3>();
            let p = camera.project(head.transform_point(at));
            let jitter = |s: u64| noise_px * 3.46 * (noise((i * 136 + l * 2) as u64 + s * 77_777) - 0.5);
            [(p.x + jitter(1)) as f32, (p.y + jitter(2)) as f32]
        });
        Picture {
            camera,
            head: Isometry::IDENTITY,
            rgb: vec![120; 160 * 200 * 3],
            labels: Some(vec![3; 160 * 200]),
            activations: Some(a),
            landmarks: Some(landmarks),
        }
    };
    (0..n).map(of).collect()
}

#[test]
fn landmarks_tell_what_aus_do_and_outliers_do_not_matter() {
    let mut pictures = tracked(160, 0.2, |_| Isometry::IDENTITY);
    for (i, p) in pictures.iter_mut().enumerate() {
        let l = p.landmarks.as_mut().unwrap();
        match i % 16 {
            3 => l[i % 68] = [f32::NAN, 3.0],
            5 => l[i % 68] = [9.0, f32::INFINITY],
            7 => l[i % 68][0] += 60.0,
            9 => p.activations.as_mut().unwrap()[1] = f32::NAN,
            11 => p.activations = None,
            _ => {}
        }
    }
    let found = start(&scene(&pictures), &settings(), &|_| {});
    let motion = found.motion.unwrap();
    let error = |l: usize| (DVec3::from(motion.rest[l]) - rest(l)).length();
    let worst = (0..68).map(error).fold(0.0, f64::max);
    assert!(worst < 0.0012, "at rest {worst}");
    let off = |k: usize, l: usize| (DVec3::from(motion.deltas[k][l]) - delta(k, l)).length();
    let sum: f64 = (0..AUS).flat_map(|k| (0..68).map(move |l| (k, l))).map(|(k, l)| off(k, l)).sum();
    assert!(sum / (68.0 * 3.0) < 0.0006, "{sum}");
    assert!(motion.error_px < 0.5);
    // The head is still, and the mouth has an inside that is in order.
    assert!(found.head_poses.iter().all(|p| *p == Isometry::IDENTITY));
    let mouth = found.mouth.unwrap();
    assert_eq!(mouth.all().len(), 600);
    assert_eq!(mouth.all().end, found.seeds.len());
    assert!(mouth.follows_jaw(mouth.tongue.start) && !mouth.follows_jaw(mouth.darkness.start));
    let behind = |i: usize| f64::from(found.seeds[i].mean[2]) > rest(62).z;
    assert!(mouth.all().all(behind));
    // Without texture the face's shape comes from the landmarks.
    assert!(found.seeds.len() > 2000 && found.seeds.iter().any(|s| s.deformable));
}

#[test]
fn a_swaying_head_is_followed() {
    let sway = |i: usize| {
        let t = i as f64 * 0.1;
        let turn = DVec3::new(0.03 * (t * 1.3).sin(), 0.05 * t.cos(), 0.02 * (0.7 * t).sin());
        Isometry::new(rotation_from_vector(turn), DVec3::new(0.004 * (0.9 * t).sin(), 0.003 * t.cos(), 0.0))
    };
    let pictures = tracked(200, 0.15, sway);
    let found = start(&scene(&pictures), &settings(), &|_| {});
    // Up to one rigid motion for all frames.
    let (mut before, mut after) = (0.0, 0.0);
    let first = found.head_poses[0].inverse().compose(&sway(0));
    for (i, pose) in found.head_poses.iter().enumerate() {
        let gap = |p: &Isometry| {
            [0, 8, 30, 45].map(|l| (p.transform_point(rest(l)) - sway(i).transform_point(rest(l))).length())
        };
        before += gap(&Isometry::IDENTITY).iter().sum::<f64>();
        after += gap(&pose.compose(&first)).iter().sum::<f64>();
    }
    assert!(after < 0.3 * before, "{after} of {before}");
}

#[test]
fn what_says_nothing_gives_little_and_never_panics() {
    let settings = settings();
    let quiet = |_: &str| {};
    // Nothing at all.
    let none = start(&scene(&[]), &settings, &quiet);
    assert!(none.seeds.is_empty() && none.motion.is_none() && none.head_poses.is_empty());
    // One frame, and frames of a camera that never moves: the head's shape.
    let one = pictures(1, true, Distortion::default());
    let found = start(&scene(&one), &settings, &quiet);
    assert!(found.motion.is_none() && found.seeds.len() > 500);
    assert!(found.seeds.iter().all(|s| s.mean.iter().chain(&s.color).all(|v| v.is_finite())));
    let still: Vec<Picture> = (0..5).flat_map(|_| pictures(1, true, Distortion::default())).collect();
    assert!(start(&scene(&still), &settings, &quiet).seeds.len() > 500);
    // Cameras that are no cameras, pictures that are too short.
    let mut broken = tracked(30, 0.0, |_| Isometry::IDENTITY);
    for (i, p) in broken.iter_mut().enumerate() {
        match i % 4 {
            0 => p.camera.camera_from_world.translation = DVec3::NAN,
            1 => p.rgb.truncate(100),
            2 => p.camera.intrinsics.fx = f64::INFINITY,
            _ => p.landmarks = Some([[f32::NAN; 2]; 68]),
        }
    }
    let found = start(&scene(&broken), &settings, &quiet);
    assert!(found.seeds.iter().all(|s| s.mean.iter().chain(&s.normal).all(|v| v.is_finite())));
    assert_eq!(found.head_poses.len(), 30);
}
