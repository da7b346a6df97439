//! The fit of the brick field: steps until the schedule or the time is over, checkpoints, metrics.

use std::path::Path;
use std::time::Instant;

use glam::Vec3;
use risorius_brick::heal::{heal, unheal};
use risorius_brick::{Brick, Fitter, Progress, Settings, StepNumbers};
use risorius_formats::Reporter;
use risorius_formats::atomic::AtomicDir;
use risorius_formats::pose_report::{json_error, write_json};
use serde::{Deserialize, Serialize};

use super::hull::RegionHull;
use super::layout;
use super::store::{self, SavedBrick};
use super::views::TrainViews;
use crate::bounds;
use crate::data::TrainData;
use crate::error::{Result, TrainerError};
use crate::fit::checkpoint::{self, CheckpointState};
use crate::fit::metrics::{MetricsLog, Recent};
use crate::fit::{FitSummary, manifest, settings_to_disk};
use crate::saved::{SavedField, SavedModel};

/// Everything that decides a fit of the brick field. Saved as `settings.toml`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BrickSettings {
    /// Always `brick`.
    pub field: String,
    /// Steps, where they were asked for; they are exact.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub steps: Option<u64>,
    /// Wall seconds, where no steps were asked for.
    pub budget_secs: f64,
    /// The dataset's image scale; 0 takes the dataset's default.
    pub image_scale: u32,
    /// Share of the rays drawn from pixels inside region masks.
    pub region_share: f32,
    /// Vertices along each edge of the AUs' lattice.
    pub expression_vertices: usize,
    /// Finest level of the head, vertices along an edge.
    pub finest_level: usize,
    /// Steps between checkpoints; 0 writes one when a minute has passed and it costs no more than a fortieth of the time.
    pub checkpoint_every: u64,
    /// The steps themselves.
    pub step: Settings,
}

impl Default for BrickSettings {
    fn default() -> Self {
        Self {
            field: "brick".to_owned(),
            steps: None,
            budget_secs: 120.0,
            image_scale: 0,
            region_share: 0.3,
            expression_vertices: 64,
            finest_level: 512,
            checkpoint_every: 0,
            step: Settings::default(),
        }
    }
}

/// A line of `metrics.jsonl`.
#[derive(Debug, Serialize)]
struct Line {
    step: u64,
    seconds: f64,
    stage: usize,
    psnr_db: f64,
    #[serde(flatten)]
    numbers: StepNumbers,
    samples_per_ray: f32,
    occupied_cells: usize,
}

/// The state of a checkpoint besides the arrays.
#[derive(Debug, Serialize, Deserialize)]
struct BrickState {
    progress: Progress,
    saved: SavedBrick,
}

/// Names of the floats that a checkpoint holds besides the model.
const PENDING: [&str; 2] = ["pending.head", "pending.background"];

/// Fits an avatar of `data` into the folder `run`.
pub fn fit(
    data: &TrainData,
    settings: &BrickSettings,
    run: &Path,
    resume: bool,
    reporter: &dyn Reporter,
) -> Result<FitSummary> {
    if data.table.regions.len() > risorius_brick::expression::REST {
        return Err(TrainerError::Dataset {
            path: data.dir.clone(),
            message: format!("has {} regions, the brick field holds 3", data.table.regions.len()),
            hint: "use `--field confies`".to_owned(),
        });
    }
    bounds::of_settings(settings).map_err(|message| TrainerError::Setting {
        message,
        hint: "`--set KEY=VALUE` and the run's settings.toml change settings".to_owned(),
    })?;
    let started = Instant::now();
    let views = TrainViews::new(data, settings.region_share);
    let (mut fitter, seconds_before) = start(data, settings, run, resume)?;
    let first_step = fitter.progress.step;
    let parameters = fitter.model.parameters();
    reporter.note(&format!(
        "{} frames of {}×{}, {} attributes in {} regions, {parameters} parameters to begin with, {:?}",
        data.frames.len(),
        data.frames[0].camera.intrinsics.width,
        data.frames[0].camera.intrinsics.height,
        data.table.attributes.len(),
        data.table.regions.len(),
        risorius_brick::simd::level(),
    ));
    settings_to_disk(settings, run)?;
    let mut log = MetricsLog::open(run, first_step)?;
    let mut recent = Recent::default();
    let seconds = || seconds_before + started.elapsed().as_secs_f64();
    // In thousandths: the length in steps of a fit by time is not known.
    let total = settings.steps.unwrap_or(1000);
    reporter.stage("fit", Some(total));
    let (mut shown, mut rays, mut samples, mut finished) = (0, 0usize, 0usize, false);
    // What the last save will take of the time that was asked for.
    let mut save_secs = (0.02 * settings.budget_secs).min(2.0);
    let mut saved_at = seconds();
    loop {
        let step = fitter.progress.step;
        let done = match settings.steps {
            Some(steps) => step as f64 / steps.max(1) as f64,
            None => (seconds() + save_secs) / settings.budget_secs,
        };
        let reached = ((done * total as f64) as u64).min(total);
        reporter.advance(reached.saturating_sub(shown));
        shown = shown.max(reached);
        if done >= 1.0 {
            finished = true;
            break;
        }
        if reporter.cancelled() {
            break;
        }
        let numbers = fitter.step(&views, done as f32);
        check_finite(&numbers, fitter.progress.step)?;
        rays += numbers.rays;
        samples += numbers.samples[0] + numbers.samples[1];
        recent.add(numbers.color);
        let step = fitter.progress.step;
        if MetricsLog::is_due(step) {
            log.write(&Line {
                step,
                seconds: (seconds() * 1e3).round() / 1e3,
                stage: fitter.progress.stage,
                psnr_db: crate::eval::psnr_from_mse(numbers.color),
                numbers,
                samples_per_ray: fitter.progress.samples_per_ray,
                occupied_cells: fitter.model.head.occupancy.occupied(),
            })?;
        }
        if step % 250 == 0 {
            reporter.note(&format!("step {step}: {:.2} dB, stage {}", recent.psnr_db(), fitter.progress.stage));
        }
        let due = match settings.checkpoint_every {
            0 => seconds() - saved_at >= (40.0 * save_secs).max(60.0),
            every => step.is_multiple_of(every),
        };
        if due {
            let begun = Instant::now();
            save(&mut fitter, &views, seconds(), data, settings, run, false)?;
            save_secs = begun.elapsed().as_secs_f64();
            saved_at = seconds();
        }
    }
    log.finish()?;
    save(&mut fitter, &views, seconds(), data, settings, run, true)?;
    if !finished {
        return Err(TrainerError::Interrupted { done: format!("step {}", fitter.progress.step) });
    }
    Ok(FitSummary {
        run: run.to_owned(),
        steps: fitter.progress.step,
        seconds: seconds(),
        rays_per_sec: rays as f64 / started.elapsed().as_secs_f64().max(1e-9),
        samples_per_sec: samples as f64 / started.elapsed().as_secs_f64().max(1e-9),
        train_psnr_db: recent.psnr_db(),
        parameters: fitter.model.parameters(),
        frames: data.frames.len(),
        scale: data.scale,
        finished,
    })
}

fn check_finite(numbers: &StepNumbers, step: u64) -> Result<()> {
    for (value, what) in
        [(numbers.color, "the colour error"), (numbers.mask, "the mask error"), (numbers.attribute, "L_attr")]
    {
        if !value.is_finite() {
            return Err(TrainerError::NotFinite { step, what: what.to_owned() });
        }
    }
    Ok(())
}

fn start(data: &TrainData, settings: &BrickSettings, run: &Path, resume: bool) -> Result<(Fitter, f64)> {
    if !resume {
        let hull = RegionHull::new(data);
        let layout = layout::of(data, settings.expression_vertices, settings.finest_level);
        let mut model = Brick::new(layout, settings.step.seed, |p| hull.regions_at(p));
        model.neutral_image = data.neutral_frame();
        return Ok((Fitter::new(model, settings.step.clone(), Progress::default()), 0.0));
    }
    let (path, state) = checkpoint::newest(run, &data.sha256)?;
    if path.join("state.safetensors").exists() {
        return Err(TrainerError::Run {
            path,
            message: "is a checkpoint of an earlier version".to_owned(),
            hint: "fit anew without `--resume`; the run's avatar can be used as it is".to_owned(),
        });
    }
    let file = path.join("brick.json");
    let bytes = std::fs::read(&file).map_err(|e| risorius_formats::FormatError::io(&file, "read", &e))?;
    let brick: BrickState = serde_json::from_slice(&bytes).map_err(|e| json_error(&e).in_file(&file))?;
    bounds::of_progress(&brick.progress).map_err(|problem| crate::saved::damaged(&file, &problem))?;
    let (model, pending) = store::checkpoint::read(&path, &brick.saved, &PENDING)?;
    let mut fitter = Fitter::new(model, settings.step.clone(), brick.progress);
    fitter.set_pending_weights(&pending);
    Ok((fitter, state.seconds))
}

fn save(
    fitter: &mut Fitter,
    views: &TrainViews<'_>,
    seconds: f64,
    data: &TrainData,
    settings: &BrickSettings,
    run: &Path,
    last: bool,
) -> Result<()> {
    let step = fitter.progress.step;
    let pending = fitter.pending_weights();
    let progress = fitter.progress.clone();
    let model = &mut fitter.model;
    let saved = SavedBrick::of(model, views.plate(), data.is_uncapped());
    let dir = AtomicDir::create(checkpoint::folder(run, step))?;
    let more = [(PENDING[0], pending[0].as_slice()), (PENDING[1], pending[1].as_slice())];
    store::checkpoint::write(dir.path(), model, &more)?;
    let brick = BrickState { progress, saved: SavedBrick { plate: None, ..saved.clone() } };
    write_json(dir.path().join("brick.json"), &brick)?;
    let state = CheckpointState { version: 1, step, seconds, dataset_sha256: data.sha256.clone() };
    write_json(dir.path().join("state.json"), &state)?;
    dir.commit()?;
    checkpoint::prune(run)?;
    // A fit that goes on decides anew what it looks into; an avatar that stays is mended.
    let before = last.then(|| heal(model, &expressions(model)));
    let written = store::avatar::write(&run.join("model.safetensors"), model, views.plate());
    if let Some(before) = before {
        unheal(model, before);
    }
    written?;
    let center =
        data.extras().map_or_else(|| Vec3::from_array(model.layout.head_box.center).as_dvec3(), |e| e.head_center);
    write_json(run.join("model.json"), &SavedModel::describe(data, SavedField::Brick(saved), center))?;
    manifest(data, "brick", settings.step.seed, step, seconds).write(run.join("run.json"))?;
    Ok(())
}

/// Activations of the neutral face and of each AU at its most, with the code of the neutral face.
fn expressions(model: &Brick) -> Vec<Vec<f32>> {
    let count = model.layout.region_of.len();
    let code = model.code(model.neutral_image);
    let face = |most: Option<usize>| {
        let aus = (0..count).map(|k| f32::from(u8::from(Some(k) == most)));
        aus.chain(code.iter().copied()).collect()
    };
    std::iter::once(face(None)).chain((0..count).map(|k| face(Some(k)))).collect()
}
