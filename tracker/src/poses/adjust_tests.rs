use super::*;
use risorius_formats::camera::Distortion;

fn noise(seed: u64) -> f64 {
    let n = (seed + 1).wrapping_mul(0x9E37_79B9_7F4A_7C15);
    let n = (n ^ (n >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    ((n ^ (n >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB) >> 40) as f64 / f64::from(1u32 << 24) - 0.5
}

fn truth_lens() -> Intrinsics {
    let mut lens = Intrinsics::pinhole(640, 480, 700.0);
    (lens.cx, lens.cy) = (331.0, 236.0);
    lens.distortion = Distortion { radial: [-0.06, 0.02, 0.0], ..Distortion::default() };
    lens
}

/// An orbit of `count` cameras around a cloud, every camera turned differently about its axis.
fn scene(count: usize, noise_px: f64) -> Scene {
    let lens = truth_lens();
    let poses: Vec<Isometry> = (0..count)
        .map(|i| {
            let t = i as f64 / (count - 1) as f64 - 0.5;
            let turn = [0.3 * (9.0 * t).sin(), 0.9 * t, 0.1 * t, 0.0, 0.0, 0.0];
            Isometry::new(glam::DMat3::IDENTITY, DVec3::Z * 2.0).compose(&se3::exp(Twist::from_array(turn)))
        })
        .collect();
    let points: Vec<DVec3> =
        (0..150u64).map(|i| DVec3::new(noise(3 * i) * 1.2, noise(3 * i + 1) * 0.9, noise(3 * i + 2) * 1.6)).collect();
    let mut observations = Vec::new();
    for (k, point) in points.iter().enumerate() {
        for (f, pose) in poses.iter().enumerate() {
            let at = (k * 1000 + f) as u64 * 2;
            let shake = DVec2::new(noise(at), noise(at + 1)) * 3.46 * noise_px;
            let pixel = lens.project(pose.transform_point(*point)) + shake;
            if (0.0..640.0).contains(&pixel.x) && (0.0..480.0).contains(&pixel.y) {
                observations.push(Observation { frame: f, point: k, pixel });
            }
        }
    }
    Scene { lens, poses, points, observations }
}

fn shaken(mut scene: Scene) -> Scene {
    for (i, pose) in scene.poses.iter_mut().enumerate() {
        let twist = std::array::from_fn(|k| 0.01 * noise((i * 6 + k) as u64 + 99));
        *pose = se3::exp(Twist::from_array(twist)).compose(pose);
    }
    for (i, point) in scene.points.iter_mut().enumerate() {
        *point += DVec3::new(noise(i as u64 + 7), noise(i as u64 + 8), noise(i as u64 + 9)) * 0.03;
    }
    scene.lens = Intrinsics::pinhole(640, 480, 730.0);
    scene
}

#[test]
fn exact_pixels_give_back_the_lens_with_its_centre_and_distortion() {
    let mut scene = shaken(scene(12, 0.0));
    let outcome = scene.adjust(LensPrior([500.0, 50.0, 50.0, 1.0, 1.0]), 0.5, 60);
    let truth = truth_lens();
    // The weak priors pull a little.
    assert!(outcome.median_error_px < 1e-3, "{outcome:?}");
    assert!((scene.lens.fx - truth.fx).abs() < 0.2 && scene.lens.fx == scene.lens.fy, "{:?}", scene.lens);
    assert!((scene.lens.cx - truth.cx).abs() < 0.1 && (scene.lens.cy - truth.cy).abs() < 0.1, "{:?}", scene.lens);
    assert!((scene.lens.distortion.radial[0] + 0.06).abs() < 2e-3, "{:?}", scene.lens);
}

#[test]
fn what_is_held_stays_and_costs_pixels() {
    let mut held = shaken(scene(12, 0.0));
    let outcome = held.adjust(LensPrior([500.0, 0.0, 0.0, 1.0, 0.0]), 0.5, 60);
    assert_eq!((held.lens.cx, held.lens.cy, held.lens.distortion.radial[1]), (320.0, 240.0, 0.0));
    assert!(outcome.median_error_px > 0.01 && outcome.lens_sigma[1] == 0.0 && outcome.lens_sigma[0] > 0.0);
}

#[test]
fn deviations_tell_how_far_the_lens_is_off() {
    let mut scene = shaken(scene(12, 0.4));
    // A tenth of all observations are wild.
    for (i, o) in scene.observations.iter_mut().enumerate().filter(|(i, _)| i % 10 == 3) {
        o.pixel += DVec2::new(20.0, 30.0 * noise(i as u64));
    }
    let outcome = scene.adjust(LensPrior([500.0, 50.0, 50.0, 1.0, 1.0]), 0.4, 60);
    let (found, truth) = (numbers(&scene.lens), numbers(&truth_lens()));
    for k in 0..LENS {
        let off = (found[k] - truth[k]).abs() / outcome.lens_sigma[k];
        assert!(off < 6.0, "{k}: {} for {}, {off} deviations", found[k], truth[k]);
    }
    assert!(outcome.lens_sigma[1] < 3.0, "{outcome:?}");
}

#[test]
fn the_reduced_system_is_the_schur_complement_of_the_whole_one() {
    // The slow twin: the whole system, points included, built from numerical derivatives.
    let scene = Scene { observations: scene(4, 0.3).observations, ..shaken(scene(4, 0.3)) };
    let few = 6;
    let scene = Scene {
        points: scene.points[..few].to_vec(),
        observations: scene.observations.iter().filter(|o| o.point < few).copied().collect(),
        ..scene
    };
    let start = Start {
        lens: numbers(&scene.lens),
        poses: scene.poses.clone(),
        pose_sigma: scene.pose_sigma(),
        prior: LensPrior([500.0, 50.0, 50.0, 1.0, 1.0]),
        sigma_px: 0.5,
        ranges: scene.ranges(),
    };
    let cameras = 6 * 4 + LENS;
    let all = cameras + 3 * few;
    let moved = |k: usize, h: f64| {
        let mut s = scene.clone();
        if k < 24 {
            let mut t = [0.0; 6];
            t[k % 6] = h;
            s.poses[k / 6] = se3::exp(Twist::from_array(t)).compose(&s.poses[k / 6]);
        } else if k < cameras {
            let mut t = [0.0; LENS];
            t[k - 24] = h;
            s.lens = with_step(&s.lens, &t);
        } else {
            s.points[(k - cameras) / 3][(k - cameras) % 3] += h;
        }
        s
    };
    let residuals = |s: &Scene| -> Vec<f64> {
        s.observations
            .iter()
            .flat_map(|o| {
                let d = (s.lens.project(s.poses[o.frame].transform_point(s.points[o.point])) - o.pixel) / 0.5;
                [d.x, d.y]
            })
            .collect()
    };
    let base = residuals(&scene);
    let mut j = DMatrix::<f64>::zeros(base.len(), all);
    for k in 0..all {
        let h = if (24..27).contains(&k) { 1e-3 } else { 1e-6 };
        let (a, b) = (residuals(&moved(k, h)), residuals(&moved(k, -h)));
        for (row, (a, b)) in a.iter().zip(&b).enumerate() {
            let r2 = base[row - row % 2].powi(2) + base[row - row % 2 + 1].powi(2);
            let weight = 1.0 / (1.0 + r2 / (CAUCHY * CAUCHY));
            j[(row, k)] = (a - b) / (2.0 * h) * weight.sqrt();
        }
    }
    let h = j.transpose() * &j;
    let (a, b) = (h.view((0, 0), (cameras, cameras)).clone_owned(), h.view((0, cameras), (cameras, 3 * few)));
    let v = h.view((cameras, cameras), (3 * few, 3 * few)).clone_owned() + DMatrix::identity(3 * few, 3 * few) * 1e-9;
    let slow = a - b * v.try_inverse().unwrap() * b.transpose();
    let mut fast = scene.reduced(&start, 0.0).0;
    for i in 0..4 {
        for k in 0..6 {
            fast[(6 * i + k, 6 * i + k)] -= start.pose_sigma[k].powi(-2);
        }
    }
    for k in 0..LENS {
        fast[(24 + k, 24 + k)] -= start.prior.0[k].powi(-2);
    }
    // Each number in its own scale.
    for i in 0..cameras {
        for k in 0..cameras {
            let scale = (h[(i, i)] * h[(k, k)]).sqrt();
            assert!((fast[(i, k)] - slow[(i, k)]).abs() < 1e-5 * scale, "{i} {k}: {} {}", fast[(i, k)], slow[(i, k)]);
        }
    }
}
