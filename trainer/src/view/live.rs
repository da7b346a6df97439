//! A face that drives the avatar live: rows of AU curves that come line by line, from `tracker live` or another program.
//!
//! The first line is the table's header and says which of the three sorts of curves it is; every line after it is a row
//! that takes the place of the row before. Values pass a one-euro filter (Casiez et al. 2012): still where the face
//! rests, quick where it moves.

use std::collections::BTreeMap;
use std::io::{BufRead, BufReader, Read as _};
use std::path::Path;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Instant;

use glam::{DMat3, DQuat};
use risorius_formats::{ActionUnit, Curves, ErrorKind, FormatError, Silent};
use serde::Serialize;

use crate::error::Result;

/// Cut-off of the filter at rest, hertz, and how much it rises per unit of intensity (or of a quaternion's component) per
/// second.
const AU_FILTER: [f64; 2] = [1.5, 0.6];
const TURN_FILTER: [f64; 2] = [1.0, 20.0];
/// Cut-off for the speed itself, hertz.
const SPEED_HZ: f64 = 1.0;
/// Rows that are farther apart than this start the filters afresh, seconds.
const GAP_SECS: f64 = 1.0;
/// Bytes of a line that are read at most: an OpenFace row has about 8,000.
const MAX_LINE: u64 = 1 << 20;

/// Rows as they come; cheap to clone, all clones see the same.
#[derive(Clone, Debug, Default)]
pub struct Live(Arc<Mutex<State>>);

/// What was last heard.
#[derive(Clone, Debug, Default)]
pub struct Now {
    /// Intensities 0–5.
    pub aus: BTreeMap<ActionUnit, f32>,
    /// The strongest of each so far.
    pub strongest: BTreeMap<ActionUnit, f32>,
    /// `camera_from_head` of the driver.
    pub turn: Option<DMat3>,
    /// How it goes.
    pub status: Status,
}

/// How it goes.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Status {
    /// Rows so far.
    pub rows: u64,
    /// Whether the last row had a face.
    pub face: bool,
    /// Whether the rows have ended.
    pub ended: bool,
    /// What was wrong with the last row that could not be read.
    pub problem: Option<String>,
}

#[derive(Debug, Default)]
struct State {
    now: Now,
    filters: BTreeMap<ActionUnit, OneEuro>,
    turn_filters: [OneEuro; 4],
    last: Option<(f64, Instant)>,
}

impl Live {
    /// Follows standard input (`-`) or a file, such as a named pipe, on a thread of its own.
    pub fn follow(path: &Path) -> Result<Self> {
        if path != Path::new("-") && !path.exists() {
            return Err(FormatError::new(ErrorKind::Missing, "does not exist").in_file(path).into());
        }
        let live = Self::default();
        let (heard, from) = (live.clone(), path.to_owned());
        let work = move || {
            if from == Path::new("-") {
                return heard.read(BufReader::new(std::io::stdin()));
            }
            // A named pipe opens when somebody writes to it: not before the page is there.
            match std::fs::File::open(&from) {
                Ok(file) => heard.read(BufReader::new(file)),
                Err(e) => heard.end(Some(format!("{}: {e}", from.display()))),
            }
        };
        std::thread::Builder::new()
            .name("live".to_owned())
            .spawn(work)
            .map_err(|e| FormatError::io(path, "start a thread to read", &e))?;
        Ok(live)
    }

    /// What was last heard.
    pub fn now(&self) -> Now {
        self.state().now.clone()
    }

    fn state(&self) -> std::sync::MutexGuard<'_, State> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Reads rows until they end.
    fn read(&self, mut source: impl BufRead) {
        let mut header: Option<Vec<u8>> = None;
        let mut line = Vec::new();
        let problem = loop {
            line.clear();
            match source.by_ref().take(MAX_LINE).read_until(b'\n', &mut line) {
                Ok(0) => break None,
                Ok(n) if n as u64 == MAX_LINE => break Some("a line is longer than 1 MiB: is it a table?".to_owned()),
                Ok(_) if line.trim_ascii().is_empty() => {}
                Ok(_) => match &header {
                    None => header = Some(std::mem::take(&mut line)),
                    Some(header) => {
                        // A row that was cut off by the end of its writer is no row.
                        if line.ends_with(b"\n") {
                            let row = Curves::parse(&[header.as_slice(), &line].concat(), &Silent);
                            self.state().hear(row, Instant::now());
                        }
                    }
                },
                Err(e) => break Some(e.to_string()),
            }
        };
        self.end(problem);
    }

    fn end(&self, problem: Option<String>) {
        let mut state = self.state();
        state.now.status.ended = true;
        if problem.is_some() {
            state.now.status.problem = problem;
        }
    }
}

impl State {
    fn hear(&mut self, row: risorius_formats::Result<Curves>, arrived: Instant) {
        let status = &mut self.now.status;
        let curves = match row {
            Ok(curves) => curves,
            Err(e) => {
                status.problem = Some(e.to_string());
                return;
            }
        };
        status.rows += 1;
        status.problem = None;
        let (Some(&secs), Some(values)) = (curves.times_secs.last(), curves.rows.last()) else { return };
        status.face = values.iter().any(Option::is_some);
        // By the rows' own clock; by ours where theirs stands still or goes back.
        let step = self.last.map(|(before, at)| {
            let (theirs, ours) = (secs - before, arrived.duration_since(at).as_secs_f64());
            if theirs > 0.0 { theirs } else { ours.max(1e-3) }
        });
        let step = step.filter(|s| *s < GAP_SECS);
        self.last = Some((secs, arrived));
        for (&unit, value) in curves.units.iter().zip(values) {
            let Some(value) = value.filter(|v| v.is_finite()) else { continue };
            let filtered = self.filters.entry(unit).or_default().next(f64::from(value), step, AU_FILTER) as f32;
            self.now.aus.insert(unit, filtered);
            let strongest = self.now.strongest.entry(unit).or_default();
            *strongest = strongest.max(filtered);
        }
        if let Some(turn) = curves.head_rotations.last().copied().flatten().filter(DMat3::is_finite) {
            let mut q = DQuat::from_mat3(&turn);
            let before = self.turn_filters.map(|f| f.value.unwrap_or(0.0));
            if DQuat::from_array(before).dot(q) < 0.0 {
                q = -q;
            }
            let mut sides = q.to_array();
            for (side, filter) in sides.iter_mut().zip(&mut self.turn_filters) {
                *side = filter.next(*side, step, TURN_FILTER);
            }
            let q = DQuat::from_array(sides);
            self.now.turn = (q.length_squared() > 1e-6).then(|| DMat3::from_quat(q.normalize()));
        }
    }
}

/// A low pass whose cut-off rises with the speed.
#[derive(Clone, Copy, Debug, Default)]
struct OneEuro {
    value: Option<f64>,
    speed: f64,
}

impl OneEuro {
    /// The filtered value, `step` seconds after the one before; `None` starts afresh.
    fn next(&mut self, value: f64, step: Option<f64>, [rest_hz, per_speed]: [f64; 2]) -> f64 {
        let (Some(before), Some(step)) = (self.value, step) else {
            *self = Self { value: Some(value), speed: 0.0 };
            return value;
        };
        let weight = |hz: f64| 1.0 / (1.0 + 1.0 / (std::f64::consts::TAU * hz * step));
        self.speed += weight(SPEED_HZ) * ((value - before) / step - self.speed);
        let next = before + weight(rest_hz + per_speed * self.speed.abs()) * (value - before);
        self.value = Some(next);
        next
    }
}

#[cfg(test)]
mod tests {
    use std::fmt::Write as _;

    use super::*;

    const AU12: ActionUnit = ActionUnit(12);

    fn heard(table: &str) -> Now {
        let live = Live::default();
        live.read(table.as_bytes());
        live.now()
    }

    #[test]
    fn rows_take_the_place_of_those_before() {
        let now = heard("secs,AU12,AU45\n0.0,1.0,0\n5.0,3.0,\n");
        assert_eq!((now.aus[&AU12], now.aus[&ActionUnit(45)]), (3.0, 0.0), "after a gap the filter starts afresh");
        assert_eq!(now.status, Status { rows: 2, face: true, ended: true, problem: None });
        assert_eq!(now.strongest[&AU12], 3.0);
    }

    #[test]
    fn noise_is_quieted_and_motion_is_followed() {
        let mut table = "secs,AU12\n".to_owned();
        let mut values = Vec::new();
        for i in 0..300 {
            let noise = if i % 2 == 0 { 0.2 } else { -0.2 };
            let value = if i < 200 { 1.0 } else { 4.0 };
            let _ = writeln!(table, "{},{}", f64::from(i) / 60.0, value + noise);
            values.push(f64::from(heard(&table).aus[&AU12]));
        }
        let spread =
            |v: &[f64]| v.iter().copied().fold(f64::MIN, f64::max) - v.iter().copied().fold(f64::MAX, f64::min);
        assert!(spread(&values[150..200]) < 0.15, "{}", spread(&values[150..200]));
        assert!(values[206] > 3.0, "a tenth of a second later: {}", values[206]);
    }

    #[test]
    fn bad_rows_are_told_and_passed_over() {
        let now = heard("secs,AU12\n0,1\n0.1,x\n");
        assert!(now.status.problem.as_ref().unwrap().contains('x') && now.aus[&AU12] == 1.0, "{:?}", now.status);
        assert_eq!(heard("secs,AU12\n0,1\n0.1,2").status.rows, 1, "a row without its end");
        let no_table = heard(&"a".repeat(2 << 20));
        assert!(no_table.status.problem.unwrap().contains("longer"));
        let now = heard("secs,AU12\n0,NaN\n0.5,inf\n");
        assert!(now.aus.get(&AU12).is_none_or(|v| v.is_finite()));
    }
}
