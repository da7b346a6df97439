//! `tracker run`: landmarks, AUs and head pose of a take by ONNX networks.
//!
//! Two passes. The first decodes the video once, follows the face ([`follow`]) and keeps what it saw on disk
//! ([`observations`]). Then the person is known: the shape of the resting face and the features of its rest. The second
//! pass turns what was seen into rows and writes them ([`rows`]). Memory does not grow with the length of the video.

pub mod between;
pub mod crop;
pub mod detect;
pub mod follow;
pub mod frames;
pub mod landmarks;
pub mod live;
pub mod mesh;
pub mod observations;
pub mod rows;

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Instant;

use risorius_formats::atomic::AtomicDir;
use risorius_formats::{FormatError, Reporter, Take, Warning};
use serde::Serialize;

use crate::aus::openface::OpenFaceModels;
use crate::aus::openface::clip::{ClipAus, ClipStatistics};
use crate::aus::{AuSource, Calibration, FEATURES, Person};
use crate::error::{Result, TrackerError};
use crate::gaze::Gazer;
use crate::head_pose::{Lens, shape::PersonShape};
use crate::models::ModelFolder;
use crate::models::runtime::{Runtime, library_places};
use crate::quality::TrackQuality;
use crate::weights::Weights;
use between::Interpolator;
use follow::{Effort, FirstFace, Follower};
use frames::{Block, decode};
use observations::{Observation, Recorder, Recording};

/// How to track a take.
#[derive(Clone, Debug)]
pub struct RunOptions {
    /// Folder with `models.toml`; `None` is [`crate::models::default_dir`].
    pub models: Option<PathBuf>,
    /// Track every N-th frame and interpolate between them; 1 tracks all.
    pub every: u32,
    /// Threads for the networks.
    pub threads: usize,
    /// Which face is followed where there are several.
    pub face: FirstFace,
    /// Focal length of the camera, pixels; `None` is 1.2 × the longer side.
    pub focal_px: Option<f64>,
    /// Whether the person's rest is learned from the whole video or, as a live system has to, from what came before.
    pub calibration: Calibration,
    /// Where AUs come from.
    pub aus: AuSource,
}

impl Default for RunOptions {
    fn default() -> Self {
        Self {
            models: None,
            every: 1,
            threads: std::thread::available_parallelism().map_or(1, usize::from),
            face: FirstFace::default(),
            focal_px: None,
            calibration: Calibration::default(),
            aus: AuSource::default(),
        }
    }
}

/// What a run found; also written beside the track, as `run.json`.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct RunSummary {
    /// Frames of the take.
    pub frames: usize,
    /// Frames that the networks saw.
    pub frames_tracked: usize,
    /// Frames between them that were interpolated.
    pub frames_interpolated: usize,
    /// `--every`.
    pub every: u32,
    /// Runs of the networks.
    pub effort: Effort,
    /// Focal length that the head pose assumes, pixels.
    pub focal_px: f64,
    /// How far the rigid points are from the fitted shape, root mean square, pixels.
    pub shape_error_px: f64,
    /// Hash of the landmark network's file, where the manifest gives one.
    pub landmark_model: String,
    /// The AU readout, or the hash (else the file) of the manifest's AU network.
    pub au_model: String,
    /// Quality of what was written.
    pub quality: TrackQuality,
    /// Seconds of the first pass.
    pub tracking_secs: f64,
    /// Seconds in all.
    pub seconds: f64,
}

/// How many frames tell the person's shape and rest at most.
const SAMPLE: usize = 1500;
/// How many of these the shape is fitted to.
const SHAPE_SAMPLE: usize = 150;

/// Tracks a take and writes `TAKE/track/`.
pub fn run(take_dir: impl AsRef<Path>, options: &RunOptions, reporter: &dyn Reporter) -> Result<RunSummary> {
    let started = Instant::now();
    let take = Take::open(take_dir)?;
    let openface = match &options.aus {
        AuSource::Own => None,
        AuSource::OpenFace(dir) => Some(Arc::new(OpenFaceModels::open(dir)?)),
    };
    let (models, mut follower) =
        open_networks(options.models.as_deref(), options.threads, options.face, openface.as_ref())?;
    let mut statistics = openface.as_deref().map(ClipStatistics::new);
    let every = options.every.max(1);
    let folder = AtomicDir::create(take.dir.join("track"))?;

    let last = (take.frames.len() as u32).saturating_sub(1);
    reporter.stage("track", Some(u64::from(last / every + 1)));
    let observations = folder.path().join("observations.tmp");
    let recording = first_pass(&take, &mut follower, statistics.as_mut(), every, &observations, reporter)?;
    let tracking_secs = started.elapsed().as_secs_f64();

    reporter.stage("write the track", None);
    let lens = Lens::new(take.manifest.width, take.manifest.height, options.focal_px);
    let sample = recording.sample(SAMPLE)?;
    if sample.is_empty() {
        let message = format!(
            "{}: no face was found in any of its {} frames; is it upright, and at least an eighth of the picture high?",
            take.media_path().display(),
            take.frames.len()
        );
        reporter.warn(Warning::new("no-face", message));
    }
    let step = sample.len().div_ceil(SHAPE_SAMPLE).max(1);
    let pictures: Vec<[[f32; 2]; 68]> = sample.iter().step_by(step).map(|o| o.points_px).collect();
    let shape: PersonShape = Weights::get().shape.fit(&lens, &pictures);
    let person = follower.readout().map(|readout| {
        let features: Vec<_> = sample.iter().filter_map(|o| o.features.as_slice().try_into().ok()).collect();
        Person::learn(readout, &features, options.calibration)
    });
    let eyes: Vec<_> = sample.iter().filter_map(|o| o.eyes.as_deref().copied()).collect();
    let eyes = Gazer::learn(&eyes, options.calibration);
    let person_is_known = person.is_some() && options.calibration == Calibration::WholeVideo;
    let clip = statistics.map(|statistics| clip_aus(&statistics, &recording, every, take.frames.len())).transpose()?;
    let network = follower.au_model();
    let au_model = match &network {
        Some(m) => m.sha256.clone().unwrap_or_else(|| m.file.clone()),
        None if clip.is_some() => "OpenFace's models".to_owned(),
        None if person.is_some() => Weights::get().name.clone(),
        None => "none: no mesh".to_owned(),
    };
    let shape_error_px = shape.error * lens.focal_px;
    let maker =
        rows::RowMaker { lens, shape, person, au_model: network, clip, eyes, before: None, pitch_apart: (0.0, 0) };
    let writer = rows::Writer { take: &take, maker, every, smooth: person_is_known };
    let written = writer.write(&recording, folder.path(), reporter)?;
    let tracked = recording.len();
    recording.remove()?;

    let summary = RunSummary {
        frames: take.frames.len(),
        frames_tracked: tracked,
        frames_interpolated: written.interpolated,
        every,
        effort: follower.effort(),
        focal_px: lens.focal_px,
        shape_error_px,
        landmark_model: models
            .manifest
            .landmarks
            .sha256
            .clone()
            .unwrap_or_else(|| models.manifest.landmarks.file.clone()),
        au_model,
        quality: written.quality,
        tracking_secs,
        seconds: started.elapsed().as_secs_f64(),
    };
    let path = folder.path().join("run.json");
    let text = serde_json::to_string_pretty(&summary)
        .map_err(|e| TrackerError::Encode { path: path.clone(), message: e.to_string() })?;
    std::fs::write(&path, text + "\n").map_err(|e| FormatError::io(&path, "write", &e))?;
    folder.commit()?;
    Ok(summary)
}

/// The AUs of every frame from x·w of the tracked ones.
fn clip_aus(statistics: &ClipStatistics, recording: &Recording, every: u32, frames: usize) -> Result<ClipAus> {
    let mut between = Interpolator::new(recording.read()?, every, frames);
    let products = (0..frames).map(|_| {
        let (observation, _) = between.next_frame()?;
        Ok(observation.and_then(|o| Some(o.features.get(FEATURES..)?.to_vec())))
    });
    statistics.aus(products)
}

/// Loads the networks of a folder, or those that `tools/models` fetched.
fn open_networks(
    models: Option<&Path>,
    threads: usize,
    face: FirstFace,
    openface: Option<&Arc<OpenFaceModels>>,
) -> Result<(ModelFolder, Follower)> {
    let default_dir = crate::models::default_dir();
    let models = ModelFolder::open(models.unwrap_or(&default_dir))?;
    let runtime = Runtime::load(&library_places(&[&models.dir, &default_dir]))?;
    let follower = Follower::new(&runtime, &models, threads, face, openface)?;
    Ok((models, follower))
}

/// Counts what OpenFace's models read of a frame, and puts x·w in its place: x is a hundred times as long.
fn reduce(observation: Option<&mut Observation>, statistics: &mut ClipStatistics) {
    let x = observation.as_ref().and_then(|o| o.features.get(FEATURES..));
    let products = statistics.push(x);
    if let (Some(observation), Some(products)) = (observation, products) {
        observation.features.truncate(FEATURES);
        observation.features.extend(products);
    }
}

/// Follows the face through the video and keeps what was seen at `path`.
fn first_pass(
    take: &Take,
    follower: &mut Follower,
    mut statistics: Option<&mut ClipStatistics>,
    every: u32,
    path: &Path,
    reporter: &dyn Reporter,
) -> Result<Recording> {
    let last = (take.frames.len() as u32).saturating_sub(1);
    let features = match &statistics {
        Some(statistics) => FEATURES + statistics.products(),
        None => follower.au_model().map_or(FEATURES, |m| m.units.len()),
    };
    let mut recorder = Recorder::create(path, features)?;
    let mut seen = 0;
    std::thread::scope(|scope| -> Result<()> {
        let (blocks, decoder) = decode(scope, take, every, last)?;
        for Block { frames, pictures } in &blocks {
            if reporter.cancelled() {
                return Err(TrackerError::Cancelled { doing: "tracking".to_owned() });
            }
            for found in follower.block(&pictures)? {
                let mut observation = found.map(Observation::from);
                if let Some(statistics) = &mut statistics {
                    reduce(observation.as_mut(), statistics);
                }
                recorder.push(observation.as_ref())?;
            }
            seen += frames.len();
            reporter.advance(frames.len() as u64);
        }
        // A panic over there is a bug that goes on here.
        decoder.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic))?;
        Ok(())
    })?;
    let expected = take.frames.len().div_ceil(every as usize) + usize::from(!last.is_multiple_of(every));
    if seen < expected {
        reporter.warn(Warning::new(
            "video-shorter",
            format!(
                "{}: ends after {seen} of {expected} frames to be tracked; the rest count as lost",
                take.media_path().display()
            ),
        ));
        for _ in seen..expected {
            recorder.push(None)?;
        }
    }
    recorder.finish()
}
