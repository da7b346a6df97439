//! Which AUs are raised together, over all usable frames and over the chosen ones.

use plotters::coord::Shift;
use plotters::prelude::*;

use super::{Chart, text};
use crate::stats::Report;

/// Side of a cell, pixels.
const CELL: u32 = 30;
/// Space for names.
const NAMES: u32 = 48;
const HEADER: u32 = 44;
const GAP: u32 = 36;

/// Two matrices: how often two AUs are raised in the same frame, as a share (%) of the frames in which either is.
#[derive(Clone, Copy, Debug)]
pub struct TogetherChart<'a>(pub &'a Report);

impl TogetherChart<'_> {
    fn side(self) -> u32 {
        NAMES + CELL * self.0.attributes.len() as u32
    }
}

impl Chart for TogetherChart<'_> {
    fn size(&self) -> (u32, u32) {
        (2 * self.side() + GAP + 24, HEADER + self.side() + 12)
    }

    fn draw<DB: DrawingBackend>(&self, root: &DrawingArea<DB, Shift>) -> Result<(), String> {
        let report = self.0;
        let together = &report.together;
        let titles = [("usable", together.correlation_before), ("chosen", together.correlation_after)];
        for (k, (counts, (name, correlation))) in
            [&together.before, &together.after].into_iter().zip(titles).enumerate()
        {
            let left = (12 + k as u32 * (self.side() + GAP)) as i32;
            let title = format!("Raised together, {name} frames (% of either); mean |r| {correlation:.2}");
            text(root, &title, (left, 12), 15)?;
            matrix(root, report, counts, left)?;
        }
        Ok(())
    }
}

fn matrix<DB: DrawingBackend>(
    root: &DrawingArea<DB, Shift>,
    report: &Report,
    counts: &[Vec<usize>],
    left: i32,
) -> Result<(), String> {
    let (cell, top) = (CELL as i32, (HEADER + 24) as i32);
    for (a, attribute) in report.attributes.iter().enumerate() {
        let name = attribute.unit.to_string();
        let along = a as i32 * cell;
        text(root, &name, (left, top + along + 9), 12)?;
        text(root, name.trim_start_matches("AU"), (left + NAMES as i32 + along + 8, top - 18), 12)?;
        for b in 0..report.attributes.len() {
            let count = |i: usize, j: usize| counts.get(i).and_then(|r| r.get(j)).copied().unwrap_or(0);
            let (both, either) = (count(a, b), count(a, a) + count(b, b) - count(a, b).min(count(a, a) + count(b, b)));
            let share = if either > 0 { both as f64 / either as f64 } else { 0.0 };
            let (x, y) = (left + NAMES as i32 + b as i32 * cell, top + along);
            let shade = |full: u8| (255.0 - share * f64::from(255 - full)).round() as u8;
            let colour = if a == b { RGBColor(225, 225, 225) } else { RGBColor(shade(12), shade(74), shade(110)) };
            let corners = [(x, y), (x + cell - 1, y + cell - 1)];
            root.draw(&Rectangle::new(corners, colour.filled())).map_err(|e| e.to_string())?;
            // On the diagonal the number of frames.
            let words = if a == b { count(a, a).to_string() } else { format!("{:.0}", 100.0 * share) };
            if a == b || share >= 0.005 {
                let style = ("sans-serif", 10).into_font().color(if share > 0.5 && a != b { &WHITE } else { &BLACK });
                root.draw(&Text::new(words, (x + 4, y + 10), style)).map_err(|e| e.to_string())?;
            }
        }
    }
    Ok(())
}
