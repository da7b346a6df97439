//! Every model of the paper's Table 2.

use std::ops::Range;

use burn::module::Module as _;
use burn::optim::AdamConfig;
use burn::tensor::{Device, Tensor, TensorData};
use risorius_trainer::config::{FitSettings, MaskRendering, ModelKind, RestMask};
use risorius_trainer::cost::ModelCost;
use risorius_trainer::fit::gradients;
use risorius_trainer::model::{ConfiesModel, Level, RayCodes, Uncertain, Windows, region_groups};

use crate::scene::{by_path, numbers, peak, scene, settings, space};

/// A step at which the ambient window is open and the uncertainty still counts.
const STEP: u64 = 12;

fn paper_groups() -> Vec<Range<usize>> {
    vec![0..3, 3..8, 8..17]
}

#[test]
fn every_model_has_as_many_parameters_as_is_counted() {
    let device = Device::flex();
    for preset in [FitSettings::paper(), FitSettings::code(), FitSettings::cpu(), settings()] {
        for kind in ModelKind::ALL {
            let settings = preset.clone().with_model(kind);
            let model = ConfiesModel::new(&settings.model, &paper_groups(), 20, 0, &device);
            let counted = ModelCost::of(&settings.model, &paper_groups(), 20).parameters();
            assert_eq!(model.num_params(), counted, "{} {}", settings.preset, kind.name());
        }
    }
}

#[test]
fn every_model_takes_a_step_and_all_its_parts_learn() {
    let data = scene(&[1]);
    let device = Device::flex().autodiff();
    for kind in ModelKind::ALL {
        let settings = FitSettings { annotated_share: 0.5, ..settings() }.with_model(kind);
        settings.validate().unwrap();
        let groups = region_groups(&data.table);
        let model = ConfiesModel::new(&settings.model, &groups, data.frames.len(), 3, &device);
        let space = space(&data, &settings);
        let (grads, numbers) = gradients(&model, &data, &space, &settings, STEP).unwrap();
        numbers.check_finite(STEP).unwrap();
        assert!(numbers.reconstruction_fine > 0.01);
        assert_eq!(numbers.mask > 0.0, !model.mask_regions().is_empty(), "{kind:?}");
        assert_eq!(numbers.attribute > 0.0, kind.has_attributes(), "{kind:?}");
        assert_eq!(numbers.latent > 0.0, kind.has_latent(), "{kind:?}");
        let by_path = by_path(&model, &grads);
        for (path, gradient) in &by_path {
            assert!(gradient.as_ref().is_some_and(|g| g.iter().all(|v| v.is_finite())), "{kind:?}: {path}");
        }
        for part in [
            "coarse.template",
            "fine.template",
            "coarse.masks",
            "fine.masks",
            "fine.uncertainty",
            "ambient",
            "deformation",
            "attribute",
            "latent",
        ] {
            let has = by_path.keys().any(|p| p.starts_with(part));
            assert_eq!(peak(&by_path, part) > 0.0, has, "{kind:?}: {part}");
        }
        let before = numbers.reconstruction_fine;
        let mut optimizer = AdamConfig::new().with_epsilon(1e-8).init();
        let mut model = optimizer.step(3e-3, model, grads);
        for _ in 0..8 {
            let (grads, _) = gradients(&model, &data, &space, &settings, STEP).unwrap();
            model = optimizer.step(3e-3, model, grads);
        }
        let (_, after) = gradients(&model, &data, &space, &settings, STEP).unwrap();
        assert!(after.reconstruction_fine < before, "{kind:?}: {before} {}", after.reconstruction_fine);
    }
}

#[test]
fn names_are_read_and_kept_in_settings() {
    for kind in ModelKind::ALL {
        assert_eq!(kind.name().parse::<ModelKind>().unwrap(), kind);
        let settings = FitSettings::code().with_model(kind);
        let text = toml::to_string(&settings).unwrap();
        assert!(text.contains(&format!("kind = \"{}\"", kind.name())), "{text}");
        assert_eq!(toml::from_str::<FitSettings>(&text).unwrap(), settings);
    }
    assert!("gan".parse::<ModelKind>().is_err());
    // Settings of before there were other models are read as what they were.
    let before = FitSettings { recompute: false, ..FitSettings::cpu() };
    let new = [
        "kind = \"confies",
        "branch_skip",
        "rest_mask",
        "annotated_share",
        "ray_order",
        "micro_rays",
        "recompute",
        "interval",
        "mask_rendering",
    ];
    let text = toml::to_string(&before).unwrap();
    let old: Vec<&str> = text.lines().filter(|l| !new.iter().any(|n| l.starts_with(n))).collect();
    assert_eq!(old.len() + new.len() + 1, text.lines().count(), "{text}");
    let mut read: FitSettings = toml::from_str(&old.join("\n")).unwrap();
    // The branch that there is not does not matter.
    (read.model.mask.branch_skip, read.model.uncertainty.branch_skip) = (false, false);
    assert_eq!(read, before);
}

/// Logits of all masks for these attributes, on slices that are far from flat.
fn mask_logits(kind: ModelKind, alpha: &[f32]) -> (Vec<f32>, usize) {
    let device = Device::flex();
    let mut config = settings().with_model(kind).model;
    config.hyper_dims = 3;
    let model = ConfiesModel::new(&config, &paper_groups(), 4, 7, &device).map(&mut Amplify);
    let codes = RayCodes {
        omega: Tensor::from_data(TensorData::new(vec![0.1f32; config.latent_dims], [1, config.latent_dims]), &device),
        alpha: Tensor::from_data(TensorData::new(alpha.to_vec(), [1, 17]), &device),
        directions: Tensor::from_data(TensorData::new(vec![0.0f32, 0.6, 0.8], [1, 3]), &device),
    };
    let points: Vec<f32> = (0..15).map(|i| (i as f32 * 1.3).sin() * 0.5).collect();
    let points = Tensor::from_data(TensorData::new(points, [5, 3]), &device);
    let out = model.evaluate(Level::Fine, points, &codes, Windows::open(&config), &Uncertain::None);
    let masks = model.mask_regions().len();
    (numbers(out.mask_logits.unwrap()), masks)
}

struct Amplify;

impl burn::module::ModuleMapper for Amplify {
    fn map_float<const D: usize>(&mut self, param: burn::module::Param<Tensor<D>>) -> burn::module::Param<Tensor<D>> {
        param.map(|t| {
            let peak = numbers(t.clone()).iter().fold(0.0f32, |m, v| m.max(v.abs()));
            if peak > 0.0 && peak < 1e-2 { t * (0.5 / peak) } else { t }
        })
    }
}

#[test]
fn masks_of_other_regions_leak_in_conerf_and_not_in_confies() {
    let mut alpha = vec![0.1f32; 17];
    let before = [ModelKind::Confies, ModelKind::Conerf].map(|kind| mask_logits(kind, &alpha));
    alpha[12] = 0.9;
    let after = [ModelKind::Confies, ModelKind::Conerf].map(|kind| mask_logits(kind, &alpha));
    let moved = |kind: usize, of: &dyn Fn(usize) -> bool| {
        let masks = before[kind].1;
        let pairs = before[kind].0.iter().zip(&after[kind].0).enumerate();
        pairs.filter(|(i, _)| of(i % masks)).any(|(_, (b, a))| b.to_bits() != a.to_bits())
    };
    assert_eq!((before[0].1, before[1].1), (3, 17));
    assert!(moved(0, &|mask| mask == 2) && !moved(0, &|mask| mask != 2), "CoNFies");
    // One net for all masks: an AU of the mouth moves the masks of the brows.
    assert!(moved(1, &|mask| mask < 3), "CoNeRF");
}

#[test]
fn the_options_of_masks_change_what_they_say() {
    let data = scene(&[]);
    let device = Device::flex().autodiff();
    let mut seen = Vec::new();
    for (rest_mask, mask_rendering) in [
        (RestMask::Clipped, MaskRendering::Logits),
        (RestMask::Plain, MaskRendering::Logits),
        (RestMask::Clipped, MaskRendering::Probabilities),
    ] {
        let mut settings = FitSettings { mask_rendering, ..settings() };
        settings.model.rest_mask = rest_mask;
        // Masks of one half each: their sum is at the clip's edge, so one bias is raised.
        let model = ConfiesModel::new(&settings.model, &region_groups(&data.table), data.frames.len(), 3, &device);
        let model = model.map(&mut Amplify);
        let (_, n) = gradients(&model, &data, &space(&data, &settings), &settings, STEP).unwrap();
        assert!(n.mask.is_finite());
        seen.push((n.mask, n.reconstruction_fine));
    }
    assert_ne!(seen[0], seen[1], "m_0");
    assert_ne!(seen[0].0, seen[2].0, "what is rendered");
    assert_eq!(seen[0].1, seen[2].1);
}
