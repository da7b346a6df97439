//! A small avatar and rays through it, for tests of the operation "render these rays".

use std::sync::Arc;

use burn::tensor::{Device, Tensor, TensorData};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use risorius_brick::Brick;
use risorius_brick::batch::RayBatch;
use risorius_brick::model::{BackgroundFrame, HeadBox, LATENT, Layout};

use super::{DType, Rendered};

/// A small avatar with lively numbers: two AUs in two regions that share bricks, a background, three images.
pub(super) fn lively(background: bool) -> Brick {
    let frame = BackgroundFrame {
        position: [0.0, 0.0, -2.0],
        axes: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
        near: 2.6,
        far: 6.0,
        middle: [0.0; 2],
        extent: [0.4; 2],
    };
    let layout = Layout {
        head_box: HeadBox { center: [0.0; 3], half: 0.5 },
        background: background.then_some(frame),
        region_of: vec![0, 1],
        regions: 2,
        images: 3,
        expression_vertices: 16,
        finest: 64,
    };
    let mut model = Brick::new(layout, 7, |p| u8::from(p[1] < 0.05) | u8::from(p[1] > -0.05) << 1);
    let mut rng = ChaCha8Rng::seed_from_u64(3);
    let mut stir =
        |values: &mut [f32], size: f32| values.iter_mut().for_each(|v| *v = (rng.random::<f32>() - 0.5) * size);
    for part in [Some(&mut model.head), model.background.as_mut()].into_iter().flatten() {
        part.field.live = 2;
        for table in &mut part.field.features {
            stir(&mut table.values, 1.0);
        }
        stir(&mut part.field.net.values, 1.2);
        // Some cells are empty: a slab, and the border. Beyond it a look-up stays where it is, and the kernels' slope does not
        // know that.
        for (cell, bits) in part.occupancy.bits.iter_mut().enumerate() {
            let at = [cell % 64, cell / 64 % 64, cell / 4096];
            let empty = at[2] % 5 == 0 || at.iter().any(|v| !(5..59).contains(v));
            *bits = if empty { 0 } else { 0xff };
        }
        part.occupancy.refresh();
    }
    model.expression.residuals.iter_mut().for_each(|table| stir(&mut table.values, 0.1));
    stir(&mut model.expression.masks.values, 6.0);
    model.latent_bases.iter_mut().for_each(|table| stir(&mut table.values, 0.05));
    stir(&mut model.alphas.values, 0.2);
    model
}

pub(super) const ACTIVATIONS: [f32; 2 + LATENT] = [0.7, 0.4, 0.3, -0.2, 0.1, 0.2, -0.3, 0.15, 0.05, -0.1];
pub(super) const MOTION: [f32; 6] = [0.01, -0.02, 0.015, 0.02, -0.01, 0.03];

pub(super) fn batch(rays: usize, opaque: f32) -> Arc<RayBatch> {
    let mut rng = ChaCha8Rng::seed_from_u64(11);
    let directions = (0..rays)
        .map(|_| {
            let d = [(rng.random::<f32>() - 0.5) * 0.4, (rng.random::<f32>() - 0.5) * 0.4, 1.0];
            let n = (d[0] * d[0] + d[1] * d[1] + 1.0).sqrt();
            d.map(|v| v / n)
        })
        .collect();
    let jitter = (0..rays).map(|_| rng.random::<f32>()).collect();
    let (haze, spread) = ([0.02, 0.03], [0.05, 0.04]);
    Arc::new(RayBatch {
        origin: [0.05, -0.02, -2.0],
        directions,
        jitter,
        divisions: 24,
        planes: 20,
        opaque,
        haze,
        spread,
    })
}

pub(super) fn vector(values: &[f32], device: &Device, dtype: DType) -> Tensor<1> {
    Tensor::from_data(TensorData::new(values.to_vec(), [values.len()]), (device, dtype))
}

pub(super) fn numbers<const D: usize>(tensor: Tensor<D>) -> Vec<f64> {
    tensor.into_data().iter::<f64>().collect()
}

pub(super) fn columns(r: &Rendered) -> Tensor<2> {
    Tensor::cat(vec![r.color.clone(), r.left.clone(), r.masks.clone(), r.depth.clone(), r.regular.clone()], 1)
}

/// Some weight for everything that rays show, or for all but masks.
pub(super) fn loss(r: &Rendered, masks: bool) -> Tensor<1> {
    let all = columns(r);
    let [rays, width] = all.dims();
    let weight = |i: usize| {
        let left_out = !masks && (4..8).contains(&(i % width));
        if left_out { 0.0 } else { ((i * 7 + 3) % 11) as f32 / 11.0 - 0.4 }
    };
    let weights: Vec<f32> = (0..rays * width).map(weight).collect();
    let weights = Tensor::<2>::from_data(TensorData::new(weights, [rays, width]), &all.device());
    (all * weights).sum()
}

pub(super) fn flat(model: &Brick) -> Vec<f32> {
    model.shown_by().iter().flat_map(|t| t.values.iter().copied()).collect()
}
