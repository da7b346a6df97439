//! A curve over time as inline SVG: no script, no font or file from elsewhere.

use std::fmt::Write as _;

/// Width of the plot, units of the drawing; each is one column of the curve.
const WIDTH: f64 = 900.0;
/// Room for the labels on the left.
const LEFT: f64 = 34.0;
/// Room for the labels of the time axis.
const FOOTER: f64 = 16.0;

/// One line of a chart.
#[derive(Clone, Copy, Debug)]
pub struct Line<'a> {
    /// One value per frame; `None` breaks the line.
    pub values: &'a [Option<f32>],
    /// A CSS colour.
    pub colour: &'a str,
}

/// Curves over one time axis.
#[derive(Clone, Copy, Debug)]
pub struct Chart<'a> {
    /// What it shows, for readers that do not see it.
    pub title: &'a str,
    /// Time of each frame, seconds, ascending.
    pub seconds: &'a [f64],
    /// Lowest and highest value of the vertical axis.
    pub range: [f32; 2],
    /// Values with a horizontal line and a label.
    pub grid: &'a [f32],
    /// The lines.
    pub lines: &'a [Line<'a>],
    /// Runs of frames without a face, first and last: shaded.
    pub lost: &'a [[u32; 2]],
    /// Frames of the first line that are marked with a dot and numbered from 1.
    pub marks: &'a [usize],
    /// Height of the plot, units of the drawing.
    pub height: f64,
}

impl Chart<'_> {
    /// The drawing.
    pub fn svg(&self) -> String {
        let mut svg = format!(
            "<svg viewBox=\"0 0 {:.0} {:.0}\" role=\"img\" aria-label=\"{}\">",
            LEFT + WIDTH + 6.0,
            self.height + FOOTER + 8.0,
            risorius_formats::html::escaped(self.title)
        );
        for [first, last] in self.lost {
            let (a, b) = (self.x(*first as usize), self.x(*last as usize + 1));
            let width = (b - a).max(1.0);
            let _ = write!(
                svg,
                "<rect class=\"lost\" x=\"{a:.1}\" y=\"6\" width=\"{width:.1}\" height=\"{:.0}\"/>",
                self.height
            );
        }
        for value in self.grid {
            let y = self.y(*value);
            let _ = write!(
                svg,
                "<path class=\"grid\" d=\"M{LEFT} {y:.1}h{WIDTH}\"/><text x=\"{:.0}\" y=\"{:.1}\" text-anchor=\"end\">{value}</text>",
                LEFT - 5.0,
                y + 3.5
            );
        }
        self.times(&mut svg);
        for line in self.lines {
            let _ = write!(svg, "<path class=\"line\" stroke=\"{}\" d=\"{}\"/>", line.colour, self.path(line.values));
        }
        for (number, frame) in self.marks.iter().enumerate() {
            let value = self.lines.first().and_then(|l| l.values.get(*frame).copied().flatten());
            if let Some(value) = value {
                let (x, y) = (self.x(*frame), self.y(value));
                // At the right edge the number stands on the left.
                let beside = if x > LEFT + WIDTH - 12.0 { -12.0 } else { 6.0 };
                let _ = write!(
                    svg,
                    "<circle cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"3.5\"/><text class=\"mark\" x=\"{:.1}\" y=\"{:.1}\">{}</text>",
                    x + beside,
                    (y + 4.0).max(12.0),
                    number + 1
                );
            }
        }
        svg.push_str("</svg>");
        svg
    }

    fn x(&self, frame: usize) -> f64 {
        let (first, last) = self.span();
        let at = self.seconds.get(frame).copied().unwrap_or(last);
        LEFT + WIDTH * (at - first) / (last - first).max(1e-9)
    }

    fn y(&self, value: f32) -> f64 {
        let [low, high] = self.range.map(f64::from);
        6.0 + self.height * (1.0 - (f64::from(value).clamp(low, high) - low) / (high - low))
    }

    fn span(&self) -> (f64, f64) {
        (self.seconds.first().copied().unwrap_or(0.0), self.seconds.last().copied().unwrap_or(1.0))
    }

    /// Unbroken runs; of the frames that share a column of the drawing the lowest and the highest, so that no peak is lost.
    fn path(&self, values: &[Option<f32>]) -> String {
        let mut path = String::new();
        let mut pen_down = false;
        let mut at = 0;
        while at < values.len() {
            let Some(value) = values[at] else {
                pen_down = false;
                at += 1;
                continue;
            };
            let column = self.x(at).floor();
            let (mut low, mut high) = ((at, value), (at, value));
            while let Some(Some(value)) = values.get(at) {
                if self.x(at).floor() > column {
                    break;
                }
                low = if *value < low.1 { (at, *value) } else { low };
                high = if *value > high.1 { (at, *value) } else { high };
                at += 1;
            }
            let (first, second) = if low.0 <= high.0 { (low, high) } else { (high, low) };
            let points = [Some(first), Some(second).filter(|p| p.0 > first.0)];
            for (frame, value) in points.into_iter().flatten() {
                let _ = write!(path, "{}{:.1} {:.1}", if pen_down { 'L' } else { 'M' }, self.x(frame), self.y(value));
                pen_down = true;
            }
        }
        path
    }

    /// Labels of the time axis: at most 12, at round seconds.
    fn times(&self, svg: &mut String) {
        let (first, last) = self.span();
        let steps = [0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 30.0, 60.0, 120.0, 300.0, 600.0, 1800.0, 3600.0];
        let step = steps.into_iter().find(|s| (last - first) / s <= 12.0).unwrap_or(7200.0);
        let mut mark = (first / step).ceil();
        while mark * step <= last {
            let x = LEFT + WIDTH * (mark * step - first) / (last - first).max(1e-9);
            let label = (mark * step * 10.0).round() / 10.0;
            let _ = write!(
                svg,
                "<text x=\"{x:.1}\" y=\"{:.0}\" text-anchor=\"middle\">{label} s</text>",
                self.height + FOOTER + 4.0
            );
            mark += 1.0;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn chart<'a>(seconds: &'a [f64], lines: &'a [Line<'a>], marks: &'a [usize]) -> Chart<'a> {
        Chart {
            title: "a<b",
            seconds,
            range: [0.0, 5.0],
            grid: &[0.0, 5.0],
            lines,
            lost: &[[1, 2]],
            marks,
            height: 100.0,
        }
    }

    #[test]
    fn a_gap_breaks_the_line_and_a_peak_survives() {
        let seconds: Vec<f64> = (0..9000).map(|i| f64::from(i) / 30.0).collect();
        let mut values = vec![Some(1.0); 9000];
        values[4001] = Some(4.0);
        values[6000] = None;
        let svg = chart(&seconds, &[Line { values: &values, colour: "#123" }], &[4001]).svg();
        let path = svg.split("stroke=\"#123\" d=\"").nth(1).unwrap().split('"').next().unwrap();
        assert_eq!(path.matches('M').count(), 2, "two runs");
        assert!(path.contains(" 26.0"), "the peak of 4 lies a fifth below the top");
        assert!(path.len() < 40_000, "a column of the drawing has two points at most: {}", path.len());
        assert!(svg.contains("<circle") && svg.contains("class=\"lost\"") && svg.contains("a&lt;b"));
    }

    #[test]
    fn a_take_of_one_frame_or_none_is_drawn() {
        assert!(chart(&[], &[Line { values: &[], colour: "red" }], &[0]).svg().ends_with("</svg>"));
        assert!(chart(&[0.5], &[Line { values: &[Some(1.0)], colour: "red" }], &[0]).svg().contains("M34.0 86.0"));
    }
}
