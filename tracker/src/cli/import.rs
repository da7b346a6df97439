//! `tracker import`.

use std::path::PathBuf;

use clap::ValueEnum;
use risorius_console::{AgainArgs, Console, Failure, Stage};
use risorius_formats::TableScale;
use risorius_formats::openface::FaceChoice;
use serde::Deserialize;
use serde_json::json;

use crate::import::{self, ImportOptions, MIN_CONFIDENCE};

/// Take the track from an OpenFace table
///
/// Takes tables of any OpenFace version; semicolons, decimal commas between them and other scales of the AUs are converted,
/// and said. Rows are matched to frames by their number, and frames whose row has `success` 0
/// or too little confidence are lost. Writes TAKE/track/openface.csv and TAKE/track/track.parquet.
#[derive(clap::Args, Debug)]
#[command(
    after_help = "Examples:\n  tracker import takes/ada --openface ada.csv\n  tracker import takes/ada --openface probabilities.csv --au-scale 1"
)]
pub(super) struct ImportArgs {
    /// The take
    take: PathBuf,
    /// The table
    #[arg(long, value_name = "FILE.csv")]
    openface: PathBuf,
    /// Number of the take's first frame in the table's `frame` column [default: 1]
    #[arg(long, value_name = "N")]
    first_frame: Option<u32>,
    /// Which face to take where there are several [default: largest]
    #[arg(long, value_name = "WHICH")]
    face: Option<FaceArg>,
    /// Rows below this confidence are lost, 0–1 [default: 0.8]
    #[arg(long, value_name = "SHARE")]
    min_confidence: Option<f32>,
    /// Largest value of the scale of the table's AUs: 1 for probabilities, 5 for OpenFace, 100 for percent [default: as
    /// the values tell]
    #[arg(long, value_name = "N")]
    au_scale: Option<TableScale>,
    #[command(flatten)]
    again: AgainArgs,
}

#[derive(Clone, Copy, Debug, ValueEnum, Deserialize)]
#[serde(rename_all = "kebab-case")]
enum FaceArg {
    Largest,
    First,
}

/// `[tracker.import]`-like keys of `risorius.toml`, table `tracker-import`.
#[derive(Debug, Default, Deserialize)]
#[serde(deny_unknown_fields, default, rename_all = "kebab-case")]
struct Settings {
    first_frame: Option<u32>,
    face: Option<FaceArg>,
    min_confidence: Option<f32>,
}

pub(super) fn run(args: &ImportArgs, console: &Console) -> Result<(), Failure> {
    let settings: Settings = risorius_console::settings("tracker-import")?;
    let min_confidence = args.min_confidence.or(settings.min_confidence).unwrap_or(MIN_CONFIDENCE);
    if !(0.0..=1.0).contains(&min_confidence) {
        return Err(Failure::usage(format!("`--min-confidence` has to lie between 0 and 1, not at {min_confidence}")));
    }
    let face = match args.face.or(settings.face).unwrap_or(FaceArg::Largest) {
        FaceArg::Largest => FaceChoice::Largest,
        FaceArg::First => FaceChoice::First,
    };
    let options = ImportOptions {
        openface: args.openface.clone(),
        first_frame: args.first_frame.or(settings.first_frame),
        face,
        min_confidence,
        scale: args.au_scale,
    };
    let asked = json!({
        "first_frame": options.first_frame,
        "first_face": matches!(options.face, FaceChoice::First),
        "min_confidence": min_confidence,
        "au_scale": options.scale.map(TableScale::largest),
    });
    let track = args.take.join("track");
    super::need_take(&args.take)?;
    let stage = Stage::new("tracker import", &track, &asked)?;
    let inputs = super::take_inputs(&args.take, &[]).file("openface", &options.openface);
    let Some(running) = stage.begin(args.again, inputs, console)? else { return Ok(()) };
    let summary = import::import(&args.take, &options, console)?;
    running.finish(&["openface.csv", "track.parquet"])?;
    let human =
        format!("{}\nwritten to   {}", super::quality_in_words(&summary.quality), args.take.join("track").display());
    console.finish(&summary, &human);
    Ok(())
}
