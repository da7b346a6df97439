//! A take on disk: `take.toml`, `frames.csv`, the video.

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use crate::attribute::toml_error;
use crate::{ErrorKind, FormatError, FrameRecord, Result, atomic, frame};

/// Where a take's pictures come from.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum SourceKind {
    /// A video file.
    Video,
    /// A folder of images, in the order of their names.
    Images,
    /// A live camera, recorded into a video file.
    Camera,
}

/// `take.toml`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct TakeManifest {
    /// Version of this file's layout.
    pub version: u32,
    /// Who is seen; free text, may be empty.
    #[serde(default)]
    pub subject: String,
    /// Under which consent it was recorded; free text, may be empty.
    #[serde(default)]
    pub consent: String,
    /// What the pictures are.
    pub source: SourceKind,
    /// The video file or image folder: relative paths start at the take's folder.
    pub media: PathBuf,
    /// SHA-256 of the video, or of the sorted list of image hashes.
    pub media_sha256: String,
    /// The name of what was recorded or imported, without its folder.
    pub original_name: String,
    /// The camera, for live recordings.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub device: Option<String>,
    /// Upright width, pixels: after the display rotation.
    pub width: u32,
    /// Upright height, pixels.
    pub height: u32,
    /// Clockwise rotation that was applied, degrees: the container's, and what `capture record --rotate` added.
    pub rotation_degrees: u32,
    /// The frame rate that was asked for or that the container states.
    pub fps_asked: Option<f64>,
    /// (frames − 1) / duration.
    pub fps_measured: f64,
    /// Number of frames.
    pub frame_count: u32,
    /// Frames missing according to the timestamps.
    pub dropped_frames: u32,
    /// Frames that repeat the one before.
    pub repeated_frames: u32,
    /// The program that wrote this, with its version.
    pub written_by: String,
}

/// No camera takes more pictures per second.
const MOST_FPS: f64 = 1e6;

/// The current layout of `take.toml`.
pub const TAKE_VERSION: u32 = 1;

impl TakeManifest {
    /// Parses `take.toml`.
    pub fn parse(text: &str) -> Result<Self> {
        let manifest: Self = toml::from_str(text).map_err(|e| toml_error(&e, text))?;
        if manifest.version > TAKE_VERSION {
            return Err(FormatError::new(
                ErrorKind::Unsupported,
                format!("layout version {} is newer than this program", manifest.version),
            )
            .with_hint("update Risorius"));
        }
        let rates = [("fps_measured", Some(manifest.fps_measured)), ("fps_asked", manifest.fps_asked)];
        for (name, rate) in rates {
            // Written so that a NaN is refused.
            if rate.is_some_and(|r| !(0.0..=MOST_FPS).contains(&r)) {
                let message = format!("`{name}` is {}, expected a number from 0", rate.unwrap_or(f64::NAN));
                return Err(FormatError::new(ErrorKind::Inconsistent, message));
            }
        }
        Ok(manifest)
    }

    /// Writes `take.toml`, whole or not at all.
    pub fn write(&self, path: impl AsRef<Path>) -> Result<()> {
        let text =
            toml::to_string(self).map_err(|e| FormatError::syntax(format!("cannot encode: {e}")).in_file(&path))?;
        atomic::write_file(path, text.as_bytes())
    }
}

/// What to do about a take whose own files do not hold what `capture record` wrote.
const DAMAGED: &str = "the take is damaged; make it again with `capture record --force`";

/// A take that was opened: its folder, manifest and frames.
#[derive(Clone, Debug)]
pub struct Take {
    /// The take's folder.
    pub dir: PathBuf,
    /// `take.toml`.
    pub manifest: TakeManifest,
    /// `frames.csv`.
    pub frames: Vec<FrameRecord>,
}

impl Take {
    /// Opens a take's folder; the video itself is not touched.
    pub fn open(dir: impl AsRef<Path>) -> Result<Self> {
        let dir = dir.as_ref().to_owned();
        if !dir.is_dir() {
            let message = if dir.exists() { "is not a folder" } else { "does not exist" };
            return Err(FormatError::new(ErrorKind::Missing, message)
                .in_file(&dir)
                .with_hint("a take is made by `capture record --input VIDEO --out TAKE`"));
        }
        let path = dir.join("take.toml");
        let text = std::fs::read_to_string(&path).map_err(|e| {
            let error = FormatError::io(&path, "read", &e);
            match e.kind() {
                std::io::ErrorKind::NotFound if dir.join("recording.toml").exists() => {
                    FormatError::new(ErrorKind::Inconsistent, "is a recording that was not finished")
                        .in_file(&dir)
                        .with_hint(format!("make it whole with `capture recover {}`", dir.display()))
                }
                std::io::ErrorKind::NotFound => error
                    .with_hint("this folder is not a take; make one with `capture record --input VIDEO --out TAKE`"),
                _ => error,
            }
        })?;
        let manifest = TakeManifest::parse(&text).map_err(|e| e.in_file(&path).or_hint(DAMAGED))?;
        let frames = frame::read_frames(dir.join("frames.csv")).map_err(|e| e.with_hint(DAMAGED))?;
        if frames.len() != manifest.frame_count as usize {
            return Err(FormatError::new(
                ErrorKind::Inconsistent,
                format!("has {} rows, but take.toml states {} frames", frames.len(), manifest.frame_count),
            )
            .in_file(dir.join("frames.csv"))
            .with_hint(DAMAGED));
        }
        Ok(Self { dir, manifest, frames })
    }

    /// The video file or image folder.
    pub fn media_path(&self) -> PathBuf {
        self.dir.join(&self.manifest.media)
    }

    /// `track/openface.csv`.
    pub fn openface_path(&self) -> PathBuf {
        self.dir.join("track").join("openface.csv")
    }

    /// `poses/sparse`.
    pub fn sparse_dir(&self) -> PathBuf {
        self.dir.join("poses").join("sparse")
    }

    /// `poses/report.json`.
    pub fn pose_report_path(&self) -> PathBuf {
        self.dir.join("poses").join("report.json")
    }

    /// Frames per second by the timestamps, or the asked rate where there is only one frame.
    pub fn fps(&self) -> f64 {
        if self.manifest.fps_measured > 0.0 {
            self.manifest.fps_measured
        } else {
            self.manifest.fps_asked.unwrap_or(30.0)
        }
    }
}
