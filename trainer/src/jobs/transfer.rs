//! Expression transfer: the AUs of a second video drive the avatar.

use std::collections::BTreeSet;
use std::path::PathBuf;

use image::RgbImage;
use image::imageops::{self, FilterType};
use risorius_formats::openface::{self, ReadOptions};
use risorius_formats::views::ViewCamera;
use risorius_formats::{ActionUnit, AttributeSpec, Camera, FormatError, Reporter, Take, Track, Warning, smooth};
use serde::{Deserialize, Serialize};

use super::render::{RenderSummary, Shot, Sink, render, warn_unknown};
use crate::avatar::Avatar;
use crate::error::{Result, TrainerError};

/// Whose range turns the driver's intensities into attributes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum Range {
    /// The driver's: its strongest smile becomes the avatar's strongest. Evens out people and trackers.
    #[default]
    Driver,
    /// The avatar's: intensity 3 stays intensity 3.
    Avatar,
}

/// How to transfer.
#[derive(Clone, Debug)]
pub struct TransferSettings {
    /// Whose range counts.
    pub range: Range,
    /// Pictures per second of the result; fewer than the driver's skips frames.
    pub fps: f64,
    /// Whether the driver is shown beside the avatar.
    pub side_by_side: bool,
    /// Rows below this confidence are held from the last good one.
    pub min_confidence: f32,
}

/// What a transfer did.
#[derive(Clone, Debug, Serialize)]
pub struct TransferSummary {
    /// The pictures.
    pub render: RenderSummary,
    /// Frames of the driver.
    pub driver_frames: usize,
    /// Frames of the driver without a face, held from their neighbours.
    pub held_frames: usize,
    /// Share of values beyond the range, clamped.
    pub clamped_share: f64,
    /// AUs that drive the avatar.
    pub driven: Vec<ActionUnit>,
}

/// The driver's intensities per attribute of the avatar, smoothed, one row per video frame; lost frames hold the last
/// good row. `None` for AUs the driver's table does not have.
struct Curves {
    /// `[attribute][frame]`
    intensities: Vec<Option<Vec<f32>>>,
    held: usize,
    frames: usize,
}

fn curves(avatar: &Avatar, take: &Take, track: &Track, min_confidence: f32) -> Result<Curves> {
    let frames = take.frames.len();
    let mut valid = vec![None; frames];
    for (i, row) in track.rows.iter().enumerate() {
        if let Some(slot) = valid.get_mut(row.frame.0 as usize)
            && row.is_valid(min_confidence)
        {
            *slot = Some(i);
        }
    }
    let held = valid.iter().filter(|v| v.is_none()).count();
    if held == frames {
        return Err(FormatError::new(risorius_formats::ErrorKind::Empty, "has no frame with a face")
            .in_file(take.openface_path())
            .with_hint("check the video, or lower `--min-confidence`")
            .into());
    }
    let window = smooth::window_for_fps(take.fps());
    let intensities = avatar
        .saved
        .table
        .attributes
        .iter()
        .map(|a| {
            let column = track.unit_index(a.unit)?;
            let values: Vec<Option<f32>> = valid.iter().map(|row| track.rows[(*row)?].intensities[column]).collect();
            Some(hold(&smooth::smooth_segments(&values, window, smooth::ORDER)))
        })
        .collect();
    Ok(Curves { intensities, held, frames })
}

/// Fills gaps with the last value before them, the first gap with the first value.
fn hold(values: &[Option<f32>]) -> Vec<f32> {
    let mut last = values.iter().flatten().next().copied().unwrap_or(0.0);
    values
        .iter()
        .map(|v| {
            last = v.unwrap_or(last);
            last
        })
        .collect()
}

/// Renders the avatar wearing the expressions of `take`.
pub fn transfer(
    avatar: &Avatar,
    take: &Take,
    settings: &TransferSettings,
    sink: &Sink,
    reporter: &dyn Reporter,
) -> Result<TransferSummary> {
    let path = take.openface_path();
    if !path.is_file() {
        return Err(FormatError::new(risorius_formats::ErrorKind::Missing, "does not exist")
            .in_file(path)
            .with_hint("the driver has to be tracked first: `tracker import TAKE --openface FILE.csv`")
            .into());
    }
    let track = openface::read(path, &ReadOptions::default(), reporter)?;
    let curves = curves(avatar, take, &track, settings.min_confidence)?;
    if curves.held > 0 {
        reporter.warn(Warning::new(
            "lost-face",
            format!("{} of {} driver frames have no face; the last expression is held", curves.held, curves.frames),
        ));
    }

    let table = &avatar.saved.table.attributes;
    let neutral = avatar.neutral_attributes();
    let mut unknown = BTreeSet::new();
    let mut driven = Vec::new();
    let (mut clamped, mut total) = (0usize, 0usize);
    let mut attributes = vec![neutral.clone(); curves.frames];
    for (k, (spec, curve)) in table.iter().zip(&curves.intensities).enumerate() {
        let Some(curve) = curve else { continue };
        let (low, high) = curve.iter().fold((f32::MAX, f32::MIN), |(l, h), &v| (l.min(v), h.max(v)));
        let range = match settings.range {
            Range::Avatar => spec.clone(),
            Range::Driver => AttributeSpec::from_range(spec.unit, spec.region, low, high, low),
        };
        if !spec.active {
            if range.active && settings.range == Range::Driver {
                unknown.insert(spec.unit);
            }
            continue;
        }
        if !range.active {
            // The driver never moves it: the avatar keeps its neutral value.
            continue;
        }
        driven.push(spec.unit);
        for (frame, &value) in attributes.iter_mut().zip(curve) {
            frame[k] = avatar.attribute_from_intensity(&range, value);
            total += 1;
            clamped +=
                usize::from(avatar.attribute_from_intensity(&range, value * 0.999) >= frame[k] && frame[k] >= 1.0);
        }
    }
    warn_unknown(&unknown, reporter);
    if driven.is_empty() {
        return Err(TrainerError::Setting {
            message: "the driver moves none of the avatar's AUs".to_owned(),
            hint: "see `tracker check` for the AU ranges of the driver".to_owned(),
        });
    }

    let chosen = resample(take, settings.fps);
    let camera = Camera::from(&avatar.saved.default_camera);
    let shots: Vec<Shot> = chosen
        .iter()
        .map(|&f| Shot { id: format!("{f:06}"), camera, attributes: attributes[f as usize].clone() })
        .collect();
    let mut drivers = settings
        .side_by_side
        .then(|| DriverFrames::read(take, &chosen, camera_size(&avatar.saved.default_camera)))
        .transpose()?;
    let render = render(avatar, &shots, sink, reporter, |i, picture| {
        Ok(match &mut drivers {
            Some(d) => beside(&d.images[i], &picture),
            None => picture,
        })
    })?;
    let clamped_share = clamped as f64 / total.max(1) as f64;
    Ok(TransferSummary { render, driver_frames: curves.frames, held_frames: curves.held, clamped_share, driven })
}

/// Frames nearest to an even spacing of `fps` pictures per second, by their true times.
fn resample(take: &Take, fps: f64) -> Vec<u32> {
    let mut chosen: Vec<u32> = Vec::new();
    let mut next_nanos = 0.0;
    for frame in &take.frames {
        if frame.timestamp_nanos as f64 >= next_nanos - 1e3 {
            chosen.push(frame.index.0);
            next_nanos += 1e9 / fps;
        }
    }
    chosen
}

fn camera_size(camera: &ViewCamera) -> (u32, u32) {
    (camera.width, camera.height)
}

struct DriverFrames {
    images: Vec<RgbImage>,
}

impl DriverFrames {
    /// The chosen frames at the height of the result.
    fn read(take: &Take, chosen: &[u32], (_, height): (u32, u32)) -> Result<Self> {
        let mut images = Vec::with_capacity(chosen.len());
        let path: PathBuf = take.media_path();
        risorius_video::read_frames(path, chosen, |_, image| -> Result<()> {
            let width =
                (f64::from(image.width()) * f64::from(height) / f64::from(image.height())).round().max(1.0) as u32;
            images.push(imageops::resize(&image, width, height, FilterType::Triangle));
            Ok(())
        })?;
        Ok(Self { images })
    }
}

fn beside(left: &RgbImage, right: &RgbImage) -> RgbImage {
    let mut both = RgbImage::new(left.width() + right.width(), left.height().max(right.height()));
    imageops::replace(&mut both, left, 0, 0);
    imageops::replace(&mut both, right, i64::from(left.width()), 0);
    both
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gaps_hold_the_value_before_them() {
        assert_eq!(hold(&[None, Some(1.0), None, None, Some(2.0), None]), [1.0, 1.0, 1.0, 1.0, 2.0, 2.0]);
        assert_eq!(hold(&[None, None]), [0.0, 0.0]);
    }
}
