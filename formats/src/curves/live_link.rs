//! Recordings of Live Link Face (`MySlate_*.csv`): ARKit's coefficients 0–1 under their names, and a timecode whose rate
//! follows from its numbers (see `rate`).
//!
//! An AU is the mean of its coefficients, times 5. ARKit's coefficients are shapes, not FACS intensities: the range of a
//! person's own recording says more about it than the numbers (see `trainer transfer --range driver`).

use glam::DMat3;

use super::{CurveOptions, CurveSource, Curves, rate};
use crate::error::shown;
use crate::{ActionUnit, FormatError, Reporter, Result, Warning};

/// ARKit's coefficients of each AU, by its number (both sides where there are two).
pub const ARKIT: [(u8, &[&str]); 17] = [
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

/// `camera_from_head` in OpenFace's axes (x to the right of the picture, y down, z away from the camera) of the app's angles,
/// radians.
///
/// `HeadYaw` is positive towards the face's own left, `HeadPitch` upwards, `HeadRoll` where the head leans to its own
/// right; they turn about ARKit's axes of a face (x to its own left, y up, z out of it) as Ry(yaw) Rx(−pitch) Rz(roll).
/// OpenFace's axes are those after half a turn about x. What this rests on is in `docs/judging.md`.
fn camera_from_head([yaw, pitch, roll]: [f64; 3]) -> DMat3 {
    DMat3::from_rotation_y(-yaw) * DMat3::from_rotation_x(-pitch) * DMat3::from_rotation_z(-roll)
}

pub(super) fn parse(bytes: &[u8], options: &CurveOptions, reporter: &dyn Reporter) -> Result<Curves> {
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
    let mut codes: Vec<[f64; 2]> = Vec::new();
    for (i, record) in reader.byte_records().enumerate() {
        let line = i as u64 + 2;
        let record = record.map_err(|e| FormatError::syntax(e.to_string()).at_line(line))?;
        let text = record.get(time).unwrap_or_default();
        let Some(code) = timecode(text) else {
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
            (Some(yaw), Some(pitch), Some(roll)) => Some(camera_from_head([yaw, pitch, roll])),
            _ => None,
        };
        codes.push(code);
        curves.rows.push(row);
        curves.head_rotations.push(rotation);
    }
    rate::unroll(&mut codes);
    rate::without_false_shares(&mut codes);
    let (told, certain) = rate::of_timecodes(&codes);
    let fps = options.fps.unwrap_or(told);
    if options.fps.is_none() && !certain && codes.len() > 1 {
        let message = format!(
            "the timecodes end within a second, so nothing tells their rate: {fps} a second assumed; `--curves-fps` states it"
        );
        reporter.warn(Warning::new("assumed-rate", message));
    }
    let first = codes.first().copied().unwrap_or_default();
    curves.times_secs = codes.iter().map(|[secs, frame]| secs - first[0] + (frame - first[1]) / fps).collect();
    curves.checked()
}

/// `hh:mm:ss:ff.fff` as whole seconds and frames.
fn timecode(text: &[u8]) -> Option<[f64; 2]> {
    let text = std::str::from_utf8(text).ok()?;
    let parts: Vec<f64> = text.split([':', ';']).map(|p| p.trim().parse::<f64>().ok()).collect::<Option<_>>()?;
    let [hours, minutes, seconds, frames] = parts[..] else { return None };
    parts.iter().all(|v| v.is_finite() && *v >= 0.0).then_some(())?;
    Some([hours * 3600.0 + minutes * 60.0 + seconds, frames])
}

#[cfg(test)]
mod tests {
    use glam::DVec3;

    use super::*;

    fn table(rows: &[&str]) -> Vec<u8> {
        let header = "Timecode,BlendshapeCount,JawOpen,HeadYaw,HeadPitch,HeadRoll";
        [&[header], rows].concat().join("\n").into_bytes()
    }

    fn read(bytes: &[u8]) -> Result<Curves> {
        parse(bytes, &CurveOptions::default(), &crate::Silent)
    }

    #[test]
    fn a_stated_rate_counts_and_midnight_is_passed() {
        let rows = ["23:59:59:23.0,61,0,,,", "00:00:00:00.0,61,0,,,", "00:00:00:01.0,61,0,,,"];
        let told = read(&table(&rows)).unwrap().times_secs;
        assert!((told[2] - 2.0 / 24.0).abs() < 1e-9, "{told:?}");
        let options = CurveOptions { fps: Some(48.0), ..CurveOptions::default() };
        let stated = parse(&table(&rows), &options, &crate::Silent).unwrap().times_secs;
        assert!((stated[2] - stated[1] - 1.0 / 48.0).abs() < 1e-9, "{stated:?}");
    }

    #[test]
    fn angles_turn_the_head_the_way_the_phone_means() {
        let curves = read(&table(&[
            "10:00:00:00.0,61,0,0,0,0",
            "10:00:00:01.0,61,0,0.3,0,0",
            "10:00:00:02.0,61,0,0,0.3,0",
            "10:00:00:03.0,61,0,0,0,0.3",
            "10:00:00:04.0,61,0,0.3,0.2,0.1",
        ]))
        .unwrap();
        let turned = |row: usize, v: DVec3| curves.head_rotations[row].unwrap() * v;
        // OpenFace's axes: x to the right of the picture, where the face's own left is; y down; the face looks to −z.
        let (ahead, own_left) = (DVec3::NEG_Z, DVec3::X);
        assert!((turned(0, ahead) - ahead).length() < 1e-12);
        assert!(turned(1, ahead).x > 0.29, "yaw: to its own left, {}", turned(1, ahead));
        assert!(turned(2, ahead).y < -0.29, "pitch: up, {}", turned(2, ahead));
        assert!(turned(3, own_left).y < -0.29, "roll: its own left ear rises, {}", turned(3, own_left));
        // Pitch goes about the turned head's own axis: whatever the yaw, it raises the gaze by itself.
        assert!((turned(4, ahead).y + 0.2f64.sin()).abs() < 1e-12, "{}", turned(4, ahead));
        let flat = DVec3 { y: 0.0, ..turned(4, ahead) };
        assert!((flat.x / -flat.z - 0.3f64.tan()).abs() < 1e-12);
    }

    #[test]
    fn timecode_counts_sixty_or_thirty_to_a_second() {
        let secs = |rows: &[&str]| read(&table(rows)).unwrap().times_secs;
        let fast = secs(&["10:00:00:58.5,61,0,,,", "10:00:00:59.5,61,0,,,", "10:00:01:00.5,61,0,,,"]);
        assert!((fast[2] - 2.0 / 60.0).abs() < 1e-9, "{fast:?}");
        let rows: Vec<String> = (0..75).map(|i| format!("10:00:{:02}:{:02}.25,61,0,,,", i / 30, i % 30)).collect();
        let slow = secs(&rows.iter().map(String::as_str).collect::<Vec<_>>());
        assert!((slow[74] - 74.0 / 30.0).abs() < 1e-9 && (slow[30] - 1.0).abs() < 1e-9, "{slow:?}");
    }
}
