//! Recordings of Live Link Face (`MySlate_*.csv`): ARKit's coefficients 0–1 under their names, timecode at 60 per second.
//!
//! An AU is the mean of its coefficients, times 5. ARKit's coefficients are shapes, not FACS intensities: the range of a
//! person's own recording says more about it than the numbers (see `trainer transfer --range driver`).

use glam::DMat3;

use super::{CurveSource, Curves};
use crate::error::shown;
use crate::{ActionUnit, FormatError, Result};

/// The coefficients of each AU (both sides where there are two).
pub(super) const ARKIT: [(u8, &[&str]); 17] = [
    (1, &["BrowInnerUp"]),
    (2, &["BrowOuterUpLeft", "BrowOuterUpRight"]),
    (4, &["BrowDownLeft", "BrowDownRight"]),
    (5, &["EyeWideLeft", "EyeWideRight"]),
    (6, &["CheekSquintLeft", "CheekSquintRight"]),
    (7, &["EyeSquintLeft", "EyeSquintRight"]),
    (9, &["NoseSneerLeft", "NoseSneerRight"]),
    (10, &["MouthUpperUpLeft", "MouthUpperUpRight"]),
    (12, &["MouthSmileLeft", "MouthSmileRight"]),
    (14, &["MouthDimpleLeft", "MouthDimpleRight"]),
    (15, &["MouthFrownLeft", "MouthFrownRight"]),
    (17, &["MouthShrugLower"]),
    (20, &["MouthStretchLeft", "MouthStretchRight"]),
    (23, &["MouthPressLeft", "MouthPressRight"]),
    (25, &["MouthLowerDownLeft", "MouthLowerDownRight"]),
    (26, &["JawOpen"]),
    (45, &["EyeBlinkLeft", "EyeBlinkRight"]),
];

/// Frames per second of the timecode.
const TIMECODE_FPS: f64 = 60.0;

pub(super) fn parse(bytes: &[u8]) -> Result<Curves> {
    let mut reader = csv::ReaderBuilder::new().trim(csv::Trim::All).flexible(true).from_reader(bytes);
    let header = reader.headers().map_err(|e| FormatError::syntax(e.to_string()))?.clone();
    let column = |name: &str| header.iter().position(|n| n.eq_ignore_ascii_case(name));
    let time = column("Timecode").unwrap_or(0);
    let wanted: Vec<(ActionUnit, Vec<usize>)> = ARKIT
        .iter()
        .filter_map(|(unit, names)| {
            let columns: Vec<usize> = names.iter().filter_map(|n| column(n)).collect();
            (!columns.is_empty()).then_some((ActionUnit(*unit), columns))
        })
        .collect();
    let head = ["HeadYaw", "HeadPitch", "HeadRoll"].map(column);
    let mut curves = Curves {
        source: CurveSource::LiveLinkFace,
        units: wanted.iter().map(|(u, _)| *u).collect(),
        times_secs: Vec::new(),
        rows: Vec::new(),
        head_rotations: Vec::new(),
    };
    let mut first = None;
    for (i, record) in reader.byte_records().enumerate() {
        let line = i as u64 + 2;
        let record = record.map_err(|e| FormatError::syntax(e.to_string()).at_line(line))?;
        let text = record.get(time).unwrap_or_default();
        let Some(secs) = secs_of_timecode(text) else {
            let message = format!("Timecode `{}` is not hours:minutes:seconds:frames", shown(text));
            return Err(FormatError::syntax(message).at_line(line));
        };
        let number = |column: usize| -> Result<Option<f64>> {
            let bytes = record.get(column).unwrap_or_default();
            if bytes.is_empty() {
                return Ok(None);
            }
            match fast_float2::parse::<f64, _>(bytes) {
                Ok(v) if v.is_finite() => Ok(Some(v)),
                _ => Err(FormatError::syntax(format!("`{}` is not a number", shown(bytes)))
                    .at_line(line)
                    .in_column(header[column].to_owned())),
            }
        };
        let mut row = Vec::with_capacity(wanted.len());
        for (_, columns) in &wanted {
            let values: Vec<f64> = columns.iter().filter_map(|&c| number(c).transpose()).collect::<Result<_>>()?;
            let mean = values.iter().sum::<f64>() / values.len().max(1) as f64;
            // A recording without a face has rows without numbers.
            row.push((!values.is_empty()).then_some((mean.clamp(0.0, 1.0) * 5.0) as f32));
        }
        let angle = |n: usize| head[n].map_or(Ok(None), number);
        let rotation = match (angle(0)?, angle(1)?, angle(2)?) {
            // ARKit turns about y up and x to the left of the subject; OpenFace's y points down.
            (Some(yaw), Some(pitch), Some(roll)) => {
                Some(DMat3::from_rotation_x(-pitch) * DMat3::from_rotation_y(-yaw) * DMat3::from_rotation_z(roll))
            }
            _ => None,
        };
        curves.times_secs.push(secs - *first.get_or_insert(secs));
        curves.rows.push(row);
        curves.head_rotations.push(rotation);
    }
    curves.checked()
}

/// `hh:mm:ss:ff.fff` to seconds.
fn secs_of_timecode(text: &[u8]) -> Option<f64> {
    let text = std::str::from_utf8(text).ok()?;
    let parts: Vec<f64> = text.split([':', ';']).map(|p| p.trim().parse::<f64>().ok()).collect::<Option<_>>()?;
    let [hours, minutes, seconds, frames] = parts[..] else { return None };
    parts.iter().all(|v| v.is_finite() && *v >= 0.0).then_some(())?;
    Some(hours * 3600.0 + minutes * 60.0 + seconds + frames / TIMECODE_FPS)
}
