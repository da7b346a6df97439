//! AU curves: intensities over time, whatever wrote them: a tracker, a phone, an animator's table.
//!
//! Three sorts of CSV are told apart by their header: OpenFace tables of every version, Live Link Face recordings (ARKit
//! names), and tables with a time column and one column per AU (Py-Feat, LibreFace, or written by hand). Separators, scale
//! and rate follow from the data, or are stated ([`CurveOptions`]).

mod columns;
mod live_link;
mod plain;
mod rate;

pub use live_link::ARKIT;

use std::path::Path;

use glam::DMat3;
use serde::Serialize;

use crate::openface::{self, ReadOptions};
use crate::{ActionUnit, ErrorKind, FormatError, Reporter, Result, TableScale, Track, Warning, dialect};

/// Times beyond a year are damage.
const LATEST_SECS: f64 = 366.0 * 86_400.0;
/// Rows closer than this stand at the same time.
const SHORTEST_SECS: f64 = 1e-6;

/// What a table was.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum CurveSource {
    /// An OpenFace table.
    Openface,
    /// A Live Link Face recording: ARKit coefficients, averaged over left and right.
    LiveLinkFace,
    /// A time column and AU columns.
    Plain,
}

/// What is stated about a table; `None` lets the data tell.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct CurveOptions {
    /// Frames per second of timecodes and frame numbers.
    pub fps: Option<f64>,
    /// The scale of the AU values; Live Link Face's coefficients are always 0–1.
    pub scale: Option<TableScale>,
}

/// Intensities of AUs over time.
#[derive(Clone, Debug, PartialEq)]
pub struct Curves {
    /// What the table was.
    pub source: CurveSource,
    /// The AUs of the rows.
    pub units: Vec<ActionUnit>,
    /// Time of every row, seconds, rising.
    pub times_secs: Vec<f64>,
    /// Intensities 0–5, one row per time; `None` where nothing is known.
    pub rows: Vec<Vec<Option<f32>>>,
    /// Rotation `camera_from_head` of every row in OpenFace's axes, where it is known.
    pub head_rotations: Vec<Option<DMat3>>,
}

impl Curves {
    /// Reads a table, whichever of the three sorts it is.
    pub fn read(path: impl AsRef<Path>, reporter: &dyn Reporter) -> Result<Self> {
        Self::read_with(path, &CurveOptions::default(), reporter)
    }

    /// As [`Self::read`], with what is stated about the table.
    pub fn read_with(path: impl AsRef<Path>, options: &CurveOptions, reporter: &dyn Reporter) -> Result<Self> {
        let path = path.as_ref();
        let bytes = std::fs::read(path).map_err(|e| FormatError::io(path, "read", &e))?;
        Self::parse_with(&bytes, options, reporter).map_err(|e| e.in_file(path))
    }

    /// Parses a table, whichever of the three sorts it is.
    pub fn parse(bytes: &[u8], reporter: &dyn Reporter) -> Result<Self> {
        Self::parse_with(bytes, &CurveOptions::default(), reporter)
    }

    /// As [`Self::parse`], with what is stated about the table.
    pub fn parse_with(bytes: &[u8], options: &CurveOptions, reporter: &dyn Reporter) -> Result<Self> {
        let bytes = bytes.strip_prefix(b"\xef\xbb\xbf").unwrap_or(bytes);
        if bytes.trim_ascii().is_empty() {
            return Err(FormatError::new(ErrorKind::Empty, "the table is empty"));
        }
        let (converted, what) = dialect::with_commas(bytes);
        if let Some(what) = what {
            reporter.warn(Warning::new("other-separators", format!("{what}; both were converted")));
        }
        let bytes = &*converted;
        let header = String::from_utf8_lossy(bytes.split(|&b| b == b'\n').next().unwrap_or_default()).into_owned();
        let names: Vec<&str> = header.split(',').map(str::trim).collect();
        let has = |name: &str| names.iter().any(|n| n.eq_ignore_ascii_case(name));
        if has("Timecode") && has("BlendShapeCount") {
            live_link::parse(bytes, options, reporter)
        } else if names.iter().any(|n| n.starts_with("AU") && n.ends_with("_r")) && has("confidence") {
            let read = ReadOptions { scale: options.scale, ..ReadOptions::default() };
            let mut curves = Self::from_track(&openface::parse(bytes, &read, reporter)?, 0.0);
            if let Some(fps) = options.fps {
                let step = curves.fps() / fps;
                curves.times_secs.iter_mut().for_each(|t| *t *= step);
            }
            Ok(curves)
        } else {
            plain::parse(bytes, options, reporter)
        }
    }

    /// The curves of a track; rows that are not tracked, or below `min_confidence`, have no values. Rows without a time
    /// count as 1/30 s.
    pub fn from_track(track: &Track, min_confidence: f32) -> Self {
        let times: Vec<f64> =
            track.rows.iter().map(|r| r.timestamp_secs.unwrap_or(f64::from(r.frame.0) / 30.0)).collect();
        // OpenFace writes two or three decimals: repeated times at high frame rates would not rise.
        let rising =
            times.windows(2).all(|w| w[1] - w[0] >= SHORTEST_SECS) && times.iter().all(|t| t.abs() <= LATEST_SECS);
        let gaps = times.len().saturating_sub(1).max(1) as f64;
        let span = times.last().copied().unwrap_or(0.0) - times.first().copied().unwrap_or(0.0);
        let step = if (SHORTEST_SECS * gaps..=LATEST_SECS).contains(&span) { span / gaps } else { 1.0 / 30.0 };
        let first = track.rows.first().map_or(0, |r| r.frame.0);
        let even = |i: usize| f64::from(track.rows[i].frame.0 - first) * step;
        let valid = |i: usize| track.rows[i].is_valid(min_confidence);
        Self {
            source: CurveSource::Openface,
            units: track.units.clone(),
            times_secs: if rising { times } else { (0..track.rows.len()).map(even).collect() },
            rows: (0..track.rows.len())
                .map(|i| if valid(i) { track.rows[i].intensities.clone() } else { vec![None; track.units.len()] })
                .collect(),
            head_rotations: (0..track.rows.len())
                .map(|i| Some(track.rows[i].head_pose.filter(|_| valid(i))?.camera_from_head().rotation))
                .collect(),
        }
    }

    /// Rows per second.
    pub fn fps(&self) -> f64 {
        let span = self.times_secs.last().copied().unwrap_or(0.0) - self.times_secs.first().copied().unwrap_or(0.0);
        if span > 0.0 { (self.times_secs.len() - 1) as f64 / span } else { 30.0 }
    }

    /// Index of a unit's column.
    pub fn unit_index(&self, unit: ActionUnit) -> Option<usize> {
        self.units.iter().position(|&u| u == unit)
    }

    /// The column of a unit.
    pub fn column(&self, unit: ActionUnit) -> Option<Vec<Option<f32>>> {
        let column = self.unit_index(unit)?;
        Some(self.rows.iter().map(|r| r[column]).collect())
    }

    /// Checks what every reader owes: as many rows as times, rising times within a year.
    fn checked(self) -> Result<Self> {
        if self.rows.is_empty() {
            return Err(FormatError::new(ErrorKind::Empty, "has a header and no rows"));
        }
        if let Some(i) = self.times_secs.iter().position(|t| !(0.0..=LATEST_SECS).contains(&t.abs())) {
            let message = format!("`{}` s is no time of a recording", self.times_secs[i]);
            return Err(FormatError::new(ErrorKind::Limits, message).at_line(i as u64 + 2));
        }
        if let Some(i) = self.times_secs.windows(2).position(|w| w[1] - w[0] < SHORTEST_SECS) {
            let message =
                format!("time stands still or goes back ({} s to {} s)", self.times_secs[i], self.times_secs[i + 1]);
            return Err(FormatError::new(ErrorKind::Inconsistent, message).at_line(i as u64 + 3));
        }
        Ok(self)
    }
}

/// The value of a curve at `time`: linear between its neighbours, held beyond its ends. `times` rises and is not empty.
pub fn interpolate(times: &[f64], values: &[f32], time: f64) -> f32 {
    let after = times.partition_point(|&t| t <= time);
    match after {
        0 => values[0],
        n if n == times.len() => values[n - 1],
        n => {
            let share = ((time - times[n - 1]) / (times[n] - times[n - 1])) as f32;
            values[n - 1] + (values[n] - values[n - 1]) * share
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Silent;

    fn parse(text: &str) -> Result<Curves> {
        Curves::parse(text.as_bytes(), &Silent)
    }

    /// Found by fuzzing: the step between frames was so small that their rate was infinite.
    #[test]
    fn times_of_a_table_that_end_where_they_begin_give_a_rate_all_the_same() {
        let found = include_bytes!("../../../fuzz/found/tables/times-that-hardly-rise");
        // The first byte chooses the fuzzer's parser.
        let curves = Curves::parse(&found[1..], &Silent).unwrap();
        assert_eq!(curves.times_secs.len(), 3);
        assert!((curves.fps() - 30.0).abs() < 1e-9, "{} frames per second", curves.fps());
    }

    #[test]
    fn plain_tables_read_by_seconds_and_by_frames() {
        let c = parse("secs,AU12,AU1\n0,0,1\n0.5,5,\n1.5,2.5,nan\n").unwrap();
        assert_eq!(c.source, CurveSource::Plain);
        assert_eq!(c.units, [ActionUnit(12), ActionUnit(1)]);
        assert_eq!(c.rows, [[Some(0.0), Some(1.0)], [Some(5.0), None], [Some(2.5), None]]);
        assert_eq!(c.times_secs, [0.0, 0.5, 1.5]);
        let frames = parse("frame,AU12_r\n0,0\n30,5\n").unwrap_or_else(|e| panic!("{e}"));
        assert!((frames.times_secs[1] - frames.times_secs[0] - 1.0).abs() < 1e-6, "{:?}", frames.times_secs);
    }

    #[test]
    fn live_link_recordings_map_arkit_names() {
        let text = "Timecode,BlendShapeCount,EyeBlinkLeft,EyeBlinkRight,MouthSmileLeft,MouthSmileRight,HeadYaw,HeadPitch,HeadRoll\n\
                    10:00:00:59.000,61,0.2,0.4,1.0,0.5,0,0,0\n10:00:01:00.500,61,0.2,0.4,0,0,0.5,0,0\n";
        let c = parse(text).unwrap();
        assert_eq!(c.source, CurveSource::LiveLinkFace);
        let at = |unit, row: usize| c.rows[row][c.unit_index(ActionUnit(unit)).unwrap()].unwrap();
        assert!((at(45, 0) - 1.5).abs() < 1e-6 && (at(12, 0) - 3.75).abs() < 1e-6 && at(12, 1) == 0.0);
        assert!((c.times_secs[1] - 1.5 / 60.0).abs() < 1e-9, "{:?}", c.times_secs);
        assert!(c.unit_index(ActionUnit(4)).is_none(), "no brow column, no AU04");
        assert!(c.head_rotations[1].is_some());
    }

    #[test]
    fn mistakes_name_their_place() {
        for (text, words) in [
            ("", "empty"),
            ("secs,AU12\n", "no rows"),
            ("secs,AU12\n0,1\n0,2\n", "time stands still"),
            ("secs,AU12\n0,1\n1,x\n", "AU12"),
            ("secs,smile\n0,1\n", "no column"),
            ("AU12,AU01\n0,1\n", "time"),
            ("secs,AU12\n0,1\n1\n", "line 3"),
            ("Timecode,BlendShapeCount,JawOpen\n1:2,61,0\n", "Timecode"),
        ] {
            let error = parse(text).unwrap_err();
            let shown = format!("{error} {:?}", crate::Hint::hint(&error));
            assert!(
                shown.contains(words) || error.line().is_some_and(|l| words == format!("line {l}")),
                "{text:?}: {shown}"
            );
        }
    }

    #[test]
    fn values_between_rows_lie_on_the_line() {
        let (times, values) = ([0.0, 1.0, 3.0], [0.0, 2.0, 4.0]);
        for (t, v) in [(-1.0, 0.0), (0.0, 0.0), (0.5, 1.0), (1.0, 2.0), (2.0, 3.0), (9.0, 4.0)] {
            assert!((interpolate(&times, &values, t) - v).abs() < 1e-6, "{t}");
        }
    }
}
