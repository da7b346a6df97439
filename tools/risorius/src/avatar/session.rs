//! One run of `risorius avatar`: stages are run, measured, told and written down.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use risorius_console::{Console, Failure, hold};
use risorius_formats::Warning;
use serde_json::Value;

use super::board::Board;
use super::card::{AvatarCard, StageEntry, folder_bytes};
use super::clock::Clock;
use super::explain::{explained, quoted};
use super::options::{AvatarArgs, Layout};
use super::programs::ProgramCommand;
use super::stages::AvatarStage;
use super::{kept, warnings};

/// What came out of a stage, in words.
#[derive(Debug, Default)]
pub(super) struct StageOutcome {
    pub(super) words: String,
    /// Beside what the stage warned of.
    pub(super) to_know: Vec<String>,
}

impl StageOutcome {
    pub(super) fn new(words: impl Into<String>) -> Self {
        Self { words: words.into(), to_know: Vec::new() }
    }
}

/// The state of a run.
#[derive(Debug)]
pub(super) struct Session<'a> {
    pub(super) args: &'a AvatarArgs,
    pub(super) layout: &'a Layout,
    pub(super) board: Arc<Board>,
    console: Console,
    pub(super) card: AvatarCard,
}

impl<'a> Session<'a> {
    pub(super) fn new(args: &'a AvatarArgs, layout: &'a Layout, board: Arc<Board>) -> Self {
        let mut card = AvatarCard::read(&layout.card());
        card.version = 1;
        card.written_by = format!("risorius {}", env!("CARGO_PKG_VERSION"));
        (card.finished, card.stopped) = (false, None);
        (card.video, card.take, card.run) = (args.video.clone(), layout.take.clone(), layout.run());
        let heard: Arc<Board> = Arc::clone(&board);
        Self { args, layout, board, console: Console::heard_by(heard), card }
    }

    /// One process at a time makes an avatar's folder. The lock of one that was killed is taken over without a word.
    pub(super) fn lock(&self) -> Result<impl Sized + use<>, Failure> {
        hold("risorius avatar", &self.layout.card(), &self.console)
    }

    /// Runs the stage `command`, which makes `result`; `describe` says what came out, or why nothing can come of it.
    pub(super) fn stage(
        &mut self,
        stage: AvatarStage,
        result: &Path,
        command: &ProgramCommand,
        describe: impl FnOnce(&Value) -> Result<StageOutcome, Failure>,
    ) -> Result<(), Failure> {
        self.board.begin(stage);
        let clock = Clock::start();
        let done = command.run(&self.console).map_err(|e| explained(e, stage, self.layout));
        let (wall_secs, cpu_secs) = (clock.wall_secs(), clock.cpu_secs());
        if let Err(failure) = done {
            self.board.abandon();
            return Err(failure);
        }
        let document = self.board.take_result();
        let was_there = document["up_to_date"] == true;
        let StageOutcome { words: outcome, to_know } =
            describe(&document).inspect_err(|_| drop(self.board.abandon()))?;
        let heard = self.board.end(if was_there { "up to date" } else { &outcome }, was_there);
        let before = self.card.entry(stage).cloned().filter(|_| was_there);
        let entry = match before {
            Some(before) => StageEntry { was_there: true, outcome: either(outcome, before.outcome), ..before },
            None => StageEntry {
                stage,
                wall_secs: (!was_there).then_some(wall_secs),
                cpu_secs: cpu_secs.filter(|_| !was_there),
                was_there,
                outcome: either(outcome, "made before".to_owned()),
                warnings: all_words(heard.warnings, to_know),
                record_sha256: None,
            },
        };
        self.put(StageEntry { record_sha256: kept::record_hash(result), ..entry })
    }

    /// Goes on with a stage's result that was made by other commands.
    pub(super) fn keep(
        &mut self,
        stage: AvatarStage,
        describe: impl FnOnce() -> Result<StageOutcome, Failure>,
    ) -> Result<(), Failure> {
        self.board.begin(stage);
        let StageOutcome { words, to_know } = describe().inspect_err(|_| drop(self.board.abandon()))?;
        self.board.end(&format!("kept: {words}"), true);
        let entry = StageEntry {
            stage,
            wall_secs: None,
            cpu_secs: None,
            was_there: true,
            outcome: words,
            warnings: to_know,
            // Not noted: it stays somebody else's.
            record_sha256: None,
        };
        self.put(entry)
    }

    /// The hash of the record that this program noted when it made a stage's result.
    pub(super) fn noted(&self, stage: AvatarStage) -> Option<String> {
        self.card.entry(stage).and_then(|e| e.record_sha256.clone())
    }

    fn put(&mut self, entry: StageEntry) -> Result<(), Failure> {
        self.card.put(entry);
        self.card.write(&self.layout.card())
    }

    /// Writes down why the work stopped, in a folder where it began.
    pub(super) fn stop(&mut self, failure: &Failure) {
        if !self.card.stages.is_empty() {
            self.card.stopped = Some(failure.message().to_owned());
            // The failure itself is what the user has to hear.
            let _ = self.card.write(&self.layout.card());
        }
    }

    /// Completes and writes the card.
    pub(super) fn finish(mut self) -> Result<AvatarCard, Failure> {
        let run = self.layout.run();
        let size = |name: &str| std::fs::metadata(run.join(name)).map_or(0, |m| m.len());
        self.card.avatar_bytes = size("model.safetensors") + size("model.json");
        self.card.folder_bytes = folder_bytes(&self.layout.out);
        self.card.finished = true;
        self.card.next = self.next();
        self.card.write(&self.layout.card())?;
        self.card.write_text(&self.layout.out.join("card.txt"))?;
        Ok(self.card.clone())
    }

    fn next(&self) -> Vec<[String; 2]> {
        let (run, out) = (quoted(&self.layout.run()), &self.layout.out);
        let at = |name: &str| quoted(&out.join(name));
        let mut next = vec![
            [format!("risorius trainer view {run}"), "turn and steer it in a browser".to_owned()],
            [
                format!("risorius trainer render {run} --au AU12=4 --out {}", at("smile")),
                "a picture of a smile".to_owned(),
            ],
            [
                format!("risorius trainer export {run} --out {}", at("avatar.html")),
                "one page with every AU, to send".to_owned(),
            ],
        ];
        match self.layout.transfer() {
            Some(video) => {
                next.push([format!("look at {}", quoted(&video)), "the driver's expressions on it".to_owned()]);
            }
            None => next.push([
                format!("risorius avatar {} --out {} --from OTHER.mp4", quoted(&self.args.video), quoted(out)),
                "another video drives it".to_owned(),
            ]),
        }
        next.push([format!("look at {}", at("run/eval/report.html")), "held-out frames beside the truth".to_owned()]);
        next.push([format!("look at {}", at("dataset/report/index.html")), "what it was fitted to".to_owned()]);
        next
    }
}

fn either(now: String, before: String) -> String {
    if now.is_empty() { before } else { now }
}

fn all_words(heard: Vec<Warning>, to_know: Vec<String>) -> Vec<String> {
    to_know.into_iter().chain(warnings::in_words(heard)).collect()
}

/// The part of a path below the folder of everything, for short texts.
pub(super) fn shown(path: &Path, out: &Path) -> PathBuf {
    path.strip_prefix(out).unwrap_or(path).to_owned()
}
