//! The stages of an avatar: their names, and about how long they take.

use risorius_formats::Take;
use serde::{Deserialize, Serialize};

/// A stage of `risorius avatar`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub(super) enum AvatarStage {
    Record,
    Track,
    Cameras,
    Dataset,
    Fit,
    Score,
    RecordDriver,
    TrackDriver,
    Transfer,
}

impl AvatarStage {
    /// As the user reads it.
    pub(super) fn title(self) -> &'static str {
        match self {
            Self::Record => "record",
            Self::Track => "track",
            Self::Cameras => "cameras",
            Self::Dataset => "dataset",
            Self::Fit => "fit",
            Self::Score => "score",
            Self::RecordDriver => "record driver",
            Self::TrackDriver => "track driver",
            Self::Transfer => "transfer",
        }
    }

    /// Whether its time is given by a budget, however fast the machine is.
    pub(super) fn has_budget(self) -> bool {
        self == Self::Fit
    }

    /// Whether its time tells how fast the machine is: that of cameras hangs on the video.
    pub(super) fn is_telling(self) -> bool {
        !self.has_budget() && self != Self::Cameras
    }
}

/// How big the work is.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct WorkSize {
    pub(super) frames: f64,
    pub(super) megapixels: f64,
    /// Pixels.
    pub(super) longer_side: u32,
    pub(super) secs: f64,
}

impl WorkSize {
    pub(super) fn new(frames: u64, width: u32, height: u32, fps: f64) -> Self {
        let frames = frames as f64;
        let secs = if fps > 0.0 { frames / fps } else { frames / 30.0 };
        let megapixels = f64::from(width) * f64::from(height) * 1e-6;
        Self { frames, megapixels, longer_side: width.max(height), secs }
    }

    /// Frames a second.
    pub(super) fn fps(&self) -> f64 {
        self.frames / self.secs
    }

    pub(super) fn of(take: &Take) -> Self {
        let m = &take.manifest;
        Self::new(u64::from(m.frame_count), m.width, m.height, m.fps_measured)
    }
}

/// What of the stages is known before they begin.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct WorkPlan {
    pub(super) size: WorkSize,
    pub(super) every: u32,
    pub(super) has_table: bool,
    pub(super) has_model: bool,
    pub(super) fit_secs: f64,
}

impl WorkPlan {
    /// Wall seconds of a stage on two cores, from the README's table (2,400 frames of 0.52 megapixels); the display
    /// corrects them by what the finished stages took.
    pub(super) fn expected_secs(&self, stage: AvatarStage) -> f64 {
        let WorkSize { frames, megapixels, secs, .. } = self.size;
        let record = 0.3 + 2.6e-3 * frames * megapixels;
        let track = 0.5 + frames * (0.012 / f64::from(self.every.max(1)) + 1.2e-3 * megapixels);
        match stage {
            AvatarStage::Record | AvatarStage::RecordDriver => record,
            AvatarStage::Track if self.has_table => 0.4,
            AvatarStage::Track | AvatarStage::TrackDriver => track,
            AvatarStage::Cameras if self.has_model => 0.4,
            AvatarStage::Cameras => 4.0 + (0.8 * secs).min(40.0) + 8e-3 * frames,
            AvatarStage::Dataset => 0.5 + 0.012 * frames.min(750.0) * megapixels.max(0.1),
            AvatarStage::Fit => self.fit_secs + 2.0,
            AvatarStage::Score => 6.0,
            AvatarStage::Transfer => 1.0 + 12.0 * secs * 0.08,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn expected_times_are_those_of_the_readme() {
        let size = WorkSize::new(2400, 540, 960, 120.0);
        let plan = WorkPlan { size, every: 4, has_table: false, has_model: false, fit_secs: 30.0 };
        for (stage, secs) in [
            (AvatarStage::Record, 3.3),
            (AvatarStage::Track, 9.0),
            (AvatarStage::Cameras, 36.0),
            (AvatarStage::Dataset, 4.6),
            (AvatarStage::Fit, 32.0),
        ] {
            let expected = plan.expected_secs(stage);
            assert!((expected / secs - 1.0).abs() < 0.25, "{stage:?}: {expected} s, measured {secs} s");
        }
    }
}
