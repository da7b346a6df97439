//! A time column (`secs`, `time`, `timestamp`, or `frame` at 30 per second) and one column per AU (`AU12`, `AU12_r`).

use super::{CurveSource, Curves};
use crate::error::shown;
use crate::{ActionUnit, ErrorKind, FormatError, Result};

pub(super) fn parse(bytes: &[u8]) -> Result<Curves> {
    let mut reader = csv::ReaderBuilder::new().trim(csv::Trim::All).flexible(true).from_reader(bytes);
    let header = reader.headers().map_err(|e| FormatError::syntax(e.to_string()))?.clone();
    let time = header.iter().position(|n| {
        ["secs", "time", "time_secs", "timestamp", "t", "frame"].iter().any(|t| n.eq_ignore_ascii_case(t))
    });
    let Some(time) = time else {
        return Err(FormatError::new(ErrorKind::Unsupported, "has no time column")
            .at_line(1)
            .with_hint("name it `secs` or `frame` (30 per second)"));
    };
    let per_second = if header[time].eq_ignore_ascii_case("frame") { 30.0 } else { 1.0 };
    let columns: Vec<(usize, ActionUnit)> = header
        .iter()
        .enumerate()
        .filter(|(_, name)| name.to_ascii_uppercase().starts_with("AU"))
        .filter_map(|(i, name)| Some((i, name.strip_suffix("_r").unwrap_or(name).parse().ok()?)))
        .collect();
    if columns.is_empty() {
        return Err(FormatError::new(ErrorKind::Unsupported, "has no column that is an AU")
            .at_line(1)
            .with_hint("name the columns like `AU12`; Live Link Face and OpenFace tables are known as well"));
    }
    let mut curves = Curves {
        source: CurveSource::Plain,
        units: columns.iter().map(|(_, u)| *u).collect(),
        times_secs: Vec::new(),
        rows: Vec::new(),
        head_rotations: Vec::new(),
    };
    for (i, record) in reader.byte_records().enumerate() {
        let line = i as u64 + 2;
        let record = record.map_err(|e| FormatError::syntax(e.to_string()).at_line(line))?;
        let cell = |column: usize| -> Result<Option<f64>> {
            let fail = |what: String| Err(FormatError::syntax(what).at_line(line).in_column(header[column].to_owned()));
            let Some(bytes) = record.get(column) else {
                return fail(format!("has {} of {} cells", record.len(), header.len()));
            };
            if bytes.is_empty() || bytes.eq_ignore_ascii_case(b"nan") {
                return Ok(None);
            }
            match fast_float2::parse::<f64, _>(bytes) {
                Ok(v) if v.is_finite() => Ok(Some(v)),
                _ => fail(format!("`{}` is not a number", shown(bytes))),
            }
        };
        let Some(at) = cell(time)? else {
            return Err(FormatError::syntax("has no time").at_line(line).in_column(header[time].to_owned()));
        };
        curves.times_secs.push(at / per_second);
        let values: Result<Vec<Option<f32>>> =
            columns.iter().map(|(c, _)| Ok(cell(*c)?.map(|v| v.clamp(0.0, 5.0) as f32))).collect();
        curves.rows.push(values?);
        curves.head_rotations.push(None);
    }
    curves.checked()
}
