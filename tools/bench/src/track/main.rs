//! How fast and how accurate `tracker run` is on a capture with truth, over `--every`, threads and models; and how far it agrees
//! with tables of OpenFace on real clips (`--real`).
//!
//! Each run is a process of the release build, as a user runs it; its CPU time and peak memory are the system's count.
//! Times on a shared machine are noisy: CPU seconds are the sounder ones. Writes `track_bench.csv` and `track_bench.svg`.

mod agreement;
mod columns;
mod gaze;
mod metrics;
mod npz;
mod plot;
mod real;

use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use clap::Parser;
use glam::DMat3;
use risorius_console::{Common, CommonArgs, Console, Failure};
use risorius_formats::openface::{self, ReadOptions};
use risorius_formats::{ErrorKind, FormatError, Silent, atomic};
use serde::Serialize;

use agreement::Agreement;
use columns::Columns;
use metrics::{Errors, Truth};
use real::Clip;

/// Speed and accuracy of `tracker run` on a capture with truth and on real clips
#[derive(Debug, Parser)]
#[command(
    name = "bench-track",
    version,
    about,
    after_help = "Example:\n  bench-track --capture captures/ada --real clips --work work/bench --every 1,2,4,8 --threads 1,2"
)]
struct Cli {
    #[command(flatten)]
    common: CommonArgs,
    /// A capture: video.mp4, and truth.npz with lm2d [frames, 68, 2] px, au [frames, 17] 0–5, head_R [frames, 3, 3]
    #[arg(long, value_name = "DIR", required_unless_present = "real")]
    capture: Option<PathBuf>,
    /// A folder of real clips with OpenFace's tables: clip.mp4 and clip.csv
    #[arg(long, value_name = "DIR")]
    real: Option<PathBuf>,
    /// The truth, if it is not the capture's truth.npz: .npz, or an OpenFace table without noise (.csv)
    #[arg(long, value_name = "FILE")]
    truth: Option<PathBuf>,
    /// Where the take and the results go
    #[arg(long, value_name = "DIR")]
    work: PathBuf,
    /// Values of `--every`
    #[arg(long, value_delimiter = ',', default_values_t = [1u32, 2, 4, 8])]
    every: Vec<u32>,
    /// Numbers of threads
    #[arg(long, value_delimiter = ',', default_values_t = [1u32, 2])]
    threads: Vec<u32>,
    /// Folders of models; none is the default one
    #[arg(long, value_name = "DIR", value_delimiter = ',')]
    models: Vec<PathBuf>,
    /// Further options for `tracker run`, such as `--online`
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
struct Row {
    models: String,
    every: u32,
    threads: u32,
    wall_secs: f64,
    cpu_secs: f64,
    /// Frames of the video per second of wall time.
    fps: f64,
    /// Frames of the video per second of CPU time: what one undisturbed core does.
    fps_per_core: f64,
    peak_mib: f64,
    errors: Errors,
    /// As on real clips.
    agreement: Agreement,
    /// Mean angle between gaze and truth with open eyes, degrees.
    gaze_deg: Option<f64>,
}

/// All that was measured.
#[derive(Debug, Serialize)]
struct Report {
    rows: Vec<Row>,
    real: Vec<Clip>,
}

fn main() -> ExitCode {
    risorius_console::run(run)
}

fn run(cli: &Cli, console: &Console) -> Result<(), Failure> {
    std::fs::create_dir_all(&cli.work).map_err(|e| FormatError::io(&cli.work, "create", &e))?;
    let models: Vec<Option<&PathBuf>> =
        if cli.models.is_empty() { vec![None] } else { cli.models.iter().map(Some).collect() };
    let rows = match &cli.capture {
        Some(capture) => rendered(capture, &models, cli, console)?,
        None => Vec::new(),
    };
    let mut clips = Vec::new();
    if let Some(folder) = &cli.real {
        for (video, csv) in real::pairs(folder)? {
            for model in &models {
                clips.push(real_clip(&video, &csv, *model, cli, console)?);
            }
        }
    }
    if !rows.is_empty() {
        atomic::write_file(cli.work.join("track_bench.csv"), csv(&rows).as_bytes())?;
        plot::write(&cli.work.join("track_bench.svg"), &rows)?;
    }
    let mut text = String::new();
    if !clips.is_empty() {
        text.push_str(&real::table(&clips));
        text.push_str("\n\n");
    }
    if !rows.is_empty() {
        text.push_str(&table(&rows));
    }
    console.finish(&Report { rows, real: clips }, &text);
    Ok(())
}

fn text(path: &Path) -> String {
    path.to_string_lossy().into_owned()
}

/// The runs over a capture with truth.
fn rendered(capture: &Path, models: &[Option<&PathBuf>], cli: &Cli, console: &Console) -> Result<Vec<Row>, Failure> {
    let truth = read_truth(&cli.truth.clone().unwrap_or_else(|| capture.join("truth.npz")))?;
    let take = record(&capture.join("video.mp4"), "take", cli)?;
    let mut rows = Vec::new();
    let reference: Vec<Option<[f64; 17]>> = truth.intensities.iter().map(|v| Some(*v)).collect();
    let blinks: Vec<f64> = truth.intensities.iter().map(|v| v[16]).collect();
    for folder in models {
        for (&every, &threads) in cli.every.iter().flat_map(|e| cli.threads.iter().map(move |t| (e, t))) {
            let mut options = vec![format!("--every={every}"), format!("--threads={threads}")];
            options.extend(cli.options.iter().cloned());
            let (wall_secs, cpu_secs, peak_mib) = track(&take, *folder, &options, cli, console)?;
            let path = take.join("track/openface.csv");
            let track = openface::read(&path, &ReadOptions::default(), &Silent)?;
            let frames = truth.landmarks_px.len() as f64;
            rows.push(Row {
                models: folder.map_or_else(|| "default".to_owned(), |f| text(f)),
                every,
                threads,
                wall_secs,
                cpu_secs,
                fps: frames / wall_secs,
                fps_per_core: frames / cpu_secs,
                peak_mib,
                errors: metrics::compare(&track, &truth),
                agreement: agreement::compare(&track, &reference),
                gaze_deg: gaze::error_deg(
                    &gaze::directions(&Columns::read(&path)?),
                    &truth.head_rotations,
                    &truth.gaze_deg,
                    &blinks,
                ),
            });
        }
    }
    Ok(rows)
}

fn real_clip(
    video: &Path,
    csv: &Path,
    models: Option<&PathBuf>,
    cli: &Cli,
    console: &Console,
) -> Result<Clip, Failure> {
    let mut name = video.file_stem().unwrap_or_default().to_string_lossy().into_owned();
    let take = record(video, &format!("take_{name}"), cli)?;
    track(&take, models, &cli.options, cli, console)?;
    if let Some(models) = models {
        let _ = write!(name, ", {}", models.display());
    }
    real::compare(name, &take.join("track/openface.csv"), csv)
}

/// The take of a video, recorded if it is not there.
fn record(video: &Path, name: &str, cli: &Cli) -> Result<PathBuf, Failure> {
    let take = cli.work.join(name);
    if !take.join("take.toml").is_file() {
        child("capture", &["record", "--input", &text(video), "--out", &text(&take)], cli)?;
    }
    Ok(take)
}

/// Tracks a take; gives wall seconds, CPU seconds and peak MiB.
fn track(
    take: &Path,
    models: Option<&PathBuf>,
    options: &[String],
    cli: &Cli,
    console: &Console,
) -> Result<(f64, f64, f64), Failure> {
    let mut args = vec!["run".to_owned(), text(take)];
    args.extend(options.iter().cloned());
    args.extend(models.map(|f| format!("--models={}", text(f))));
    console.say(&format!("tracker {}", args.join(" ")));
    child("tracker", &args, cli)
}

fn read_truth(path: &Path) -> Result<Truth, Failure> {
    if path.extension().is_some_and(|e| e == "csv") {
        let track = openface::read(path, &ReadOptions::default(), &Silent)?;
        let units: Vec<Option<usize>> =
            risorius_formats::au::OPENFACE_INTENSITIES.iter().map(|u| track.unit_index(*u)).collect();
        let mut truth = Truth::default();
        for (i, row) in track.rows.iter().enumerate() {
            let known = row.landmarks.as_ref().filter(|_| row.frame.0 as usize == i);
            let landmarks = known.ok_or_else(|| {
                FormatError::new(ErrorKind::Missing, format!("frame {i} has no landmarks")).in_file(path)
            })?;
            truth.landmarks_px.push(landmarks.points_px.map(|p| p.map(f64::from)));
            let value = |k: &Option<usize>| k.and_then(|k| row.intensities[k]).map_or(0.0, f64::from);
            truth.intensities.push(std::array::from_fn(|j| value(&units[j])));
            truth.head_rotations.extend(row.head_pose.map(|p| p.camera_from_head().rotation));
        }
        return Ok(truth);
    }
    let arrays = npz::read(path)?;
    let get = |name: &str, inner: &[usize]| {
        arrays.get(name).filter(|a| a.shape.len() == inner.len() + 1 && a.shape[1..] == *inner).ok_or_else(|| {
            let message = format!("has no array `{name}` of floats with the shape [frames, {inner:?}]");
            FormatError::new(ErrorKind::Missing, message).in_file(path)
        })
    };
    let landmarks = get("lm2d", &[68, 2])?;
    let intensities = get("au", &[17])?;
    let rotations = get("head_R", &[3, 3]).map(|a| a.values.as_slice()).unwrap_or_default();
    let point = |v: &[f64]| std::array::from_fn(|i| [v[2 * i], v[2 * i + 1]]);
    Ok(Truth {
        landmarks_px: landmarks.values.chunks_exact(136).map(point).collect(),
        intensities: intensities.values.chunks_exact(17).map(|v| std::array::from_fn(|j| v[j])).collect(),
        head_rotations: rotations
            .chunks_exact(9)
            .map(|v| DMat3::from_cols_array(&std::array::from_fn(|i| v[i])).transpose())
            .collect(),
        gaze_deg: get("gaze_deg", &[2]).map(|a| a.values.as_chunks().0.to_vec()).unwrap_or_default(),
    })
}

/// Runs a program beside this one; gives its wall seconds, CPU seconds and peak MiB.
fn child<S: AsRef<str>>(program: &str, args: &[S], cli: &Cli) -> Result<(f64, f64, f64), Failure> {
    let args: Vec<&str> = args.iter().map(AsRef::as_ref).collect();
    let run = risorius_bench::child::run(program, &args, &cli.work)?;
    Ok((run.wall_secs, run.cpu_secs, run.peak_mib))
}

fn csv(rows: &[Row]) -> String {
    let units: Vec<&str> = rows.first().map_or(vec![], |r| r.errors.icc31.iter().map(|e| e.0.as_str()).collect());
    let mut text = "models,every,threads,wall_secs,cpu_secs,fps,fps_per_core,peak_mib,found_share,landmarks_percent,landmarks_without_offset_percent,head_rotation_deg,icc31_mean,icc31_min,f1_mean".to_owned();
    for kind in ["icc31", "f1"] {
        for unit in &units {
            let _ = write!(text, ",{kind}_{unit}");
        }
    }
    text.push('\n');
    for r in rows {
        let e = &r.errors;
        let _ = write!(
            text,
            "\"{}\",{},{},{:.2},{:.2},{:.1},{:.1},{:.0},{:.4},{:.3},{:.3},{:.3},{:.3},{:.3},{:.3}",
            r.models.replace('"', "'"),
            r.every,
            r.threads,
            r.wall_secs,
            r.cpu_secs,
            r.fps,
            r.fps_per_core,
            r.peak_mib,
            e.found_share,
            e.landmarks_percent,
            e.landmarks_without_offset_percent,
            e.head_rotation_deg.unwrap_or(f64::NAN),
            e.icc31_mean,
            e.icc31_min,
            e.f1_mean
        );
        for (_, value) in e.icc31.iter().chain(&e.f1) {
            let _ = write!(text, ",{value:.3}");
        }
        text.push('\n');
    }
    text
}

fn table(rows: &[Row]) -> String {
    let mut text = "| models | every | threads | wall s | CPU s | frames/s | per core | peak MiB | inner 51 % | without offset % | pose ° | ICC(3,1) mean | min | F1 | r, AUs > 0.5 | ICC | ≥ 4.9 % | jitter at rest | cross-talk | gaze ° |\n|---|---|---|---|---|---|---|---|---|---|---|---|---|---|---|---|---|---|---|---|".to_owned();
    for r in rows {
        let (e, a) = (&r.errors, &r.agreement);
        let gaze = r.gaze_deg.map_or_else(|| "–".to_owned(), |d| format!("{d:.2}"));
        let pose = e.head_rotation_deg.map_or_else(|| "–".to_owned(), |d| format!("{d:.2}"));
        let _ = write!(
            text,
            "\n| {} | {} | {} | {:.1} | {:.1} | {:.0} | {:.0} | {:.0} | {:.2} | {:.2} | {pose} | {:.3} | {:.2} | {:.3} | {:.3} | {:.3} | {:.1} | {:.3} | {:.3} | {gaze} |",
            r.models,
            r.every,
            r.threads,
            r.wall_secs,
            r.cpu_secs,
            r.fps,
            r.fps_per_core,
            r.peak_mib,
            e.landmarks_percent,
            e.landmarks_without_offset_percent,
            e.icc31_mean,
            e.icc31_min,
            e.f1_mean,
            a.moving[0],
            a.moving[1],
            100.0 * a.saturated_share,
            a.jitter_at_rest,
            a.cross_talk
        );
    }
    if let Some(first) = rows.first() {
        let list = |e: &[(String, f64)]| e.iter().map(|(u, v)| format!("{u} {v:.2}")).collect::<Vec<_>>().join(", ");
        let _ = write!(
            text,
            "\n\nfirst run, ICC(3,1): {}\nfirst run, F1: {}",
            list(&first.errors.icc31),
            list(&first.errors.f1)
        );
    }
    text
}
