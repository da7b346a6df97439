//! The driver: AU curves without gaps, smoothed, and the turns of the head.

use std::collections::BTreeMap;
use std::path::Path;

use glam::{DMat3, DQuat};
use risorius_formats::curves::{CurveOptions, CurveSource, interpolate};
use risorius_formats::openface::{self, ReadOptions};
use risorius_formats::{ActionUnit, Curves, ErrorKind, FormatError, Reporter, Take, Warning, smooth};

use crate::error::Result;

/// What drives: a take with its video, or a table of curves alone.
pub struct Driver {
    /// The take, if it is one.
    pub take: Option<Take>,
    /// Time of every frame, seconds from the first.
    pub times_secs: Vec<f64>,
    /// Intensities 0–5 of every frame.
    pub intensities: BTreeMap<ActionUnit, Vec<f32>>,
    /// Turn of the head against its mean, in camera axes, per frame: components of quaternions.
    pub turns: Option<[Vec<f32>; 4]>,
    /// Frames without a face, held from the one before.
    pub held_frames: usize,
}

impl Driver {
    /// The AUs of a tracked take; rows below `min_confidence` are held from the row before.
    pub fn of_take(take: Take, min_confidence: f32, smooth_secs: f64, reporter: &dyn Reporter) -> Result<Self> {
        let path = take.openface_path();
        if !path.is_file() {
            return Err(FormatError::new(ErrorKind::Missing, "does not exist")
                .in_file(path)
                .with_hint("the driver has to be tracked first: `tracker run TAKE`, or `tracker import TAKE --openface FILE.csv`")
                .into());
        }
        let track = openface::read(&path, &ReadOptions::default(), reporter)?;
        let tracked = Curves::from_track(&track, min_confidence);
        // A row per frame of the video, at its own time.
        let frames = take.frames.len();
        let mut curves = Curves {
            source: CurveSource::Openface,
            units: tracked.units,
            times_secs: take.frames.iter().map(|f| f.timestamp_nanos as f64 * 1e-9).collect(),
            rows: vec![vec![None; track.units.len()]; frames],
            head_rotations: vec![None; frames],
        };
        for (i, row) in track.rows.iter().enumerate().filter(|(_, r)| (r.frame.0 as usize) < frames) {
            let at = row.frame.0 as usize;
            curves.rows[at].clone_from(&tracked.rows[i]);
            curves.head_rotations[at] = tracked.head_rotations[i];
        }
        let fps = take.fps();
        Self::new(&curves, Some(take), fps, smooth_secs, &path, reporter)
    }

    /// The AUs of a table: OpenFace, Live Link Face, or plain.
    pub fn of_table(path: &Path, options: &CurveOptions, smooth_secs: f64, reporter: &dyn Reporter) -> Result<Self> {
        let curves = Curves::read_with(path, options, reporter)?;
        Self::new(&curves, None, curves.fps(), smooth_secs, path, reporter)
    }

    fn new(
        curves: &Curves,
        take: Option<Take>,
        fps: f64,
        smooth_secs: f64,
        path: &Path,
        reporter: &dyn Reporter,
    ) -> Result<Self> {
        let frames = curves.rows.len();
        let held_frames = curves.rows.iter().filter(|r| r.iter().all(Option::is_none)).count();
        if held_frames == frames {
            return Err(FormatError::new(ErrorKind::Empty, "has no frame with a face")
                .in_file(path)
                .with_hint("check the video, or lower `--min-confidence`")
                .into());
        }
        if held_frames > 0 {
            let message = format!("{held_frames} of {frames} driver frames have no face; the last expression is held");
            reporter.warn(Warning::new("lost-face", message));
        }
        let window = window(fps, smooth_secs);
        let smoothed = |values: &[Option<f32>]| match window {
            Some(window) => hold(&smooth::smooth_segments(values, window, smooth::ORDER)),
            None => hold(values),
        };
        let column = |unit: &ActionUnit| Some((*unit, smoothed(&curves.column(*unit)?)));
        let known = |unit: &&ActionUnit| curves.column(**unit).is_some_and(|c| c.iter().any(Option::is_some));
        Ok(Self {
            times_secs: curves.times_secs.iter().map(|t| t - curves.times_secs[0]).collect(),
            intensities: curves.units.iter().filter(known).filter_map(column).collect(),
            turns: turns(&curves.head_rotations).map(|t| t.map(|c| smoothed(&c))),
            held_frames,
            take,
        })
    }

    /// Frames per second.
    pub fn fps(&self) -> f64 {
        let last = self.times_secs.last().copied().unwrap_or(0.0);
        if last > 0.0 { (self.times_secs.len() - 1) as f64 / last } else { 30.0 }
    }
    /// Turn of the head at a time, scaled; the identity where turns are not known.
    pub fn turn_at(&self, secs: f64, scale: f64) -> DMat3 {
        let Some(turns) = &self.turns else { return DMat3::IDENTITY };
        let [x, y, z, w] = [0, 1, 2, 3].map(|c| f64::from(interpolate(&self.times_secs, &turns[c], secs)));
        let q = DQuat::from_xyzw(x, y, z, w);
        if q.length_squared() < 1e-6 {
            return DMat3::IDENTITY;
        }
        let (axis, angle) = q.normalize().to_axis_angle();
        DMat3::from_axis_angle(axis, angle * scale)
    }
}

/// Frames of a smoothing window; `None` for no smoothing.
fn window(fps: f64, secs: f64) -> Option<usize> {
    if secs <= 0.0 {
        return None;
    }
    let frames = (secs * fps).round().clamp(0.0, 1e6) as usize;
    Some((frames | 1).max(smooth::ORDER + 2))
}

/// Rotations against their mean, as components of quaternions on one half of the sphere.
fn turns(rotations: &[Option<DMat3>]) -> Option<[Vec<Option<f32>>; 4]> {
    let all: Vec<Option<DQuat>> = rotations.iter().map(|r| Some(DQuat::from_mat3(&(*r)?))).collect();
    let first = all.iter().flatten().next().copied()?;
    let near = |q: DQuat| if q.dot(first) < 0.0 { -q } else { q };
    let sum = all.iter().flatten().fold(DQuat::from_xyzw(0.0, 0.0, 0.0, 0.0), |sum, q| sum + near(*q));
    if sum.length() < 1e-6 {
        return None;
    }
    let mean = sum.normalize();
    let relative: Vec<Option<[f64; 4]>> = all
        .iter()
        .map(|q| {
            let turn = near(q.as_ref().copied()?) * mean.inverse();
            Some(if turn.w < 0.0 { (-turn).to_array() } else { turn.to_array() })
        })
        .collect();
    Some([0, 1, 2, 3].map(|c| relative.iter().map(|q| Some(q.as_ref()?[c] as f32)).collect()))
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gaps_hold_the_value_before_them() {
        assert_eq!(hold(&[None, Some(1.0), None, None, Some(2.0), None]), [1.0, 1.0, 1.0, 1.0, 2.0, 2.0]);
        assert_eq!(hold(&[None, None]), [0.0, 0.0]);
    }

    #[test]
    fn turns_are_relative_to_the_mean_and_can_be_scaled() {
        let at = |degrees: f64| Some(DMat3::from_rotation_x(0.4) * DMat3::from_rotation_y(degrees.to_radians()));
        let rotations = [at(-10.0), at(0.0), None, at(10.0)];
        let turns = turns(&rotations).unwrap().map(|c| hold(&c));
        let driver = Driver {
            take: None,
            times_secs: vec![0.0, 1.0, 2.0, 3.0],
            intensities: BTreeMap::new(),
            turns: Some(turns),
            held_frames: 0,
        };
        let angle = |secs, scale| DQuat::from_mat3(&driver.turn_at(secs, scale)).to_axis_angle().1.to_degrees();
        assert!((angle(3.0, 1.0) - 10.0).abs() < 1e-3 && (angle(3.0, 0.5) - 5.0).abs() < 1e-3);
        assert!(angle(1.0, 1.0).abs() < 1e-3 && angle(2.0, 1.0).abs() < 1e-3, "a gap holds");
        let expected = at(10.0).unwrap() * at(0.0).unwrap().transpose();
        assert!((driver.turn_at(3.0, 1.0) - expected).to_cols_array().iter().all(|v| v.abs() < 1e-3));
    }
}
