//! The options of `risorius avatar`, and what they mean for the stages.

use std::path::{Path, PathBuf};

use risorius_console::Failure;
use risorius_formats::Take;

use super::stages::WorkSize;

/// Make an avatar of a video, from recording to a page with figures
///
/// Records the video as a take, tracks the face, finds the cameras, builds a dataset, fits an avatar and scores it on
/// frames that it has not seen. Stages whose result is there and whose inputs did not change are skipped: after a stop,
/// the same command goes on. Writes OUT/takes/NAME, OUT/dataset, OUT/run and OUT/card.json.
#[derive(clap::Args, Debug)]
#[command(after_help = "Examples:
  risorius avatar face.mp4 --out ada
  risorius avatar face.mp4 --out ada --fast
  risorius avatar face.mp4 --out ada --from other.mp4
  risorius avatar takes/ada --out ada

The video: one face, upright, well lit, some seconds of lively expressions. Either the camera moves around a head that is \
held still (COLMAP finds its path), or the camera stands still and the head turns.

Of more than 30 frames a second only about 30 are tracked and the rest interpolated; --best tracks each. On a rendered \
person at 120 frames/s (`ada` of the README) the error is the same: points 1.5 % of the outer-eye distance, mean AU ICC(3,1) 0.83.

Everything else stands in risorius.toml, in the tables of the stages: [capture], [tracker-run], [tracker-import], \
[tracker-poses], [dataset], [trainer.fit]. --fast and --best override them.")]
pub(crate) struct AvatarArgs {
    /// A video of a face, a folder of pictures, or a take
    #[arg(value_name = "VIDEO|TAKE")]
    pub(super) video: PathBuf,
    /// The folder for everything
    #[arg(long, value_name = "DIR")]
    pub(super) out: PathBuf,
    /// Let the expressions of this video, take or table of AUs drive the avatar, into OUT/NAME.mp4
    #[arg(long, value_name = "DRIVER")]
    pub(super) from: Option<PathBuf>,
    /// Fit for 30 s [default: a minute]
    #[arg(long, conflicts_with = "best")]
    pub(super) fast: bool,
    /// Track every frame, fit for 2 minutes
    #[arg(long)]
    pub(super) best: bool,
    /// Take landmarks and AUs from this OpenFace table instead of tracking
    #[arg(long, value_name = "TABLE.csv")]
    pub(super) openface: Option<PathBuf>,
    /// Take the cameras from this COLMAP model instead of finding them
    #[arg(long, value_name = "DIR")]
    pub(super) colmap_model: Option<PathBuf>,
}

/// Where the expressions of a transfer come from.
#[derive(Debug)]
pub(super) enum DriverSource {
    /// A take that is there.
    Take(PathBuf),
    /// A video, which becomes a take.
    Video { input: PathBuf, take: PathBuf },
    /// A table of AUs.
    Table(PathBuf),
}

/// The folders of one avatar.
#[derive(Debug)]
pub(super) struct Layout {
    pub(super) out: PathBuf,
    pub(super) take: PathBuf,
    /// Whether `VIDEO` is a take already.
    pub(super) take_is_given: bool,
    pub(super) driver: Option<DriverSource>,
}

impl Layout {
    /// Looks at the paths of a command line.
    pub(super) fn of(args: &AvatarArgs) -> Result<Self, Failure> {
        let is_take = |path: &Path| path.join("take.toml").exists() || path.join("recording.toml").exists();
        need(&args.video, "give a video of a face, a folder of pictures or a take")?;
        if args.out.exists() && !args.out.is_dir() {
            return Err(Failure::input(format!("{}: is a file, not a folder", args.out.display()))
                .with_hint("choose another `--out`"));
        }
        if is_take(&args.out) {
            return Err(Failure::input(format!("{}: is a take", args.out.display()))
                .with_hint("`--out` is the folder for the avatar; choose a new one"));
        }
        for (path, hint) in [
            (&args.openface, "`--openface` takes a table of OpenFace"),
            (&args.colmap_model, "`--colmap-model` takes a folder with cameras, images and points3D"),
            (&args.from, "`--from` takes a video, a take or a table of AUs"),
        ] {
            if let Some(path) = path {
                need(path, hint)?;
            }
        }
        let take_is_given = is_take(&args.video);
        let name = name_of(&args.video);
        let take = if take_is_given { args.video.clone() } else { args.out.join("takes").join(&name) };
        if take_is_given {
            Take::open(&take)?;
        }
        let driver = args.from.as_ref().map(|from| {
            let driver_name = name_of(from);
            let own = if driver_name == name { format!("{driver_name}-driver") } else { driver_name };
            if is_take(from) {
                DriverSource::Take(from.clone())
            } else if from.extension().is_some_and(|e| e.eq_ignore_ascii_case("csv")) {
                DriverSource::Table(from.clone())
            } else {
                DriverSource::Video { input: from.clone(), take: args.out.join("takes").join(own) }
            }
        });
        Ok(Self { out: args.out.clone(), take, take_is_given, driver })
    }

    pub(super) fn dataset(&self) -> PathBuf {
        self.out.join("dataset")
    }

    pub(super) fn run(&self) -> PathBuf {
        self.out.join("run")
    }

    pub(super) fn card(&self) -> PathBuf {
        self.out.join("card.json")
    }

    /// The video that the driver's expressions give.
    pub(super) fn transfer(&self) -> Option<PathBuf> {
        let name = match self.driver.as_ref()? {
            DriverSource::Take(path) | DriverSource::Table(path) => name_of(path),
            DriverSource::Video { take, .. } => name_of(take),
        };
        Some(self.out.join(format!("{name}.mp4")))
    }
}

fn need(path: &Path, hint: &str) -> Result<(), Failure> {
    if path.exists() {
        return Ok(());
    }
    Err(Failure::input(format!("{}: does not exist", path.display())).with_hint(hint))
}

/// The last part of a path without its ending.
fn name_of(path: &Path) -> String {
    let full = path.canonicalize().unwrap_or_else(|_| path.to_owned());
    let name = if full.is_dir() { full.file_name() } else { full.file_stem() };
    let name = name.map_or_else(String::new, |n| n.to_string_lossy().into_owned());
    if name.is_empty() || name.starts_with('.') { format!("video{name}") } else { name }
}

/// What the quality switches, the video and `risorius.toml` make of the stages' options.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Tuning {
    /// `tracker run --every`, where the settings do not state it.
    pub(super) every: Option<u32>,
    /// `dataset build --scale`, where the settings do not state it.
    pub(super) scale: Option<u32>,
    /// Whether the settings state the scales to write.
    pub(super) has_scales: bool,
    /// `trainer fit --budget`, where a switch states it.
    pub(super) budget_secs: Option<u32>,
    /// What the fit takes, for the progress.
    pub(super) expected_fit_secs: f64,
}

/// Frames a second that are tracked, the rest interpolated.
const TRACKED_FPS: f64 = 30.0;
/// The longer side of the pictures that are fitted: at this size the figures of the README were measured.
const FITTED_SIDE_PX: u32 = 640;
/// Wall seconds of a fit: `--fast`, `--best`, and what `trainer fit` takes by itself.
const FAST_SECS: u32 = 30;
const BEST_SECS: u32 = 120;
const USUAL_SECS: f64 = 60.0;

impl Tuning {
    pub(super) fn of_size(args: &AvatarArgs, size: &WorkSize) -> Result<Self, Failure> {
        let set = |table: &str, key: &str| -> Result<Option<toml::Value>, Failure> {
            let mut table: toml::Table = risorius_console::settings(table)?;
            Ok(table.remove(key))
        };
        let every = match (args.best, set("tracker-run", "every")?) {
            (true, _) => Some(1),
            (false, Some(_)) => None,
            (false, None) => Some(every_of(size.fps())),
        };
        let budget_secs = match (args.fast, args.best) {
            (true, _) => Some(FAST_SECS),
            (_, true) => Some(BEST_SECS),
            _ => None,
        };
        let scale = set("dataset", "scale")?.is_none().then(|| scale_of(size.longer_side));
        Ok(Self {
            every,
            scale,
            has_scales: set("dataset", "scales")?.is_some(),
            budget_secs,
            expected_fit_secs: budget_secs.map_or(USUAL_SECS, f64::from),
        })
    }
}

/// Every how many frames one is tracked.
fn every_of(fps: f64) -> u32 {
    if fps.is_finite() { (fps / TRACKED_FPS).round().clamp(1.0, 16.0) as u32 } else { 1 }
}

/// The finest scale at which the longer side is not above [`FITTED_SIDE_PX`].
fn scale_of(longer_side: u32) -> u32 {
    [1, 2, 4].into_iter().find(|s| longer_side / s <= FITTED_SIDE_PX).unwrap_or(8)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn about_thirty_frames_a_second_are_tracked() {
        assert_eq!([119.9, 60.0, 30.0, 25.0, 0.0, f64::NAN].map(every_of), [4, 2, 1, 1, 1, 1]);
    }

    #[test]
    fn pictures_are_fitted_at_a_sensible_size() {
        let scales = [480, 960, 1280, 1920, 3840].map(scale_of);
        assert_eq!(scales, [1, 2, 2, 4, 8]);
    }

    #[test]
    fn folders_are_named_after_the_video() {
        let dir = tempfile::tempdir().unwrap();
        let video = dir.path().join("my face.mp4");
        std::fs::write(&video, "x").unwrap();
        let args = |from: Option<PathBuf>, video: &Path| AvatarArgs {
            video: video.to_owned(),
            out: dir.path().join("out"),
            from,
            fast: false,
            best: false,
            openface: None,
            colmap_model: None,
        };
        let layout = Layout::of(&args(Some(video.clone()), &video)).unwrap();
        assert_eq!(layout.take, dir.path().join("out/takes/my face"));
        assert_eq!(layout.transfer().unwrap(), dir.path().join("out/my face-driver.mp4"));
        let failure = Layout::of(&args(None, &dir.path().join("none.mp4"))).unwrap_err();
        assert!(failure.message().ends_with("none.mp4: does not exist"), "{failure:?}");
    }
}
