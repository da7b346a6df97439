//! The Gaussian field in the loop.

use std::path::Path;
use std::time::Instant;

use risorius_formats::Reporter;
use risorius_splat::model::channel;
use risorius_splat::{Fitter, Scene, Settings, StepNumbers};
use serde::{Deserialize, Serialize};

use super::scene::SceneData;
use super::store::{self, SavedSplat};
use super::{checkpoint as stored, plate::Plate, space::MetricSpace};
use crate::bounds;
use crate::data::TrainData;
use crate::error::{Result, TrainerError};
use crate::field::{FieldFit, StepReport};
use crate::fit::{FitSummary, Length, Plan, checkpoint, drive, note_scene, settings_to_disk};
use crate::saved::{SavedField, SavedModel};

/// Everything that decides a fit of the Gaussian field. Saved as `settings.toml`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SplatSettings {
    /// Always `splat`.
    pub field: String,
    /// Steps, where they were asked for; they are exact.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub steps: Option<u64>,
    /// Wall seconds, where no steps were asked for.
    pub budget_secs: f64,
    /// The dataset's image scale; 0 takes the dataset's default.
    pub image_scale: u32,
    /// Steps between checkpoints; 0 writes one when a minute has passed and it costs no more than a fortieth of the time.
    pub checkpoint_every: u64,
    /// The steps themselves.
    pub splat: Settings,
}

impl Default for SplatSettings {
    fn default() -> Self {
        Self {
            field: "splat".to_owned(),
            steps: None,
            budget_secs: 60.0,
            image_scale: 0,
            checkpoint_every: 0,
            splat: Settings::default(),
        }
    }
}

/// A fit in progress.
pub struct SplatFit<'a> {
    data: &'a TrainData,
    scene: &'a Scene<'a>,
    space: MetricSpace,
    plate: Option<&'a Plate>,
    fitter: Fitter,
}

impl FieldFit for SplatFit<'_> {
    type Numbers = StepNumbers;

    fn step(&self) -> u64 {
        self.fitter.progress.step
    }

    fn parameters(&self) -> usize {
        let model = &self.fitter.model;
        model.count() * (channel::COUNT + model.layout.regions) + model.deltas.len()
    }

    fn advance(&mut self, done: f64) -> Result<StepReport<StepNumbers>> {
        let numbers = self.fitter.step(self.scene, done as f32);
        let checked = [
            ("the colour error", numbers.color),
            ("the mask error", numbers.mask),
            ("the attribute loss", numbers.attribute),
        ];
        Ok(StepReport {
            mse: numbers.color,
            pixels: numbers.pixels,
            checked: checked.map(|(name, v)| (name.to_owned(), v)).into(),
            numbers,
        })
    }

    fn write_checkpoint(&mut self, folder: &Path) -> Result<()> {
        stored::write(folder, &self.fitter)
    }

    fn write_avatar(&mut self, run: &Path, _last: bool) -> Result<()> {
        let model = self.fitter.avatar();
        store::write(&run.join("model.safetensors"), &model, self.plate)?;
        let saved = SavedSplat {
            groups: model.groups(),
            deformable: model.deformable,
            layout: model.layout,
            space: self.space,
            intensities: self.data.has_intensities(),
            plate: self.plate.map(|p| [p.width, p.height]),
        };
        let center = self.data.extras().map_or(self.space.origin_in_world, |e| e.head_center);
        let described = SavedModel::describe(self.data, SavedField::Splat(saved), center);
        Ok(risorius_formats::pose_report::write_json(run.join("model.json"), &described)?)
    }
}

/// Fits an avatar of `data` into the folder `run`.
///
/// With `resume`, goes on from the newest checkpoint; without, an existing run is refused by the caller.
pub fn fit(
    data: &TrainData,
    settings: &SplatSettings,
    run: &Path,
    resume: bool,
    reporter: &dyn Reporter,
) -> Result<FitSummary> {
    bounds::of_settings(settings).map_err(|message| TrainerError::Setting {
        message,
        hint: "`--set KEY=VALUE` and the run's settings.toml change settings".to_owned(),
    })?;
    let started = Instant::now();
    let made = SceneData::new(data)?;
    let scene = made.scene();
    let (fitter, seconds_before) = if resume {
        let (folder, state) = checkpoint::newest(run, &data.sha256)?;
        let fitter = stored::read(&folder, &settings.splat)?;
        check_same_images(&fitter, data, &folder)?;
        (fitter, state.seconds)
    } else {
        (Fitter::new(&scene, settings.splat.clone(), &|what| reporter.note(what)), 0.0)
    };
    let mut fit = SplatFit { data, scene: &scene, space: made.space, plate: made.plate.as_ref(), fitter };
    note_scene(data, fit.parameters(), reporter);
    settings_to_disk(settings, run)?;
    let plan = Plan {
        data,
        run,
        field: "splat",
        seed: settings.splat.seed,
        length: Length { steps: settings.steps, budget_secs: settings.steps.is_none().then_some(settings.budget_secs) },
        checkpoint_every: settings.checkpoint_every,
        started,
        seconds_before,
    };
    drive(&mut fit, &plan, reporter)
}

/// What belongs to single images is looked up by their numbers.
fn check_same_images(fitter: &Fitter, data: &TrainData, folder: &Path) -> Result<()> {
    let layout = &fitter.model.layout;
    let regions = data.table.attributes.iter().map(|a| a.region);
    if layout.images == data.frames.len()
        && fitter.head_poses.len() == data.frames.len()
        && regions.eq(layout.region_of.iter().copied())
    {
        return Ok(());
    }
    Err(crate::saved::damaged(folder, &"its frames or AUs are not those of the dataset"))
}
