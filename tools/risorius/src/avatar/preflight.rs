//! What can be known before the first stage: whether the video opens, how big it is, whether the networks are there.

use std::path::{Path, PathBuf};

use risorius_capture::record::{RecordOptions, rehearse};
use risorius_console::Failure;
use risorius_formats::Take;
use risorius_tracker::models::ModelFolder;
use risorius_tracker::models::runtime::library_places;

use super::explain::explained;
use super::options::{AvatarArgs, DriverSource, Layout, Tuning};
use super::stages::{AvatarStage, WorkPlan, WorkSize};

/// Looks at what the stages will need; fails where one of them is bound to.
pub(super) fn look(args: &AvatarArgs, layout: &Layout) -> Result<WorkPlan, Failure> {
    let size = if layout.take.join("take.toml").exists() {
        WorkSize::of(&Take::open(&layout.take)?)
    } else {
        size_of_video(&args.video, &layout.take).map_err(|e| explained(e, AvatarStage::Record, layout))?
    };
    let is_tracked = |take: &Path| take.join("track/openface.csv").is_file();
    let mut needs_networks = args.openface.is_none() && !is_tracked(&layout.take);
    match &layout.driver {
        Some(DriverSource::Video { input, take }) if !take.join("take.toml").exists() => {
            size_of_video(input, take).map_err(|e| explained(e, AvatarStage::RecordDriver, layout))?;
            needs_networks = true;
        }
        Some(DriverSource::Video { take, .. } | DriverSource::Take(take)) => needs_networks |= !is_tracked(take),
        Some(DriverSource::Table(_)) | None => {}
    }
    if needs_networks {
        find_networks()?;
    }
    let tuning = Tuning::of_size(args, &size)?;
    Ok(WorkPlan {
        size,
        every: tuning.every.unwrap_or(1),
        has_table: args.openface.is_some(),
        has_model: args.colmap_model.is_some(),
        fit_secs: tuning.expected_fit_secs,
    })
}

fn size_of_video(input: &Path, out: &Path) -> Result<WorkSize, Failure> {
    let options = RecordOptions { input: input.to_owned(), out: out.to_owned(), ..RecordOptions::default() };
    let found = rehearse(&options)?;
    Ok(WorkSize::new(found.frame_count_estimate.unwrap_or(0), found.width, found.height, found.fps))
}

/// The folder of the networks that `tracker run` will take.
fn find_networks() -> Result<(), Failure> {
    let mut settings: toml::Table = risorius_console::settings("tracker-run")?;
    let named = settings.remove("models").and_then(|v| v.as_str().map(PathBuf::from));
    let default_dir = risorius_tracker::models::default_dir();
    let dir = named.unwrap_or_else(|| default_dir.clone());
    let lacking = if let Err(e) = ModelFolder::open(&dir) {
        Some(e.to_string())
    } else {
        let places = library_places(&[&dir, &default_dir]);
        let there = places.iter().any(|p| p.is_file());
        (!there).then(|| format!("{}: ONNX Runtime is not there", dir.display()))
    };
    lacking.map_or(Ok(()), |what| {
        Err(Failure::input(format!("the networks that find the face are not here ({what})"))
            .of_installation()
            .with_hint(
                "fetch them once with `risorius models`, then type the same command again; with a table of OpenFace, \
                 `--openface TABLE.csv`, no networks are needed",
            ))
    })
}
