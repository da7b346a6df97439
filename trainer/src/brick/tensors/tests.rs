//! The operation against its twin, value and gradient; the twin against finite differences; records.

use burn::module::Module as _;
use burn::optim::{AdamConfig, GradientsParams};
use burn::store::ModuleRecord;
use burn::tensor::{Bytes, Device};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use self::support::*;
use super::*;

#[path = "../../../tests/support/rays.rs"]
mod support;

/// In f32 by the kernels, in f64 by the twin.
const BOTH: [DType; 2] = [DType::F32, DType::F64];

/// The loss and its gradients in the three inputs, by the kernels or by their twin.
fn gradients(scene: &Arc<RayScene>, flat: &[f32], batch: &Arc<RayBatch>, twin: bool) -> (f64, [Vec<f64>; 3]) {
    let device = Device::flex().autodiff();
    let inputs = [flat, &ACTIVATIONS, &MOTION].map(|v| vector(v, &device, DType::F32).require_grad());
    let [p, a, m] = inputs.clone();
    let rendered =
        if twin { split(&twin::render(scene, &p, &a, &m, batch)) } else { render_rays(scene, p, a, m, batch) };
    let loss = loss(&rendered, true);
    let value = numbers(loss.clone())[0];
    let grads = loss.backward();
    (value, inputs.map(|input| numbers(input.grad(&grads).unwrap())))
}

#[test]
fn rays_show_what_their_twin_shows() {
    for (background, opaque) in [(true, 0.0), (true, 1e-3), (false, 0.05)] {
        let model = lively(background);
        let (flat, batch) = (flat(&model), batch(150, opaque));
        let scene = RayScene::new(model);
        let show = |dtype: DType| {
            let [p, a, m] = [&flat[..], &ACTIVATIONS, &MOTION].map(|v| vector(v, &Device::flex(), dtype));
            numbers(columns(&render_rays(&scene, p, a, m, &batch)))
        };
        let [fused, twin] = BOTH.map(show);
        assert_eq!(fused.len(), 150 * COLUMNS);
        let apart: Vec<f64> = fused.iter().zip(&twin).map(|(a, b)| (a - b).abs()).collect();
        // A sample on the border of a part may fall on either side in vectors, or end a ray one sample later.
        let close = apart.iter().filter(|d| **d < 3e-4).count();
        assert!(close * 100 >= apart.len() * 98, "{close} of {} agree", apart.len());
        assert!(apart.iter().all(|d| *d < 0.1), "{:?}", apart.iter().copied().fold(0.0, f64::max));
        let shows = |column: usize| (0..150).any(|r| fused[r * COLUMNS + column].abs() > 1e-3);
        assert!((0..COLUMNS).filter(|c| *c != 6).all(shows), "a column of nothing");
    }
}

#[test]
fn gradients_are_those_of_the_twin() {
    for background in [true, false] {
        let model = lively(background);
        let (flat, batch) = (flat(&model), batch(60, 0.0));
        let lengths: Vec<usize> = model.shown_by().iter().map(|t| t.values.len()).collect();
        let scene = RayScene::new(model);
        let [(value, fused), (expected, twin)] = [false, true].map(|twin| gradients(&scene, &flat, &batch, twin));
        assert!((value - expected).abs() < 1e-3 * expected.abs().max(1.0), "{value} {expected}");
        let norm = |v: &[f64]| v.iter().map(|x| x * x).sum::<f64>().sqrt();
        let close = |name: &str, found: &[f64], expected: &[f64]| {
            let apart: Vec<f64> = found.iter().zip(expected).map(|(a, b)| a - b).collect();
            assert!(norm(&apart) < 4e-3 * norm(expected) + 1e-5, "{name}: {} of {}", norm(&apart), norm(expected));
        };
        let (mut at, mut moved) = (0, 0);
        for (t, length) in lengths.into_iter().enumerate() {
            let range = at..at + length;
            moved += usize::from(norm(&twin[0][range.clone()]) > 1e-4);
            close(&format!("table {t}"), &fused[0][range.clone()], &twin[0][range]);
            at += length;
        }
        assert!(moved >= 20, "gradients reach {moved} tables only");
        close("activations", &fused[1], &twin[1]);
        close("motion", &fused[2], &twin[2]);
    }
}

/// Masks are learned from masks alone: nothing that they show moves the density, and colours do not move them.
#[test]
fn masks_do_not_bend_the_shape() {
    let model = lively(true);
    let (flat, batch) = (flat(&model), batch(40, 0.0));
    let lengths: Vec<usize> = model.shown_by().iter().map(|t| t.values.len()).collect();
    let first_mask: usize = lengths[..lengths.len() - 1 - LATENT].iter().sum();
    let mask_numbers = first_mask..first_mask + lengths[lengths.len() - 1 - LATENT];
    let scene = RayScene::new(model);
    let device = Device::flex().autodiff();
    for twin in [false, true] {
        let of = |what: fn(Rendered) -> Tensor<2>| {
            let p = vector(&flat, &device, DType::F32).require_grad();
            let [a, m] = [&ACTIVATIONS[..], &MOTION].map(|v| vector(v, &device, DType::F32));
            let shown = if twin {
                split(&twin::render(&scene, &p, &a, &m, &batch))
            } else {
                render_rays(&scene, p.clone(), a, m, &batch)
            };
            let grads = what(shown).sum().backward();
            p.grad(&grads).map_or_else(|| vec![0.0; flat.len()], numbers)
        };
        let by_masks = of(|r| r.masks);
        let beside = by_masks.iter().enumerate().filter(|(i, d)| !mask_numbers.contains(i) && **d != 0.0).count();
        // Where a mask is looked up does depend on nothing that is learned.
        assert_eq!(beside, 0, "masks move other numbers");
        assert!(by_masks[mask_numbers.clone()].iter().any(|d| d.abs() > 1e-3));
        let by_colors = of(|r| r.color);
        assert!(by_colors[mask_numbers.clone()].iter().all(|d| *d == 0.0), "colours move masks");
    }
}

/// Burn's optimiser learns through the operation, and goes on from its records as if it had not stopped, to the bit.
#[test]
fn burn_s_adam_learns_through_it_and_goes_on_from_records() {
    let device = Device::flex().autodiff();
    let target = {
        let model = lively(false);
        let (flat, batch) = (flat(&model), batch(128, 1e-3));
        let scene = RayScene::new(model);
        let [p, a, m] = [&flat[..], &ACTIVATIONS, &[0.0; 6]].map(|v| vector(v, &Device::flex(), DType::F32));
        render_rays(&scene, p, a, m, &batch).color.into_data()
    };
    let mut start = lively(false);
    start.head.field.net.values.iter_mut().for_each(|v| *v *= 0.7);
    let (scene, batch) = (RayScene::new(start.clone()), batch(128, 1e-3));
    let target = Tensor::<2>::from_data(target, &device);
    let step = |model: BrickParameters, optimizer: &mut burn::optim::ModuleOptimizer| {
        let activations = model.activations(1, &[0.2, -0.4]);
        let shown = render_rays(&scene, model.flat(), activations, model.motion(1), &batch);
        let loss = (shown.color - target.clone()).powi_scalar(2).mean() + shown.regular.mean() * 1e-3;
        let value = numbers(loss.clone())[0];
        let grads = GradientsParams::from_grads(loss.backward(), &model);
        (optimizer.step(0.02, model, grads), value)
    };
    let adam = || AdamConfig::new().init();
    let mut straight = (BrickParameters::of(&start, &device), adam());
    let mut errors = Vec::new();
    let mut stopped = None;
    for i in 0..16 {
        let (model, error) = step(straight.0, &mut straight.1);
        straight.0 = model;
        errors.push(error);
        if i == 7 {
            let bytes = straight.0.clone().into_record().into_bytes().unwrap();
            stopped = Some((bytes.to_vec(), straight.1.into_bytes().unwrap().to_vec()));
        }
    }
    assert!(errors[15] < 0.3 * errors[0], "{errors:?}");
    let (weights, moments) = stopped.unwrap();
    let record = ModuleRecord::from_bytes(Bytes::from_bytes_vec(weights)).unwrap();
    let mut model = BrickParameters::of(&lively(false), &device).load_record(record);
    let mut optimizer = adam().from_bytes(Bytes::from_bytes_vec(moments)).unwrap();
    for (i, before) in errors.iter().enumerate().skip(8) {
        let (next, error) = step(model, &mut optimizer);
        model = next;
        assert_eq!(error.to_bits(), before.to_bits(), "step {i}");
    }
    assert_eq!(numbers(model.flat()), numbers(straight.0.flat()));
}

/// A checkpoint's files are the records of the modules that describe them.
#[test]
fn a_checkpoint_is_a_record() {
    use crate::brick::store::{SavedBrick, checkpoint};

    let dir = tempfile::tempdir().unwrap();
    let mut model = lively(true);
    let mut rng = ChaCha8Rng::seed_from_u64(8);
    for table in model.shown_by_mut() {
        table.first.iter_mut().chain(&mut table.second).for_each(|v| *v = rng.random());
        table.steps.iter_mut().for_each(|v| *v = rng.random_range(0..9));
    }
    let whole = model.clone();
    checkpoint::write(dir.path(), &mut model, &[("pending", &[1.0, 2.0])]).unwrap();
    assert_eq!(flat(&model), flat(&whole), "the model has its numbers back");

    let device = Device::flex();
    let load = |file: &str| ModuleRecord::load(dir.path().join(file)).unwrap();
    let fresh = Brick::new(whole.layout.clone(), 1, |p| u8::from(p[1] < 0.05) | u8::from(p[1] > -0.05) << 1);
    let parameters = BrickParameters::of(&fresh, &device).try_load_record(load("weights.bpk")).unwrap();
    assert_eq!(numbers(parameters.flat()), flat(&whole).into_iter().map(f64::from).collect::<Vec<_>>());
    assert_eq!(numbers(parameters.alphas.val()), whole.alphas.values.iter().map(|v| f64::from(*v)).collect::<Vec<_>>());
    let moments = BrickMoments::of(&fresh, &device).try_load_record(load("optimizer.bpk")).unwrap();
    let second: Vec<f64> = whole.shown_by().iter().flat_map(|t| t.second.iter().map(|v| f64::from(*v))).collect();
    assert_eq!(numbers(moments.second.flat()), second);
    let steps: Vec<u32> = moments.steps.residuals[1].val().into_data().iter::<u32>().collect();
    assert_eq!(steps, whole.expression.residuals[1].steps);

    let saved = SavedBrick::of(&whole, None, false);
    let (read, more) = checkpoint::read(dir.path(), &saved, &["pending"]).unwrap();
    assert_eq!(more, [vec![1.0, 2.0]]);
    for (a, b) in read.shown_by().iter().zip(whole.shown_by()) {
        assert_eq!((&a.values, &a.first, &a.second, &a.steps), (&b.values, &b.first, &b.second, &b.steps));
    }
    assert_eq!(read.head.occupancy.bits, whole.head.occupancy.bits);
    // Numbers that are none are refused, and what was there stays.
    model.head.field.net.values[3] = f32::NAN;
    let refused = checkpoint::write(dir.path(), &mut model, &[]).unwrap_err().to_string();
    assert!(refused.contains("head.net") && refused.contains("NaN"), "{refused}");
    checkpoint::read(dir.path(), &saved, &["pending"]).unwrap();
}

/// An avatar's file gives back what rays depend on. A fit's moments would take three times the memory.
#[test]
fn an_avatar_comes_back_without_moments() {
    use crate::brick::store::{SavedBrick, avatar};

    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("model.safetensors");
    let mut model = lively(true);
    avatar::write(&path, &mut model, None).unwrap();
    let (read, plate) = avatar::read(&path, &SavedBrick::of(&model, None, false)).unwrap();
    assert!(plate.is_none());
    assert_eq!(flat(&read), flat(&model));
    assert_eq!(read.codes.values, model.codes.values);
    assert_eq!(read.head.occupancy.bits, model.head.occupancy.bits);
    assert!(read.shown_by().iter().all(|t| t.first.is_empty() && t.second.is_empty()));
    assert_eq!(read.motions.values.len(), model.motions.values.len(), "images have a camera each, which did not move");
}

/// What a bad disk makes of a checkpoint is refused, or reads as numbers; nothing panics.
#[test]
fn a_damaged_checkpoint_is_refused() {
    use crate::brick::store::{SavedBrick, checkpoint};

    let dir = tempfile::tempdir().unwrap();
    let mut model = lively(false);
    checkpoint::write(dir.path(), &mut model, &[("pending", &[1.0])]).unwrap();
    let saved = SavedBrick::of(&model, None, false);
    let read = || checkpoint::read(dir.path(), &saved, &["pending"]);
    let mut rng = ChaCha8Rng::seed_from_u64(12);
    for file in ["weights.bpk", "optimizer.bpk", "space.bpk"] {
        let path = dir.path().join(file);
        let sound = std::fs::read(&path).unwrap();
        let mut refused = 0;
        for round in 0..40 {
            let mut bytes = sound.clone();
            match round % 4 {
                0 => bytes.truncate(rng.random_range(0..bytes.len())),
                1 => bytes[rng.random_range(0..12)] ^= 1 << rng.random_range(0..8),
                // The names and sizes stand in the first kilobytes.
                _ => (0..=round / 10).for_each(|_| bytes[rng.random_range(10..1500)] = rng.random()),
            }
            std::fs::write(&path, &bytes).unwrap();
            refused += usize::from(read().is_err());
        }
        assert!(refused >= 30, "{file}: {refused} of 40 are refused");
        std::fs::remove_file(&path).unwrap();
        let missing = read().err().unwrap().to_string();
        assert!(missing.contains(file), "{missing}");
        std::fs::write(&path, &sound).unwrap();
    }
    read().unwrap();
}
