//! The AUs of a take over time, with the chosen frames marked.

use plotters::coord::Shift;
use plotters::prelude::*;

use super::{Chart, text};
use crate::raster;
use crate::rows::{FrameState, TakeRows};
use risorius_formats::AttributeTable;

const WIDTH: u32 = 1200;
/// Height of an AU's curve, pixels.
const ROW: u32 = 34;
const HEADER: u32 = 40;
const FOOTER: u32 = 64;
const LEFT: u32 = 56;

/// One curve per AU (intensity 0–5), the chosen frames as ticks below, blue for fitting and orange held out; grey where
/// frames cannot be used.
#[derive(Clone, Copy, Debug)]
pub struct Timeline<'a> {
    /// The take.
    pub take: &'a TakeRows,
    /// The attributes.
    pub table: &'a AttributeTable,
}

impl Timeline<'_> {
    fn span(&self) -> (f64, f64) {
        let times = || self.take.frames.iter().map(|f| f.timestamp_nanos as f64 * 1e-9);
        let (first, last) = (times().next().unwrap_or(0.0), times().next_back().unwrap_or(0.0));
        (first, (last - first).max(1e-3))
    }

    fn x(&self, nanos: i64) -> i32 {
        let (first, length) = self.span();
        let plot = f64::from(WIDTH - LEFT - 12);
        LEFT as i32 + ((nanos as f64 * 1e-9 - first) / length * plot).floor() as i32
    }
}

impl Chart for Timeline<'_> {
    fn size(&self) -> (u32, u32) {
        (WIDTH, HEADER + ROW * self.table.attributes.len() as u32 + FOOTER)
    }

    fn draw<DB: DrawingBackend>(&self, root: &DrawingArea<DB, Shift>) -> Result<(), String> {
        let chosen = self.take.frames.iter().filter(|f| f.id.is_some()).count();
        let title = format!("Take {}: AU intensities (0 to 5) over time, {chosen} chosen frames", self.take.name);
        text(root, &title, (12, 12), 15)?;
        let bottom = (HEADER + ROW * self.table.attributes.len() as u32) as i32;
        self.unusable(root, bottom)?;
        for (k, spec) in self.table.attributes.iter().enumerate() {
            let base = (HEADER + ROW * (k as u32 + 1)) as i32 - 4;
            text(root, &spec.unit.to_string(), (8, base - 18), 13)?;
            let [r, g, b] = if spec.active { raster::region_colour(spec.region as u8 + 1) } else { [170; 3] };
            let colour = RGBColor(r, g, b);
            // The highest value of each column of pixels: no peak is lost.
            let mut tops = std::collections::BTreeMap::<i32, f32>::new();
            for f in &self.take.frames {
                if let Some(v) = f.intensities.as_ref().and_then(|v| v.get(k)) {
                    let top = tops.entry(self.x(f.timestamp_nanos)).or_default();
                    *top = top.max(*v);
                }
            }
            for run in runs(&tops) {
                let height = |v: f32| base - (v / 5.0 * (ROW - 8) as f32).round() as i32;
                let mut outline = vec![(run[0].0, base)];
                outline.extend(run.iter().map(|&(x, v)| (x, height(v))));
                outline.push((run[run.len() - 1].0, base));
                root.draw(&Polygon::new(outline, colour.mix(0.75).filled())).map_err(|e| e.to_string())?;
            }
            let line = vec![(LEFT as i32, base), (WIDTH as i32 - 12, base)];
            root.draw(&PathElement::new(line, RGBColor(205, 205, 205))).map_err(|e| e.to_string())?;
        }
        self.ticks(root, bottom)
    }
}

impl Timeline<'_> {
    fn unusable<DB: DrawingBackend>(&self, root: &DrawingArea<DB, Shift>, bottom: i32) -> Result<(), String> {
        let bad: std::collections::BTreeSet<i32> = self
            .take
            .frames
            .iter()
            .filter(|f| f.state != FrameState::Usable)
            .map(|f| self.x(f.timestamp_nanos))
            .collect();
        for x in bad {
            let bar = Rectangle::new([(x, HEADER as i32), (x + 1, bottom)], RGBColor(232, 232, 232).filled());
            root.draw(&bar).map_err(|e| e.to_string())?;
        }
        Ok(())
    }

    fn ticks<DB: DrawingBackend>(&self, root: &DrawingArea<DB, Shift>, bottom: i32) -> Result<(), String> {
        for (split, colour, top) in
            [("train", RGBColor(0, 114, 178), bottom + 4), ("val", RGBColor(213, 94, 0), bottom + 16)]
        {
            let chosen = self.take.frames.iter().filter(|f| f.split == Some(split));
            let xs: std::collections::BTreeSet<i32> = chosen.map(|f| self.x(f.timestamp_nanos)).collect();
            for x in xs {
                root.draw(&Rectangle::new([(x, top), (x + 1, top + 10)], colour.filled()))
                    .map_err(|e| e.to_string())?;
            }
        }
        text(root, "fit", (8, bottom + 2), 11)?;
        text(root, "held out", (8, bottom + 15), 11)?;
        let (first, length) = self.span();
        let step = [0.1, 0.25, 0.5, 1.0, 2.0, 5.0, 10.0, 30.0, 60.0, 300.0].into_iter().find(|s| length / s <= 16.0);
        let step = step.unwrap_or(length);
        for mark in 0..=(length / step).floor() as u32 {
            let secs = f64::from(mark) * step;
            let x = self.x(((first + secs) * 1e9) as i64);
            text(root, &format!("{secs} s"), (x, bottom + 34), 11)?;
        }
        Ok(())
    }
}

/// Unbroken runs of columns: a gap of more than two pixels ends one.
fn runs(tops: &std::collections::BTreeMap<i32, f32>) -> Vec<Vec<(i32, f32)>> {
    let mut runs: Vec<Vec<(i32, f32)>> = Vec::new();
    for (&x, &v) in tops {
        match runs.last_mut() {
            Some(run) if run.last().is_some_and(|l| x - l.0 <= 2) => run.push((x, v)),
            _ => runs.push(vec![(x, v)]),
        }
    }
    runs
}
