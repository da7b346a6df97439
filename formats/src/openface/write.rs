//! Writing the 714 columns of OpenFace 2.2, in its order and with its decimals.
//!
//! | group | decimals |
//! |---|---|
//! | frame, face_id, timestamp, confidence, success | –, –, 3, 2, – |
//! | gaze directions / gaze angles (0 unless given) | 6 / 3 |
//! | eye landmarks (0 unless given) | 1 |
//! | head pose, translation / rotation | 1 / 3 |
//! | landmarks, image / camera space | 1 |
//! | shape parameters (not known here: 0) | 3 |
//! | AU intensities / presences | 2 / 1 |

use glam::DVec3;

use super::{EYE_LANDMARKS, Eyes};
use crate::au::OPENFACE_INTENSITIES;
use crate::{ActionUnit, ErrorKind, FormatError, Result, Track, TrackRow};

/// The AU whose presence, but not intensity, OpenFace knows; its place is before the last one.
const PRESENCE_ONLY: ActionUnit = ActionUnit(28);

/// The presences of an OpenFace table, in its order.
fn presence_units() -> Vec<ActionUnit> {
    let mut units = OPENFACE_INTENSITIES.to_vec();
    units.insert(units.len() - 1, PRESENCE_ONLY);
    units
}

/// OpenFace's columns, then those of the track that OpenFace does not have.
fn with_others(openface: &[ActionUnit], track: &[ActionUnit]) -> (Vec<ActionUnit>, Vec<ActionUnit>) {
    (openface.to_vec(), track.iter().filter(|u| !openface.contains(u)).copied().collect())
}

fn header(intensities: [&[ActionUnit]; 2], presences: [&[ActionUnit]; 2]) -> String {
    let mut names: Vec<String> = ["frame", "face_id", "timestamp", "confidence", "success"].map(str::to_owned).to_vec();
    for eye in 0..2 {
        names.extend(["x", "y", "z"].map(|axis| format!("gaze_{eye}_{axis}")));
    }
    names.extend(["x", "y"].map(|axis| format!("gaze_angle_{axis}")));
    for axis in ["x", "y", "X", "Y", "Z"] {
        names.extend((0..EYE_LANDMARKS).map(|i| format!("eye_lmk_{axis}_{i}")));
    }
    names.extend(["Tx", "Ty", "Tz", "Rx", "Ry", "Rz"].map(|n| format!("pose_{n}")));
    for axis in ["x", "y", "X", "Y", "Z"] {
        names.extend((0..68).map(|i| format!("{axis}_{i}")));
    }
    names.extend(["scale", "rx", "ry", "rz", "tx", "ty"].map(|n| format!("p_{n}")));
    names.extend((0..34).map(|i| format!("p_{i}")));
    for i in 0..2 {
        names.extend(intensities[i].iter().map(|u| format!("{u}_r")));
        names.extend(presences[i].iter().map(|u| format!("{u}_c")));
    }
    names.join(",")
}

/// A line under construction.
struct Line<'a> {
    out: &'a mut Vec<u8>,
}

impl Line<'_> {
    fn comma(&mut self) {
        self.out.push(b',');
    }

    fn digits(&mut self, mut value: u64, at_least: usize) {
        let mut digits = [b'0'; 20];
        let mut start = digits.len();
        while value > 0 || digits.len() - start < at_least {
            start -= 1;
            digits[start] = b'0' + (value % 10) as u8;
            value /= 10;
        }
        self.out.extend_from_slice(&digits[start..]);
    }

    /// A comma and a number with `decimals` digits after the point; what is missing or no number is `nan`.
    fn number(&mut self, value: Option<f64>, decimals: u32) {
        self.comma();
        let scale = 10u64.pow(decimals);
        match value.map(|v| (v * scale as f64).round()) {
            Some(scaled) if scaled.abs() < 1e15 => {
                if scaled < 0.0 {
                    self.out.push(b'-');
                }
                let scaled = scaled.abs() as u64;
                self.digits(scaled / scale, 1);
                self.out.push(b'.');
                self.digits(scaled % scale, decimals as usize);
            }
            _ => self.out.extend_from_slice(b"nan"),
        }
    }

    fn numbers(&mut self, values: impl Iterator<Item = Option<f64>>, decimals: u32) {
        values.for_each(|v| self.number(v, decimals));
    }

    fn zeros(&mut self, count: usize, decimals: u32) {
        let zero: &[u8] = match decimals {
            1 => b",0.0",
            2 => b",0.00",
            3 => b",0.000",
            _ => b",0.000000",
        };
        for _ in 0..count {
            self.out.extend_from_slice(zero);
        }
    }
}

impl Line<'_> {
    fn eyes(&mut self, eyes: Option<&Eyes<'_>>) {
        let Some(eyes) = eyes else {
            self.zeros(6, 6);
            self.zeros(2, 3);
            return self.zeros(5 * EYE_LANDMARKS, 1);
        };
        self.numbers(eyes.directions.iter().flat_map(DVec3::to_array).map(Some), 6);
        self.numbers(eyes.angles.into_iter().map(Some), 3);
        for axis in 0..2 {
            self.numbers(eyes.landmarks_px.iter().map(|p| Some(f64::from(p[axis]) - 0.5)), 1);
        }
        for axis in 0..3 {
            let of = |i: usize| eyes.landmarks_mm.get(i).map_or(0.0, |p| f64::from(p[axis]));
            self.numbers((0..EYE_LANDMARKS).map(|i| Some(of(i))), 1);
        }
    }
}

/// Where each of `wanted` stands in `have`.
fn places(wanted: &[ActionUnit], have: &[ActionUnit]) -> Vec<Option<usize>> {
    wanted.iter().map(|u| have.iter().position(|h| h == u)).collect()
}

/// The bytes of a table; see [`super::to_bytes`].
pub(super) fn to_bytes(track: &Track, eyes: &[Option<Eyes<'_>>]) -> Result<Vec<u8>> {
    let (intensities, more_intensities) = with_others(&OPENFACE_INTENSITIES, &track.units);
    let (presences, more_presences) = with_others(&presence_units(), &track.presence_units);
    let mut out = header([&intensities, &more_intensities], [&presences, &more_presences]).into_bytes();
    out.reserve(track.rows.len() * 4500);
    out.push(b'\n');
    let groups = [
        (places(&intensities, &track.units), places(&presences, &track.presence_units)),
        (places(&more_intensities, &track.units), places(&more_presences, &track.presence_units)),
    ];
    for (i, row) in track.rows.iter().enumerate() {
        if row.intensities.len() != track.units.len() || row.presences.len() != track.presence_units.len() {
            let message = format!("the row of frame {} has another number of action units than the track", row.frame.0);
            return Err(FormatError::new(ErrorKind::Inconsistent, message));
        }
        write_row(&mut out, row, eyes.get(i).and_then(Option::as_ref), &groups)?;
    }
    Ok(out)
}

type Places = (Vec<Option<usize>>, Vec<Option<usize>>);

fn write_row(out: &mut Vec<u8>, row: &TrackRow, eyes: Option<&Eyes<'_>>, groups: &[Places; 2]) -> Result<()> {
    let frame = row.frame.0.checked_add(1).ok_or_else(|| {
        FormatError::new(
            ErrorKind::Limits,
            format!("frame {} is too large for a table that counts from 1", row.frame.0),
        )
    })?;
    let mut line = Line { out };
    line.digits(u64::from(frame), 1);
    line.comma();
    line.digits(u64::from(row.face_id), 1);
    line.number(row.timestamp_secs, 3);
    line.number(Some(f64::from(row.confidence)), 2);
    line.out.extend_from_slice(if row.success { b",1" } else { b",0" });
    line.eyes(eyes);
    if row.success {
        let pose = row.head_pose;
        line.numbers((0..3).map(|i| pose.map(|p| p.translation_mm[i])), 1);
        line.numbers((0..3).map(|i| pose.map(|p| p.rotation_rad[i])), 3);
        for axis in 0..2 {
            let points = row.landmarks.as_ref();
            line.numbers((0..68).map(|i| points.map(|l| f64::from(l.points_px[i][axis]) - 0.5)), 1);
        }
        for axis in 0..3 {
            let points = row.landmarks_in_camera_mm.as_ref();
            line.numbers((0..68).map(|i| points.map(|p| f64::from(p[i][axis]))), 1);
        }
    } else {
        line.zeros(3, 1);
        line.zeros(3, 3);
        line.zeros(5 * 68, 1);
    }
    line.zeros(40, 3);
    for (intensities, presences) in groups {
        if row.success {
            line.numbers(intensities.iter().map(|at| at.and_then(|i| row.intensities[i]).map(f64::from)), 2);
            let flag = |present: bool| if present { 1.0 } else { 0.0 };
            line.numbers(presences.iter().map(|at| at.and_then(|i| row.presences[i]).map(flag)), 1);
        } else {
            line.zeros(intensities.len(), 2);
            line.zeros(presences.len(), 1);
        }
    }
    line.out.push(b'\n');
    Ok(())
}
