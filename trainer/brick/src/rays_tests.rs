//! The kernels against their twin: values, gradients, and what must not change anything.

use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::*;
use crate::evaluate::Samples;
use crate::expression::{BlendGrad, Seen};
use crate::field::{LAYER, MIDDLE, monomials};
use crate::lattice::BRICK;
use crate::math;
use crate::model::{HeadBox, LATENT, Layout, deformation};
use crate::reference::{Twin, Which};

const ORIGIN: [f32; 3] = [0.05, -0.02, -2.0];

/// A small avatar with lively numbers everywhere: two AUs in two regions that share a brick.
fn lively(background: bool) -> Brick {
    let layout = Layout {
        head_box: HeadBox { center: [0.0, 0.0, 0.1], half: 0.5 },
        background: background.then_some(BackgroundFrame {
            position: [0.0, 0.0, -2.0],
            axes: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
            near: 2.7,
            far: 6.0,
            middle: [0.0, 0.0],
            extent: [0.4, 0.4],
        }),
        region_of: vec![0, 1],
        regions: 2,
        images: 2,
        expression_vertices: 16,
        finest: 128,
    };
    let mut model = Brick::new(layout, 7, |p| u8::from(p[1] < 0.05) | u8::from(p[1] > -0.05) << 1);
    let mut rng = ChaCha8Rng::seed_from_u64(3);
    let mut stir =
        |values: &mut [f32], size: f32| values.iter_mut().for_each(|v| *v = (rng.random::<f32>() - 0.5) * size);
    let parts = [Some(&mut model.head), model.background.as_mut()];
    for part in parts.into_iter().flatten() {
        part.field.live = 3;
        for table in &mut part.field.features {
            stir(&mut table.values, 1.0);
        }
        stir(&mut part.field.net.values, 1.2);
    }
    for table in &mut model.expression.residuals {
        stir(&mut table.values, 0.1);
        table.steps.fill(1);
    }
    stir(&mut model.expression.masks.values, 6.0);
    for table in &mut model.latent_bases {
        stir(&mut table.values, 0.05);
    }
    model
}

const ACTIVATIONS: [f32; 2 + LATENT] = [0.7, 0.4, 0.3, -0.2, 0.1, 0.2, -0.3, 0.15, 0.05, -0.1];
const LOOK: Look =
    Look { divisions: 24, planes: 20, opaque: 1e-4, batch: 64, faint: None, tells_acts: true, everywhere: false };

fn directions(count: usize) -> Vec<[f32; 3]> {
    let mut rng = ChaCha8Rng::seed_from_u64(11);
    (0..count)
        .map(|_| {
            let d = [(rng.random::<f32>() - 0.5) * 0.4, (rng.random::<f32>() - 0.5) * 0.4, 1.0];
            let n = math::dot(d, d).sqrt();
            d.map(|v| v / n)
        })
        .collect()
}

fn twin(model: &Brick, motion: [f64; 6]) -> Twin<'_> {
    Twin {
        model,
        activations: ACTIVATIONS.iter().map(|&a| f64::from(a)).collect(),
        motion,
        nudge: None,
        divisions: LOOK.divisions,
        planes: LOOK.planes,
        opaque: f64::from(LOOK.opaque),
    }
}

fn d_left(d_color: &[[f32; 3]], behind: &[[f32; 3]]) -> Vec<f32> {
    d_color.iter().zip(behind).map(|(d, behind)| math::dot(*d, *behind)).collect()
}

struct Prepared {
    blend: Vec<f32>,
    gates: Vec<f32>,
    latent: Vec<f32>,
}

fn prepare(model: &Brick) -> Prepared {
    let gates = model.expression.gates();
    let (mut blend, mut latent) = (Vec::new(), Vec::new());
    model.expression.blend(&gates, &ACTIVATIONS, &mut blend);
    model.latent_blend(&ACTIVATIONS[2..], &mut latent);
    Prepared { blend, gates, latent }
}

#[test]
fn rays_show_what_their_twin_shows() {
    let mut model = lively(true);
    // Some cells are empty, so that the march skips.
    for cell in 0..model.head.occupancy.bits.len() {
        model.head.occupancy.bits[cell] = match cell % 7 {
            _ if cell / 4096 % 5 == 0 => 0,
            0 => 0,
            1 => 0b0110_1011,
            _ => 0xff,
        };
    }
    model.head.occupancy.refresh();
    let p = prepare(&model);
    let d = deformation(&model, &p.blend, &p.gates, Some(&p.latent));
    let directions = directions(48);
    let motion = [0.01f32, -0.02, 0.015, 0.02, -0.01, 0.03];
    let mut rays = Rays::default();
    rays.forward(&model, &d, Some(&motion), ORIGIN, &directions, || 0.5, LOOK);
    let twin = twin(&model, motion.map(f64::from));
    let mut close = 0;
    for (r, &direction) in directions.iter().enumerate() {
        let expected = twin.ray(ORIGIN, direction);
        let apart = (0..3)
            .map(|c| (f64::from(rays.color[r][c]) - expected.color[c]).abs())
            .chain([(f64::from(rays.left[r]) - expected.left).abs()])
            .chain((0..MASKS).map(|n| (f64::from(rays.masks[r][n]) - expected.masks[n]).abs()))
            .fold(0.0, f64::max);
        close += u32::from(apart < 2e-4);
        // A sample on the border of a cell may fall on either side in f32.
        assert!(apart < 0.05, "ray {r}: {apart}");
    }
    assert!(close >= 44, "only {close} of 48 rays agree");
}

#[test]
fn every_instruction_set_shows_the_same() {
    // The same kernel at all levels, on one field: differences come from the order of additions only.
    let model = lively(false);
    let p = prepare(&model);
    let d = deformation(&model, &p.blend, &p.gates, Some(&p.latent));
    let mut rng = ChaCha8Rng::seed_from_u64(5);
    let points: Vec<[f32; 3]> = (0..53).map(|_| std::array::from_fn(|_| rng.random::<f32>() * 2.2 - 1.1)).collect();
    let run = |level| {
        let mut samples = Samples::default();
        samples.directions.push(monomials([0.0, 0.6, 0.8]));
        samples.point.clone_from(&points);
        samples.ray.resize(points.len(), 0);
        samples.forward_at(level, &model.head.field, Some(&d));
        (0..points.len())
            .flat_map(|i| [samples.density(i), samples.color(i)[1], samples.masks[i][0]])
            .collect::<Vec<_>>()
    };
    let scalar = run(simd::Level::Scalar);
    for level in [simd::Level::Avx2, simd::Level::Avx512] {
        for (a, b) in scalar.iter().zip(run(level)) {
            assert!((a - b).abs() < 1e-4 * (1.0 + a.abs()), "{level:?}: {a} {b}");
        }
    }
}

/// Analytic gradients of Σ |colour − ½|² + spread, and their finite differences in the twin.
#[test]
fn gradients_are_those_of_the_twin() {
    let model = lively(true);
    let p = prepare(&model);
    let d = deformation(&model, &p.blend, &p.gates, Some(&p.latent));
    let directions = directions(8);
    let spread = [0.05f32, 0.03];
    let prior = spread.map(|spread| Prior { haze: 0.0, spread });
    let mut rays = Rays::default();
    rays.forward(&model, &d, None, ORIGIN, &directions, || 0.5, LOOK);
    let behind = vec![[0.2, 0.5, 0.9]; directions.len()];
    let d_color: Vec<[f32; 3]> = (0..directions.len())
        .map(|r| std::array::from_fn(|c| 2.0 * (rays.color[r][c] + rays.left[r] * behind[r][c] - 0.5)))
        .collect();
    let (mut head, mut background) = (FieldGrad::default(), FieldGrad::default());
    head.fit(&model.head.field);
    let part = model.background.as_ref().unwrap();
    background.fit(&part.field);
    let slots = model.expression.lattice.slots;
    let mut d_blend = BlendGrad::default();
    d_blend.fit(slots);
    let mut d_gates = vec![0.0; slots * BRICK * MASKS];
    let mut d_latent = vec![0.0; model.latent_lattice.slots * BRICK * 4];
    let mut d_motion = [0.0; 6];
    rays.backward(
        &model,
        &d,
        [Some(&model.head.field.transposed()), Some(&part.field.transposed())],
        LOOK,
        Upstream { color: &d_color, left: &d_left(&d_color, &behind), masks: None, depth: None, regular: None },
        prior,
        Lot::default(),
        [&mut head, &mut background],
        &mut DeformationGrad {
            blend: &mut d_blend,
            gates: &mut d_gates,
            latent: &mut d_latent,
            motion: &mut d_motion,
            moves: true,
        },
    );
    let mut residuals: Vec<Vec<f32>> = model.expression.residuals.iter().map(|t| vec![0.0; t.values.len()]).collect();
    let mut d_activations = vec![0.0; ACTIVATIONS.len()];
    let seen = Seen { activations: &ACTIVATIONS, d_blend: &d_blend };
    crate::expression::backward(&model.expression, &p.gates, seen, &mut residuals, &mut d_activations);
    // The latent displacement adds to what the code does through the residuals.
    for (j, basis) in model.latent_bases.iter().enumerate() {
        d_activations[2 + j] += d_latent.iter().zip(&basis.values).map(|(a, b)| a * b).sum::<f32>();
    }

    let loss = |nudge| {
        let mut twin = twin(&model, [0.0; 6]);
        twin.nudge = nudge;
        directions
            .iter()
            .map(|&direction| {
                let ray = twin.ray(ORIGIN, direction);
                let color: f64 =
                    (0..3).map(|c| (ray.color[c] + ray.left * f64::from(behind[0][c]) - 0.5).powi(2)).sum();
                color + f64::from(spread[0]) * ray.spread[0] + f64::from(spread[1]) * ray.spread[1]
            })
            .sum::<f64>()
    };
    let strongest = |values: &[f32]| {
        let mut order: Vec<usize> = (0..values.len()).collect();
        order.sort_by(|&a, &b| values[b].abs().total_cmp(&values[a].abs()));
        order
    };
    let mut cases: Vec<(Which, usize, f32)> = Vec::new();
    let mut add = |which, values: &[f32], count: usize| {
        cases.extend(strongest(values).into_iter().take(count).map(|i| (which, i, values[i])));
    };
    for l in 0..3 {
        add(Which::HeadLevel(l), &head.features[l].dense(), 3);
        add(Which::BackgroundLevel(l), &background.features[l].dense(), 3);
    }
    add(Which::HeadNet, &head.net.values, 12);
    add(Which::BackgroundNet, &background.net.values, 12);
    add(Which::Residual(0), &residuals[0], 6);
    add(Which::Residual(1), &residuals[1], 6);
    add(Which::Residual(4), &residuals[4], 6);
    add(Which::LatentBasis(2), &d_latent.iter().map(|d| d * ACTIVATIONS[4]).collect::<Vec<_>>(), 6);
    add(Which::Activation, &d_activations, ACTIVATIONS.len());
    for (which, index, analytic) in cases {
        let h = 1e-5;
        let numeric = (loss(Some((which, index, h))) - loss(Some((which, index, -h)))) / (2.0 * h);
        // An activation's gradient sums thousands of terms of both signs in f32: its floor is that of the terms.
        let floor = if which == Which::Activation { 0.02 } else { 2e-3 };
        let size = numeric.abs().max(f64::from(analytic.abs())).max(floor);
        assert!(
            (numeric - f64::from(analytic)).abs() < 0.02 * size,
            "{which:?}[{index}]: analytic {analytic}, numeric {numeric}"
        );
    }
}

/// Without deformation, turning and shifting the camera has the gradient that the samples' own motion gives.
#[test]
fn the_camera_s_gradient_is_that_of_the_twin() {
    let mut model = lively(false);
    model.expression.residuals.iter_mut().for_each(|t| t.values.fill(0.0));
    model.latent_bases.iter_mut().for_each(|t| t.values.fill(0.0));
    let p = prepare(&model);
    let d = deformation(&model, &p.blend, &p.gates, Some(&p.latent));
    // Inside the box a ray's samples move with the camera; where it enters does too, which the kernel leaves out.
    let origin = [0.0, 0.0, 0.0];
    let directions = directions(6);
    let mut rays = Rays::default();
    let motion = [0.0f32; 6];
    rays.forward(&model, &d, Some(&motion), origin, &directions, || 0.5, LOOK);
    let behind = vec![[0.0; 3]; directions.len()];
    let d_color: Vec<[f32; 3]> = rays.color.iter().map(|c| c.map(|v| 2.0 * (v - 0.5))).collect();
    let mut head = FieldGrad::default();
    head.fit(&model.head.field);
    let mut unused = FieldGrad::default();
    let slots = model.expression.lattice.slots;
    let mut d_blend = BlendGrad::default();
    d_blend.fit(slots);
    let mut d_motion = [0.0; 6];
    rays.backward(
        &model,
        &d,
        [Some(&model.head.field.transposed()), None],
        LOOK,
        Upstream { color: &d_color, left: &d_left(&d_color, &behind), masks: None, depth: None, regular: None },
        [Prior::default(); 2],
        Lot::default(),
        [&mut head, &mut unused],
        &mut DeformationGrad {
            blend: &mut d_blend,
            gates: &mut vec![0.0; slots * BRICK * MASKS],
            latent: &mut vec![0.0; model.latent_lattice.slots * BRICK * 4],
            motion: &mut d_motion,
            moves: true,
        },
    );
    let loss = |nudge| {
        let mut twin = twin(&model, [0.0; 6]);
        twin.nudge = nudge;
        directions
            .iter()
            .map(|&d| twin.ray(origin, d).color.iter().map(|c| (c - 0.5).powi(2)).sum::<f64>())
            .sum::<f64>()
    };
    let h = 1e-5;
    for (i, &analytic) in d_motion.iter().enumerate() {
        let numeric = (loss(Some((Which::Motion, i, h))) - loss(Some((Which::Motion, i, -h)))) / (2.0 * h);
        let size = numeric.abs().max(0.02);
        assert!((numeric - f64::from(analytic)).abs() < 0.05 * size, "{i}: analytic {analytic}, numeric {numeric}");
    }
}

/// Skipping empty cells, ending opaque rays, and AUs of another region leave a picture as it is.
#[test]
fn an_au_leaves_rays_that_miss_its_region_bit_identical() {
    let model = lively(true);
    let mut rays = [Rays::default(), Rays::default()];
    let directions = directions(64);
    for (a, rays) in [0.0, 1.0].into_iter().zip(&mut rays) {
        let gates = model.expression.gates();
        let mut activations = ACTIVATIONS;
        activations[0] = a;
        let mut blend = Vec::new();
        model.expression.blend(&gates, &activations, &mut blend);
        let d = deformation(&model, &blend, &gates, None);
        rays.forward(&model, &d, None, ORIGIN, &directions, || 0.5, LOOK);
    }
    let (mut same, mut other) = (0, 0);
    for (r, direction) in directions.iter().enumerate() {
        // Region 0 ends at y = 0.05 and, with interpolation, one vertex (0.067) above it.
        let lowest = (0..100)
            .map(|i| ORIGIN[1] + direction[1] * (1.5 + i as f32 * 0.011) / direction[2])
            .fold(f32::MAX, f32::min);
        let equal = rays[0].color[r].map(f32::to_bits) == rays[1].color[r].map(f32::to_bits);
        if lowest > 0.05 + 0.07 {
            assert!(equal, "ray {r} misses the region and changed");
            same += 1;
        } else if !equal {
            other += 1;
        }
    }
    assert!(same >= 5 && other >= 5, "{same} rays beside the region, {other} that changed");
}

/// Samples where nothing is show nothing, and what is behind an opaque surface shows less than half a step of 8 bits:
/// with and without the skips the picture is the same to 1/512.
#[test]
fn skips_change_no_pixel_by_more_than_a_512th() {
    let mut model = lively(true);
    for part in [Some(&mut model.head), model.background.as_mut()].into_iter().flatten() {
        for cell in 0..part.occupancy.bits.len() {
            part.occupancy.bits[cell] = if cell % 5 < 2 { 0b1101_0110 } else { 0 };
        }
        part.occupancy.refresh();
        // Denser than it was born: rays have to end.
        for row in part.field.net.values[LAYER[1]..LAYER[2]].chunks_exact_mut(MIDDLE) {
            row[0] *= 8.0;
        }
    }
    let p = prepare(&model);
    let d = deformation(&model, &p.blend, &p.gates, Some(&p.latent));
    let directions = directions(256);
    let (opaque, faint) = (1.0 / 640.0, Some(1.0 / 2600.0));
    let show = |look: Look| {
        let mut rays = Rays::default();
        rays.forward(&model, &d, None, ORIGIN, &directions, || 0.5, look);
        let counts = rays.sample_counts();
        (
            rays.color.iter().zip(&rays.left).map(|(c, l)| [c[0], c[1], c[2], *l]).collect::<Vec<_>>(),
            counts[0] + counts[1],
            rays.faint,
        )
    };
    let (skipped, few, without_color) = show(Look { opaque, faint, ..LOOK });
    let mut ended = 0;
    for look in [
        Look { opaque, faint, everywhere: true, ..LOOK },
        Look { opaque: 0.0, faint, ..LOOK },
        Look { opaque, ..LOOK },
        Look { opaque: 0.0, everywhere: true, ..LOOK },
    ] {
        let (whole, many, _) = show(look);
        assert!(
            many > few || (look.opaque, look.everywhere) == (opaque, false),
            "{many} samples, {few} with all skips"
        );
        for (r, (a, b)) in skipped.iter().zip(&whole).enumerate() {
            ended += usize::from(a[3] < opaque);
            let apart = (0..4).map(|c| (a[c] - b[c]).abs()).fold(0.0, f32::max);
            assert!(apart < 1.0 / 512.0, "ray {r}: {apart}");
        }
    }
    let faint = without_color.iter().filter(|w| **w > 0.0).count();
    assert!(faint > 5, "only {faint} rays have samples without colour");
    assert!(ended > 20, "only {ended} rays end");
}
