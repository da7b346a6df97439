//! The captures, takes and datasets that the measured commands are given.

use std::path::PathBuf;

use risorius_bench::child;
use risorius_console::Failure;
use risorius_formats::{FormatError, atomic};

use crate::cases::{Bench, text};
use crate::score::number;

/// A capture with its take.
pub(crate) struct World {
    pub(crate) capture: PathBuf,
    pub(crate) take: String,
    pub(crate) frames: u32,
}

impl Bench<'_> {
    /// Makes a capture and its take.
    pub(crate) fn world(&mut self, name: &str, frames: u32) -> Result<World, Failure> {
        let capture = self.made(&format!("capture-{name}"));
        let out = text(&capture);
        let frames_text = frames.to_string();
        let args =
            ["--out", &out, "--frames", &frames_text, "--fps", "30", "--size", self.sizes.size, "--noise", "off"];
        self.console.say(&format!("a capture of {frames} frames"));
        child::run("synth", &args, self.work)?;
        self.take(name, capture, Some(frames))
    }

    pub(crate) fn take(&mut self, name: &str, capture: PathBuf, frames: Option<u32>) -> Result<World, Failure> {
        let take = text(&self.made(&format!("take-{name}")));
        let video = text(&capture.join("video.mp4"));
        let args = ["record", "--input", &video, "--out", &take];
        let grows: Vec<(&str, f64)> = frames.iter().map(|&n| ("frames", f64::from(n))).collect();
        let run = self.measure(&format!("take/{name}"), "capture", &args, &grows)?;
        let counted = ["frame_count", "frames"].iter().find_map(|key| number(&run.document, &[key]));
        let frames = frames.or_else(|| counted.map(|n| n as u32)).unwrap_or(0);
        let table = text(&capture.join("openface.csv"));
        self.measure(
            &format!("import/{name}"),
            "tracker",
            &["import", &take, "--openface", &table],
            &[("frames", f64::from(frames))],
        )?;
        let model = text(&capture.join("truth_colmap"));
        let args = ["poses", &take, "--colmap-model", &model];
        self.measure(&format!("poses/model-{name}"), "tracker", &args, &[("frames", f64::from(frames))])?;
        Ok(World { capture, take, frames })
    }

    /// A dataset of a take whose table knows fewer AUs.
    pub(crate) fn with_fewer_aus(&mut self, world: &World, count: usize) -> Result<String, Failure> {
        let take = text(&self.made(&format!("take-aus-{count}")));
        let [video, model] = ["video.mp4", "truth_colmap"].map(|n| text(&world.capture.join(n)));
        child::run("capture", &["record", "--input", &video, "--out", &take], self.work)?;
        let table = self.work.join("fewer.csv");
        let source = world.capture.join("openface.csv");
        let all = std::fs::read_to_string(&source).map_err(|e| FormatError::io(&source, "read", &e))?;
        atomic::write_file(&table, fewer_aus(&all, count).as_bytes())?;
        child::run("tracker", &["import", &take, "--openface", &text(&table)], self.work)?;
        child::run("tracker", &["poses", &take, "--colmap-model", &model], self.work)?;
        let out = text(&self.made(&format!("dataset-aus-{count}")));
        let frames = self.sizes.chosen[1].to_string();
        child::run("dataset", &["build", &take, "--frames", &frames, "--scale", "2", "--out", &out], self.work)?;
        Ok(out)
    }
}

/// The table with its first `count` AUs only.
fn fewer_aus(table: &str, count: usize) -> String {
    let header: Vec<&str> = table.lines().next().unwrap_or_default().split(',').collect();
    let intensities: Vec<&str> =
        header.iter().map(|c| c.trim()).filter(|c| c.starts_with("AU") && c.ends_with("_r")).collect();
    // Evenly over them, so that every region keeps some.
    let kept: Vec<&str> =
        (0..count).filter_map(|i| Some(&intensities.get(i * intensities.len() / count)?[..4])).collect();
    let keeps = |name: &str| !name.starts_with("AU") || kept.iter().any(|au| name.starts_with(au));
    let columns: Vec<usize> = (0..header.len()).filter(|&i| keeps(header[i].trim())).collect();
    let line = |line: &str| {
        let cells: Vec<&str> = line.split(',').collect();
        columns.iter().filter_map(|&i| cells.get(i).copied()).collect::<Vec<_>>().join(",") + "\n"
    };
    table.lines().map(line).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn fewer_aus_leave_all_other_columns() {
        let table = "frame, AU01_r, AU02_r, AU04_r, AU12_r, AU01_c, AU04_c, AU45_c\n1, 0.1, 0.2, 0.4, 1.2, 1, 0, 1\n";
        assert_eq!(fewer_aus(table, 2), "frame, AU01_r, AU04_r, AU01_c, AU04_c\n1, 0.1, 0.4, 1, 0\n");
        assert_eq!(fewer_aus(table, 4).lines().count(), 2);
    }
}
