//! The columns of a plain table: OpenFace's names, Py-Feat's (`AU12` as probabilities, `frame`, `approx_time`), LibreFace's
//! (`au_12_intensity`, `frame_time_in_ms`), and whatever a person would call them.

use crate::{ActionUnit, ErrorKind, FormatError, Result};

/// Names of columns that hold seconds, thousandths of them, and frame numbers.
const SECS: [&str; 8] = ["secs", "seconds", "sec", "time", "time_secs", "timestamp", "t", "time_s"];
const MILLIS: [&str; 6] = ["frame_time_in_ms", "time_ms", "timestamp_ms", "time_in_ms", "millis", "ms"];
const FRAMES: [&str; 4] = ["frame", "frame_idx", "frame_index", "frame_number"];

/// Where the time of a row stands.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Time {
    /// A column that, times a factor, is seconds.
    Clock(usize, f64),
    /// A column of frame numbers.
    Frame(usize),
}

/// Which faces the rows are of.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Faces {
    /// One, as far as the columns say.
    One,
    /// A number of the face.
    Id(usize),
    /// Left, top, width and height of a box.
    Box([usize; 4]),
}

/// What the header of a table says.
#[derive(Clone, Debug)]
pub(super) struct Columns {
    pub(super) time: Time,
    /// A clock in minutes and seconds beside frame numbers.
    pub(super) clock: Option<usize>,
    pub(super) units: Vec<(usize, ActionUnit)>,
    pub(super) faces: Faces,
    /// Whether the AUs are Py-Feat's: probabilities.
    pub(super) probabilities: bool,
    /// Whether the AUs are known to be 0–5.
    pub(super) intensities: bool,
}

impl Columns {
    pub(super) fn parse(header: &csv::StringRecord) -> Result<Self> {
        let find = |name: &str| header.iter().position(|n| n.eq_ignore_ascii_case(name));
        let any = |names: &[&str]| names.iter().find_map(|n| find(n));
        // The most exact one counts.
        let time = any(&MILLIS).map(|c| Time::Clock(c, 1e-3)).or(any(&SECS).map(|c| Time::Clock(c, 1.0)));
        let Some(time) = time.or(any(&FRAMES).map(Time::Frame)) else {
            return Err(FormatError::new(ErrorKind::Unsupported, "has no time column")
                .at_line(1)
                .with_hint("name it `secs`, `time_ms` or `frame`"));
        };
        let named: Vec<(usize, ActionUnit, bool)> =
            header.iter().enumerate().filter_map(|(i, n)| unit_of(n).map(|(u, stated)| (i, u, stated))).collect();
        // Beside `au_12_intensity`, `au_12` says only whether the AU is there.
        let intensities = named.iter().any(|n| n.2);
        let mut units: Vec<(usize, ActionUnit)> = Vec::new();
        for (column, unit, _) in named.into_iter().filter(|n| n.2 == intensities) {
            if let Some((first, _)) = units.iter().find(|(_, u)| *u == unit) {
                let message = format!("means the same action unit as `{}`", &header[*first]);
                return Err(FormatError::new(ErrorKind::Inconsistent, message)
                    .at_line(1)
                    .in_column(header[column].to_owned())
                    .with_hint("rename or remove one of them"));
            }
            units.push((column, unit));
        }
        if units.is_empty() {
            return Err(FormatError::new(ErrorKind::Unsupported, "has no column that is an AU").at_line(1).with_hint(
                "name the columns like `AU12`; tables of OpenFace, Live Link Face, Py-Feat and LibreFace are known as well",
            ));
        }
        let corners = ["FaceRectX", "FaceRectY", "FaceRectWidth", "FaceRectHeight"].map(find);
        let faces = match (corners, any(&["face_id", "face", "face_idx"])) {
            ([Some(x), Some(y), Some(w), Some(h)], _) => Faces::Box([x, y, w, h]),
            (_, Some(id)) => Faces::Id(id),
            _ => Faces::One,
        };
        let probabilities = !intensities && find("FaceScore").is_some();
        Ok(Self { time, clock: find("approx_time"), units, faces, probabilities, intensities })
    }
}

/// The AU that a column is of, and whether its name says that it holds intensities.
fn unit_of(name: &str) -> Option<(ActionUnit, bool)> {
    let name = name.trim().to_ascii_lowercase();
    let rest = name.strip_prefix("au")?.trim_start_matches('_');
    let (digits, stated) = match rest.strip_suffix("_intensity").or_else(|| rest.strip_suffix("_r")) {
        Some(digits) => (digits, true),
        None => (rest, false),
    };
    Some((digits.parse().ok()?, stated))
}

/// Seconds of a clock: `12.5`, `1:02`, `00:01:02.5`.
pub(super) fn clock(text: &str) -> Option<f64> {
    let mut secs = 0.0;
    for part in text.split(':') {
        let value: f64 = part.trim().parse().ok().filter(|v: &f64| v.is_finite())?;
        secs = secs * 60.0 + value;
    }
    Some(secs)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_of_several_tools_are_known() {
        let units = |name: &str| unit_of(name).map(|(u, stated)| (u.0, stated));
        assert_eq!(units("AU12"), Some((12, false)));
        assert_eq!(units("au_4_intensity"), Some((4, true)));
        assert_eq!(units("AU45_r"), Some((45, true)));
        assert_eq!([units("AU12_c"), units("audio"), units("au")], [None; 3]);
        assert_eq!(
            [clock("1:02"), clock("00:01:02.5"), clock("7.5"), clock("a:b")],
            [Some(62.0), Some(62.5), Some(7.5), None]
        );
    }
}
