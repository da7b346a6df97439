//! Which frame each row of a table belongs to, and which row of a frame is taken.

use super::faces::{self, Candidate};
use super::read::{Parser, RawRow, line_at};
use super::{FaceChoice, ReadOptions};
use crate::{ErrorKind, FormatError, FrameIndex, Reporter, Result, TrackRow, Warning};

/// OpenFace counts frames from 1.
const DEFAULT_FIRST_FRAME: u32 = 1;

/// Gives every row its frame from 0 and groups the rows by frame, in order.
pub(super) fn number_frames(
    mut rows: Vec<RawRow>,
    parser: &Parser<'_>,
    options: &ReadOptions,
    reporter: &dyn Reporter,
) -> Result<Vec<Vec<TrackRow>>> {
    let columns = &parser.columns;
    let first = if columns.frame.is_none() { 0 } else { options.first_frame.unwrap_or(DEFAULT_FIRST_FRAME) };
    let repeated = repeated_row(&rows);
    let stuck = rows.iter().all(|r| r.number == 0) && (first > 0 || repeated.is_some());
    if let Some((number, face, start)) = repeated
        && !stuck
        && columns.face_id.is_some()
    {
        return Err(FormatError::new(
            ErrorKind::Inconsistent,
            format!("frame {number} of face {face} stands there twice"),
        )
        .at_line(line_at(parser.bytes, start))
        .in_column("frame")
        .with_hint("two tables may have been pasted together, or the run was killed; run FeatureExtraction again"));
    }
    if stuck || repeated.is_some() {
        let why = match (columns.frame, stuck) {
            (None, _) => "column `face` repeats and there is no `frame`",
            (_, true) => "column `frame` is 0 in every row",
            (_, false) => "column `frame` repeats and there is no `face_id`",
        };
        reporter.warn(Warning::new("frames-by-row", format!("{why}; rows were numbered by their order")));
        return Ok(number_by_order(rows));
    }
    rows.sort_by_key(|r| r.number);
    let mut frames: Vec<Vec<TrackRow>> = Vec::new();
    let mut last = None;
    for RawRow { start, number, mut row } in rows {
        let Some(index) = number.checked_sub(first) else {
            let message = format!("frame `{number}` lies before the first frame `{first}`");
            return Err(FormatError::new(ErrorKind::Inconsistent, message)
                .at_line(line_at(parser.bytes, start))
                .in_column("frame")
                .with_hint(format!("if the table counts from {number}, say `--first-frame {number}`")));
        };
        row.frame = FrameIndex(index);
        match frames.last_mut() {
            Some(group) if last == Some(number) => group.push(row),
            _ => frames.push(vec![row]),
        }
        last = Some(number);
    }
    Ok(frames)
}

/// A row whose frame and face stood there before: frame, face, start.
fn repeated_row(rows: &[RawRow]) -> Option<(u32, u32, usize)> {
    let mut keys: Vec<(u32, u32, usize)> = rows.iter().map(|r| (r.number, r.row.face_id, r.start)).collect();
    keys.sort_unstable();
    keys.windows(2).find(|w| (w[0].0, w[0].1) == (w[1].0, w[1].1)).map(|w| w[1])
}

/// Every row is a frame, except that rows of one time and with different face ids share one.
fn number_by_order(rows: Vec<RawRow>) -> Vec<Vec<TrackRow>> {
    let mut frames: Vec<Vec<TrackRow>> = Vec::new();
    for RawRow { mut row, .. } in rows {
        let shares = frames.last().is_some_and(|group| {
            row.timestamp_secs.is_some()
                && group.iter().all(|r| r.timestamp_secs == row.timestamp_secs && r.face_id != row.face_id)
        });
        row.frame = FrameIndex(frames.len() as u32 - u32::from(shares));
        match frames.last_mut() {
            Some(group) if shares => group.push(row),
            _ => frames.push(vec![row]),
        }
    }
    frames
}

/// Leaves one row a frame.
pub(super) fn choose_faces(frames: Vec<Vec<TrackRow>>, choice: FaceChoice, reporter: &dyn Reporter) -> Vec<TrackRow> {
    let crowded = frames.iter().filter(|group| group.len() > 1).count();
    if crowded == 0 {
        return frames.into_iter().flatten().collect();
    }
    let how = match choice {
        FaceChoice::Largest => "the largest of the first one is followed by its place",
        FaceChoice::First => "the first row of each is taken",
    };
    reporter
        .warn(Warning::new("several-faces", format!("{crowded} of {} frames hold several faces; {how}", frames.len())));
    match choice {
        FaceChoice::First => frames.into_iter().filter_map(|group| group.into_iter().next()).collect(),
        FaceChoice::Largest => faces::follow(frames, Candidate::of),
    }
}
