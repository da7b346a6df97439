//! The header of an OpenFace table: which column holds what, whatever version wrote it.

use std::collections::HashMap;

use crate::{ActionUnit, ErrorKind, FormatError, Result};

/// The places of the columns that are read. Names are exact: `x_0` (pixels) and `X_0` (millimetres) differ by case only.
#[derive(Debug)]
pub(super) struct Columns {
    /// All names, for messages.
    pub(super) names: Vec<String>,
    /// `None` in tables of single images, which have `face` instead.
    pub(super) frame: Option<usize>,
    pub(super) face_id: Option<usize>,
    pub(super) timestamp: Option<usize>,
    pub(super) confidence: usize,
    /// `None` in tables of single images.
    pub(super) success: Option<usize>,
    pub(super) intensities: Vec<(ActionUnit, usize)>,
    pub(super) presences: Vec<(ActionUnit, usize)>,
    /// x_0..67, then y_0..67.
    pub(super) landmarks: Option<Vec<usize>>,
    /// X_0..67, Y_0..67, Z_0..67.
    pub(super) landmarks_3d: Option<Vec<usize>>,
    /// Tx, Ty, Tz, Rx, Ry, Rz.
    pub(super) head_pose: Option<Vec<usize>>,
}

/// A cell without the spaces and quotes around it.
pub(super) fn cell(raw: &[u8]) -> &[u8] {
    let cell = raw.trim_ascii();
    match cell {
        [b'"', inner @ .., b'"'] => inner.trim_ascii(),
        _ => cell,
    }
}

impl Columns {
    pub(super) fn parse<'a>(header: impl Iterator<Item = &'a [u8]>) -> Result<Self> {
        let names: Vec<String> = header.map(|raw| String::from_utf8_lossy(cell(raw)).into_owned()).collect();
        if names.iter().flat_map(|n| n.chars()).any(|c| c.is_control() && c != '\t') {
            return Err(FormatError::syntax("is not a text table").with_hint(EXPECTED));
        }
        let mut places: HashMap<&str, usize> = HashMap::with_capacity(names.len());
        for (i, name) in names.iter().enumerate().filter(|(_, name)| !name.is_empty()) {
            if let Some(first) = places.insert(name, i) {
                let message = format!("the name stands at columns {} and {}", first + 1, i + 1);
                return Err(FormatError::new(ErrorKind::Inconsistent, message)
                    .in_column(name)
                    .with_hint("rename or remove one of them; a wrong guess would mix up the data"));
            }
        }
        let find = |name: &str| places.get(name).copied();
        let need = |name: &str| find(name).ok_or_else(|| missing(name, &names));
        let group = |wanted: Vec<String>| -> Result<Option<Vec<usize>>> {
            if wanted.iter().all(|name| find(name).is_none()) {
                return Ok(None);
            }
            wanted.iter().map(|name| need(name)).collect::<Result<Vec<_>>>().map(Some)
        };
        let points = |axes: &[&str]| axes.iter().flat_map(|a| (0..68).map(move |i| format!("{a}_{i}"))).collect();

        let image_mode = find("frame").is_none() && find("face").is_some();
        let frame = if image_mode { None } else { Some(need("frame")?) };
        let confidence = need("confidence")?;
        let success = if image_mode { find("success") } else { Some(need("success")?) };
        let units = |suffix: &str| -> Vec<(ActionUnit, usize)> {
            let unit =
                |name: &str| name.strip_suffix(suffix).filter(|n| n.starts_with("AU")).and_then(|n| n.parse().ok());
            names.iter().enumerate().filter_map(|(i, name)| unit(name).map(|u| (u, i))).collect()
        };
        let columns = Self {
            frame,
            face_id: find("face_id").or_else(|| find("face").filter(|_| image_mode)),
            timestamp: find("timestamp"),
            confidence,
            success,
            intensities: units("_r"),
            presences: units("_c"),
            landmarks: group(points(&["x", "y"]))?,
            landmarks_3d: group(points(&["X", "Y", "Z"]))?,
            head_pose: group(["Tx", "Ty", "Tz", "Rx", "Ry", "Rz"].map(|n| format!("pose_{n}")).to_vec())?,
            names: Vec::new(),
        };
        for units in [&columns.intensities, &columns.presences] {
            if let Some((i, (unit, column))) =
                units.iter().enumerate().find(|(i, (unit, _))| units[..*i].iter().any(|(u, _)| u == unit))
            {
                let other = units[..i].iter().find(|(u, _)| u == unit).map_or("", |(_, c)| names[*c].as_str());
                let message = format!("means the same action unit as `{other}`");
                return Err(FormatError::new(ErrorKind::Inconsistent, message).in_column(&names[*column]));
            }
        }
        if columns.intensities.is_empty() && columns.landmarks.is_none() {
            return Err(missing("AU01_r", &names));
        }
        Ok(Self { names, ..columns })
    }

    /// The name of a column, for messages.
    pub(super) fn name(&self, column: usize) -> &str {
        self.names.get(column).map_or("", String::as_str)
    }
}

/// Which table is wanted, for hints.
pub(super) const EXPECTED: &str = "the table should be one that OpenFace's FeatureExtraction wrote, with its header";

fn missing(name: &str, names: &[String]) -> FormatError {
    let error = FormatError::new(ErrorKind::Missing, format!("there is no column `{name}`"));
    // A name is worth showing when it is clean and at least half of its letters agree.
    let clean = |n: &&String| (1..40).contains(&n.len()) && n.bytes().all(|b| b.is_ascii_graphic() || b == b' ');
    let near = names.iter().filter(clean).map(|n| (distance(name, n), n)).min();
    match near {
        Some((distance, near)) if distance <= name.len() => {
            error.with_hint(format!("the nearest name is `{near}`; {EXPECTED}"))
        }
        _ => error.with_hint(EXPECTED),
    }
}

/// Edit distance in which a change of case costs less than a change of letter.
fn distance(a: &str, b: &str) -> usize {
    let b: Vec<char> = b.chars().take(60).collect();
    let mut row: Vec<usize> = (0..=b.len()).map(|i| 2 * i).collect();
    for (i, ca) in a.chars().enumerate() {
        let mut diagonal = row[0];
        row[0] = 2 * (i + 1);
        for (j, &cb) in b.iter().enumerate() {
            let change = match (ca == cb, ca.eq_ignore_ascii_case(&cb)) {
                (true, _) => 0,
                (_, true) => 1,
                _ => 2,
            };
            let best = (diagonal + change).min(row[j] + 2).min(row[j + 1] + 2);
            diagonal = row[j + 1];
            row[j + 1] = best;
        }
    }
    row[b.len()]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn case_is_nearer_than_letters() {
        assert_eq!(distance("frame", "Frame"), 1);
        assert_eq!(distance("frame", "frames"), 2);
        assert_eq!(distance("", "ab"), 4);
        assert_eq!(distance("AU01_r", "AU01_c"), 2);
    }
}
