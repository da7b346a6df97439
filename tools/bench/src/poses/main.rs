//! How fast and how accurate `tracker poses` is on a capture with exact cameras, beside the plain COLMAP recipe.
//!
//! The plain recipe is what one types after reading COLMAP's tutorial: full-size pictures, all features, all pairs, the
//! mapper as it is. Each run is a process of its own; CPU time and peak memory are the system's count, of all programs
//! it started. Times on a shared machine are noisy: CPU seconds are the sounder ones. Writes `poses_bench.csv` and
//! `poses_bench.svg`.

mod plain;
mod plot;

use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use clap::Parser;
use risorius_bench::child;
use risorius_console::{Common, CommonArgs, Console, Failure};
use risorius_formats::{FormatError, Take, atomic, colmap};
use serde::Serialize;
use serde_json::Value;

/// Speed and accuracy of `tracker poses` on a capture with exact cameras
#[derive(Debug, Parser)]
#[command(
    name = "bench-poses",
    version,
    about,
    after_help = "Example:\n  bench-poses --capture captures/ada --work work/poses --keyframes 30,40,60,80 --plain 40,80"
)]
struct Cli {
    #[command(flatten)]
    common: CommonArgs,
    /// A capture: video.mp4, openface.csv, and truth_colmap with the exact cameras (images numbered from 0)
    #[arg(long, value_name = "DIR")]
    capture: PathBuf,
    /// Where the take and the results go
    #[arg(long, value_name = "DIR")]
    work: PathBuf,
    /// Numbers of key frames for `tracker poses`
    #[arg(long, value_delimiter = ',', default_values_t = [40usize, 80])]
    keyframes: Vec<usize>,
    /// Numbers of pictures for the plain recipe; none leaves it out
    #[arg(long, value_delimiter = ',')]
    plain: Vec<usize>,
    /// The COLMAP program
    #[arg(long, value_name = "PATH", default_value = "colmap")]
    colmap: PathBuf,
    /// Further options for `tracker poses`, such as `--mask-face off`
    #[arg(last = true)]
    options: Vec<String>,
}

impl Common for Cli {
    fn common(&self) -> &CommonArgs {
        &self.common
    }
}

/// One run.
#[derive(Clone, Debug, Serialize)]
pub(crate) struct Row {
    recipe: &'static str,
    keyframes: usize,
    wall_secs: f64,
    cpu_secs: f64,
    peak_mib: f64,
    /// Frames with a pose, and frames of the video.
    posed: usize,
    frames: usize,
    rotation_mean_deg: f64,
    rotation_max_deg: f64,
    /// Units of the truth.
    position_mean: f64,
    position_max: f64,
    /// Share of the largest distance of a true camera from their mean, percent.
    position_mean_percent: f64,
    /// Focal length against the truth, percent.
    focal_percent: f64,
}

fn main() -> ExitCode {
    risorius_console::run(run)
}

fn text(p: &Path) -> String {
    p.to_string_lossy().into_owned()
}

fn run(cli: &Cli, console: &Console) -> Result<(), Failure> {
    std::fs::create_dir_all(&cli.work).map_err(|e| FormatError::io(&cli.work, "create", &e))?;
    let take_dir = cli.work.join("take");
    let take_text = text(&take_dir);
    let call = |program: &str, args: &[String]| {
        let args: Vec<&str> = args.iter().map(String::as_str).collect();
        child::run(program, &args, &cli.work)
    };
    let words = |list: &[&str]| list.iter().map(|s| (*s).to_owned()).collect::<Vec<_>>();
    if !take_dir.join("take.toml").is_file() {
        let video = text(&cli.capture.join("video.mp4"));
        call("capture", &words(&["record", "--input", &video, "--out", &take_text]))?;
    }
    let table = text(&cli.capture.join("openface.csv"));
    call("tracker", &words(&["import", &take_text, "--openface", &table]))?;
    let truth = cli.capture.join("truth_colmap");
    let mut rows = Vec::new();
    for &keyframes in &cli.keyframes {
        let mut args = words(&["poses", &take_text, "--method", "colmap", "--keyframes", &keyframes.to_string()]);
        args.extend(words(&["--colmap", &text(&cli.colmap)]));
        args.extend(cli.options.iter().cloned());
        console.say(&format!("tracker {}", args.join(" ")));
        let done = call("tracker", &args)?;
        let row = Row {
            wall_secs: done.wall_secs,
            cpu_secs: done.cpu_secs,
            peak_mib: done.peak_mib,
            ..Row::empty("tracker poses", keyframes)
        };
        rows.push(measured(row, &take_dir, &truth, &call)?);
    }
    for &pictures in &cli.plain {
        console.say(&format!("plain COLMAP on {pictures} pictures"));
        let take = Take::open(&take_dir)?;
        let folder = cli.work.join(format!("plain-{pictures}"));
        let used = plain::run(&cli.colmap, &take, pictures, &folder)?;
        // Its model as it is; the frames between are left to interpolation, as the recipe has nothing for them.
        let model = text(&used.model);
        call("tracker", &words(&["poses", &take_text, "--colmap-model", &model, "--no-refine", "--accept-poor"]))?;
        let row = Row {
            wall_secs: used.wall_secs,
            cpu_secs: used.cpu_secs,
            peak_mib: used.peak_mib,
            ..Row::empty("plain COLMAP", pictures)
        };
        rows.push(measured(row, &take_dir, &truth, &call)?);
    }
    atomic::write_file(cli.work.join("poses_bench.csv"), csv(&rows).as_bytes())?;
    let plot = cli.work.join("poses_bench.svg");
    plot::write(&plot, &rows)?;
    console.finish(&rows, &in_words(&rows));
    Ok(())
}

impl Row {
    fn empty(recipe: &'static str, keyframes: usize) -> Self {
        Self {
            recipe,
            keyframes,
            wall_secs: 0.0,
            cpu_secs: 0.0,
            peak_mib: 0.0,
            posed: 0,
            frames: 0,
            rotation_mean_deg: 0.0,
            rotation_max_deg: 0.0,
            position_mean: 0.0,
            position_max: 0.0,
            position_mean_percent: 0.0,
            focal_percent: 0.0,
        }
    }
}

/// Fills in the errors: of all frames for `tracker poses`, of the frames that COLMAP placed for the plain recipe.
fn measured(
    mut row: Row,
    take_dir: &Path,
    truth: &Path,
    call: &impl Fn(&str, &[String]) -> Result<child::Run, Failure>,
) -> Result<Row, Failure> {
    let args = ["check", &text(take_dir), "--reference", &text(truth)].map(str::to_owned);
    let check = call("tracker", &args)?.document;
    let set = if row.recipe == "plain COLMAP" { "registered" } else { "all" };
    let errors = &check["reference"][set];
    let number = |v: &Value| v.as_f64().unwrap_or(f64::NAN);
    row.posed = errors["frames"].as_u64().unwrap_or(0) as usize;
    row.frames = check["poses"]["frames"].as_u64().unwrap_or(0) as usize;
    row.rotation_mean_deg = number(&errors["rotation_deg"]["mean"]);
    row.rotation_max_deg = number(&errors["rotation_deg"]["max"]);
    row.position_mean = number(&errors["position"]["mean"]);
    row.position_max = number(&errors["position"]["max"]);
    let exact = colmap::read_model(truth)?;
    let centres: Vec<glam::DVec3> = exact.images.values().map(|i| i.camera_from_world.camera_center()).collect();
    let mean = centres.iter().sum::<glam::DVec3>() / centres.len().max(1) as f64;
    let radius = centres.iter().map(|c| c.distance(mean)).fold(0.0, f64::max);
    row.position_mean_percent = 100.0 * row.position_mean / radius;
    let own = colmap::read_model(Take::open(take_dir)?.sparse_dir())?;
    let focal =
        |m: &colmap::Model| m.cameras.values().next().and_then(|c| c.intrinsics().ok()).map_or(f64::NAN, |l| l.fx);
    row.focal_percent = 100.0 * (focal(&own) / focal(&exact) - 1.0);
    Ok(row)
}

fn csv(rows: &[Row]) -> String {
    let mut out = "recipe,keyframes,wall_secs,cpu_secs,peak_mib,posed,frames,rotation_mean_deg,rotation_max_deg,position_mean,position_max,position_mean_percent,focal_percent\n".to_owned();
    for r in rows {
        let _ = writeln!(
            out,
            "{},{},{:.1},{:.1},{:.0},{},{},{:.4},{:.4},{:.6},{:.6},{:.4},{:.4}",
            r.recipe,
            r.keyframes,
            r.wall_secs,
            r.cpu_secs,
            r.peak_mib,
            r.posed,
            r.frames,
            r.rotation_mean_deg,
            r.rotation_max_deg,
            r.position_mean,
            r.position_max,
            r.position_mean_percent,
            r.focal_percent
        );
    }
    out
}

fn in_words(rows: &[Row]) -> String {
    let mut out = "recipe          key   wall s    CPU s    MiB   posed        rotation mean, max °   position mean, max    % of radius   focal %".to_owned();
    for r in rows {
        let _ = write!(
            out,
            "\n{:14} {:4} {:8.1} {:8.1} {:6.0}   {:5}/{:5}   {:8.4} {:8.4}     {:9.6} {:9.6}   {:7.3}      {:+.3}",
            r.recipe,
            r.keyframes,
            r.wall_secs,
            r.cpu_secs,
            r.peak_mib,
            r.posed,
            r.frames,
            r.rotation_mean_deg,
            r.rotation_max_deg,
            r.position_mean,
            r.position_max,
            r.position_mean_percent,
            r.focal_percent
        );
    }
    out
}
