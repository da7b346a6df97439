//! One progress over all stages: a bar on a terminal, otherwise a line per 5 % and per stage.
//!
//! Shares are wall time: what has passed against what is expected to come. A stage's expected time comes from
//! [`WorkPlan`]; it is corrected by how the finished stages kept theirs, and by the steps of the stage under way.

use std::io::Write as _;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use indicatif::{ProgressBar, ProgressStyle};
use risorius_console::{CommonArgs, Listener};
use risorius_formats::{Reporter, Warning};

use super::stages::{AvatarStage, WorkPlan};

const PERCENT_PER_LINE: u64 = 5;
const TICK: Duration = Duration::from_millis(250);
/// Finished stages tell the machine's speed when they were expected to take this long together.
const TELLING_SECS: f64 = 3.0;
/// A stage that takes longer than expected is taken to need at least this share more.
const OVERTIME: f64 = 0.05;

/// What a stage said while it ran.
#[derive(Debug, Default)]
pub(super) struct Heard {
    pub(super) warnings: Vec<Warning>,
    /// The command's own result.
    pub(super) result: Option<serde_json::Value>,
}

/// The progress of `risorius avatar`, and the listener of its stages.
#[derive(Debug)]
pub(super) struct Board {
    state: Mutex<State>,
    bar: Option<ProgressBar>,
    lines: bool,
    quiet: u8,
    verbose: u8,
}

#[derive(Debug)]
struct State {
    plan: WorkPlan,
    stages: Vec<Planned>,
    at: Option<usize>,
    begun: Instant,
    started: Instant,
    part: Option<Part>,
    note: String,
    percent: u64,
    heard: Heard,
}

#[derive(Debug)]
struct Planned {
    stage: AvatarStage,
    /// Wall seconds, once it is over; 0 for one that was skipped.
    took: Option<f64>,
}

/// A part of the stage under way, as the stage counts it.
#[derive(Debug)]
struct Part {
    name: String,
    total: Option<u64>,
    done: u64,
    begun: Instant,
}

/// Parts that are nearly all of their stages.
const MAIN_PARTS: [&str; 6] = ["reading frames", "track", "write pictures", "fit", "evaluate", "render"];

impl Part {
    fn is_main(&self) -> bool {
        MAIN_PARTS.contains(&self.name.as_str())
    }

    /// Wall seconds to go, if its steps tell.
    fn left_secs(&self) -> Option<f64> {
        let total = self.total.filter(|&t| self.done * 20 >= t && t > 0)?;
        Some(self.begun.elapsed().as_secs_f64() * total.saturating_sub(self.done) as f64 / self.done.max(1) as f64)
    }
}

impl State {
    /// How much longer than expected stages take on this machine, as far as is known.
    fn slowness(&self) -> f64 {
        let over = self.stages.iter().filter(|s| s.stage.is_telling());
        let (mut took, mut expected) = (0.0, 0.0);
        for (secs, planned) in over.filter_map(|s| Some((s.took.filter(|&t| t > 0.0)?, s))) {
            took += secs;
            expected += self.plan.expected_secs(planned.stage);
        }
        if expected < TELLING_SECS { 1.0 } else { (took / expected).clamp(0.25, 6.0) }
    }

    fn expected(&self, stage: AvatarStage, slowness: f64) -> f64 {
        self.plan.expected_secs(stage) * if stage.has_budget() { 1.0 } else { slowness }
    }

    /// Wall seconds to go, over all stages.
    fn left_secs(&self) -> f64 {
        let slowness = self.slowness();
        let now = self.at.map_or(0.0, |at| {
            let expected = self.expected(self.stages[at].stage, slowness);
            let by_plan = (expected - self.begun.elapsed().as_secs_f64()).max(OVERTIME * expected);
            match self.part.as_ref().and_then(|part| Some((part.is_main(), part.left_secs()?))) {
                Some((true, left)) => left,
                // What comes after a smaller part is only in the plan.
                Some((false, left)) => left.max(by_plan),
                None => by_plan,
            }
        });
        let next = self.at.map_or(0, |at| at + 1);
        let later = self.stages[next..].iter().filter(|s| s.took.is_none());
        now + later.map(|s| self.expected(s.stage, slowness)).sum::<f64>()
    }

    /// The share in percent; it never falls.
    fn update(&mut self) -> (u64, f64) {
        let (passed, left) = (self.started.elapsed().as_secs_f64(), self.left_secs());
        let percent = (100.0 * passed / (passed + left).max(1e-9)).floor() as u64;
        self.percent = self.percent.max(percent.min(99));
        (self.percent, left)
    }

    /// `3 of 6, cameras: features 12 of 40`
    fn place(&self) -> String {
        let Some(at) = self.at else { return String::new() };
        let mut text = format!("{} of {}, {}", at + 1, self.stages.len(), self.stages[at].stage.title());
        match &self.part {
            Some(Part { name, total: Some(1000), done, .. }) if name == "fit" => {
                text = format!("{text} {} %", done / 10);
            }
            Some(Part { name, total, done, .. }) => {
                if name != self.stages[at].stage.title() {
                    text = format!("{text}: {name}");
                }
                if let Some(total) = total {
                    text = format!("{text} {done} of {total}");
                }
            }
            None => {}
        }
        text
    }
}

impl Board {
    /// A progress over `stages`.
    pub(super) fn new(stages: &[AvatarStage], plan: WorkPlan, common: &CommonArgs) -> Self {
        let hidden = common.no_progress || common.quiet > 0;
        let terminal = std::io::IsTerminal::is_terminal(&std::io::stderr());
        let bar = (!hidden && terminal).then(new_bar);
        let now = Instant::now();
        let state = State {
            plan,
            stages: stages.iter().map(|&stage| Planned { stage, took: None }).collect(),
            at: None,
            begun: now,
            started: now,
            part: None,
            note: String::new(),
            percent: 0,
            heard: Heard::default(),
        };
        let (quiet, verbose) = (common.quiet, common.verbose);
        Self { state: Mutex::new(state), bar, lines: !hidden && !terminal, quiet, verbose }
    }

    /// Corrects what is known of the work.
    pub(super) fn replan(&self, change: impl FnOnce(&mut WorkPlan)) {
        change(&mut self.lock().plan);
    }

    /// A stage begins.
    pub(super) fn begin(&self, stage: AvatarStage) {
        let mut state = self.lock();
        state.at = state.stages.iter().position(|s| s.stage == stage);
        state.begun = Instant::now();
        state.part = None;
        state.note.clear();
        state.heard = Heard::default();
        drop(state);
        self.show();
    }

    /// A stage is over; `outcome` says how it went, `skipped` that there was nothing to do.
    pub(super) fn end(&self, outcome: &str, skipped: bool) -> Heard {
        let mut state = self.lock();
        let secs = state.begun.elapsed().as_secs_f64();
        let Some(at) = state.at.take() else { return Heard::default() };
        state.stages[at].took = Some(if skipped { 0.0 } else { secs });
        state.part = None;
        let title = state.stages[at].stage.title();
        let heard = std::mem::take(&mut state.heard);
        drop(state);
        let time = if skipped { String::new() } else { format!("{}, ", seconds(secs)) };
        self.say(&format!("{title:>13}  {time}{outcome}"));
        heard
    }

    /// The result of the stage under way.
    pub(super) fn take_result(&self) -> serde_json::Value {
        self.lock().heard.result.take().unwrap_or_default()
    }

    /// The stage under way came to nothing.
    pub(super) fn abandon(&self) -> Heard {
        let mut state = self.lock();
        state.at = None;
        std::mem::take(&mut state.heard)
    }

    /// A line for people on stderr.
    pub(super) fn say(&self, text: &str) {
        if self.quiet == 0 {
            self.print(text);
        }
    }

    /// The progress is over.
    pub(super) fn finish(&self) {
        if let Some(bar) = &self.bar {
            bar.finish_and_clear();
        }
    }

    fn print(&self, text: &str) {
        // One write, so that lines of several threads do not mix; nobody is left to tell when stderr is closed.
        let write = || drop(std::io::stderr().lock().write_all(format!("{text}\n").as_bytes()));
        match &self.bar {
            Some(bar) => bar.suspend(write),
            None => write(),
        }
    }

    fn show(&self) {
        let mut state = self.lock();
        if state.at.is_none() {
            return;
        }
        let before = state.percent;
        let (percent, left) = state.update();
        let place = state.place();
        if let Some(bar) = &self.bar {
            bar.set_position(percent);
            bar.set_message(format!("{} left   {place}  {}", seconds(left), state.note));
        } else if self.lines && percent / PERCENT_PER_LINE > before / PERCENT_PER_LINE {
            drop(state);
            self.print(&format!("{percent:>3} %, about {} left ({place})", seconds(left)));
        }
    }

    fn lock(&self) -> std::sync::MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Reporter for Board {
    fn stage(&self, name: &str, total: Option<u64>) {
        let mut state = self.lock();
        state.part = Some(Part { name: name.to_owned(), total, done: 0, begun: Instant::now() });
        state.note.clear();
        drop(state);
        self.show();
    }

    fn advance(&self, steps: u64) {
        if let Some(part) = &mut self.lock().part {
            part.done += steps;
        }
    }

    fn note(&self, text: &str) {
        let mut state = self.lock();
        text.clone_into(&mut state.note);
        drop(state);
        if self.verbose > 0 {
            self.print(&format!("{:>13}  {text}", ""));
        }
    }

    fn warn(&self, warning: Warning) {
        if self.verbose > 0 {
            self.print(&format!("warning: {}", warning.message));
        }
        self.lock().heard.warnings.push(warning);
    }
}

impl Listener for Board {
    fn result(&self, document: serde_json::Value, _: &str) {
        self.lock().heard.result = Some(document);
    }
}

/// Keeps the display moving until it is dropped.
#[derive(Debug)]
pub(super) struct Ticker {
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Ticker {
    pub(super) fn new(board: &Arc<Board>) -> Self {
        let stop = Arc::new(AtomicBool::new(false));
        let (board, stopped) = (Arc::clone(board), Arc::clone(&stop));
        let tick = move || {
            while !stopped.load(Ordering::Relaxed) {
                board.show();
                std::thread::park_timeout(TICK);
            }
        };
        // Without the thread the display stands still; the work does not.
        let thread = std::thread::Builder::new().name("progress".to_owned()).spawn(tick).ok();
        Self { stop, thread }
    }
}

impl Drop for Ticker {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            thread.thread().unpark();
            let _ = thread.join();
        }
    }
}

fn new_bar() -> ProgressBar {
    let style = ProgressStyle::with_template("{bar:30} {pos:>2} %  {wide_msg}");
    ProgressBar::new(100).with_style(style.unwrap_or_else(|_| ProgressStyle::default_bar()))
}

/// A duration in words, to a tenth below ten seconds.
pub(super) fn seconds(secs: f64) -> String {
    if secs.round() < 10.0 { format!("{secs:.1} s") } else { risorius_console::seconds(secs) }
}

#[cfg(test)]
mod tests {
    use super::super::stages::WorkSize;
    use super::*;

    fn board() -> Board {
        let size = WorkSize::new(2400, 540, 960, 120.0);
        let plan = WorkPlan { size, every: 4, has_table: false, has_model: false, fit_secs: 60.0 };
        let common = CommonArgs { quiet: 2, ..CommonArgs::default() };
        Board::new(&[AvatarStage::Record, AvatarStage::Track, AvatarStage::Fit], plan, &common)
    }

    #[test]
    fn a_slow_machine_is_told_by_finished_stages_and_budgets_stay() {
        let board = board();
        let mut state = board.lock();
        let plan = state.plan;
        assert_eq!(state.slowness(), 1.0);
        state.stages[0].took = Some(3.0 * plan.expected_secs(AvatarStage::Record));
        assert!((state.slowness() - 3.0).abs() < 1e-9);
        state.at = Some(0);
        state.stages[0].took = Some(0.0);
        let left = state.left_secs();
        let later = plan.expected_secs(AvatarStage::Track) + plan.expected_secs(AvatarStage::Fit);
        assert!(left > later && left < later + 1.1 * plan.expected_secs(AvatarStage::Record));
    }

    #[test]
    fn the_share_never_falls_and_warnings_are_kept() {
        let board = board();
        board.begin(AvatarStage::Track);
        board.lock().percent = 40;
        assert_eq!(board.lock().update().0, 40);
        board.stage("track", Some(600));
        board.advance(300);
        assert!(board.lock().place().contains("2 of 3, track 300 of 600"), "{}", board.lock().place());
        board.warn(Warning::new("x", "words"));
        let heard = board.end("done", false);
        assert_eq!(heard.warnings.len(), 1);
        assert!(board.lock().stages[1].took.is_some());
    }
}
