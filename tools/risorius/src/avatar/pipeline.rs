//! The stages in their order: which command each one is, and what is said of its result.

use std::path::{Path, PathBuf};

use risorius_console::Failure;
use risorius_formats::Take;
use risorius_formats::pose_report::{PoseMethod, PoseReport};
use serde_json::Value;

use super::card::HeldOutScores;
use super::face::FaceCoverage;
use super::kept::is_by_hand;
use super::options::{DriverSource, Tuning};
use super::programs::ProgramCommand;
use super::session::{Session, StageOutcome, shown};
use super::stages::{AvatarStage, WorkSize};

/// What a take's track and poses are made of.
const TAKE_FILES: [&str; 3] = ["take.toml", "frames.csv", "track/openface.csv"];

/// From the video to the avatar, and to the driven avatar.
pub(super) fn run_all(session: &mut Session<'_>) -> Result<(), Failure> {
    let layout = session.layout;
    if !layout.take_is_given {
        record(session, AvatarStage::Record, &session.args.video, &layout.take)?;
    }
    let take = Take::open(&layout.take)?;
    let tuning = Tuning::of_size(session.args, &WorkSize::of(&take))?;
    session.board.replan(|plan| {
        plan.size = WorkSize::of(&take);
        plan.every = tuning.every.unwrap_or(plan.every);
    });
    let args = session.args;
    let (openface, what) = (args.openface.as_deref(), args.video.display().to_string());
    let face = track(session, AvatarStage::Track, &layout.take, openface, tuning.every, &what)?;
    session.card.face = Some(face);
    cameras(session)?;
    dataset(session, &tuning)?;
    fit(session, &tuning)?;
    score(session)?;
    transfer(session, &tuning)
}

fn record(session: &mut Session<'_>, stage: AvatarStage, input: &Path, take: &Path) -> Result<(), Failure> {
    let command =
        ProgramCommand::new("capture", "record").option("--input", input).option("--out", take).words(["--if-changed"]);
    let path = take.to_owned();
    session.stage(stage, take, &command, |_| {
        let take = Take::open(path)?;
        let m = &take.manifest;
        let rate = format!("{:.4}", m.fps_measured);
        let rate = rate.trim_end_matches('0').trim_end_matches('.');
        let rate: f64 = rate.parse().unwrap_or(m.fps_measured);
        Ok(StageOutcome::new(format!("{} frames, {}×{}, {:.0} frames/s", m.frame_count, m.width, m.height, rate)))
    })
}

/// Tracks a take, or takes a table, or keeps the track that it has.
fn track(
    session: &mut Session<'_>,
    stage: AvatarStage,
    take: &Path,
    table: Option<&Path>,
    every: Option<u32>,
    what: &str,
) -> Result<FaceCoverage, Failure> {
    let result = take.join("track");
    let mut found = None;
    let describe = |found: &mut Option<FaceCoverage>| -> Result<StageOutcome, Failure> {
        let opened = Take::open(take)?;
        let face = FaceCoverage::of(&opened)?;
        let to_know = face.judge(what)?;
        let words = format!(
            "a face in {} of {} frames{}, {} of {} AUs change by 1 or more of 5",
            face.frames_with_face,
            face.frames,
            tracked_in_words(take),
            face.covered().count(),
            face.units.len()
        );
        *found = Some(face);
        Ok(StageOutcome { words, to_know })
    };
    let noted = session.noted(stage);
    if table.is_none() && is_by_hand(&result, "openface.csv", take, &TAKE_FILES[..2], noted.as_deref()) {
        session.keep(stage, || describe(&mut found))?;
    } else {
        let command = match table {
            Some(table) => ProgramCommand::new("tracker", "import").path(take).option("--openface", table),
            None => ProgramCommand::new("tracker", "run").path(take).number("--every", every),
        };
        session.stage(stage, &result, &command.words(["--if-changed"]), |_| describe(&mut found))?;
    }
    found.ok_or_else(|| Failure::bug("a track without a face was taken"))
}

/// What was not tracked frame by frame.
fn tracked_in_words(take: &Path) -> String {
    let bytes = std::fs::read(take.join("track/run.json")).unwrap_or_default();
    let summary: Value = serde_json::from_slice(&bytes).unwrap_or_default();
    match summary["every"].as_u64() {
        Some(every @ 2..) => format!(" (1 of {every} tracked)"),
        _ => String::new(),
    }
}

fn cameras(session: &mut Session<'_>) -> Result<(), Failure> {
    let (stage, take) = (AvatarStage::Cameras, session.layout.take.clone());
    let result = take.join("poses");
    let report = result.join("report.json");
    let describe = || {
        let r = PoseReport::read(report)?;
        let placed = r.frames_registered + r.frames_followed + r.frames_interpolated;
        let how = match r.method {
            PoseMethod::Colmap => "the camera moves, found by COLMAP",
            PoseMethod::ColmapModel => "from the COLMAP model",
            PoseMethod::Head => "the camera stands still, found by the head",
        };
        let mut outcome = StageOutcome::new(format!("{placed} of {} frames; {how}", r.frames));
        outcome.to_know = r.problems.iter().map(|p| format!("The cameras are of low quality: {p}.")).collect();
        Ok(outcome)
    };
    let noted = session.noted(stage);
    let model = session.args.colmap_model.clone();
    if model.is_none() && is_by_hand(&result, "report.json", &take, &TAKE_FILES, noted.as_deref()) {
        return session.keep(stage, describe);
    }
    let command = ProgramCommand::new("tracker", "poses").path(&take).words(["--if-changed"]);
    let command = match &model {
        Some(model) => command.option("--colmap-model", model),
        None => command,
    };
    session.stage(stage, &result, &command, |_| describe())
}

fn dataset(session: &mut Session<'_>, tuning: &Tuning) -> Result<(), Failure> {
    let result = session.layout.dataset();
    let scale = tuning.scale.map(|s| s.to_string());
    let mut command = ProgramCommand::new("dataset", "build").path(&session.layout.take).option("--out", &result);
    if let Some(scale) = &scale {
        command = command.words(["--scale", scale]);
        if !tuning.has_scales {
            command = command.words(["--scales", scale]);
        }
    }
    session.stage(AvatarStage::Dataset, &result, &command.words(["--if-changed"]), |document| {
        let (Some(chosen), Some(usable)) = (document["chosen"].as_u64(), document["candidates"].as_u64()) else {
            return Ok(StageOutcome::default());
        };
        let at = scale.as_ref().filter(|s| *s != "1").map_or_else(String::new, |s| format!(", pictures at 1/{s}"));
        Ok(StageOutcome::new(format!("{chosen} of {usable} frames, chosen for many expressions{at}")))
    })
}

fn fit(session: &mut Session<'_>, tuning: &Tuning) -> Result<(), Failure> {
    let run = session.layout.run();
    let mut command = ProgramCommand::new("trainer", "fit").path(&session.layout.dataset()).option("--out", &run);
    if let Some(secs) = tuning.budget_secs {
        command = command.words(["--budget", &format!("{secs}s")]);
    }
    // A fit of other settings or of other frames gives way; one that was stopped goes on.
    session.stage(AvatarStage::Fit, &run, &command.words(["--force", "--if-changed"]), |document| {
        let Some(steps) = document["steps"].as_u64() else { return Ok(StageOutcome::default()) };
        Ok(StageOutcome::new(format!("{steps} steps over {} frames", document["frames"])))
    })
}

fn score(session: &mut Session<'_>) -> Result<(), Failure> {
    let (run, folder) = (session.layout.run(), session.layout.run().join("eval"));
    let mut scores = None;
    let command = ProgramCommand::new("trainer", "eval").path(&run).words(["--lpips", "none", "--if-changed"]);
    let path = folder.join("eval.json");
    session.stage(AvatarStage::Score, &folder, &command, |_| {
        let bytes = std::fs::read(&path).unwrap_or_default();
        let document: Value = serde_json::from_slice(&bytes).unwrap_or_default();
        scores = HeldOutScores::of(&document);
        let Some(s) = &scores else { return Ok(StageOutcome::default()) };
        let regions = s.au_regions_db.map_or_else(String::new, |db| format!(", AU regions {db:.1} dB"));
        Ok(StageOutcome::new(format!("{:.1} dB on {} held-out frames{regions}", s.whole_db, s.frames)))
    })?;
    session.card.held_out = scores;
    Ok(())
}

/// Tracks the driver and lets it drive the avatar.
fn transfer(session: &mut Session<'_>, tuning: &Tuning) -> Result<(), Failure> {
    let layout = session.layout;
    let (Some(driver), Some(video)) = (&layout.driver, layout.transfer()) else { return Ok(()) };
    let command = ProgramCommand::new("trainer", "transfer").path(&layout.run());
    let command = match driver {
        DriverSource::Table(table) => command.option("--curves", table),
        DriverSource::Take(take) => command.option("--from", &driver_take(session, None, take, tuning)?),
        DriverSource::Video { input, take } => {
            command.option("--from", &driver_take(session, Some(input), take, tuning)?)
        }
    };
    let command = command.option("--video", &video).words(["--if-changed"]);
    let name = shown(&video, &layout.out);
    session.stage(AvatarStage::Transfer, &video, &command, |document| {
        let Some(pictures) = document["pictures"].as_u64() else { return Ok(StageOutcome::default()) };
        Ok(StageOutcome::new(format!("{pictures} pictures in {}", name.display())))
    })
}

fn driver_take(
    session: &mut Session<'_>,
    input: Option<&Path>,
    take: &Path,
    tuning: &Tuning,
) -> Result<PathBuf, Failure> {
    if let Some(input) = input {
        record(session, AvatarStage::RecordDriver, input, take)?;
    }
    let opened = Take::open(take)?;
    // The stages of the avatar itself are done by now.
    session.board.replan(|plan| (plan.size, plan.has_table) = (WorkSize::of(&opened), false));
    let every = Tuning::of_size(session.args, &WorkSize::of(&opened))?.every.or(tuning.every);
    let what = input.unwrap_or(take).display().to_string();
    track(session, AvatarStage::TrackDriver, take, None, every, &what)?;
    Ok(take.to_owned())
}
