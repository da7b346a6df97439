//! `dataset export`, `dataset import` and `dataset redact`.

use std::path::PathBuf;

use clap::ValueEnum;
use risorius_console::{Console, Failure};
use risorius_formats::ActionUnit;

use crate::export::{self, ExportOptions, Target};
use crate::import::{self, ImportOptions};
use crate::redact;

/// Write a dataset in another layout.
///
/// nerfies: without our additions. Nerfies and HyperNeRF open it as it is; the released CoNeRF and CoNFies loaders also
/// want rgb/<s>x/<id>_depth.npy, which no video holds and which is not made up here.
/// transforms: transforms.json with OpenGL axes and pictures, for nerfstudio and instant-ngp.
/// colmap: sparse/0 as a COLMAP text model and pictures, without 3-D points.
/// parquet: a table with a row per frame, pictures, the tables of all frames and a dataset card.
///
/// What a layout cannot express goes into a folder risorius/ beside it, so that `dataset import` gives the dataset back.
#[derive(Debug, clap::Args)]
#[command(
    after_help = "Example:\n  dataset export datasets/ada --to transforms --out exports/ada",
    verbatim_doc_comment
)]
pub(super) struct ExportArgs {
    /// Folder of the dataset
    dataset: PathBuf,
    /// The layout
    #[arg(long, value_enum)]
    to: LayoutArg,
    /// Where it goes; an older folder there is replaced
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Leave out the folder risorius/
    #[arg(long)]
    plain: bool,
}

#[derive(Clone, Copy, Debug, ValueEnum)]
enum LayoutArg {
    #[value(alias = "conerf")]
    Nerfies,
    Transforms,
    Colmap,
    Parquet,
}

/// Make a dataset of another program's folder, or of an export.
///
/// A CoNeRF or CoNFies folder with annotated attributes, or anything that `dataset export` wrote. Classes that are not
/// named like AUs need an AU each.
#[derive(Debug, clap::Args)]
#[command(
    after_help = "Examples:\n  dataset import exports/ada --out datasets/ada2\n  dataset import conerf/captain --au \"left eye=AU46\" --au \"right eye=AU45\" --au mouth=AU26 --out datasets/captain"
)]
pub(super) struct ImportArgs {
    /// Folder to import
    folder: PathBuf,
    /// Where the dataset goes; an older one there is replaced
    #[arg(long, value_name = "DATASET")]
    out: PathBuf,
    /// Which AU a class stands for
    #[arg(long, value_name = "CLASS=AUxx", value_parser = class_and_unit)]
    au: Vec<(String, ActionUnit)>,
    /// Pass by the folder risorius/ of an export, as another program would
    #[arg(long)]
    ignore_sidecar: bool,
}

fn class_and_unit(text: &str) -> Result<(String, ActionUnit), String> {
    let (class, unit) = text.rsplit_once('=').ok_or("write it like `smile=AU12`")?;
    Ok((class.trim().to_owned(), unit.trim().parse().map_err(|e: risorius_formats::FormatError| e.to_string())?))
}

/// Remove a take from a dataset for good: pictures, masks, cameras, attributes, tables and report.
///
/// The ranges of the AUs and the place of the head were measured on all takes and stay. Exports and avatars made earlier
/// are not reached.
#[derive(Debug, clap::Args)]
#[command(after_help = "Example:\n  dataset redact datasets/ab --take b")]
pub(super) struct RedactArgs {
    /// Folder of the dataset
    dataset: PathBuf,
    /// Name of the take
    #[arg(long, value_name = "NAME")]
    take: String,
}

pub(super) fn export(args: &ExportArgs, console: &Console) -> Result<(), Failure> {
    let target = match args.to {
        LayoutArg::Nerfies => Target::Nerfies,
        LayoutArg::Transforms => Target::Transforms,
        LayoutArg::Colmap => Target::Colmap,
        LayoutArg::Parquet => Target::Parquet,
    };
    let options = ExportOptions { plain: args.plain };
    let _lock = risorius_console::hold("dataset export", &args.out, console)?;
    let done = export::export_with(&args.dataset, target, &args.out, options, console)?;
    if matches!(args.to, LayoutArg::Nerfies) {
        console.say("note: the released CoNeRF and CoNFies loaders also want rgb/<s>x/<id>_depth.npy; a video has no depth, so none is written");
    }
    console.finish(&done, &format!("{}: {} frames in {} files", args.out.display(), done.frames, done.files));
    Ok(())
}

pub(super) fn import(args: &ImportArgs, console: &Console) -> Result<(), Failure> {
    let options = ImportOptions { units: args.au.iter().cloned().collect(), ignore_sidecar: args.ignore_sidecar };
    let _lock = risorius_console::hold("dataset import", &args.out, console)?;
    let report = import::import(&args.folder, &args.out, &options, console)?;
    let active = report.attributes.iter().filter(|a| a.active).count();
    let text = format!(
        "{}: {} frames, {} for fitting, {active} of {} attributes active",
        args.out.display(),
        report.chosen,
        report.split.train,
        report.attributes.len()
    );
    console.finish(&report, &text);
    Ok(())
}

pub(super) fn redact(args: &RedactArgs, console: &Console) -> Result<(), Failure> {
    let _lock = risorius_console::hold("dataset redact", &args.dataset, console)?;
    let done = redact::redact(&args.dataset, &args.take, console)?;
    let text = format!(
        "{}: {} frames of take `{}` are gone, {} frames of {} stay",
        args.dataset.display(),
        done.frames_removed,
        args.take,
        done.frames_left,
        done.takes_left.join(", ")
    );
    console.finish(&done, &text);
    Ok(())
}
