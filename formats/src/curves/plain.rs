//! A time column (seconds, thousandths, or frame numbers) and one column per AU, whatever tool wrote it; see `columns`.

use super::columns::{Columns, Faces, Time, clock};
use super::{CurveOptions, CurveSource, Curves, rate};
use crate::au::MAX_INTENSITY;
use crate::error::shown;
use crate::table_scale::{self, Judged, Values};
use crate::{FormatError, Reporter, Result, TableScale, Warning, dialect};

/// Frames per second where nothing tells.
const UNKNOWN_FPS: f64 = 30.0;

/// A row as it stands.
struct Row {
    line: u64,
    /// Seconds, or a frame number.
    at: f64,
    /// Seconds of the clock beside it.
    clock: Option<f64>,
    values: Vec<Option<f32>>,
    /// Middle and size of the face's box.
    place: Option<[f64; 3]>,
    id: Option<f64>,
}

pub(super) fn parse(bytes: &[u8], options: &CurveOptions, reporter: &dyn Reporter) -> Result<Curves> {
    let mut reader = csv::ReaderBuilder::new().trim(csv::Trim::All).flexible(true).from_reader(bytes);
    let header = reader.headers().map_err(|e| FormatError::syntax(e.to_string()))?.clone();
    let columns = Columns::parse(&header)?;
    let mut rows = Vec::new();
    for (i, record) in reader.byte_records().enumerate() {
        let line = i as u64 + 2;
        let record = record.map_err(|e| FormatError::syntax(e.to_string()).at_line(line))?;
        rows.push(row(&record, &header, &columns, line).map_err(|e| e.at_line(line))?);
    }
    let mut rows = one_face(rows, columns.faces, reporter);
    scale(&mut rows, &columns, options, reporter)?;
    let fps = match columns.time {
        Time::Clock(..) => 1.0,
        Time::Frame(_) => fps(&rows, options, reporter),
    };
    let curves = Curves {
        source: CurveSource::Plain,
        units: columns.units.iter().map(|(_, u)| *u).collect(),
        times_secs: rows.iter().map(|r| r.at / fps).collect(),
        head_rotations: vec![None; rows.len()],
        rows: rows.iter_mut().map(|r| std::mem::take(&mut r.values)).collect(),
    };
    curves.checked().map_err(|e| match e.line().and_then(|l| rows.get(l as usize - 2)) {
        // Rows of other faces are gone: the line is that of the file.
        Some(row) if columns.faces != Faces::One => e.moved_to_line(row.line),
        _ => e,
    })
}

fn row(record: &csv::ByteRecord, header: &csv::StringRecord, columns: &Columns, line: u64) -> Result<Row> {
    if let Some(error) = dialect::decimal_commas(header.len(), record.len(), record.iter()) {
        return Err(error);
    }
    let text = |column: usize| -> Result<&[u8]> {
        record.get(column).ok_or_else(|| {
            FormatError::syntax(format!("has {} of {} cells", record.len(), header.len()))
                .in_column(header[column].to_owned())
        })
    };
    let cell =
        |column: usize| -> Result<Option<f64>> {
            let bytes = text(column)?;
            if bytes.is_empty() || bytes.eq_ignore_ascii_case(b"nan") {
                return Ok(None);
            }
            match fast_float2::parse::<f64, _>(bytes) {
                Ok(v) if v.is_finite() => Ok(Some(v)),
                _ => Err(FormatError::syntax(format!("{} is not a number", shown(bytes)))
                    .in_column(header[column].to_owned())),
            }
        };
    let no_time = |column: usize| FormatError::syntax("has no time").in_column(header[column].to_owned());
    let at = match columns.time {
        Time::Frame(column) => cell(column)?.ok_or_else(|| no_time(column))?,
        Time::Clock(column, factor) => {
            let bytes = text(column)?;
            let with_colons = std::str::from_utf8(bytes).ok().filter(|t| t.contains(':')).and_then(clock);
            let secs = if with_colons.is_some() { with_colons } else { cell(column)? };
            secs.ok_or_else(|| no_time(column))? * factor
        }
    };
    let (place, id) = match columns.faces {
        Faces::One => (None, None),
        Faces::Id(column) => (None, cell(column)?),
        Faces::Box(corners) => {
            let [x, y, w, h] = [cell(corners[0])?, cell(corners[1])?, cell(corners[2])?, cell(corners[3])?];
            let place = x.zip(y).zip(w.zip(h)).map(|((x, y), (w, h))| [x + 0.5 * w, y + 0.5 * h, w.hypot(h)]);
            (place, None)
        }
    };
    let clock = columns.clock.and_then(|c| std::str::from_utf8(record.get(c)?).ok().and_then(clock));
    let values: Result<Vec<Option<f32>>> = columns.units.iter().map(|(c, _)| Ok(cell(*c)?.map(|v| v as f32))).collect();
    Ok(Row { line, at, clock, values: values?, place, id })
}

/// One row per time: the largest face of the first time that has several, then the nearest, or the one with its number.
fn one_face(rows: Vec<Row>, faces: Faces, reporter: &dyn Reporter) -> Vec<Row> {
    if faces == Faces::One {
        return rows;
    }
    let mut times: Vec<Vec<Row>> = Vec::new();
    for row in rows {
        match times.last_mut() {
            Some(group) if group[0].at == row.at => group.push(row),
            _ => times.push(vec![row]),
        }
    }
    let crowded = times.iter().filter(|group| group.len() > 1).count();
    if crowded > 0 {
        let how = if matches!(faces, Faces::Box(_)) { "the largest of the first one" } else { "the first one's face" };
        let message = format!("{crowded} of {} times hold several faces; {how} is followed", times.len());
        reporter.warn(Warning::new("several-faces", message));
    }
    let (mut last, mut last_id): (Option<[f64; 3]>, Option<f64>) = (None, None);
    let mut chosen = Vec::with_capacity(times.len());
    for mut group in times {
        let cost = |row: &Row| match (row.place, last) {
            (Some(here), Some(there)) => (here[0] - there[0]).hypot(here[1] - there[1]),
            (Some(here), None) => -here[2],
            (None, _) => f64::from(u8::from(row.id != last_id)) * 1e9,
        };
        let best = (0..group.len()).min_by(|&a, &b| cost(&group[a]).total_cmp(&cost(&group[b]))).unwrap_or(0);
        let row = group.swap_remove(best);
        last = row.place.or(last);
        last_id = last_id.or(row.id);
        chosen.push(row);
    }
    chosen
}

/// Brings the values to 0–5.
fn scale(rows: &mut [Row], columns: &Columns, options: &CurveOptions, reporter: &dyn Reporter) -> Result<()> {
    let mut values = Values::default();
    for row in rows.iter() {
        row.values.iter().enumerate().for_each(|(unit, v)| v.iter().for_each(|v| values.add(unit, *v)));
    }
    let most = values.most();
    let scale = match options.scale {
        Some(stated) => stated,
        None if columns.probabilities => {
            reporter.warn(Warning::new(
                "other-scale",
                "the AUs of a Py-Feat table are probabilities: multiplied by 5 to intensities 0–5",
            ));
            TableScale::One
        }
        None => match values.judge()? {
            Judged::Small if columns.intensities => TableScale::Five,
            Judged::Small => {
                reporter.warn(Warning::new("small-intensities", table_scale::small(most, "--curves-scale")));
                TableScale::Five
            }
            Judged::Plain => TableScale::Five,
            Judged::Other(found) => {
                reporter.warn(Warning::new("other-scale", table_scale::converted(found, most)));
                found
            }
        },
    };
    let (mut off, mut first) = (0u64, 0);
    for row in rows {
        for value in row.values.iter_mut().flatten() {
            let scaled = *value * scale.factor();
            *value = scaled.clamp(0.0, MAX_INTENSITY);
            if *value != scaled {
                off += 1;
                first = if off == 1 { row.line } else { first };
            }
        }
    }
    if off > 0 {
        let message =
            format!("{off} values outside 0–{} were moved to its ends (first in line {first})", scale.largest());
        reporter.warn(Warning::new("intensity-off-scale", message));
    }
    Ok(())
}

/// Frames per second: as stated, as the clock tells, or a guess that is said.
fn fps(rows: &[Row], options: &CurveOptions, reporter: &dyn Reporter) -> f64 {
    if let Some(fps) = options.fps {
        return fps;
    }
    let start = rows.first().map_or(0.0, |r| r.at);
    // A table that begins within a video has a clock of that video.
    let from = if rows.first().and_then(|r| r.clock).is_some_and(|c| c > 0.0) { 0.0 } else { start };
    let told = rate::of_clock(rows.iter().filter_map(|r| Some((r.at - from, r.clock?))));
    told.unwrap_or_else(|| {
        let message = format!(
            "rows count frames, and nothing tells their rate: {UNKNOWN_FPS} a second assumed; `--curves-fps` states it"
        );
        reporter.warn(Warning::new("assumed-rate", message));
        UNKNOWN_FPS
    })
}

#[cfg(test)]
mod tests {
    use std::fmt::Write as _;

    use super::*;
    use crate::ActionUnit;
    use crate::report::Collected;

    fn read(text: &str, options: &CurveOptions) -> Result<(Curves, Vec<&'static str>)> {
        let heard = Collected::default();
        let curves = parse(text.as_bytes(), options, &heard)?;
        Ok((curves, heard.warnings().iter().map(|w| w.kind).collect()))
    }

    fn pyfeat(rows: u32, second_face: bool) -> String {
        let mut text =
            "FaceRectX,FaceRectY,FaceRectWidth,FaceRectHeight,FaceScore,AU06,AU12,frame,approx_time\n".to_owned();
        for i in 0..rows {
            let clock = format!("00:{:02}", i / 25);
            if second_face {
                let _ = writeln!(text, "300,100,90,90,0.9,0.7,0.1,{i},{clock}");
            }
            let _ = writeln!(text, "100,100,200,200,0.9,0.2,0.9,{i},{clock}");
        }
        text
    }

    #[test]
    fn py_feat_s_probabilities_clock_and_faces_are_read() {
        let (curves, heard) = read(&pyfeat(50, false), &CurveOptions::default()).unwrap();
        assert_eq!((curves.rows[0].clone(), heard), (vec![Some(1.0), Some(4.5)], vec!["other-scale"]));
        assert!((curves.times_secs[49] - 49.0 / 25.0).abs() < 1e-12, "{:?}", curves.times_secs);
        let (curves, heard) = read(&pyfeat(50, true), &CurveOptions::default()).unwrap();
        assert_eq!((curves.rows.len(), heard), (50, vec!["several-faces", "other-scale"]));
        assert!(curves.rows.iter().all(|r| r[1] == Some(4.5)));
        // Within the first second nothing tells the rate, unless somebody does.
        let (curves, heard) = read(&pyfeat(20, false), &CurveOptions::default()).unwrap();
        assert_eq!((curves.times_secs[15], heard), (0.5, vec!["other-scale", "assumed-rate"]));
        let options = CurveOptions { fps: Some(60.0), scale: Some(TableScale::Five) };
        let (curves, heard) = read(&pyfeat(20, false), &options).unwrap();
        assert_eq!((curves.times_secs[15], curves.rows[0][1], heard), (0.25, Some(0.9), vec![]));
    }

    #[test]
    fn libreface_s_intensities_and_thousandths_are_read() {
        let text =
            "frame_idx,frame_time_in_ms,au_12,au_12_intensity,au_26_intensity\n0,0.0,1,2.0,0\n1,40.0,1,2.2,0.3\n";
        let (curves, heard) = read(text, &CurveOptions::default()).unwrap();
        assert_eq!((curves.units, heard), (vec![ActionUnit(12), ActionUnit(26)], vec![]));
        assert_eq!((curves.times_secs[1], curves.rows[1][0]), (0.04, Some(2.2)));
    }

    #[test]
    fn percent_and_small_values_are_told_apart() {
        let rows = |values: [f32; 2]| {
            let lines: Vec<String> = (0..30).map(|i| format!("{i},{},{}", values[0], values[1])).collect();
            format!("secs,AU06,AU12\n{}\n", lines.join("\n"))
        };
        let (curves, heard) = read(&rows([20.0, 80.0]), &CurveOptions::default()).unwrap();
        assert_eq!((curves.rows[3].clone(), heard), (vec![Some(1.0), Some(4.0)], vec!["other-scale"]));
        assert_eq!(read(&rows([0.2, 0.6]), &CurveOptions::default()).unwrap().1, ["small-intensities"]);
        assert_eq!(read(&rows([0.2, 6.0]), &CurveOptions::default()).unwrap().1, ["intensity-off-scale"]);
        assert!(read(&rows([120.0, 420.0]), &CurveOptions::default()).is_err());
    }

    #[test]
    fn decimal_commas_between_commas_are_named() {
        let error = read("secs,AU12\n0,5,1,25\n", &CurveOptions::default()).unwrap_err();
        assert!(error.to_string().contains("decimal commas") && error.line() == Some(2), "{error}");
        assert_eq!(read("t,AU1,au_1_intensity\n0,1,2\n", &CurveOptions::default()).unwrap().0.rows[0], [Some(2.0)]);
        assert!(read("t,AU1,AU01\n0,1,2\n", &CurveOptions::default()).is_err());
    }
}
