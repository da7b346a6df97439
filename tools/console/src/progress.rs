//! Progress of the current stage: a bar on a terminal, a line per 5 % otherwise.

use std::io::{self, Write};
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

use indicatif::{ProgressBar, ProgressStyle};

/// A line stands for this share of the work.
const PERCENT_PER_LINE: u64 = 5;
/// How often a stage of unknown length is heard of, off the terminal.
const LINE_INTERVAL: Duration = Duration::from_secs(10);

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Mode {
    Hidden,
    Bar,
    Lines,
}

#[derive(Debug)]
struct Stage {
    name: String,
    total: Option<u64>,
    done: u64,
    /// Off the terminal: the share that was last printed, in `PERCENT_PER_LINE`.
    printed: u64,
    begun: Instant,
    last_line: Instant,
    note: String,
    bar: Option<ProgressBar>,
}

/// The progress of the current stage.
#[derive(Debug)]
pub(crate) struct Progress {
    mode: Mode,
    stage: Mutex<Option<Stage>>,
}

impl Stage {
    /// Begins now, without a bar.
    fn new(name: &str, total: Option<u64>) -> Self {
        let now = Instant::now();
        Self {
            name: name.to_owned(),
            total,
            done: 0,
            printed: 0,
            begun: now,
            last_line: now,
            note: String::new(),
            bar: None,
        }
    }
}

impl Progress {
    pub(crate) fn new(hidden: bool, terminal: bool) -> Self {
        let mode = match (hidden, terminal) {
            (true, _) => Mode::Hidden,
            (false, true) => Mode::Bar,
            (false, false) => Mode::Lines,
        };
        Self { mode, stage: Mutex::new(None) }
    }

    /// Begins a stage; the one before ends.
    pub(crate) fn begin(&self, name: &str, total: Option<u64>) {
        let mut slot = self.lock();
        end(&mut slot);
        let bar = (self.mode == Mode::Bar).then(|| new_bar(name, total));
        *slot = Some(Stage { bar, ..Stage::new(name, total) });
    }

    pub(crate) fn advance(&self, steps: u64) {
        let mut slot = self.lock();
        let Some(stage) = slot.as_mut() else { return };
        stage.done += steps;
        match self.mode {
            Mode::Hidden => {}
            Mode::Bar => {
                if let Some(bar) = &stage.bar {
                    bar.inc(steps);
                }
            }
            Mode::Lines => {
                if let Some(line) = stage.next_line(Instant::now()) {
                    write_line(&line);
                }
            }
        }
    }

    /// Puts `text` beside the progress; as a line of its own where there is no bar and `own_line` is set.
    pub(crate) fn note(&self, text: &str, own_line: bool) {
        let mut slot = self.lock();
        match slot.as_mut() {
            Some(Stage { bar: Some(bar), .. }) => bar.set_message(text.to_owned()),
            Some(stage) if self.mode == Mode::Lines && stage.total.is_none_or(|t| stage.done < t) && !own_line => {
                text.clone_into(&mut stage.note);
            }
            _ if own_line || self.mode == Mode::Lines => write_line(text),
            _ => {}
        }
    }

    /// A line on stderr, above the bar if there is one.
    pub(crate) fn print(&self, text: &str) {
        let slot = self.lock();
        match slot.as_ref().and_then(|s| s.bar.as_ref()) {
            Some(bar) => bar.suspend(|| write_line(text)),
            None => write_line(text),
        }
    }

    /// Ends the current stage.
    pub(crate) fn end(&self) {
        end(&mut self.lock());
    }

    fn lock(&self) -> std::sync::MutexGuard<'_, Option<Stage>> {
        self.stage.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Stage {
    /// The line that is due, if one is.
    fn next_line(&mut self, now: Instant) -> Option<String> {
        let elapsed = now.duration_since(self.begun);
        let line = if let Some(total) = self.total.filter(|&t| t > 0) {
            let percent = self.done.min(total) * 100 / total;
            if percent / PERCENT_PER_LINE <= self.printed {
                return None;
            }
            self.printed = percent / PERCENT_PER_LINE;
            let left = elapsed.as_secs_f64() * (total.saturating_sub(self.done)) as f64 / self.done.max(1) as f64;
            let time = if percent < 100 { format!("{} left", seconds(left)) } else { seconds(elapsed.as_secs_f64()) };
            format!("{}: {percent} % ({} of {total}, {time})", self.name, self.done)
        } else {
            if now.duration_since(self.last_line) < LINE_INTERVAL {
                return None;
            }
            format!("{}: {} ({})", self.name, self.done, seconds(elapsed.as_secs_f64()))
        };
        self.last_line = now;
        let note = std::mem::take(&mut self.note);
        Some(if note.is_empty() { line } else { format!("{line} {note}") })
    }
}

fn end(slot: &mut Option<Stage>) {
    if let Some(bar) = slot.take().and_then(|s| s.bar) {
        bar.finish_and_clear();
    }
}

fn new_bar(name: &str, total: Option<u64>) -> ProgressBar {
    let (bar, template) = match total {
        Some(total) => {
            (ProgressBar::new(total), "{prefix} {bar:30} {human_pos}/{human_len} {per_sec}, {eta} left {wide_msg}")
        }
        None => (ProgressBar::no_length(), "{prefix} {spinner} {human_pos} {per_sec}, {elapsed} {wide_msg}"),
    };
    let style = ProgressStyle::with_template(template).unwrap_or_else(|_| ProgressStyle::default_bar());
    let bar = bar.with_style(style).with_prefix(name.to_owned());
    bar.enable_steady_tick(Duration::from_millis(200));
    bar
}

fn write_line(text: &str) {
    // One write, so that lines of several threads do not mix; nobody is left to tell when stderr is closed.
    let _ = io::stderr().lock().write_all(format!("{text}\n").as_bytes());
}

/// A duration in words, to a second from one second on.
pub fn seconds(secs: f64) -> String {
    let whole = secs.round() as u64;
    match whole {
        0 => format!("{secs:.1} s"),
        1..=99 => format!("{whole} s"),
        100..=5999 => format!("{} min {:02} s", whole / 60, whole % 60),
        _ => format!("{} h {:02} min", whole / 3600, whole % 3600 / 60),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_stands_for_five_percent() {
        let mut s = Stage::new("reading", Some(1000));
        let mut lines = Vec::new();
        for i in 1..=1000 {
            s.done = i;
            lines.extend(s.next_line(s.begun + Duration::from_millis(10 * i)));
        }
        assert_eq!(lines.len(), 20);
        assert_eq!(lines[4], "reading: 25 % (250 of 1000, 8 s left)");
        assert_eq!(lines[19], "reading: 100 % (1000 of 1000, 10 s)");
    }

    #[test]
    fn a_stage_of_unknown_length_speaks_every_ten_seconds() {
        let mut s = Stage::new("reading", None);
        let lines: Vec<_> = (1..=35)
            .filter_map(|i| {
                s.done = i;
                s.next_line(s.begun + Duration::from_secs(i))
            })
            .collect();
        assert_eq!(lines, ["reading: 10 (10 s)", "reading: 20 (20 s)", "reading: 30 (30 s)"]);
    }

    #[test]
    fn more_steps_than_announced_do_no_harm() {
        let mut s = Stage::new("reading", Some(2));
        s.done = 5;
        assert_eq!(s.next_line(s.begun + Duration::from_secs(1)).unwrap(), "reading: 100 % (5 of 2, 1 s)");
        assert!(s.next_line(s.begun).is_none());
    }

    #[test]
    fn durations_are_readable() {
        assert_eq!([0.24, 59.6, 125.0, 7300.0].map(seconds), ["0.2 s", "60 s", "2 min 05 s", "2 h 01 min"]);
    }
}
