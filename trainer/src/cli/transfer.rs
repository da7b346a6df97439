//! `trainer transfer`.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use risorius_console::{AgainArgs, Console, Failure, Inputs, Running, Stage};
use risorius_formats::pose_report::write_json;
use risorius_formats::{Take, smooth};

use super::{DeviceArgs, need, run_inputs};
use crate::avatar::Avatar;
use crate::field::Look;
use crate::jobs::render::Sink;
use crate::jobs::transfer::{Driver, Named, Range, TransferSettings, transfer, transfer_views};

/// Options of `trainer transfer`.
#[derive(Debug, clap::Args)]
#[command(
    after_help = "Examples:\n  trainer transfer runs/ada --from takes/bob --video bob_as_ada.mp4\n  trainer transfer runs/ada --from takes/bob --out frames --range avatar --fps 24 --head copy\n  trainer transfer runs/ada runs/eve --curves MySlate_1.csv --video both.mp4\n  trainer transfer runs/ada --from takes/bob --views transfer/views.json --out compared"
)]
pub(super) struct TransferArgs {
    /// Folders of one run or of several, which are driven at once
    #[arg(required = true)]
    run: Vec<PathBuf>,
    /// The driver: a tracked take
    #[arg(long, value_name = "TAKE", required_unless_present = "curves", conflicts_with = "curves")]
    from: Option<PathBuf>,
    /// The driver: AU curves from an OpenFace, Live Link Face or plain table (`secs,AU12,…`)
    #[arg(long, value_name = "FILE.csv")]
    curves: Option<PathBuf>,
    #[command(flatten)]
    curve_options: super::curves::CurvesArgs,
    /// A video of the result
    #[arg(long, value_name = "OUT.mp4")]
    video: Option<PathBuf>,
    /// A folder for the pictures, named by the driver's frame; one folder in it per avatar where there are several
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Whose range turns the driver's intensities into expressions [default: driver]
    #[arg(long, value_enum)]
    range: Option<Range>,
    /// Pictures per second; above the driver's rate they lie between its frames [default: 12]
    #[arg(long, value_name = "FPS")]
    fps: Option<f64>,
    /// Turns of the head: fixed, copy, or a factor on them [default: fixed]
    #[arg(long, value_name = "HOW", value_parser = parse_head)]
    head: Option<f64>,
    /// Length of the smoothing window in seconds, 0 for none [default: 0.125]
    #[arg(long, value_name = "SECS")]
    smooth: Option<f64>,
    /// Leave the driver out of the picture
    #[arg(long)]
    alone: bool,
    /// Driver frames below this confidence hold the expression before them [default: 0.8]
    #[arg(long, value_name = "0-1")]
    min_confidence: Option<f32>,
    /// Render these views, each with the driver's expression at its `driver_frame`, and score them
    #[arg(long, value_name = "VIEWS.json", requires = "out", conflicts_with_all = ["video", "fps", "head"])]
    views: Option<PathBuf>,
    #[command(flatten)]
    again: AgainArgs,
    #[command(flatten)]
    device: DeviceArgs,
}

fn parse_head(text: &str) -> Result<f64, String> {
    match text {
        "fixed" => Ok(0.0),
        "copy" => Ok(1.0),
        _ => match text.parse::<f64>() {
            Ok(v) if (0.0..=2.0).contains(&v) => Ok(v),
            _ => Err("write `fixed`, `copy` or a factor between 0 and 2".to_owned()),
        },
    }
}

pub(super) fn run(args: &TransferArgs, console: &Console) -> Result<(), Failure> {
    if args.out.is_none() && args.video.is_none() {
        return Err(Failure::usage("nothing to write: give `--video OUT.mp4`, `--out DIR` or both"));
    }
    let fps = args.fps.unwrap_or(12.0);
    if !(fps.is_finite() && fps > 0.0 && fps <= 240.0) {
        return Err(Failure::usage("`--fps` must be above 0, and at most 240"));
    }
    let smooth_secs = args.smooth.unwrap_or(smooth::WINDOW_SECS);
    if !(0.0..=10.0).contains(&smooth_secs) {
        return Err(Failure::usage("`--smooth` must be between 0 and 10 seconds"));
    }
    for run in &args.run {
        need(run, "a run made by `trainer fit`")?;
    }
    let Some(running) = begin(args, fps, smooth_secs, console)? else { return Ok(()) };
    let driver = match (&args.from, &args.curves) {
        (Some(take), _) => {
            Driver::of_take(Take::open(take)?, args.min_confidence.unwrap_or(0.8), smooth_secs, console)?
        }
        (None, Some(path)) => Driver::of_table(path, &args.curve_options.options()?, smooth_secs, console)?,
        (None, None) => return Err(Failure::usage("no driver: give `--from TAKE` or `--curves FILE.csv`")),
    };
    let device = args.device.device()?;
    let opened = args.run.iter().map(|run| Avatar::open(run, &device)).collect::<Result<Vec<_>, _>>()?;
    let names = names(&args.run);
    let avatars: Vec<Named<'_>> = opened.iter().zip(names).map(|(avatar, name)| Named { name, avatar }).collect();
    let range = args.range.unwrap_or_default();
    if let (Some(list), Some(folder), [avatar, rest @ ..]) = (&args.views, &args.out, avatars.as_slice()) {
        if !rest.is_empty() {
            return Err(Failure::usage("`--views` takes one avatar"));
        }
        let evaluation = transfer_views(avatar, &driver, range, list, folder, console)?;
        write_json(folder.join("eval.json"), &evaluation)?;
        running.finish(&["eval.json"])?;
        let human = format!("mean PSNR {:.2} dB over {} views", evaluation.mean_psnr_db, evaluation.views.len());
        console.finish(&evaluation, &human);
        return Ok(());
    }
    let settings = TransferSettings { range, fps, side_by_side: !args.alone, head: args.head.unwrap_or(0.0) };
    let sink = Sink {
        folder: args.out.clone(),
        video: args.video.clone().map(|path| (path, fps)),
        look: Look::default(),
        ..Sink::default()
    };
    let summary = transfer(&avatars, &driver, &settings, &sink, console)?;
    let pictures = pictures(args.out.as_deref());
    running.finish(&pictures.iter().map(String::as_str).collect::<Vec<_>>())?;
    let mut human = format!(
        "{} pictures driven by {} AUs of {} frames, {:.2} s each",
        summary.pictures,
        summary.driven.len(),
        summary.driver_frames,
        summary.seconds_per_picture
    );
    for avatar in summary.avatars.iter().filter(|a| a.unseen_share > 0.0) {
        let share = avatar.unseen_share * 100.0;
        let _ =
            write!(human, "\n{}: {share:.0} % of the pictures turn the head farther than its cameras saw", avatar.name);
    }
    console.finish(&summary, &human);
    Ok(())
}

/// Takes the lock of what is to be written; `None` if it is there already.
fn begin(args: &TransferArgs, fps: f64, smooth_secs: f64, console: &Console) -> Result<Option<Running>, Failure> {
    let asked = serde_json::json!({
        "fps": fps,
        "smooth_secs": smooth_secs,
        "range": format!("{:?}", args.range.unwrap_or_default()),
        "head": args.head,
        "alone": args.alone,
        "min_confidence": args.min_confidence,
        "curves": format!("{:?}", args.curve_options),
        "names": names(&args.run),
        "video": args.video.is_some(),
    });
    let mut inputs = Inputs::default();
    for (run, k) in args.run.iter().zip(1..) {
        inputs = run_inputs(inputs, &format!("run {k}"), run);
    }
    if let Some(take) = &args.from {
        inputs = inputs.file("take.toml", take.join("take.toml")).file("driver", take.join("track/openface.csv"));
    }
    for (role, path) in [("curves", &args.curves), ("views", &args.views)] {
        if let Some(path) = path {
            inputs = inputs.file(role, path);
        }
    }
    let Some(result) = args.out.as_ref().or(args.video.as_ref()) else { return Err(Failure::usage("no result")) };
    Stage::new("trainer transfer", result, &asked)?.begin(args.again, inputs, console)
}

/// By what a transfer is known to be whole: the pictures in the folder, or the video, which is the result itself. In
/// folders of several avatars nothing is looked at, and the work is done again.
fn pictures(out: Option<&Path>) -> Vec<String> {
    let Some(out) = out else { return vec![String::new()] };
    let entries = std::fs::read_dir(out).into_iter().flatten().flatten();
    let names = entries.map(|e| e.file_name().to_string_lossy().into_owned());
    let mut names: Vec<String> = names.filter(|n| Path::new(n).extension().is_some_and(|e| e == "png")).collect();
    names.sort();
    names
}

/// The last parts of the folders, told apart by a number where they are the same.
fn names(runs: &[PathBuf]) -> Vec<String> {
    let plain = |run: &Path| {
        let full = run.canonicalize().unwrap_or_else(|_| run.to_owned());
        full.file_name().map_or_else(|| "avatar".to_owned(), |n| n.to_string_lossy().into_owned())
    };
    let all: Vec<String> = runs.iter().map(|r| plain(r)).collect();
    let numbered = |(i, name): (usize, &String)| {
        let twice = all.iter().filter(|n| *n == name).count() > 1;
        if twice { format!("{name}_{}", i + 1) } else { name.clone() }
    };
    all.iter().enumerate().map(numbered).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn heads_and_names() {
        assert_eq!((parse_head("fixed"), parse_head("copy"), parse_head("0.5")), (Ok(0.0), Ok(1.0), Ok(0.5)));
        assert!(parse_head("3").is_err() && parse_head("still").is_err());
        let runs = ["/nowhere/a", "/nowhere/b", "/else/a"].map(PathBuf::from);
        assert_eq!(names(&runs), ["a_1", "b", "a_3"]);
    }
}
