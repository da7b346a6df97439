//! What the names of an image folder say: which numbers are missing, and what else lies in it.
//!
//! Pictures are frames in the order of their names. Where the names count (`frame_000012.jpg`) and some numbers are missing,
//! the frames around a gap are as far apart in time as their numbers: a picture that was deleted is a dropped frame.

use std::path::{Path, PathBuf};

use risorius_formats::frame::FrameRecord;
use risorius_formats::{Reporter, Warning};

/// Files that hold pictures and are not read.
const OTHER_PICTURES: [&str; 16] = [
    "webp", "tif", "tiff", "bmp", "heic", "heif", "avif", "jxl", "gif", "exr", "tga", "jp2", "dng", "cr2", "nef", "arw",
];
/// Names are shown up to this many.
const SHOWN: usize = 3;
/// Steps other than one may be missing pictures as long as so many are as usual.
const LEAST_USUAL: f64 = 0.5;

/// Warns about pictures in `folder` that are not among its `files`: they are no frames of the take.
pub(crate) fn warn_about_strangers(folder: &Path, files: &[PathBuf], reporter: &dyn Reporter) {
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
    let is_picture = |path: &PathBuf| {
        let ending = path.extension().map(|e| e.to_string_lossy().to_ascii_lowercase());
        path.is_file() && ending.is_some_and(|e| OTHER_PICTURES.contains(&e.as_str()))
    };
    let mut names: Vec<String> = entries
        .map(|entry| entry.path())
        .filter(|path| is_picture(path) && !files.contains(path))
        .filter_map(|path| path.file_name().map(|n| n.to_string_lossy().into_owned()))
        .filter(|name| !name.starts_with('.'))
        .collect();
    if names.is_empty() {
        return;
    }
    names.sort_unstable();
    let more = if names.len() > SHOWN { ", …" } else { "" };
    let shown = names.iter().take(SHOWN).map(|n| format!("`{n}`")).collect::<Vec<_>>().join(", ");
    let message = format!(
        "{}: {} of {} pictures are neither PNG nor JPEG and were passed by: {shown}{more}; convert them first",
        folder.display(),
        names.len(),
        names.len() + files.len()
    );
    reporter.warn(Warning::new("other-pictures", message));
}

/// Moves frames behind missing numbers on in time, and counts what is missing as dropped.
pub(crate) fn spread(frames: &mut [FrameRecord], files: &[PathBuf], fps: f64, reporter: &dyn Reporter) {
    let Some(numbers) = numbers(files).filter(|n| n.len() == frames.len()) else { return };
    let steps: Vec<u64> = numbers.windows(2).map(|w| w[1].saturating_sub(w[0])).collect();
    let Some(&usual) = steps.iter().min().filter(|step| **step > 0) else { return };
    let as_usual = steps.iter().filter(|step| **step == usual).count();
    if as_usual == steps.len() || (as_usual as f64) < LEAST_USUAL * steps.len() as f64 {
        return;
    }
    let missing: Vec<u64> = steps.iter().map(|step| step / usual - 1).collect();
    let mut number = 0u64;
    for (frame, missing) in frames.iter_mut().zip(std::iter::once(0).chain(missing.iter().copied())) {
        number += missing + u64::from(frame.index.0 > 0);
        frame.timestamp_nanos = (number as f64 / fps * 1e9).round() as i64;
        frame.dropped_before = u32::try_from(missing).unwrap_or(u32::MAX);
    }
    let first = missing.iter().position(|m| *m > 0).unwrap_or(0);
    let name = |at: usize| files[at].file_name().map_or(String::new(), |n| n.to_string_lossy().into_owned());
    reporter.warn(Warning::new(
        "missing-numbers",
        format!(
            "{} numbers are missing in the names of the pictures, the first between `{}` and `{}`; they count as dropped frames",
            missing.iter().sum::<u64>(),
            name(first),
            name(first + 1)
        ),
    ));
}

/// The numbers that tell the names apart: the only run of digits that differs; `None` where it is not one run, or not rising.
fn numbers(files: &[PathBuf]) -> Option<Vec<u64>> {
    let runs = |path: &PathBuf| -> Option<Vec<String>> {
        let stem = path.file_stem()?.to_string_lossy().into_owned();
        let digits = stem.split(|c: char| !c.is_ascii_digit()).filter(|run| !run.is_empty());
        Some(digits.map(str::to_owned).collect())
    };
    let all: Vec<Vec<String>> = files.iter().map(runs).collect::<Option<_>>()?;
    let first = all.first()?;
    if all.iter().any(|run| run.len() != first.len()) {
        return None;
    }
    let differs = |k: &usize| all.iter().any(|run| run[*k] != first[*k]);
    let mut places = (0..first.len()).filter(differs);
    let (place, None) = (places.next()?, places.next()) else { return None };
    let numbers: Vec<u64> = all.iter().map(|run| run[place].parse().ok()).collect::<Option<_>>()?;
    numbers.windows(2).all(|w| w[1] > w[0]).then_some(numbers)
}

#[cfg(test)]
mod tests {
    use risorius_formats::FrameIndex;
    use risorius_formats::report::Collected;

    use super::*;

    /// (milliseconds, dropped) of frames with these names at 25 a second, and whether something was said.
    fn spread_out(names: &[&str]) -> (Vec<(i64, u32)>, usize) {
        let files: Vec<PathBuf> = names.iter().map(PathBuf::from).collect();
        let frame = |i: u32| FrameRecord {
            index: FrameIndex(i),
            timestamp_nanos: i64::from(i) * 40_000_000,
            ..FrameRecord::default()
        };
        let mut frames: Vec<FrameRecord> = (0..names.len() as u32).map(frame).collect();
        let heard = Collected::default();
        spread(&mut frames, &files, 25.0, &heard);
        let times = frames.iter().map(|f| (f.timestamp_nanos / 1_000_000, f.dropped_before)).collect();
        (times, heard.warnings().len())
    }

    #[test]
    fn missing_numbers_are_dropped_frames() {
        let (times, said) = spread_out(&["f_03.png", "f_04.png", "f_07.png", "f_08.png"]);
        assert_eq!((times, said), (vec![(0, 0), (40, 0), (160, 2), (200, 0)], 1));
        let (times, _) = spread_out(&["0.png", "8.png", "24.png", "32.png"]);
        assert_eq!(times, [(0, 0), (40, 0), (120, 1), (160, 0)]);
    }

    #[test]
    fn even_steps_and_numbers_that_mean_something_else_stay() {
        for names in [
            &["0.png", "8.png", "16.png"][..],
            &["1.png", "2.png", "3.png"],
            &["a.png", "b.png"],
            &["1_5.png", "2_9.png", "7_1.png"],
            &["1.png", "17.png", "40.png", "41.png"],
        ] {
            let (times, said) = spread_out(names);
            assert!(said == 0 && times.iter().zip(0i64..).all(|(t, i)| *t == (40 * i, 0)), "{names:?}: {times:?}");
        }
    }
}
