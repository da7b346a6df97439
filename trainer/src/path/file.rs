//! Files with keys of cameras and expressions, written by hand or saved from the viewer.
//!
//! ```toml
//! fps = 25
//!
//! [[key]]
//! secs = 0
//! orbit = { yaw_deg = -20, zoom = 1.2 }
//! preset = "neutral"
//!
//! [[key]]
//! secs = 2
//! orbit = { yaw_deg = 20 }
//! aus = { AU12 = 4, AU06 = 2 }
//! ```
//!
//! A key without `orbit` leaves the camera to its neighbours, one without `aus` and `preset` the expression; AUs that an
//! expression leaves out are neutral. Between keys, curves are smooth, stay between the keys' values, and rest at the ends.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use risorius_formats::{ActionUnit, ErrorKind, FormatError};
use serde::{Deserialize, Serialize};

use super::Orbit;
use crate::presets::{PRESETS, Preset};

/// A moment that the author fixed.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PathKey {
    /// When, seconds from the start.
    pub secs: f64,
    /// The camera.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub orbit: Option<Orbit>,
    /// The expression by its name.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub preset: Option<String>,
    /// The expression by its intensities 0–5; on top of the preset where there are both.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub aus: Option<BTreeMap<ActionUnit, f32>>,
}

/// Keys in the order of time.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CameraPath {
    /// Pictures per second.
    #[serde(default = "default_fps")]
    pub fps: f64,
    /// The keys.
    #[serde(rename = "key")]
    pub keys: Vec<PathKey>,
}

fn default_fps() -> f64 {
    25.0
}

/// A picture of a path.
#[derive(Clone, Debug, PartialEq)]
pub struct Moment {
    /// When, seconds.
    pub secs: f64,
    /// The camera, where any key has one.
    pub orbit: Option<Orbit>,
    /// The expression, where any key has one.
    pub aus: Option<BTreeMap<ActionUnit, f32>>,
}

/// Frames of a path at most: half an hour at 60 per second.
const MAX_FRAMES: f64 = 108_000.0;

impl CameraPath {
    /// Reads a path.
    pub fn read(path: impl AsRef<Path>) -> Result<Self, FormatError> {
        let path = path.as_ref();
        let text = std::fs::read_to_string(path).map_err(|e| FormatError::io(path, "read", &e))?;
        Self::parse(&text).map_err(|e| e.in_file(path))
    }

    /// Parses a path and checks it.
    pub fn parse(text: &str) -> Result<Self, FormatError> {
        let read: Self = toml::from_str(text).map_err(|e| {
            let error = FormatError::syntax(e.message().trim().replace('\n', ", "));
            let line = e.span().map(|s| text[..s.start.min(text.len())].matches('\n').count() as u64 + 1);
            match line {
                Some(line) => error.at_line(line),
                None => error,
            }
        })?;
        read.check()?;
        Ok(read)
    }

    /// The path as a file.
    pub fn to_toml(&self) -> Result<String, FormatError> {
        toml::to_string(self).map_err(|e| FormatError::syntax(format!("cannot encode: {e}")))
    }

    /// Whether keys are in order and their numbers make sense.
    pub fn check(&self) -> Result<(), FormatError> {
        let fail = |message: String| Err(FormatError::new(ErrorKind::Inconsistent, message));
        if self.keys.is_empty() {
            return fail("holds no `[[key]]`".to_owned());
        }
        if !(self.fps.is_finite() && self.fps > 0.0 && self.fps <= 240.0) {
            return fail(format!("`fps` is {}, expected 0–240", self.fps));
        }
        for (i, key) in self.keys.iter().enumerate() {
            if !(key.secs.is_finite() && key.secs >= 0.0 && key.secs * self.fps <= MAX_FRAMES) {
                return fail(format!("key {}: `secs` is {}", i + 1, key.secs));
            }
            if i > 0 && key.secs <= self.keys[i - 1].secs {
                return fail(format!("key {}: {} s does not come after {} s", i + 1, key.secs, self.keys[i - 1].secs));
            }
            if let Some(orbit) = key.orbit
                && orbit.bounded() != orbit
            {
                return fail(format!("key {}: the orbit leaves what makes sense (zoom 0.2–10, pitch ±80°)", i + 1));
            }
            let wrong = |(_, v): &(&ActionUnit, &f32)| !(0.0..=5.0).contains(*v);
            if let Some((unit, value)) = key.aus.iter().flatten().find(wrong) {
                return fail(format!("key {}: `{unit}` is {value}, expected 0–5", i + 1));
            }
            if let Some(name) = key.preset.as_deref().filter(|n| Preset::named(n).is_none()) {
                let names: Vec<&str> = PRESETS.iter().map(|p| p.name).collect();
                return fail(format!("key {}: there is no preset `{name}`; presets: {}", i + 1, names.join(", ")));
            }
        }
        Ok(())
    }

    /// Every picture from the first key to the last.
    pub fn moments(&self) -> Vec<Moment> {
        let (first, last) = match (self.keys.first(), self.keys.last()) {
            (Some(first), Some(last)) => (first.secs, last.secs),
            _ => return Vec::new(),
        };
        let count = ((last - first) * self.fps + 1e-6).floor() as usize + 1;
        let orbits: Vec<(f64, [f64; 5])> =
            self.keys.iter().filter_map(|k| Some((k.secs, k.orbit?.to_array()))).collect();
        let faces: Vec<(f64, BTreeMap<ActionUnit, f32>)> =
            self.keys.iter().filter_map(|k| Some((k.secs, k.expression()?))).collect();
        let units: BTreeSet<ActionUnit> = faces.iter().flat_map(|(_, f)| f.keys().copied()).collect();
        let orbit_curves: [Vec<(f64, f64)>; 5] =
            std::array::from_fn(|n| orbits.iter().map(|(t, o)| (*t, o[n])).collect());
        let unit_curves: Vec<(ActionUnit, Vec<(f64, f64)>)> = units
            .into_iter()
            .map(|u| (u, faces.iter().map(|(t, f)| (*t, f64::from(f.get(&u).copied().unwrap_or(0.0)))).collect()))
            .collect();
        (0..count)
            .map(|i| {
                let secs = first + i as f64 / self.fps;
                Moment {
                    secs,
                    orbit: (!orbits.is_empty())
                        .then(|| Orbit::from_array(std::array::from_fn(|n| smooth_at(&orbit_curves[n], secs)))),
                    aus: (!faces.is_empty())
                        .then(|| unit_curves.iter().map(|(u, curve)| (*u, smooth_at(curve, secs) as f32)).collect()),
                }
            })
            .collect()
    }
}

impl PathKey {
    fn expression(&self) -> Option<BTreeMap<ActionUnit, f32>> {
        let preset = self.preset.as_deref().and_then(Preset::named).map(Preset::intensities);
        if preset.is_none() && self.aus.is_none() {
            return None;
        }
        let mut all = preset.unwrap_or_default();
        all.extend(self.aus.iter().flatten().map(|(u, v)| (*u, *v)));
        Some(all)
    }
}

/// A monotone cubic (Fritsch and Carlson's harmonic slopes) through `points`, flat at both ends and held beyond them.
fn smooth_at(points: &[(f64, f64)], t: f64) -> f64 {
    let after = points.partition_point(|(at, _)| *at <= t);
    if after == 0 {
        return points.first().map_or(0.0, |p| p.1);
    }
    if after == points.len() {
        return points[after - 1].1;
    }
    let secant = |i: usize| (points[i + 1].1 - points[i].1) / (points[i + 1].0 - points[i].0);
    let slope = |i: usize| {
        if i == 0 || i + 1 == points.len() {
            return 0.0;
        }
        let (before, next) = (secant(i - 1), secant(i));
        if before * next <= 0.0 { 0.0 } else { 2.0 * before * next / (before + next) }
    };
    let i = after - 1;
    let (p, q) = (points[i], points[i + 1]);
    let width = q.0 - p.0;
    let s = (t - p.0) / width;
    let (s2, s3) = (s * s, s * s * s);
    (2.0 * s3 - 3.0 * s2 + 1.0) * p.1
        + (s3 - 2.0 * s2 + s) * width * slope(i)
        + (3.0 * s2 - 2.0 * s3) * q.1
        + (s3 - s2) * width * slope(i + 1)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn curves_go_through_their_keys_and_not_beyond() {
        let points = [(0.0, 0.0), (1.0, 4.0), (3.0, 5.0), (4.0, 1.0)];
        for (t, v) in points {
            assert!((smooth_at(&points, t) - v).abs() < 1e-12);
        }
        for i in 0..=400 {
            let t = f64::from(i) / 100.0;
            let v = smooth_at(&points, t);
            let (low, high) = if t <= 1.0 {
                (0.0, 4.0)
            } else if t <= 3.0 {
                (4.0, 5.0)
            } else {
                (1.0, 5.0)
            };
            assert!((low - 1e-9..=high + 1e-9).contains(&v), "{t}: {v}");
        }
        assert!((smooth_at(&[(0.0, 0.0), (1.0, 2.0)], 0.5) - 1.0).abs() < 1e-12);
    }

    #[test]
    fn a_file_becomes_moments() {
        let path = CameraPath::parse(
            "fps = 10\n[[key]]\nsecs = 0\norbit = { yaw_deg = -20 }\npreset = \"neutral\"\n[[key]]\nsecs = 0.5\n\
             [[key]]\nsecs = 1\norbit = { yaw_deg = 20, zoom = 2 }\naus = { AU12 = 4 }\n",
        )
        .unwrap();
        let moments = path.moments();
        assert_eq!(moments.len(), 11);
        assert_eq!(moments[0].orbit.unwrap().yaw_deg, -20.0);
        let middle = &moments[5];
        assert!((middle.orbit.unwrap().yaw_deg).abs() < 1e-9);
        assert!((middle.aus.as_ref().unwrap()[&ActionUnit(12)] - 2.0).abs() < 1e-6);
        assert_eq!(CameraPath::parse(&path.to_toml().unwrap()).unwrap(), path);
    }

    #[test]
    fn mistakes_are_told() {
        for (text, word) in [
            ("fps = 10\n", "key"),
            ("[[key]]\nsecs = 1\n[[key]]\nsecs = 1\n", "after"),
            ("[[key]]\nsecs = 0\norbit = { zoom = 50 }\n", "zoom"),
            ("[[key]]\nsecs = 0\naus = { AU12 = 9 }\n", "AU12"),
            ("[[key]]\nsecs = 0\npreset = \"grin\"\n", "grin"),
            ("[[key]]\nsecs = 0\nyaw = 1\n", "yaw"),
        ] {
            let error = CameraPath::parse(text).unwrap_err().to_string();
            assert!(error.contains(word), "{text}: {error}");
        }
    }
}
