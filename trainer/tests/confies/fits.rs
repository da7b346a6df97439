//! Whole fits: resumed, stopped by their numbers, logged.

use std::fs;
use std::path::Path;

use burn::tensor::Device;
use risorius_formats::Silent;
use risorius_trainer::TrainerError;
use risorius_trainer::config::{FitSettings, ModelKind, RayOrder};
use risorius_trainer::fit::confies::{ConfiesNumbers, Limits, fit};
use risorius_trainer::fit::metrics::Line;
use risorius_trainer::fit::{checkpoint, tensorboard};
use risorius_trainer::schedule::Schedule;

use crate::scene::{scene, settings};

fn short(kind: ModelKind) -> FitSettings {
    let settings = FitSettings { annotated_share: 0.5, ..settings() }.with_steps(30).with_model(kind);
    FitSettings { checkpoint_every: 10, micro_rays: 10, ..settings }
}

fn fitted(settings: &FitSettings, run: &Path, resume: bool) -> Result<(), Box<TrainerError>> {
    let data = scene(&[2]);
    fit(&data, settings, Limits::default(), run, resume, &Device::flex(), &Silent).map(drop).map_err(Box::new)
}

fn lines(run: &Path) -> Vec<Line<ConfiesNumbers>> {
    let text = fs::read_to_string(run.join("metrics.jsonl")).unwrap();
    text.lines().map(|l| serde_json::from_str(l).unwrap()).collect()
}

#[test]
fn a_resumed_fit_is_the_uninterrupted_one_to_the_bit() {
    for (kind, ray_order) in [(ModelKind::Confies, RayOrder::Epochs), (ModelKind::Conerf, RayOrder::Independent)] {
        let dir = tempfile::tempdir().unwrap();
        let (whole, parted) = (dir.path().join("whole"), dir.path().join("parted"));
        let settings = FitSettings { ray_order, ..short(kind) };
        fitted(&settings, &whole, false).unwrap();
        fitted(&settings, &parted, false).unwrap();
        let steps = |run: &Path| checkpoint::list(run).into_iter().map(|(step, _)| step).collect::<Vec<_>>();
        // Only the newest two are kept.
        assert_eq!(steps(&parted), [20, 30]);
        // Ten steps of Adam from the older checkpoint on: weights come out the same only if its moments, its count of
        // steps and the rays drawn are. (Weights carry their parameters' identities, which are the run's own.)
        let weights = || fs::read(parted.join("checkpoints/step-00000030/weights.bpk")).unwrap();
        let before = weights();
        fs::remove_dir_all(parted.join("checkpoints/step-00000030")).unwrap();
        fs::remove_file(parted.join("model.safetensors")).unwrap();
        fitted(&settings, &parted, true).unwrap();
        assert_eq!(steps(&parted), [20, 30]);
        assert!(before == weights(), "weights differ");
        let model = |run: &Path| fs::read(run.join("model.safetensors")).unwrap();
        assert!(model(&whole) == model(&parted), "model.safetensors differs");
        let numbers = |run: &Path| {
            lines(run)
                .into_iter()
                .map(|l| (l.step, l.numbers.reconstruction, l.numbers.attribute, l.numbers.gradient_norms))
                .collect::<Vec<_>>()
        };
        assert_eq!(numbers(&whole), numbers(&parted));
    }
}

#[test]
fn numbers_are_logged_as_lines_and_as_events() {
    let dir = tempfile::tempdir().unwrap();
    fitted(&short(ModelKind::Confies), dir.path(), false).unwrap();
    let lines = lines(dir.path());
    assert_eq!(lines.iter().map(|l| l.step).collect::<Vec<_>>(), [1, 10, 20, 30]);
    for line in lines.into_iter().map(|l| l.numbers) {
        assert!(line.gradient_norm > 0.0 && line.gradient_norms.len() >= 8, "{line:?}");
        assert!(line.mask > 0.0 && line.latent > 0.0 && line.attribute_weight <= 0.1);
    }
    let events: Vec<_> =
        fs::read_dir(dir.path().join(tensorboard::FOLDER)).unwrap().map(|e| e.unwrap().path()).collect();
    assert_eq!(events.len(), 1);
    let bytes = fs::read(&events[0]).unwrap();
    for tag in ["reconstruction_coarse", "gradient_norms/fine.template", "attribute_weight"] {
        let times = bytes.windows(tag.len()).filter(|w| *w == tag.as_bytes()).count();
        assert_eq!(times, 4, "{tag}");
    }
}

#[test]
fn a_fit_that_diverges_says_where_and_leaves_its_checkpoint() {
    let dir = tempfile::tempdir().unwrap();
    let mut settings = short(ModelKind::Confies);
    fitted(&settings.clone().with_steps(10), dir.path(), false).unwrap();
    let kept = fs::read(dir.path().join("checkpoints/step-00000010/weights.bpk")).unwrap();
    settings.learning_rate = Schedule::Constant { value: 1e30 };
    let error = fitted(&settings, dir.path(), true).unwrap_err();
    let TrainerError::NotFinite { step, what } = &*error else { panic!("{error}") };
    assert!((12..=20).contains(step), "{error}");
    assert!(what.contains("loss") || what.contains("gradient"), "{error}");
    assert_eq!(checkpoint::list(dir.path()).len(), 1);
    assert!(kept == fs::read(dir.path().join("checkpoints/step-00000010/weights.bpk")).unwrap());
}
