//! Poison through `risorius-trainer` and `risorius-splat`: sampling, encodings, networks, rendering, losses, the SE(3)
//! exponential, scores, paths and whole pictures of Gaussians.

use burn::tensor::{Device, Tensor, TensorData};
use glam::{DMat3, DVec2, DVec3};
use image::RgbImage;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng as _;
use risorius_formats::{Camera, Intrinsics, Isometry};
use risorius_splat::model::{LANES, channel};
use risorius_splat::{Gaussians, Outputs, Renderer, Skips};
use risorius_trainer::config::Spacing;
use risorius_trainer::eval::{icc, ms_ssim, mse, psnr_from_mse, ssim_map};
use risorius_trainer::kernel::{self, MlpSpec, Products};
use risorius_trainer::path::{self, Orbit};
use risorius_trainer::schedule::Schedule;
use risorius_trainer::{encoding, loss, sampling, se3, volume};

use crate::support::{Ledger, POISON, POISON_32, Verdict, block, check, finite, finite_32};

fn tensor<const D: usize>(values: &[f32], shape: [usize; D]) -> Tensor<D> {
    Tensor::from_data(TensorData::new(values.to_vec(), shape), &Device::flex())
}

fn host<const D: usize>(t: Tensor<D>) -> Vec<f32> {
    t.into_data().try_to_vec::<f32>().unwrap()
}

#[test]
fn samples_lie_where_they_may() {
    let mut ledger = Ledger::default();
    ledger.poke_32("sampling::importance", [0.1, 0.7, 0.2], |weights| {
        let bins = [0.0, 1.0, 2.0, 4.0];
        for random in [false, true] {
            let mut out = Vec::new();
            let mut rng = ChaCha8Rng::seed_from_u64(1);
            sampling::importance(&mut out, &bins, &weights, 16, random.then_some(&mut rng));
            check(out.iter().all(|z| (0.0..=4.0).contains(z)), || format!("{out:?}"))?;
        }
        Ok(())
    });
    ledger.poke_32("sampling::union", [0.1, 0.7, 0.2, 0.0], |weights| {
        let mut out = Vec::new();
        sampling::union(&mut out, &[1.0, 2.0, 3.0, 4.0], &weights, 8, None::<&mut ChaCha8Rng>);
        check(out.len() == 12 && out.is_sorted(), || format!("{out:?}"))
    });
    for samples in [0, 1, 2, 3, 64] {
        for spacing in [Spacing::Depth, Spacing::Disparity] {
            ledger.one("sampling::stratified", &format!("{samples} samples"), || {
                let mut out = Vec::new();
                sampling::stratified(&mut out, samples, 0.5, 4.0, spacing, None::<&mut ChaCha8Rng>);
                check(out.iter().all(|z| (0.49..=4.01).contains(z)), || format!("{out:?}"))
            });
        }
    }
    for spacing in [Spacing::Depth, Spacing::Disparity] {
        ledger.poke_32("sampling::stratified", [0.5, 4.0], |[near, far]| {
            let mut out = Vec::new();
            let mut rng = ChaCha8Rng::seed_from_u64(1);
            sampling::stratified(&mut out, 16, near, far, spacing, Some(&mut rng));
            let sound = 1e-19 < near && near < far && far < 1e19;
            if sound {
                finite_32(out.iter().copied()).and(check(out.is_sorted(), || format!("{out:?}")))
            } else {
                Ok(())
            }
        });
    }
    ledger.poke("encoding::window", [2.5], |[a]| {
        let w = encoding::window(6, a);
        if a.is_nan() { Ok(()) } else { check(w.iter().all(|v| (0.0..=1.0).contains(v)), || format!("{w:?}")) }
    });
    for step in [0, 1, 2, 999, 1000, 1001, u64::MAX] {
        for schedule in [
            Schedule::Constant { value: 0.5 },
            Schedule::Exponential { from: 1e-3, to: 0.0, steps: 1000 },
            Schedule::Exponential { from: 1e-3, to: 1e-4, steps: 0 },
            Schedule::Ramp { delay: 1000, from: 0.0, to: 1.0, steps: 0 },
            Schedule::Ramp { delay: u64::MAX, from: 0.0, to: 1.0, steps: u64::MAX },
        ] {
            ledger.one("schedule::at", &format!("{schedule:?} at {step}"), || {
                finite([schedule.at(step), schedule.stretched(1e-9).at(step), schedule.stretched(1e9).at(step)])
            });
        }
    }
    ledger.close("sampling");
}

#[test]
fn tensors_keep_poison_in_its_own_row_or_lose_it_to_a_bound() {
    let mut ledger = Ledger::default();
    let device = Device::flex();
    // Two rows: the poison in the first must not touch the second.
    let sound_row = [0.3f32, 0.4, 0.5];
    let alone = |w: [f32; 3], v: [f32; 3]| {
        host(se3::transform(&tensor(&w, [1, 3]), &tensor(&v, [1, 3]), tensor(&sound_row, [1, 3])))
    };
    let expected = alone([0.1, 0.2, -0.1], [0.0, 0.1, 0.0]);
    ledger.poke_32("se3::transform", [0.4, -0.3, 0.2, 0.1, -0.2, 0.05], |a| {
        let w = tensor(&[a[0], a[1], a[2], 0.1, 0.2, -0.1], [2, 3]);
        let v = tensor(&[a[3], a[4], a[5], 0.0, 0.1, 0.0], [2, 3]);
        let out = host(se3::transform(&w, &v, tensor(&[0.3, 0.4, 0.5, 0.3, 0.4, 0.5], [2, 3])));
        check(out[3..] == expected[..], || format!("the other row became {:?}", &out[3..]))?;
        let sound = a.iter().all(|v| v.is_finite() && v.abs() < 1e15);
        if sound { finite_32(out) } else { Ok(()) }
    });
    for scale in [0.0f32, 1e-38, 1e-20, 1e-8, 1e-3, 0.0999, 0.1001, 1.0, 3.15, 100.0, 1e4] {
        ledger.one("se3::transform, gradient", &scale.to_string(), || {
            let device = device.clone().autodiff();
            let w: Tensor<2> =
                Tensor::from_data(TensorData::new(vec![scale, -scale, scale], [1, 3]), &device).require_grad();
            let v: Tensor<2> = Tensor::from_data(TensorData::new(vec![scale; 3], [1, 3]), &device).require_grad();
            let x = Tensor::from_data(TensorData::new(sound_row.to_vec(), [1, 3]), &device);
            let grads = se3::transform(&w, &v, x).sum().backward();
            finite_32(host(w.grad(&grads).unwrap()).into_iter().chain(host(v.grad(&grads).unwrap())))
        });
    }
    ledger.poke_32("kernel::composite and volume::weights", [0.5, 1.0, 2.0, 0.1, 0.1, 1e10], |a| {
        let sigma = [a[0], a[1], a[2]].map(|v| if v < 0.0 { -v } else { v });
        let deltas = [a[3], a[4], a[5]].map(|v| if v < 0.0 { -v } else { v });
        let values = [0.1f32, 0.2, 0.3];
        let (out, weights) =
            kernel::composite(tensor(&sigma, [1, 3]), tensor(&deltas, [1, 3]), tensor(&values, [1, 3, 1]));
        let own = host(volume::weights(tensor(&sigma, [1, 3]), tensor(&deltas, [1, 3])));
        let (out, weights) = (host(out), host(weights));
        let sound = sigma.iter().chain(&deltas).all(|v| v.is_finite())
            && sigma.iter().zip(&deltas).all(|(s, d)| (s * d).is_finite());
        if !sound {
            return Ok(());
        }
        finite_32(out.iter().chain(&weights).chain(&own).copied())?;
        let sum: f32 = weights.iter().sum();
        check((0.0..=1.0001).contains(&sum) && weights.iter().all(|w| (0.0..=1.0).contains(w)), || {
            format!("{weights:?}")
        })
    });
    ledger.poke_32("kernel::positional_encoding", [0.3, -0.7], |a| {
        let out = host(kernel::positional_encoding(tensor(&[a[0], a[1], 0.1, 0.2], [2, 2]), 0..8, &[1.0; 8], false));
        let width = out.len() / 2;
        finite_32(out[width..].iter().copied())?;
        for (i, v) in out[..width].iter().enumerate() {
            let from = a[i % 2];
            // 2^7 x has to be a number that a sine can be told of.
            if from.is_finite() && from.abs() < 1e4 {
                check(v.abs() <= 1.0 + 1e-6, || format!("{v} of {from}"))?;
            } else {
                check(v.is_nan() || v.abs() <= 1.0 + 1e-6, || format!("{v} of {from}"))?;
            }
        }
        Ok(())
    });
    let spec = MlpSpec { depth: 2, width: 8, skip: None, output: Some(2), products: Products::F32 };
    let params: Vec<f32> = (0..spec.parameter_count(3)).map(|i| ((i * 37 % 19) as f32 - 9.0) * 0.05).collect();
    let pure = host(kernel::mlp_forward(tensor(&[0.1, 0.2, 0.3], [1, 3]), tensor(&params, [params.len()]), &spec));
    ledger.poke_32("kernel::mlp_forward", [0.1, -0.2, 0.3], |a| {
        let x = tensor(&[a[0], a[1], a[2], 0.1, 0.2, 0.3], [2, 3]);
        let out = host(kernel::mlp_forward(x, tensor(&params, [params.len()]), &spec));
        check(out[2..].iter().zip(&pure).all(|(a, b)| (a - b).abs() < 1e-6), || "the other row changed".into())
    });
    ledger.poke_32("loss::focal", [2.0, 1.0], |[z, y]| {
        let out = host(loss::focal(tensor(&[z], [1, 1]), tensor(&[y], [1, 1])));
        let sound = z.is_finite() && z.abs() < 1e30 && (0.0..=1.0).contains(&y);
        if sound { finite_32(out.iter().copied()).and(check(out[0] >= 0.0, || format!("{out:?}"))) } else { Ok(()) }
    });
    let counts = |attributes| loss::Counts { rays: 1.0, masks: 0.0, attributes };
    ledger.poke_32("loss::attribute", [0.5, -0.5, 1.0], |[alpha, truth, beta]| {
        let out = host(loss::attribute(
            tensor(&[alpha], [1, 1]),
            tensor(&[truth], [1, 1]),
            tensor(&[beta], [1, 1]),
            tensor(&[1.0], [1, 1]),
            counts(1.0),
        ));
        let sound = [alpha, truth, beta].iter().all(|v| v.is_finite() && v.abs() < 1e15);
        if sound { finite_32(out) } else { Ok(()) }
    });
    ledger.one("loss::attribute", "nothing given", || {
        let t = |v: f32| tensor(&[v], [1, 1]);
        check(host(loss::attribute(t(0.5), t(0.0), t(1.0), t(0.0), counts(0.0))) == [0.0], || "not 0".into())
    });
    ledger.close("tensors");
}

#[test]
fn scores_and_paths_are_numbers_or_none() {
    let mut ledger = Ledger::default();
    ledger.poke("eval::icc", [1.0, 2.0, 3.0], |a| {
        let ratings: Vec<Vec<f64>> = vec![vec![a[0], a[1]], vec![2.0, a[2]], vec![4.0, 4.5], vec![3.0, 3.1]];
        let pairs: Vec<[f64; 2]> = ratings.iter().map(|r| [r[0], r[1]]).collect();
        finite(icc::correlation(&pairs))?;
        let Some(i) = icc::icc(&ratings) else { return Ok(()) };
        finite([i.icc_1_1, i.icc_2_1, i.icc_3_1]).and(check(i.icc_3_1 <= 1.0 + 1e-9, || format!("{i:?}")))
    });
    for (name, v) in POISON {
        ledger.one("eval::icc, all alike", name, || {
            check(icc::icc(&vec![vec![v, v]; 5]).is_none() && icc::correlation(&[[v, v]; 5]).is_none(), || {
                "found".into()
            })
        });
        ledger.one("eval::icc, far from 0", name, || {
            // The same agreement wherever the scale begins.
            if !(v.is_finite() && v.abs() < 1e9) {
                return Ok(());
            }
            let rated = |offset: f64| {
                let rows: Vec<Vec<f64>> =
                    (0..8).map(f64::from).map(|i| vec![offset + i, offset + i + 0.3 * (i * 2.0).sin()]).collect();
                icc::icc(&rows).map(|i| i.icc_3_1)
            };
            let (here, there) = (rated(0.0).unwrap(), rated(v + 1e6).unwrap());
            check((here - there).abs() < 1e-6, || format!("{here} and {there}"))
        });
    }
    ledger.poke("eval::psnr_from_mse", [0.01], |[v]| {
        let db = psnr_from_mse(v);
        check(db.is_nan() == v.is_nan() && (db.is_nan() || db <= 100.0), || db.to_string())
    });
    for (w, h) in [(0, 0), (1, 1), (10, 11), (11, 11), (11, 500), (176, 176)] {
        ledger.one("eval::ms_ssim, ssim_map, mse", &format!("{w}×{h}"), || {
            let (black, white) = (RgbImage::new(w, h), RgbImage::from_pixel(w, h, image::Rgb([255; 3])));
            for (a, b) in [(&black, &black), (&black, &white), (&white, &white)] {
                finite(ms_ssim(a, b).map(|m| m.value).into_iter().chain(mse(a, b)))?;
                finite(ssim_map(a, b).iter().flat_map(|m| m.values.iter().copied()))?;
            }
            Ok(())
        });
    }
    let reference = Camera {
        intrinsics: Intrinsics::pinhole(64, 48, 80.0),
        camera_from_world: Isometry::new(DMat3::from_rotation_y(0.3), DVec3::new(0.1, -0.2, 2.0)),
    };
    ledger.poke("path::Orbit", [10.0, 5.0, 1.2, 0.1, -0.1], |a| {
        let camera = Orbit::from_array(a).bounded().camera(&reference, DVec3::new(0.05, 0.1, 0.0));
        finite(camera.center().to_array())?;
        check(camera.ray_direction(DVec2::new(3.0, 4.0)).is_some(), || "no ray".into())
    });
    ledger.poke("path::spread, orbit, spiral", [0.05, 0.1, 0.0], |a| {
        // Also with the camera in the middle of the head.
        let center = DVec3::from(a);
        let inside = Camera { camera_from_world: Isometry::new(DMat3::IDENTITY, -center), ..reference };
        let spread = path::spread(&reference, &[reference, inside], center);
        let sound = a.iter().all(|v| v.is_finite() && v.abs() < 1e30);
        let cameras = path::orbit(&reference, center, [0.3, 0.2], 5).into_iter().chain(path::spiral(
            &inside,
            center,
            [0.3, 0.2],
            2.0,
            5,
        ));
        let poses = finite(cameras.flat_map(|c| c.center().to_array()));
        if sound { finite(spread).and(poses) } else { Ok(()) }
    });
    ledger.close("scores and paths");
}

/// A picture of the block with all that a picture can hold.
fn drawn(model: &Gaussians, camera: &Camera, activations: &[f32]) -> Verdict {
    let outputs = Outputs { depth: true, masks: true, head: true };
    let mut renderer = Renderer::new(model, Skips::default());
    let picture = renderer.draw(camera, &Isometry::IDENTITY, activations, None, outputs);
    let planes = picture.masks.iter().flatten().chain(&picture.depth).chain(&picture.transmittance);
    finite_32(planes.chain(picture.head.as_flattened()).copied())?;
    check(picture.transmittance.iter().all(|t| (-1e-5..=1.0001).contains(t)), || "light from nowhere".into())?;
    check(picture.masks.iter().flatten().all(|m| (-1e-5..=1.0001).contains(m)), || "a mask beyond 1".into())
}

fn looking(at: [f64; 3], turn: f64) -> Camera {
    Camera {
        intrinsics: Intrinsics::pinhole(40, 32, 60.0),
        camera_from_world: Isometry::new(DMat3::from_rotation_y(turn), DVec3::from(at)),
    }
}

#[test]
fn pictures_are_finite_wherever_they_are_taken_from() {
    let mut ledger = Ledger::default();
    let model = block();
    // In front, inside, beside, behind, far away.
    ledger.poke("Renderer::draw, camera", [0.0, 0.01, 0.5, 0.1], |[x, y, z, turn]| {
        let turn = if turn.is_finite() { turn.rem_euclid(7.0) } else { 0.0 };
        drawn(&model, &looking([x, y, z], turn), &[0.4, 0.9])
    });
    for z in [0.0, -0.5, 1e-9, 1e-3, 0.02, 1e3, 1e9] {
        ledger.one("Renderer::draw, camera", &format!("at {z} m"), || {
            drawn(&model, &looking([0.0, 0.0, z], 0.0), &[0.0, 0.0])
        });
    }
    ledger.poke("Renderer::draw, lens", [60.0, 60.0, 20.0, 16.0, 0.1, -0.05], |[fx, fy, cx, cy, k1, p1]| {
        let mut camera = looking([0.0, 0.0, 0.5], 0.0);
        let k = &mut camera.intrinsics;
        (k.fx, k.fy, k.cx, k.cy) = (fx, fy, cx, cy);
        (k.distortion.radial[0], k.distortion.tangential[0]) = (k1, p1);
        drawn(&model, &camera, &[0.4, 0.9])
    });
    ledger.poke_32("Renderer::draw, activations", [0.5, 1.2], |a| drawn(&model, &looking([0.0, 0.0, 0.5], 0.0), &a));
    for size in [[1, 1], [1, 500], [17, 3]] {
        ledger.one("Renderer::draw, size", &format!("{size:?}"), || {
            let mut camera = looking([0.0, 0.0, 0.5], 0.0);
            (camera.intrinsics.width, camera.intrinsics.height) = (size[0], size[1]);
            drawn(&model, &camera, &[0.4, 0.9])
        });
    }
    ledger.close("pictures");
}

#[test]
fn a_gaussian_of_extreme_numbers_spoils_no_picture() {
    let mut ledger = Ledger::default();
    let camera = looking([0.0, 0.0, 0.5], 0.0);
    for c in 0..channel::COUNT {
        for (name, value) in POISON_32.iter().filter(|(_, v)| v.is_finite()) {
            ledger.one("Gaussians::base", &format!("channel {c} = {name}"), || {
                let mut model = block();
                model.base[c * LANES + 5] = *value;
                drawn(&model, &camera, &[0.4, 0.9])
            });
        }
    }
    for (name, value) in POISON_32.iter().filter(|(_, v)| v.is_finite()) {
        ledger.one("Gaussians::deltas", name, || {
            let mut model = block();
            model.deltas[3] = *value;
            drawn(&model, &camera, &[0.4, 0.9])
        });
        ledger.one("Gaussians::membership", name, || {
            let mut model = block();
            model.membership[3] = *value;
            drawn(&model, &camera, &[0.4, 0.9])
        });
    }
    ledger.one("Gaussians", "thousands in one pixel", || {
        let mut model = block();
        (0..model.groups() * LANES).for_each(|i| {
            (0..3).for_each(|axis| model.base[(i / LANES * channel::COUNT + axis) * LANES + i % LANES] = 0.0);
        });
        let (base, membership, weight) = (model.base.clone(), model.membership.clone(), model.head_weight.clone());
        for _ in 0..60 {
            model.base.extend(&base);
            model.membership.extend(&membership);
            model.head_weight.extend(&weight);
        }
        drawn(&model, &camera, &[0.4, 0.9])
    });
    ledger.one("Gaussians", "none", || {
        let mut model = block();
        model.deformable = 0;
        for part in
            [&mut model.base, &mut model.deltas, &mut model.gates, &mut model.membership, &mut model.head_weight]
        {
            part.clear();
        }
        drawn(&model, &camera, &[0.4, 0.9])
    });
    ledger.close("Gaussians");
}
