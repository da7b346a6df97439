//! `tracker run`.

use std::fmt::Write as _;
use std::path::PathBuf;

use clap::ValueEnum;
use risorius_console::{AgainArgs, Console, Failure, Stage};
use serde::Deserialize;
use serde_json::json;

use crate::aus::openface::folder::ModelFiles;
use crate::aus::{AuSource, Calibration};
use crate::run::follow::FirstFace;
use crate::run::{self, RunOptions};

/// Track the face: 68 landmarks, 17 AUs, head pose
///
/// Runs ONNX networks over the video: the face is detected once and then followed. AU intensities come from a regressor
/// of this project, calibrated on the person over the whole video, as OpenFace does. Writes TAKE/track/openface.csv (an
/// OpenFace 2.2 table), TAKE/track/track.parquet and TAKE/track/run.json.
///
/// The networks and the ONNX Runtime are not part of this program: `tools/models` fetches them.
#[derive(clap::Args, Debug)]
#[command(after_help = "Examples:
  tracker run takes/ada
  tracker run takes/ada --every 4
  tracker run takes/ada --models my-models --threads 1
  tracker run takes/ada --aus openface --openface-models OpenFace_2.2.0_win_x64")]
pub(super) struct RunArgs {
    /// The take
    take: PathBuf,
    /// Folder with models.toml and the networks it names [default: where `tools/models` puts them]
    #[arg(long, value_name = "DIR")]
    models: Option<PathBuf>,
    /// Track every N-th frame and interpolate between them [default: 1]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=1000))]
    every: Option<u32>,
    /// Threads for the networks [default: all cores]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=1024))]
    threads: Option<u32>,
    /// Which face to follow where there are several [default: largest]
    #[arg(long, value_name = "WHICH")]
    face: Option<FaceArg>,
    /// Focal length of the camera, pixels [default: 1.2 × the longer side]
    #[arg(long, value_name = "PX")]
    focal: Option<f64>,
    /// Learn the person's rest from earlier frames only, as a live system has to
    #[arg(long)]
    online: bool,
    /// Where AUs come from [default: own]
    #[arg(long, value_name = "WHICH")]
    aus: Option<AusArg>,
    /// Folder of an OpenFace 2.x install, for `--aus openface`
    #[arg(long, value_name = "DIR")]
    openface_models: Option<PathBuf>,
    #[command(flatten)]
    again: AgainArgs,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum, Deserialize)]
#[serde(rename_all = "kebab-case")]
enum AusArg {
    /// This project's readout, or the AU network of models.toml
    Own,
    /// OpenFace's own AU models (academic, non-commercial use), which you have
    Openface,
}

#[derive(Clone, Copy, Debug, ValueEnum, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub(super) enum FaceArg {
    Largest,
    /// The one that the detector is surest of
    First,
}

impl FaceArg {
    pub(super) fn first(self) -> FirstFace {
        match self {
            Self::Largest => FirstFace::Largest,
            Self::First => FirstFace::First,
        }
    }
}

/// Keys of `risorius.toml`, table `tracker-run`.
#[derive(Debug, Default, Deserialize)]
#[serde(deny_unknown_fields, default, rename_all = "kebab-case")]
struct Settings {
    models: Option<PathBuf>,
    every: Option<u32>,
    threads: Option<u32>,
    face: Option<FaceArg>,
    focal: Option<f64>,
    online: Option<bool>,
    aus: Option<AusArg>,
    openface_models: Option<PathBuf>,
}

/// Where AUs come from, by the options `--aus` and `--openface-models`; the latter's default lies in `risorius.toml`.
fn au_source(
    aus: AusArg,
    named: Option<&PathBuf>,
    default: Option<PathBuf>,
    online: bool,
) -> Result<AuSource, Failure> {
    match (aus, named.cloned().or(default)) {
        (AusArg::Own, _) if named.is_some() => Err(Failure::usage("`--openface-models` goes with `--aus openface`")),
        (AusArg::Own, _) => Ok(AuSource::Own),
        (AusArg::Openface, _) if online => Err(Failure::usage(
            "`--aus openface` needs the whole clip: its median is rest, and `--online` knows earlier frames only",
        )),
        (AusArg::Openface, Some(dir)) => Ok(AuSource::OpenFace(dir)),
        (AusArg::Openface, None) => {
            Err(Failure::usage("`--aus openface` needs `--openface-models DIR`, the folder of an OpenFace 2.x install"))
        }
    }
}

pub(super) fn run(args: &RunArgs, console: &Console) -> Result<(), Failure> {
    let settings: Settings = risorius_console::settings("tracker-run")?;
    let defaults = RunOptions::default();
    let focal_px = super::above_zero("focal", "pixels", args.focal.or(settings.focal))?;
    let every = args.every.or(settings.every).unwrap_or(defaults.every);
    let threads = args.threads.or(settings.threads).map_or(defaults.threads, |n| n as usize);
    if every == 0 || threads == 0 {
        return Err(Failure::usage("`every` and `threads` have to be at least 1"));
    }
    let face = args.face.or(settings.face).unwrap_or(FaceArg::Largest).first();
    let online = args.online || settings.online.unwrap_or(false);
    let aus = au_source(
        args.aus.or(settings.aus).unwrap_or(AusArg::Own),
        args.openface_models.as_ref(),
        settings.openface_models,
        online,
    )?;
    let options = RunOptions {
        models: args.models.clone().or(settings.models),
        every,
        threads,
        face,
        focal_px,
        calibration: if online { Calibration::Online } else { Calibration::WholeVideo },
        aus,
    };
    let models = options.models.clone().unwrap_or_else(crate::models::default_dir);
    let mut asked = json!({
        "every": every,
        "first_face": matches!(face, FirstFace::First),
        "focal_px": focal_px,
        "online": online,
    });
    if options.aus != AuSource::Own {
        asked["aus"] = json!("openface");
    }
    let track = args.take.join("track");
    super::need_take(&args.take)?;
    let stage = Stage::new("tracker run", &track, &asked)?;
    let mut inputs = super::take_inputs(&args.take, &[]).file("models", models.join(crate::models::MANIFEST));
    if let AuSource::OpenFace(dir) = &options.aus {
        inputs = inputs.file("openface-models", ModelFiles::find(dir)?.list);
    }
    let Some(running) = stage.begin(args.again, inputs, console)? else { return Ok(()) };
    let summary = run::run(&args.take, &options, console).map_err(|e| super::failure(e, options.models.is_some()))?;
    running.finish(&["openface.csv", "track.parquet"])?;
    let mut human = super::quality_in_words(&summary.quality);
    let _ = write!(
        human,
        "\nhead pose    {:.2} px from the fitted shape (focal length {:.0} px)\ntracked      {} frames in {:.1} s: {:.0} frames/s of the video",
        summary.shape_error_px,
        summary.focal_px,
        summary.frames_tracked,
        summary.tracking_secs,
        summary.frames as f64 / summary.seconds.max(1e-9),
    );
    if summary.frames_interpolated > 0 {
        let _ = write!(human, ", {} interpolated", summary.frames_interpolated);
    }
    let _ = write!(human, "\nwritten to   {}", args.take.join("track").display());
    console.finish(&summary, &human);
    Ok(())
}
