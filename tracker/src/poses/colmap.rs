//! Cameras by COLMAP: key frames as pictures, features, comparisons of picture pairs, mapping.
//!
//! Only key frames are handed over; what lies between them is interpolated. Everything runs on the CPU. The pairs to be
//! compared are given as lists, in portions, so that progress and Ctrl-C do not depend on COLMAP's own output.

use std::collections::BTreeMap;
use std::ffi::OsString;
use std::fmt::Write as _;
use std::fs;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use glam::DVec2;
use risorius_formats::{FormatError, FrameIndex, Reporter, Silent, Take, Warning};

use super::child::{Runner, number_after};
use super::flags::Flags;
use super::join::join;
use super::keyframes;
use super::keys::{self, Keys};
use super::model::{self, Found};
use super::picture::Picture;
use super::program::{Program, Surroundings};
use super::work::{self, Work};
use crate::error::{Result, TrackerError};

/// Below this share of placed key frames the result is refused.
pub const MIN_REGISTERED_SHARE: f64 = 0.4;
/// Pictures whose longer side is below this are doubled for the features.
const SMALL_SIDE: u32 = 720;
/// Pairs per call of the matcher.
const PAIRS_PER_CALL: usize = 150;
/// COLMAP's own least number of images of a model.
const MIN_IMAGES: usize = 3;

/// Whether features on the face are left out.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum MaskFace {
    /// If there is enough else to hold on to.
    Auto,
    /// Always.
    On,
    /// Never.
    Off,
}

/// How COLMAP is run.
#[derive(Clone, Debug)]
pub struct ColmapOptions {
    /// The program: COLMAP, or a Python that has `pycolmap` (its file name begins with `python`).
    pub program: PathBuf,
    /// How many key frames; `None` decides by the length of the take.
    pub keyframes: Option<usize>,
    /// COLMAP's camera model for the one camera of the take.
    pub camera_model: String,
    /// Features per key frame.
    pub max_features: u32,
    /// Key frames are reduced until their longer side is at most this, pixels.
    pub max_side: u32,
    /// Whether features on the face are left out.
    pub mask_face: MaskFace,
    /// How long COLMAP may take.
    pub time_limit: Option<Duration>,
    /// Whether the pictures and the database stay in the take's `.poses-work`.
    pub keep_work: bool,
    /// Take a model even if few key frames were placed.
    pub accept_poor: bool,
}

impl Default for ColmapOptions {
    fn default() -> Self {
        Self {
            program: super::program::default_path(),
            keyframes: None,
            // A second focal length and tangential terms trade off against the pose: with OPENCV, a capture with
            // known square pixels came out with fy 0.4 % off and every pose turned by the same 0.12°.
            camera_model: "SIMPLE_RADIAL".into(),
            max_features: 1500,
            max_side: 1280,
            mask_face: MaskFace::Auto,
            time_limit: None,
            keep_work: false,
            accept_poor: false,
        }
    }
}

/// What COLMAP gave.
#[derive(Clone, Debug)]
pub struct Run {
    /// The best sub-model.
    pub found: Found,
    /// The key frames.
    pub keyframes: Vec<u32>,
    /// Their pictures.
    pub(crate) pictures: BTreeMap<u32, Picture>,
    /// Outline of the masked face in them, pixels; empty without masks.
    pub(crate) face: BTreeMap<u32, Vec<DVec2>>,
    /// What to know.
    pub notes: Vec<String>,
}

/// Runs COLMAP with its files in the folder `work_dir`, where an unfinished run of the same job goes on; its output is
/// in `log`, which will later be found at `final_log`.
pub fn run(
    take: &Take,
    options: &ColmapOptions,
    read: Keys,
    work_dir: &Path,
    log: &Path,
    final_log: &Path,
    reporter: &dyn Reporter,
) -> Result<Run> {
    let around = Surroundings { log, final_log, started: Instant::now(), limit: options.time_limit, reporter };
    let program = Program::find(&options.program, around)?;
    let runner = program.runner(around);
    let flags = Flags::of(program.version);
    let in_words = program.in_words();
    let keys: Vec<u32> = read.pictures.keys().copied().collect();
    let (masked, why) = keys::decide_mask(options.mask_face, &read.pictures, &read.outlines);
    let face = if masked { read.outlines.clone() } else { BTreeMap::new() };
    let work = Work::open(work_dir.to_owned(), &job(take, &keys, options, &in_words, &face))?;
    let mut notes = vec![format!("{in_words} on {} key frames", keys.len()), why];
    if work.is_done("features") {
        let message = "went on where an earlier run had stopped".to_owned();
        reporter.note(&message);
        notes.push(message);
    }
    if !work.is_done("pictures") {
        keys::write(&keys, &read, &face, masked, take, &work)?;
        work.done("pictures")?;
    }
    let (pictures, database) = (work.path("images"), work.path("database.db"));
    if !work.is_done("features") {
        reporter.stage("features", Some(keys.len() as u64));
        // COLMAP would give the pictures that a killed run had not come to a second camera.
        work.remove_files("database.db")?;
        let mut args = words(&[
            ("--database_path", database.as_os_str()),
            ("--image_path", pictures.as_os_str()),
            ("--ImageReader.single_camera", "1".as_ref()),
            ("--ImageReader.camera_model", options.camera_model.as_ref()),
            ("--SiftExtraction.max_num_features", options.max_features.to_string().as_ref()),
            ("--SiftExtraction.first_octave", first_octave(take, options).as_ref()),
            // A second orientation of the same place doubles the comparisons and adds no point.
            ("--SiftExtraction.max_num_orientations", "1".as_ref()),
            (flags.extraction_gpu, "0".as_ref()),
        ]);
        if masked {
            args.extend(words(&[("--ImageReader.mask_path", work.path("masks").as_os_str())]));
        }
        runner.run("feature_extractor", &args, Some(|line| number_after(line, "Processed file [")))?;
        work.done("features")?;
    }
    compare(&runner, &keys, &database, flags, &work)?;
    if !work.is_done("map") {
        map(&runner, &keys, &database, &pictures, flags, &work)?;
        work.done("map")?;
    }
    let found = pick(take, &work, final_log, keys.len(), &mut notes)?;
    let registered = found.model.frames.len();
    if (registered as f64) < MIN_REGISTERED_SHARE * keys.len() as f64 {
        if !options.accept_poor {
            return Err(TrackerError::FewRegistered { registered, tried: keys.len() });
        }
        let message = format!("COLMAP placed only {registered} of {} key frames; taken as asked", keys.len());
        reporter.warn(Warning::new("few-registered", message.clone()));
        notes.push(message);
    }
    Ok(Run { found, keyframes: keys, pictures: read.pictures, face, notes })
}

/// Whether the program is there: asked before pictures are read, as a missing program should not cost that.
pub fn look_for(options: &ColmapOptions, log: &Path, final_log: &Path, reporter: &dyn Reporter) -> Result<()> {
    let around = Surroundings { log, final_log, started: Instant::now(), limit: options.time_limit, reporter };
    Program::find(&options.program, around).map(drop)
}

/// What the files in the work folder depend on.
fn job(take: &Take, keys: &[u32], options: &ColmapOptions, version: &str, face: &BTreeMap<u32, Vec<DVec2>>) -> String {
    // Outlines to a tenth of a pixel: the mask's pixels hang on no more.
    let face: Vec<[i64; 3]> = face
        .iter()
        .flat_map(|(&f, hull)| hull.iter().map(move |p| [i64::from(f), (p.x * 10.0) as i64, (p.y * 10.0) as i64]))
        .collect();
    serde_json::json!({
        "video": take.manifest.media_sha256,
        "size": [take.manifest.width, take.manifest.height],
        "frames": keys,
        "colmap": version,
        "camera_model": options.camera_model,
        "max_features": options.max_features,
        "max_side": options.max_side,
        "face": face,
    })
    .to_string()
}

/// COLMAP doubles its pictures before it looks for features: four times the work, for features of a pixel or two.
///
/// Small pictures have few others. The places need not be exact, since they are found again by their patches.
fn first_octave(take: &Take, options: &ColmapOptions) -> &'static str {
    let side = take.manifest.width.max(take.manifest.height).min(options.max_side);
    if side < SMALL_SIDE { "-1" } else { "0" }
}

fn words(pairs: &[(&str, &std::ffi::OsStr)]) -> Vec<OsString> {
    pairs.iter().flat_map(|(name, value)| [OsString::from(name), (*value).to_owned()]).collect()
}

fn compare(runner: &Runner<'_>, keys: &[u32], database: &Path, flags: Flags, work: &Work) -> Result<()> {
    let pairs = keyframes::pairs(keys.len());
    runner.reporter.stage("compare pictures", Some(pairs.len() as u64));
    for (i, portion) in pairs.chunks(PAIRS_PER_CALL).enumerate() {
        let step = format!("pairs_{i:04}");
        if work.is_done(&step) {
            runner.reporter.advance(portion.len() as u64);
            continue;
        }
        let list = work.path(&format!("{step}.txt"));
        let mut text = String::new();
        for &(a, b) in portion {
            // Writing into a string cannot fail.
            let _ = writeln!(text, "{} {}", FrameIndex(keys[a]).image_name(), FrameIndex(keys[b]).image_name());
        }
        fs::write(&list, text).map_err(|e| FormatError::io(&list, "write", &e))?;
        let args = words(&[
            ("--database_path", database.as_os_str()),
            ("--match_list_path", list.as_os_str()),
            ("--match_type", "pairs".as_ref()),
            (flags.matching_gpu, "0".as_ref()),
        ]);
        runner.run("matches_importer", &args, None)?;
        work.done(&step)?;
        runner.reporter.advance(portion.len() as u64);
    }
    Ok(())
}

fn map(runner: &Runner<'_>, keys: &[u32], database: &Path, pictures: &Path, flags: Flags, work: &Work) -> Result<()> {
    let sparse = work.path("sparse");
    // Half a model of a run that was killed.
    work::remove(&sparse)?;
    keys::create_dir(&sparse)?;
    runner.reporter.stage("map", Some(keys.len() as u64));
    let args = words(&[
        ("--database_path", database.as_os_str()),
        ("--image_path", pictures.as_os_str()),
        ("--output_path", sparse.as_os_str()),
        // A model doubles its cost when it is adjusted as a whole after every tenth picture.
        (flags.global_ratio, "1.4".as_ref()),
        ("--Mapper.ba_global_points_ratio", "1.4".as_ref()),
        ("--Mapper.ba_global_max_num_iterations", "30".as_ref()),
    ]);
    match runner.run("mapper", &args, Some(images_placed)) {
        // Some versions exit with an error when they find no model; that is told better below.
        Err(TrackerError::ColmapFailed { .. })
            if model::model_dirs(&sparse).is_empty() && is_about_no_model(runner.log) =>
        {
            Ok(())
        }
        other => other.map(|_| ()),
    }
}

/// `Registering image #12 (34)` is the 34th image; from 3.12 on it reads `(num_reg_frames=34)`.
fn images_placed(line: &str) -> Option<u64> {
    line.contains("Registering image #")
        .then(|| number_after(line, "num_reg_frames=").or(number_after(line, "(")))
        .flatten()
}

fn is_about_no_model(log: &Path) -> bool {
    let text = fs::read(log).map(|b| String::from_utf8_lossy(&b).into_owned()).unwrap_or_default();
    let text = text.to_ascii_lowercase();
    // 4.0 says `any sparse model`.
    let none = ["failed to create sparse model", "failed to create any sparse model", "no good initial image pair"];
    none.iter().any(|words| text.contains(words))
}

/// The largest sub-model, with the others joined to it where they share frames.
fn pick(take: &Take, work: &Work, log: &Path, tried: usize, notes: &mut Vec<String>) -> Result<Found> {
    let sparse = work.path("sparse");
    let dirs = model::model_dirs(&sparse);
    if dirs.is_empty() {
        return Err(TrackerError::ColmapNoModel { tried, log: log.to_owned() });
    }
    // Silent: that the pictures were reduced is our own doing.
    let mut found = model::load(&sparse, take, 0, &Silent)?;
    let largest = found.model.frames.len();
    let mut joined = 0;
    for dir in dirs.iter().filter(|d| **d != found.dir) {
        let other = model::load(dir, take, 0, &Silent)?;
        joined += usize::from(join(&mut found.model, &other.model));
    }
    let registered = found.model.frames.len();
    notes.push(match (dirs.len(), joined) {
        (1, _) => format!("one model with {registered} images"),
        (n, 0) => {
            format!("took the largest of {n} sub-models with {registered} images; the others share too few frames")
        }
        (n, joined) => {
            format!("{joined} of {} sub-models joined to the largest: {largest} and then {registered} images", n - 1)
        }
    });
    if registered < MIN_IMAGES {
        return Err(TrackerError::ColmapNoModel { tried, log: log.to_owned() });
    }
    Ok(found)
}

#[cfg(test)]
#[path = "colmap_tests.rs"]
mod tests;
