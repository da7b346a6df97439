//! Kernels against their f64 twin: pictures and the gradients of every channel, for every instruction set.

use glam::{DVec2, DVec3};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use risorius_formats::{Camera, Intrinsics, Isometry};

use crate::bin::{Bins, Line};
use crate::model::{DELTAS, Gaussians, LANES, Layout, REGIONS, channel};
use crate::project::active_bases;
use crate::raster::{BACKDROP, CHARBONNIER, Target, Tile, TrainRow};
use crate::reference::{self, Projected};
use crate::scene::rotation_from_vector;
use crate::simd::{self, Level};
use crate::update::{Evidence, Moments, Rates, Update, Whole};
use crate::view::View;
use crate::{Outputs, Renderer, Skips};

const LEVELS: [Level; 3] = [Level::Scalar, Level::Avx2, Level::Avx512];

/// A random scene of `count` Gaussians before a camera, half of them deformable, with five AUs in three regions.
fn random_model(seed: u64, count: usize) -> Gaussians {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let layout =
        Layout { region_of: vec![0, 0, 1, 2, 2], also_in: vec![0, 0, 0b101], regions: 3, latent: 4, images: 3 };
    let groups = count / LANES;
    let deformable = groups / 2;
    let mut draw = |low: f32, high: f32| rng.random_range(low..high);
    let mut base = vec![0.0; groups * channel::COUNT * LANES];
    for slot in 0..groups * LANES {
        let mut set = |c: usize, v: f32| base[(slot / LANES * channel::COUNT + c) * LANES + slot % LANES] = v;
        for (c, half) in [0.09f32, 0.06, 0.08].into_iter().enumerate() {
            set(c, draw(-half, half));
            set(3 + c, draw(-6.5, -4.0));
            set(11 + c, draw(-0.1, 1.1));
        }
        (6..10).for_each(|c| set(c, draw(-1.0, 1.0)));
        set(10, draw(-3.0, 3.0));
        (14..23).for_each(|c| set(c, draw(-0.3, 0.3)));
    }
    let bases = layout.bases();
    Gaussians {
        deltas: (0..deformable * bases * DELTAS * LANES).map(|_| draw(-0.02, 0.02)).collect(),
        gates: (0..deformable * REGIONS * LANES).map(|_| draw(0.0, 1.0)).collect(),
        membership: (0..groups * REGIONS * LANES).map(|_| draw(-3.0, 3.0)).collect(),
        head_weight: (0..groups * LANES).map(|_| draw(0.0, 1.0)).collect(),
        layout,
        deformable,
        base,
    }
}

fn camera(distorted: bool) -> Camera {
    let mut intrinsics = Intrinsics::pinhole(52, 37, 90.0);
    intrinsics.cx += 3.3;
    intrinsics.skew = 0.7;
    if distorted {
        intrinsics.distortion.radial = [0.08, -0.05, 0.02];
        intrinsics.distortion.tangential = [0.004, -0.003];
    }
    let rotation = rotation_from_vector(DVec3::new(0.1, -0.2, 0.05));
    Camera { intrinsics, camera_from_world: Isometry::new(rotation, DVec3::new(0.01, -0.02, 0.4)) }
}

fn head() -> Isometry {
    Isometry::new(rotation_from_vector(DVec3::new(-0.03, 0.05, 0.02)), DVec3::new(0.003, -0.002, 0.004))
}

const ACTIVATIONS: [f32; 9] = [0.7, 0.0, 0.3, 0.01, 1.2, 0.5, -0.4, 0.0, 0.2];

/// What the kernels know: too small an AU is at rest.
fn activations() -> Vec<f64> {
    ACTIVATIONS.iter().map(|&a| f64::from(a)).collect()
}

#[test]
fn pictures_are_those_of_the_twin_for_every_instruction_set() {
    for (seed, distorted) in [(1, false), (2, true), (3, true)] {
        let model = random_model(seed, 96);
        let camera = camera(distorted);
        let wanted = reference::picture(&model, &camera, &head(), &activations(), [f64::from(BACKDROP); 3]);
        for level in LEVELS {
            let _held = simd::hold(level);
            let picture = Renderer::new(&model, Skips::default())
                .draw(&camera, &head(), &ACTIVATIONS, None, Outputs::default())
                .clone();
            let worst = picture
                .rgb
                .iter()
                .zip(wanted.iter().flatten())
                .map(|(&b, &w)| (f64::from(b) - w.clamp(0.0, 1.0) * 255.0).abs())
                .fold(0.0, f64::max);
            // Half a level of rounding, and a block that stops when it is opaque to 1/500.
            assert!(worst < 1.2, "{level:?}, seed {seed}: {worst}");
        }
    }
}

#[test]
fn depth_and_masks_are_composited_with_the_colours_weights() {
    let model = random_model(5, 64);
    let camera = camera(false);
    let outputs = Outputs { depth: true, masks: true, head: true };
    let mut renderer = Renderer::new(&model, Skips::default());
    let picture = renderer.draw(&camera, &head(), &ACTIVATIONS, None, outputs);
    let list = reference::project_all(&model, &camera, &head(), &activations());
    for (at, &t) in picture.transmittance.iter().enumerate() {
        let pixel = DVec2::new((at % 52) as f64 + 0.5, (at / 52) as f64 + 0.5);
        let with = |value: &dyn Fn(&Projected) -> f64| {
            let list: Vec<Projected> = list.iter().map(|p| Projected { color: [value(p); 3], ..*p }).collect();
            reference::composite(&list, pixel, [0.0; 3]).0[0]
        };
        let mask = with(&|p| {
            let logit = model.membership[(p.slot / LANES * REGIONS + 1) * LANES + p.slot % LANES];
            1.0 / (1.0 + f64::from(-logit).exp())
        });
        assert!((f64::from(picture.masks[1][at]) - mask).abs() < 3e-3);
        let head = with(&|p| f64::from(model.head_weight[p.slot]));
        assert!((f64::from(picture.head[at][3]) - head).abs() < 3e-3);
        if t < 0.98 {
            // The head's where it is most of what is seen.
            let depth = if head > 0.5 * with(&|_| 1.0) {
                with(&|p| f64::from(model.head_weight[p.slot]) * p.depth) / head
            } else {
                with(&|p| p.depth) / with(&|_| 1.0)
            };
            assert!((f64::from(picture.depth[at]) - depth).abs() < 3e-3, "{} {depth}", picture.depth[at]);
        }
    }
}

/// What one backward pass gives: base and delta gradients in the arrays' layout, and what concerns the whole picture.
struct Backward {
    base: Vec<f32>,
    deltas: Vec<f32>,
    whole: Whole,
}

fn kernel_gradients(model: &Gaussians, camera: &Camera, wanted: &[u8]) -> Backward {
    let view = View::new(camera, &head());
    let active = active_bases(&model.layout, &ACTIVATIONS, false);
    let mut bins = Bins::default();
    bins.fill(model, &view, &active, None);
    let mut sums = vec![Line::ZERO; bins.slots.len()];
    let target = Target { rgb: wanted, valid: None, backdrop: None, width: view.width, reduce: 1, gain: [1.0; 3] };
    let columns = view.columns();
    let mut tile = Tile::default();
    for row in 0..view.tiles() / columns {
        let entries = bins.entries(row * columns).start..bins.entries((row + 1) * columns - 1).end;
        simd::run(TrainRow {
            bins: &bins,
            target: &target,
            row,
            columns,
            width: view.width,
            height: view.height,
            sums: &mut sums[entries],
            tile: &mut tile,
        });
    }
    let rates = Rates {
        mean: 0.0,
        depth: 0.0,
        delta: 0.0,
        log_scale: 0.0,
        quaternion: 0.0,
        opacity: 0.0,
        color: 0.0,
        sh1: 0.0,
    };
    let mut model = model.clone();
    let (mut base, mut deltas) = (Moments::zero(model.base.len()), Moments::zero(model.deltas.len()));
    let mut movement = vec![0.0; model.groups() * LANES];
    let whole =
        Update { model: &mut model, base: &mut base, deltas: &mut deltas, movement: &mut movement }.apply(&Evidence {
            view: &view,
            active: &active,
            bins: &bins,
            sums: &sums,
            rates,
            base_correction: 1.0,
            correction: &vec![1.0; active.len()],
            poses: true,
        });
    // A first moment that began at zero is a tenth of the gradient.
    let ten = |m: Vec<f32>| m.into_iter().map(|v| v * 10.0).collect();
    Backward { base: ten(base.first), deltas: ten(deltas.first), whole }
}

/// The twin's gradient of the projected Gaussians.
fn twin_gradients(model: &Gaussians, camera: &Camera, wanted: &[u8]) -> Vec<(Projected, [f64; 9])> {
    let list = reference::project_all(model, camera, &head(), &activations());
    let mut gradients = vec![[0.0; 9]; list.len()];
    let backdrop = [f64::from(BACKDROP); 3];
    for (at, wanted) in wanted.chunks_exact(3).enumerate() {
        let pixel = DVec2::new((at % 52) as f64 + 0.5, (at / 52) as f64 + 0.5);
        let (color, _) = reference::composite(&list, pixel, backdrop);
        let g = std::array::from_fn(|c| {
            let d = color[c] - f64::from(wanted[c]) / 255.0;
            d / d.hypot(f64::from(CHARBONNIER))
        });
        reference::composite_backward(&list, pixel, backdrop, g, &mut gradients);
    }
    list.into_iter().zip(gradients).collect()
}

/// ∂L of moving to `other` per `step`: the twin's chain through central differences of the projection alone.
fn along(
    twin: &[(Projected, [f64; 9])],
    of: impl Fn(usize, f64) -> Option<Projected>,
    steps: impl Fn(usize) -> f64,
) -> f64 {
    twin.iter()
        .map(|(p, g)| {
            let (Some(plus), Some(minus)) = (of(p.slot, 1.0), of(p.slot, -1.0)) else { return 0.0 };
            let difference = plus.numbers().into_iter().zip(minus.numbers()).zip(g).map(|((a, b), g)| (a - b) * g);
            difference.sum::<f64>() / steps(p.slot)
        })
        .sum()
}

fn wanted_picture() -> Vec<u8> {
    let mut rng = ChaCha8Rng::seed_from_u64(9);
    (0..52 * 37 * 3).map(|_| rng.random_range(0..=255)).collect()
}

#[test]
fn gradients_of_every_channel_are_the_twins() {
    for (distorted, tolerance) in [(false, 2e-3), (true, 2e-2)] {
        let model = random_model(11, 48);
        let camera = camera(distorted);
        let wanted = wanted_picture();
        let twin = twin_gradients(&model, &camera, &wanted);
        for level in LEVELS {
            let _held = simd::hold(level);
            let kernel = kernel_gradients(&model, &camera, &wanted);
            let mut by_channel = vec![(0.0f64, 0.0f64); channel::COUNT + DELTAS];
            for (p, _) in &twin {
                for c in 0..channel::COUNT {
                    let at = (p.slot / LANES * channel::COUNT + c) * LANES + p.slot % LANES;
                    let mut moved = [model.clone(), model.clone()];
                    let h = 1e-3f32.max(model.base[at].abs() * 1e-3) * if c < 3 { 0.1 } else { 1.0 };
                    moved[0].base[at] += h;
                    moved[1].base[at] -= h;
                    let step = f64::from(moved[0].base[at]) - f64::from(moved[1].base[at]);
                    let own: Vec<_> = twin.iter().filter(|(q, _)| q.slot == p.slot).copied().collect();
                    let of = |slot: usize, side: f64| {
                        let model = &moved[usize::from(side < 0.0)];
                        reference::project(model, slot, &camera, &head(), &activations())
                    };
                    let wanted = along(&own, of, |_| step);
                    let got = f64::from(kernel.base[at]);
                    by_channel[c].0 += (got - wanted).powi(2);
                    by_channel[c].1 += wanted.powi(2);
                }
                let (g, lane) = (p.slot / LANES, p.slot % LANES);
                for c in 0..DELTAS {
                    // Basis 4 (region 2) has an activation of 1.2: its deltas' gradient is that of the base times a · gate.
                    if g < model.deformable {
                        let bases = model.layout.bases();
                        let got = f64::from(kernel.deltas[((g * bases + 4) * DELTAS + c) * LANES + lane]);
                        let from = if c < 3 { c } else { channel::COLOR + c - 3 };
                        let base = f64::from(kernel.base[(g * channel::COUNT + from) * LANES + lane]);
                        let wanted = base * 1.2 * f64::from(model.gates[(g * REGIONS + 2) * LANES + lane]);
                        by_channel[channel::COUNT + c].0 += (got - wanted).powi(2);
                        by_channel[channel::COUNT + c].1 += wanted.powi(2);
                    }
                }
            }
            for (c, (error, size)) in by_channel.iter().enumerate() {
                let relative = (error / size.max(1e-12)).sqrt();
                assert!(relative < tolerance, "{level:?}, distorted {distorted}, channel {c}: {relative}");
            }
        }
    }
}

#[test]
fn gradients_of_activations_and_poses_are_the_twins() {
    let mut model = random_model(12, 48);
    // Gaussians that are half bound to the head turn a little differently; poses take them for what they mostly are.
    model.head_weight.iter_mut().for_each(|h| *h = h.round());
    // Directions of view turn with poses: without spherical harmonics what is compared is complete.
    for g in 0..model.groups() {
        model.base[(g * channel::COUNT + channel::SH1) * LANES..(g + 1) * channel::COUNT * LANES].fill(0.0);
    }
    let camera = camera(false);
    let wanted = wanted_picture();
    let twin = twin_gradients(&model, &camera, &wanted);
    let kernel = kernel_gradients(&model, &camera, &wanted);
    let h = 1e-4;
    let close = |got: f32, wanted: f64, what: &str| {
        assert!((f64::from(got) - wanted).abs() < 5e-3 * wanted.abs().max(1.0), "{what}: {got} {wanted}");
    };
    for (i, active) in active_bases(&model.layout, &ACTIVATIONS, false).iter().enumerate() {
        let of = |slot: usize, side: f64| {
            let mut a = activations();
            a[active.basis] += side * h;
            reference::project(&model, slot, &camera, &head(), &a)
        };
        close(kernel.whole.activations[i], along(&twin, of, |_| 2.0 * h), &format!("basis {}", active.basis));
    }
    for i in 0..6 {
        let motion = |side: f64| {
            let mut v = [0.0; 6];
            v[i] = side * h;
            Isometry::new(rotation_from_vector(DVec3::new(v[3], v[4], v[5])), DVec3::new(v[0], v[1], v[2]))
        };
        let of = |slot: usize, side: f64| {
            let mut camera = camera;
            camera.camera_from_world = motion(side).compose(&camera.camera_from_world);
            reference::project(&model, slot, &camera, &head(), &activations())
        };
        close(kernel.whole.camera[i], along(&twin, of, |_| 2.0 * h), &format!("camera {i}"));
        // A motion of the head in room axes, brought to camera axes.
        let axes = camera.camera_from_world.rotation;
        let of = |slot: usize, side: f64| {
            let m = motion(side);
            let turned = Isometry::new(axes.transpose() * m.rotation * axes, axes.transpose() * m.translation);
            reference::project(&model, slot, &camera, &turned.compose(&head()), &activations())
        };
        close(kernel.whole.head[i], along(&twin, of, |_| 2.0 * h), &format!("head {i}"));
    }
}

#[test]
fn edits_with_a_still_camera_are_whole_pictures_to_the_bit() {
    let mut model = random_model(21, 160);
    // Regions that meet only in part.
    for g in 0..model.deformable {
        for n in 0..REGIONS {
            if (g + n) % 2 == 0 {
                model.gates[(g * REGIONS + n) * LANES..(g * REGIONS + n + 1) * LANES].fill(0.0);
            }
        }
    }
    let camera = camera(true);
    let mut renderer = Renderer::new(&model, Skips::default());
    let mut activations = ACTIVATIONS;
    for (k, value) in [(0, 0.2), (1, 0.9), (1, 0.0), (2, 0.6), (3, 0.5), (0, 0.2), (7, 0.3), (4, 0.0)] {
        activations[k] = value;
        let edited = renderer.draw(&camera, &head(), &activations, None, Outputs::default()).clone();
        let whole = Renderer::new(&model, Skips { unchanged: false, ..Skips::default() })
            .draw(&camera, &head(), &activations, None, Outputs::default())
            .clone();
        assert_eq!(edited, whole, "basis {k} to {value}");
    }
}
