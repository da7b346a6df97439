//! The loop of a fit, the same for all fields: steps until they or the time are over, checkpoints, metrics, and a guard
//! against numbers that are none.

pub mod checkpoint;
pub mod confies;
pub mod estimate;
pub mod metrics;
pub mod norms;
mod step;
pub mod tensorboard;

use std::path::{Path, PathBuf};
use std::time::Instant;

use risorius_formats::atomic::AtomicDir;
use risorius_formats::pose_report::write_json;
use risorius_formats::run::RunManifest;
use risorius_formats::{Reporter, Warning};
use serde::Serialize;

use self::checkpoint::CheckpointState;
use self::metrics::{Line, MetricsLog, Recent};
use crate::data::TrainData;
use crate::error::{Result, TrainerError};
use crate::field::FieldFit;

pub use step::{StepNumbers, gradients, losses};
pub(crate) use step::{host, points, rows};

/// Steps between notes.
const NOTE_EVERY: u64 = 100;
/// Checkpoints by time are at least this far apart, seconds …
const LEAST_SECS: f64 = 60.0;
/// … and at least this many times as far as one takes.
const LEAST_TIMES: f64 = 40.0;

/// What a fit did.
#[derive(Clone, Debug, Serialize)]
pub struct FitSummary {
    /// The run's folder.
    pub run: PathBuf,
    /// Steps done in total.
    pub steps: u64,
    /// Wall seconds in total, resumed parts included.
    pub seconds: f64,
    /// Pixels (or rays) per second of this call.
    pub pixels_per_sec: f64,
    /// PSNR of the last steps' pixels, dB.
    pub train_psnr_db: f64,
    /// Numbers that were learned.
    pub parameters: usize,
    /// Training frames.
    pub frames: usize,
    /// Image scale that was fitted.
    pub scale: u32,
    /// Whether the fit ended by its length (or a limit of time or Ctrl-C ended it early).
    pub finished: bool,
}

/// How long a fit is.
#[derive(Clone, Copy, Debug, Default)]
pub struct Length {
    /// Steps, which are exact.
    pub steps: Option<u64>,
    /// Wall seconds. Without steps they are the fit's length, resumed parts included; with steps a limit on this call.
    pub budget_secs: Option<f64>,
}

/// A fit's frame: all that the loop needs to know besides the field.
#[derive(Clone, Copy, Debug)]
pub struct Plan<'a> {
    /// The dataset.
    pub data: &'a TrainData,
    /// The run's folder.
    pub run: &'a Path,
    /// The field's name.
    pub field: &'static str,
    /// The seed, for the run's manifest.
    pub seed: u64,
    /// How long.
    pub length: Length,
    /// Steps between checkpoints; 0 writes one when a minute has passed and it costs no more than a fortieth of the time.
    pub checkpoint_every: u64,
    /// When the fit began: making a field ready is part of its time.
    pub started: Instant,
    /// Wall seconds of the parts before.
    pub seconds_before: f64,
}

impl Plan<'_> {
    fn seconds(&self) -> f64 {
        self.seconds_before + self.started.elapsed().as_secs_f64()
    }

    /// The share of the fit that lies behind, when a save still takes `save_secs`.
    fn done(&self, step: u64, save_secs: f64) -> f64 {
        match (self.length.steps, self.length.budget_secs) {
            (Some(steps), _) => step as f64 / steps.max(1) as f64,
            (None, Some(budget)) => (self.seconds() + save_secs) / budget,
            (None, None) => 1.0,
        }
    }

    /// Whether a fit of so many steps has used up its time.
    fn is_out_of_time(&self) -> bool {
        let limit = self.length.budget_secs.filter(|_| self.length.steps.is_some());
        limit.is_some_and(|budget| self.started.elapsed().as_secs_f64() > budget * 1.05)
    }
}

/// Steps a field until the fit's end, writing checkpoints, metrics and the avatar into the run's folder.
pub fn drive<F: FieldFit>(fit: &mut F, plan: &Plan<'_>, reporter: &dyn Reporter) -> Result<FitSummary> {
    let first_step = fit.step();
    let mut log = MetricsLog::open(plan.run, first_step)?;
    let mut recent = Recent::default();
    // In thousandths where the length in steps is not known.
    let total = plan.length.steps.unwrap_or(1000);
    reporter.stage("fit", Some(total));
    let begun = Instant::now();
    let mut save_secs = (0.02 * plan.length.budget_secs.unwrap_or(0.0)).min(2.0);
    let (mut shown, mut pixels, mut saved_at) = (0, 0usize, plan.seconds());
    let finished = loop {
        let done = plan.done(fit.step(), save_secs);
        let reached = ((done * total as f64) as u64).min(total);
        reporter.advance(reached.saturating_sub(shown));
        shown = shown.max(reached);
        if done >= 1.0 {
            break true;
        }
        if reporter.cancelled() || plan.is_out_of_time() {
            break false;
        }
        let report = fit.advance(done)?;
        let step = fit.step();
        check_finite(step, &report.checked)?;
        pixels += report.pixels;
        recent.add(report.mse);
        if MetricsLog::is_due(step) {
            log.write(&Line::new(step, plan.seconds(), report.mse, report.numbers))?;
        }
        if step.is_multiple_of(NOTE_EVERY) {
            reporter.note(&format!("step {step}: {:.2} dB", recent.psnr_db()));
        }
        let due = match plan.checkpoint_every {
            0 => plan.seconds() - saved_at >= (LEAST_TIMES * save_secs).max(LEAST_SECS),
            every => step.is_multiple_of(every) && plan.length.steps != Some(step),
        };
        if due {
            let saving = Instant::now();
            save(fit, plan, false)?;
            save_secs = saving.elapsed().as_secs_f64();
            saved_at = plan.seconds();
        }
    };
    log.finish()?;
    save(fit, plan, true)?;
    if !finished && reporter.cancelled() {
        return Err(TrainerError::Interrupted { done: format!("step {}", fit.step()) });
    }
    if !finished {
        let message = format!("the time ran out at step {} of {total}", fit.step());
        reporter.warn(Warning::new("budget", message));
    }
    Ok(FitSummary {
        run: plan.run.to_owned(),
        steps: fit.step(),
        seconds: plan.seconds(),
        pixels_per_sec: pixels as f64 / begun.elapsed().as_secs_f64().max(1e-9),
        train_psnr_db: recent.psnr_db(),
        parameters: fit.parameters(),
        frames: plan.data.frames.len(),
        scale: plan.data.scale,
        finished,
    })
}

/// Fails where one of a step's numbers is not finite, naming it.
pub(crate) fn check_finite(step: u64, numbers: &[(String, f64)]) -> Result<()> {
    match numbers.iter().find(|(_, value)| !value.is_finite()) {
        Some((what, _)) => Err(TrainerError::NotFinite { step, what: what.clone() }),
        None => Ok(()),
    }
}

/// Says what is fitted.
pub(crate) fn note_scene(data: &TrainData, parameters: usize, reporter: &dyn Reporter) {
    let i = &data.frames[0].camera.intrinsics;
    reporter.note(&format!(
        "{} frames of {}×{}, {} attributes in {} regions, {parameters} parameters to begin with",
        data.frames.len(),
        i.width,
        i.height,
        data.table.attributes.len(),
        data.table.regions.len(),
    ));
}

pub(crate) fn settings_to_disk(settings: &impl Serialize, run: &Path) -> Result<()> {
    let path = run.join("settings.toml");
    let text = toml::to_string(settings).map_err(|e| TrainerError::Setting {
        message: format!("the settings cannot be written: {e}"),
        hint: String::new(),
    })?;
    Ok(risorius_formats::atomic::write_file(path, text.as_bytes())?)
}

/// A checkpoint, the avatar, and the run's manifest.
fn save<F: FieldFit>(fit: &mut F, plan: &Plan<'_>, last: bool) -> Result<()> {
    let (data, run, step, seconds) = (plan.data, plan.run, fit.step(), plan.seconds());
    let dir = AtomicDir::create(checkpoint::folder(run, step))?;
    fit.write_checkpoint(dir.path())?;
    let state = CheckpointState { version: 1, step, seconds, dataset_sha256: data.sha256.clone() };
    write_json(dir.path().join("state.json"), &state)?;
    dir.commit()?;
    checkpoint::prune(run)?;
    fit.write_avatar(run, last)?;
    let manifest = RunManifest {
        version: 1,
        dataset: data.dir.clone(),
        dataset_sha256: data.sha256.clone(),
        field: plan.field.to_owned(),
        seed: plan.seed,
        steps: step,
        seconds,
        written_by: format!("risorius {}", env!("CARGO_PKG_VERSION")),
    };
    Ok(manifest.write(run.join("run.json"))?)
}
