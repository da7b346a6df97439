//! `tracker poses`.

use std::fmt::Write as _;
use std::path::PathBuf;
use std::time::Duration;

use clap::ValueEnum;
use risorius_console::{AgainArgs, Console, Failure, Stage};
use risorius_formats::pose_report::{PoseMethod, PoseReport};
use serde::Deserialize;

use crate::import::MIN_CONFIDENCE;
use crate::poses::colmap::{ColmapOptions, MaskFace};
use crate::poses::head::{HeadOptions, SMOOTH_SECS};
use crate::poses::interpolate::MAX_GAP_SECS;
use crate::poses::{self, Numbering, PosesOptions, Source};

/// Find the camera of every frame
///
/// `auto` (default) looks whether the background moves. `colmap`: the camera moves around a head that is held still;
/// COLMAP places key frames, their patches place all other frames. `head`: the camera stands still and the head moves.
/// `--colmap-model` takes a finished COLMAP model. Needs the landmarks of `tracker run` or `tracker import`. Writes
/// TAKE/poses/sparse (COLMAP text), TAKE/poses/report.json and TAKE/poses/report.svg. A run that was stopped goes on
/// where it was.
#[derive(clap::Args, Debug)]
#[command(after_help = "Examples:
  tracker poses takes/ada
  tracker poses takes/ada --colmap-model ada-colmap/sparse/0
  tracker poses takes/ada --colmap-model ada-colmap/sparse/0 --colmap-first 1 --colmap-step 8
  tracker poses takes/bob --method head")]
pub(super) struct PosesArgs {
    /// The take
    take: PathBuf,
    /// Where the cameras come from [default: auto]
    #[arg(long, value_name = "METHOD")]
    method: Option<MethodArg>,
    /// Take this COLMAP model (a folder with cameras, images and points3D, or one above it) instead of running COLMAP
    #[arg(long, value_name = "DIR")]
    colmap_model: Option<PathBuf>,
    /// Number of the take's first frame in the model's image names [default: what fits the landmarks]
    #[arg(long, value_name = "N", requires = "colmap_model")]
    colmap_first: Option<u32>,
    /// Frames of the take from one number in the model's image names to the next, such as 8 where every eighth was
    /// extracted [default: what fits the landmarks]
    #[arg(long, value_name = "N", requires = "colmap_model")]
    colmap_step: Option<f64>,
    /// Take only images of this folder of the model, where it holds several captures [default: what fits the landmarks]
    #[arg(long, value_name = "NAME", requires = "colmap_model")]
    colmap_folder: Option<String>,
    /// Key frames that COLMAP gets [default: one per 0.5 s, 40 to 80]
    #[arg(long, value_name = "N")]
    keyframes: Option<usize>,
    /// The COLMAP program, or a Python that has `pycolmap`, such as venv/bin/python [default: colmap, else python3]
    #[arg(long, value_name = "PATH")]
    colmap: Option<PathBuf>,
    /// COLMAP's camera model [default: SIMPLE_RADIAL]
    #[arg(long, value_name = "NAME")]
    camera_model: Option<String>,
    /// Features per key frame [default: 1500]
    #[arg(long, value_name = "N")]
    max_features: Option<u32>,
    /// Leave the moving face out of COLMAP's features [default: auto, if there is enough texture beside it]
    #[arg(long, value_name = "WHETHER")]
    mask_face: Option<MaskArg>,
    /// Stop COLMAP after this many seconds
    #[arg(long, value_name = "SECS")]
    time_limit: Option<u64>,
    /// Keep COLMAP's pictures and database in TAKE/.poses-work
    #[arg(long)]
    keep_work: bool,
    /// Take the result even if it is of low quality, or worse than the poses that the take has
    #[arg(long)]
    accept_poor: bool,
    /// Millimetres between the person's pupils: the world becomes metres (63 is usual)
    #[arg(long, value_name = "MM")]
    eye_distance: Option<f64>,
    /// With `--method head`: focal length in pixels [default: from the table, or 1.2 × the longer side]
    #[arg(long, value_name = "PX")]
    focal: Option<f64>,
    /// With `--method head`: smooth the poses over this many seconds to each side, 0 is off [default: 0.06]
    #[arg(long, value_name = "SECS")]
    smooth: Option<f64>,
    /// Leave COLMAP's poses as they are and interpolate between them; with `--method head`: take the
    /// table's poses as they are
    #[arg(long)]
    no_refine: bool,
    #[command(flatten)]
    again: AgainArgs,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum, Deserialize)]
#[serde(rename_all = "kebab-case")]
enum MethodArg {
    Auto,
    Colmap,
    Head,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum, Deserialize)]
#[serde(rename_all = "kebab-case")]
enum MaskArg {
    Auto,
    On,
    Off,
}

/// Keys of the table `tracker-poses` in `risorius.toml`.
#[derive(Debug, Default, Deserialize)]
#[serde(deny_unknown_fields, default, rename_all = "kebab-case")]
struct Settings {
    method: Option<MethodArg>,
    keyframes: Option<usize>,
    colmap: Option<PathBuf>,
    camera_model: Option<String>,
    max_features: Option<u32>,
    mask_face: Option<MaskArg>,
    time_limit: Option<u64>,
    eye_distance: Option<f64>,
    focal: Option<f64>,
    smooth: Option<f64>,
}

pub(super) fn run(args: &PosesArgs, console: &Console) -> Result<(), Failure> {
    let settings: Settings = risorius_console::settings("tracker-poses")?;
    if args.colmap_model.is_some() && args.method == Some(MethodArg::Head) {
        return Err(Failure::usage("`--colmap-model` and `--method head` exclude each other"));
    }
    let source = if let Some(dir) = &args.colmap_model {
        Source::Model { dir: dir.clone(), numbering: numbering(args)? }
    } else {
        match args.method.or(settings.method).unwrap_or(MethodArg::Auto) {
            MethodArg::Auto => Source::Auto(colmap_options(args, &settings)?, head_options(args, &settings)?),
            MethodArg::Colmap => Source::Colmap(colmap_options(args, &settings)?),
            MethodArg::Head => Source::Head(head_options(args, &settings)?),
        }
    };
    let eye_distance = args.eye_distance.or(settings.eye_distance);
    if eye_distance.is_some_and(|d| !(d.is_finite() && d > 0.0)) {
        return Err(Failure::usage("`--eye-distance` has to be a positive number of millimetres"));
    }
    let options = PosesOptions {
        source,
        min_confidence: MIN_CONFIDENCE,
        max_gap_secs: MAX_GAP_SECS,
        accept_poor: args.accept_poor,
        eye_distance_mm: eye_distance,
        follow: !args.no_refine,
        correct_by_landmarks: !args.no_refine,
    };
    let place = args.take.join("poses");
    super::need_take(&args.take)?;
    // The options hold where a model lies, which is no setting: its contents are an input.
    let asked = match &options.source {
        Source::Model { numbering, .. } => {
            let source = Source::Model { dir: PathBuf::new(), numbering: numbering.clone() };
            format!("{:?}", PosesOptions { source, ..options.clone() })
        }
        _ => format!("{options:?}"),
    };
    let stage = Stage::new("tracker poses", &place, &asked)?;
    let mut inputs = super::take_inputs(&args.take, &["track/openface.csv"]);
    if let Some(dir) = &args.colmap_model {
        inputs = inputs.folder("colmap_model", dir, is_of_model);
    }
    let Some(running) = stage.begin(args.again, inputs, console)? else { return Ok(()) };
    let report = poses::find(&args.take, &options, console).map_err(|e| super::failure(e, args.colmap.is_some()))?;
    running.finish(&["sparse/cameras.txt", "sparse/images.txt", "sparse/points3D.txt"])?;
    let human = format!("{}\nwritten to    {}", in_words(&report), args.take.join("poses").display());
    console.finish(&report, &human);
    Ok(())
}

fn numbering(args: &PosesArgs) -> Result<Numbering, Failure> {
    if args.colmap_step.is_some_and(|s| !(s.is_finite() && s > 0.0)) {
        return Err(Failure::usage("`--colmap-step` has to be a positive number of frames"));
    }
    Ok(Numbering { first: args.colmap_first, step: args.colmap_step, folder: args.colmap_folder.clone() })
}

/// Whether a file belongs to a COLMAP model, wherever it lies in the folder that was named.
fn is_of_model(path: &str) -> bool {
    let name = path.rsplit('/').next().unwrap_or(path);
    ["cameras.", "images.", "points3D."].iter().any(|start| name.starts_with(start))
}

fn colmap_options(args: &PosesArgs, settings: &Settings) -> Result<ColmapOptions, Failure> {
    let defaults = ColmapOptions::default();
    let keyframes = args.keyframes.or(settings.keyframes);
    if keyframes.is_some_and(|n| n < 3) {
        return Err(Failure::usage("`--keyframes` has to be at least 3"));
    }
    Ok(ColmapOptions {
        program: args.colmap.clone().or(settings.colmap.clone()).unwrap_or(defaults.program),
        keyframes,
        camera_model: args.camera_model.clone().or(settings.camera_model.clone()).unwrap_or(defaults.camera_model),
        max_features: args.max_features.or(settings.max_features).unwrap_or(defaults.max_features),
        max_side: defaults.max_side,
        mask_face: args.mask_face.or(settings.mask_face).map_or(defaults.mask_face, |m| match m {
            MaskArg::Auto => MaskFace::Auto,
            MaskArg::On => MaskFace::On,
            MaskArg::Off => MaskFace::Off,
        }),
        time_limit: args.time_limit.or(settings.time_limit).map(Duration::from_secs),
        keep_work: args.keep_work,
        accept_poor: args.accept_poor,
    })
}

fn head_options(args: &PosesArgs, settings: &Settings) -> Result<HeadOptions, Failure> {
    let focal_px = args.focal.or(settings.focal);
    if focal_px.is_some_and(|f| !(f.is_finite() && f > 0.0)) {
        return Err(Failure::usage("`--focal` has to be a positive number of pixels"));
    }
    let smooth_secs = args.smooth.or(settings.smooth).unwrap_or(SMOOTH_SECS);
    if !(0.0..=1.0).contains(&smooth_secs) {
        return Err(Failure::usage("`--smooth` has to lie between 0 and 1 second"));
    }
    Ok(HeadOptions { focal_px, smooth_secs, refine: !args.no_refine, min_confidence: MIN_CONFIDENCE })
}

/// The report as lines of text.
pub(super) fn in_words(r: &PoseReport) -> String {
    let method = match r.method {
        PoseMethod::Colmap => "COLMAP",
        PoseMethod::ColmapModel => "finished COLMAP model",
        PoseMethod::Head => "head pose (still camera)",
    };
    let mut text = format!(
        "method        {method}\nframes        {} of {} with a pose: {} of {} placed ({:.1} %), {} by patches of those, {} interpolated",
        r.frames_registered + r.frames_followed + r.frames_interpolated,
        r.frames,
        r.frames_registered,
        r.frames_tried,
        100.0 * r.registered_share,
        r.frames_followed,
        r.frames_interpolated
    );
    if let Some(error) = r.reprojection_error_px {
        let _ = write!(text, "\nreprojection  {error:.2} px");
    }
    if let Some(error) = r.landmark_error_px {
        let _ = write!(text, "\nmean face     {error:.2} px from the landmarks (expression included)");
    }
    let unit = if r.units_per_metre == Some(1.0) { " m" } else { "" };
    let _ = write!(
        text,
        "\nhead          depth {:.3} … {:.3}{unit}, radius {:.3}{unit}\nnear, far     {:.3}, {:.3}{unit}",
        r.head_depth[0], r.head_depth[1], r.head_radius, r.near, r.far
    );
    for problem in &r.problems {
        let _ = write!(text, "\nproblem       {problem}");
    }
    for note in &r.notes {
        let _ = write!(text, "\nnote          {note}");
    }
    let _ = write!(text, "\ntime          {:.1} s", r.seconds);
    text
}
