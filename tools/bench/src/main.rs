//! Measures every stage of the main job on one capture: wall time, CPU time, peak memory, and the error against the truth.
//!
//! The stages run as a user runs them, as processes of the release build; times on a shared machine are noisy, so compare
//! within one run. The capture's folder has the layout that `synth` writes.

use std::path::{Path, PathBuf};
use std::process::ExitCode;

use clap::Parser;
use risorius_bench::child;
use risorius_console::{Common, CommonArgs, Console, Failure};
use risorius_formats::FormatError;
use serde::Serialize;
use serde_json::Value;

/// Time, memory and error of every stage on one capture
#[derive(Debug, Parser)]
#[command(
    name = "bench",
    version,
    about,
    after_help = "Example:\n  synth --driver --out work/capture && bench --capture work/capture --work work/bench"
)]
struct Cli {
    #[command(flatten)]
    common: CommonArgs,
    /// A capture with truth: video.mp4, openface.csv, truth_colmap/, test/views.json, driver.mp4, `driver_openface.csv`
    #[arg(long, value_name = "DIR")]
    capture: PathBuf,
    /// Where takes, dataset and run go; emptied first
    #[arg(long, value_name = "DIR")]
    work: PathBuf,
    /// Frames of the dataset
    #[arg(long, default_value_t = 750)]
    frames: u32,
    /// Image scale of the dataset
    #[arg(long, default_value_t = 2)]
    scale: u32,
    /// Time for the fit of the Gaussian field
    #[arg(long, default_value = "1m")]
    budget: String,
    /// Also fit the paper's networks (preset `cpu`) for so many steps
    #[arg(long, value_name = "STEPS")]
    confies: Option<u64>,
    /// Also find the cameras with the real COLMAP and compare them with the truth
    #[arg(long)]
    colmap: bool,
}

impl Common for Cli {
    fn common(&self) -> &CommonArgs {
        &self.common
    }
}

/// One measured stage.
#[derive(Debug, Serialize)]
struct Row {
    stage: &'static str,
    command: String,
    wall_secs: f64,
    cpu_secs: f64,
    peak_mib: f64,
    error: String,
}

fn main() -> ExitCode {
    risorius_console::run(run)
}

fn run(cli: &Cli, console: &Console) -> Result<(), Failure> {
    if cli.work.exists() {
        std::fs::remove_dir_all(&cli.work).map_err(|e| FormatError::io(&cli.work, "empty", &e))?;
    }
    std::fs::create_dir_all(&cli.work).map_err(|e| FormatError::io(&cli.work, "create", &e))?;
    let capture = |name: &str| path(&cli.capture.join(name));
    let work = |name: &str| path(&cli.work.join(name));
    let (take, dataset, avatar, driver) = (work("take"), work("dataset"), work("run"), work("driver"));
    let (frames, scale) = (cli.frames.to_string(), cli.scale.to_string());
    let mut bench = Bench { rows: Vec::new(), work: &cli.work, console };

    bench.stage("record", "capture", &["record", "--input", &capture("video.mp4"), "--out", &take], |v| {
        format!("{} frames", number(v, &["frame_count", "frames"]))
    })?;
    bench.stage("import", "tracker", &["import", &take, "--openface", &capture("openface.csv")], |_| String::new())?;
    if cli.colmap {
        bench.stage("poses (COLMAP)", "tracker", &["poses", &take], |_| String::new())?;
        bench.stage("  against truth", "tracker", &["check", &take, "--reference", &capture("truth_colmap")], |v| {
            v.get("reference").map_or_else(String::new, Value::to_string)
        })?;
    }
    let model = capture("truth_colmap");
    bench.stage("poses (model)", "tracker", &["poses", &take, "--colmap-model", &model], |v| {
        format!("landmarks {} px", number(v, &["landmark_error_px"]))
    })?;
    let build = ["build", &take, "--balance", "--frames", &frames, "--scale", &scale, "--out", &dataset];
    bench.stage("dataset", "dataset", &build, |v| format!("{} frames", number(v, &["frames", "selected"])))?;
    let fit =
        |v: &Value| format!("training pixels {} dB, {} steps", number(v, &["train_psnr_db"]), number(v, &["steps"]));
    let rendered =
        |v: &Value| format!("{} pictures, {} s each", number(v, &["rendered"]), number(v, &["seconds_per_picture"]));
    let views = capture("test/views.json");
    let renders = work("renders");
    bench.stage("fit (splat)", "trainer", &["fit", &dataset, "--out", &avatar, "--budget", &cli.budget], fit)?;
    bench.stage("render", "trainer", &["render", &avatar, "--views", &views, "--out", &renders], rendered)?;
    bench.stage("eval", "trainer", &["eval", &avatar, "--views", &views, "--renders", &renders], scores)?;
    if let Some(steps) = cli.confies {
        let (avatar, renders) = (work("run-confies"), work("renders-confies"));
        let steps = steps.to_string();
        let args = ["fit", &dataset, "--out", &avatar, "--field", "confies", "--steps", &steps, "--image-scale", "4"];
        bench.stage("fit (confies)", "trainer", &args, fit)?;
        bench.stage("render", "trainer", &["render", &avatar, "--views", &views, "--out", &renders], rendered)?;
        bench.stage("eval", "trainer", &["eval", &avatar, "--views", &views, "--renders", &renders], scores)?;
    }
    if cli.capture.join("driver.mp4").is_file() {
        bench.stage(
            "record driver",
            "capture",
            &["record", "--input", &capture("driver.mp4"), "--out", &driver],
            |_| String::new(),
        )?;
        bench.stage(
            "import driver",
            "tracker",
            &["import", &driver, "--openface", &capture("driver_openface.csv")],
            |_| String::new(),
        )?;
        bench.stage(
            "transfer",
            "trainer",
            &["transfer", &avatar, "--from", &driver, "--fps", "6", "--video", &work("transfer.mp4")],
            |v| format!("{} frames of the driver", number(v, &["driver_frames"])),
        )?;
    }

    let head = "| stage | wall s | CPU s | peak MiB | result |\n|---|---|---|---|---|".to_owned();
    let line =
        |r: &Row| format!("| {} | {:.1} | {:.1} | {:.0} | {} |", r.stage, r.wall_secs, r.cpu_secs, r.peak_mib, r.error);
    let table: Vec<String> = std::iter::once(head).chain(bench.rows.iter().map(line)).collect();
    console.finish(&bench.rows, &table.join("\n"));
    Ok(())
}

/// Mean PSNR of all views and of each kind.
fn scores(v: &Value) -> String {
    let kinds = v.get("mean_psnr_db_by_kind").and_then(Value::as_object).into_iter().flatten();
    let kinds: Vec<String> = kinds.map(|(kind, psnr)| format!("{kind} {:.2}", psnr.as_f64().unwrap_or(0.0))).collect();
    format!("mean PSNR {} dB ({})", number(v, &["mean_psnr_db"]), kinds.join(", "))
}

struct Bench<'a> {
    rows: Vec<Row>,
    work: &'a Path,
    console: &'a Console,
}

impl Bench<'_> {
    /// Runs `program` beside this one with `--json` and turns its document into words.
    fn stage(
        &mut self,
        stage: &'static str,
        program: &str,
        args: &[&str],
        words: impl Fn(&Value) -> String,
    ) -> Result<(), Failure> {
        let command = format!("{program} {}", args.join(" "));
        self.console.say(&command);
        let run = child::run(program, args, self.work)?;
        self.rows.push(Row {
            stage,
            command,
            wall_secs: run.wall_secs,
            cpu_secs: run.cpu_secs,
            peak_mib: run.peak_mib,
            error: words(&run.document),
        });
        Ok(())
    }
}

/// The first of `names` in the document, rounded.
fn number(document: &Value, names: &[&str]) -> String {
    match names.iter().find_map(|n| document.get(n)) {
        Some(Value::Number(n)) if n.is_f64() => format!("{:.2}", n.as_f64().unwrap_or(f64::NAN)),
        Some(v) => v.to_string(),
        None => "?".to_owned(),
    }
}

fn path(path: &Path) -> String {
    path.to_string_lossy().into_owned()
}
