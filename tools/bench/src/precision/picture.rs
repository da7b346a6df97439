//! Whole rays through the brick field: look-ups, small networks and compositing together.

use half::{bf16, f16};
use risorius_brick::model::LATENT;
use risorius_brick::reference::Twin;
use risorius_brick::render::{BakedFace, Face};
use risorius_brick::table::Table;
use risorius_brick::{BackgroundFrame, Brick, HeadBox, Layout, math};

use crate::Rung;
use crate::ladder::{noise, rung};
use crate::numbers::Number;

const ORIGIN: [f32; 3] = [0.02, -0.03, -2.0];
/// Rays of the picture; the twin takes most of the time.
const RAYS: usize = 384;
/// Attributes of the two AUs.
const ATTRIBUTES: [f32; 2] = [0.4, -0.2];
/// Share of rays that count: where a sample stands on the border of a cell, f32 may take the cell beside it.
const CALM_SHARE: f64 = 0.95;

/// Every table of a model with its numbers.
fn tables(model: &mut Brick) -> Vec<&mut Table> {
    let mut all = Vec::new();
    for part in [Some(&mut model.head), model.background.as_mut()].into_iter().flatten() {
        all.extend(part.field.features.iter_mut().chain([&mut part.field.net]));
    }
    all.extend(model.expression.residuals.iter_mut().chain(&mut model.latent_bases));
    all.extend([&mut model.expression.masks, &mut model.codes]);
    all
}

/// An avatar in which everything acts.
fn lively() -> Brick {
    let layout = Layout {
        head_box: HeadBox { center: [0.0, 0.0, 0.1], half: 0.5 },
        background: Some(BackgroundFrame {
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
    (model.divisions, model.planes) = (48, 32);
    for part in [Some(&mut model.head), model.background.as_mut()].into_iter().flatten() {
        part.field.live = 3;
    }
    for table in &mut model.expression.residuals {
        table.steps.fill(1);
    }
    for (i, table) in tables(&mut model).into_iter().enumerate() {
        let size = if table.block > 2048 { 0.2 } else { 0.6 };
        let values = noise(table.values.len(), 100 + i as u64);
        table.values.iter_mut().zip(values).for_each(|(v, n)| *v = (n * size) as f32);
    }
    model
}

fn directions() -> Vec<[f32; 3]> {
    let n = noise(2 * RAYS, 9);
    let unit = |i: usize| {
        let d = [n[2 * i] as f32 * 0.2, n[2 * i + 1] as f32 * 0.2, 1.0];
        let length = math::dot(d, d).sqrt();
        d.map(|v| v / length)
    };
    (0..RAYS).map(unit).collect()
}

/// All rungs of whole rays.
pub(crate) fn climb(rounds: u32) -> Vec<Rung> {
    let model = lively();
    let directions = directions();
    let activations: Vec<f64> = ATTRIBUTES
        .iter()
        .map(|&a| f64::from(risorius_brick::model::activation(a)))
        .chain(model.code(model.neutral_image)[..LATENT].iter().map(|&v| f64::from(v)))
        .collect();
    let twin = Twin {
        model: &model,
        activations,
        motion: [0.0; 6],
        nudge: None,
        divisions: model.divisions,
        planes: model.planes,
        opaque: 1.0 / 600.0,
    };
    let by_the_book = || directions.iter().flat_map(|&d| twin.ray(ORIGIN, d).color).collect::<Vec<f64>>();
    let shown = |face: &Face<'_>| colors(face.render(ORIGIN, &directions).iter().map(|s| s.color));
    let all_truth = by_the_book();
    // Rays whose samples do not stand on a border of cells.
    let face = Face::new(&model, &ATTRIBUTES);
    let first = shown(&face);
    let apart = |ray: usize| (0..3).map(|c| (first[3 * ray + c] - all_truth[3 * ray + c]).abs()).fold(0.0, f64::max);
    let mut order: Vec<usize> = (0..RAYS).collect();
    order.sort_by(|&a, &b| apart(a).total_cmp(&apart(b)));
    let calm = &order[..(RAYS as f64 * CALM_SHARE) as usize];
    let pick =
        |all: Vec<f64>| calm.iter().flat_map(|&r| [all[3 * r], all[3 * r + 1], all[3 * r + 2]]).collect::<Vec<f64>>();
    let truth = pick(all_truth);

    let mut rungs = vec![
        rung("brick rays", "f64 twin", 1, &truth, || pick(by_the_book())),
        rung("brick rays", "f32 kernel", rounds, &truth, || pick(shown(&face))),
    ];
    let rounded = |of: fn(f32) -> f32| {
        let mut model = model.clone();
        for table in tables(&mut model) {
            table.values.iter_mut().for_each(|v| *v = of(*v));
        }
        model
    };
    let (brain, half) = (rounded(through::<bf16>), rounded(through::<f16>));
    for (name, model) in [("bf16 tables", &brain), ("f16 tables", &half)] {
        let face = Face::new(model, &ATTRIBUTES);
        rungs.push(rung("brick rays", name, rounds, &truth, || pick(shown(&face))));
    }
    let mut baked = BakedFace::new(&model, &ATTRIBUTES, ORIGIN);
    let picture = std::cell::RefCell::new(&mut baked);
    rungs.push(rung("brick rays", "baked", rounds, &truth, || {
        let taken = picture.borrow_mut().picture(ORIGIN, directions.clone());
        pick(colors(taken.shown.iter().map(|s| s.color)))
    }));
    rungs
}

fn colors(of: impl Iterator<Item = [f32; 3]>) -> Vec<f64> {
    of.flatten().map(f64::from).collect()
}

/// A number as it comes back from a storage of another type.
fn through<T: Number>(value: f32) -> f32 {
    T::of(f64::from(value)).value() as f32
}
