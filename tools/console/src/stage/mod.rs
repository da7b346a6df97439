//! Stages that may be run again, twice at once, and after a kill.
//!
//! A stage makes one result, a folder or a file, of inputs and settings. Around its work stand a lock beside the result
//! (one process at a time, [`lock`]) and a record in it of what it was made of ([`record`]). With `--if-changed` a result
//! that was made of the same inputs with the same settings, and is still there unchanged, is left as it is.
//!
//! ```text
//! TAKE/.track.lock        who makes TAKE/track now
//! TAKE/track/stage.json   what it was made of
//! ```

mod lock;
mod record;

use std::path::{Path, PathBuf};

use risorius_formats::FormatError;
use serde::Serialize;
use serde_json::{Value, json};

use self::lock::Lock;
pub use self::record::Inputs;
use self::record::Record;
use crate::{Console, Failure};

/// The option of stages that may be run again.
#[derive(clap::Args, Clone, Copy, Debug, Default)]
pub struct AgainArgs {
    /// Do nothing where the result is there already, made of the same inputs with the same settings; where another
    /// process is making it, wait for that
    #[arg(long)]
    pub if_changed: bool,
}

/// The work of a stage, about to begin.
#[derive(Debug)]
pub struct Stage<'a> {
    name: &'static str,
    result: &'a Path,
    settings: Value,
}

/// The work of a stage, under way: the result is this process's own until this is dropped.
#[derive(Debug)]
pub struct Running {
    result: PathBuf,
    record: Record,
    unfinished: bool,
    /// Whether it is wanted that the same work is known again.
    again: bool,
    _lock: Option<Lock>,
}

impl<'a> Stage<'a> {
    /// The stage `name`, such as `tracker run`, that makes `result` with `settings`.
    ///
    /// Settings that do not change what is made, such as a number of threads, do not belong there.
    pub fn new(name: &'static str, result: &'a Path, settings: &impl Serialize) -> Result<Self, Failure> {
        let settings = serde_json::to_value(settings)
            .map_err(|e| Failure::bug(format!("the settings of `{name}` cannot be written: {e}")))?;
        Ok(Self { name, result, settings })
    }

    /// Takes the lock and looks whether there is anything to do. `None`: nothing; that was said.
    pub fn begin(self, again: AgainArgs, inputs: Inputs, console: &Console) -> Result<Option<Running>, Failure> {
        let lock = Lock::take(self.result, self.name, again.if_changed, console)?;
        let record = Record::begun(self.name, self.settings, inputs);
        let before = Record::read(self.result).filter(|before| before.is_about(&record));
        if again.if_changed && before.as_ref().is_some_and(|before| before.holds(self.result)) {
            let result = self.result.display().to_string();
            console.finish(
                &json!({ "up_to_date": true, "stage": self.name, "result": result }),
                &format!("{result}: up to date"),
            );
            return Ok(None);
        }
        Ok(Some(Running {
            result: self.result.to_owned(),
            record,
            again: again.if_changed,
            unfinished: before.is_some_and(|before| !before.is_finished()),
            _lock: lock,
        }))
    }
}

impl Running {
    /// Whether the same work was begun here and not finished: it may go on where it stopped.
    pub fn is_unfinished(&self) -> bool {
        self.unfinished
    }

    /// Writes down what is being made, for stages whose result grows in its place.
    pub fn mark(&self) -> Result<(), FormatError> {
        self.record.write(&self.result)
    }

    /// The work is done. `outputs` are the files in the result that its integrity is judged by; an empty name is the
    /// result itself.
    pub fn finish(mut self, outputs: &[&str]) -> Result<(), FormatError> {
        // In a folder the record is one file of many; beside a single file it is clutter that nobody asked for.
        if record::is_file(&self.result) && !self.again {
            return Ok(());
        }
        let result = std::mem::take(&mut self.result);
        self.finish_in(&result, outputs)
    }

    /// As [`Self::finish`], of a folder that is whole but not in its place yet: it comes there with its record.
    pub fn finish_in(&mut self, folder: &Path, outputs: &[&str]) -> Result<(), FormatError> {
        self.record.finish(folder, outputs);
        self.record.write(folder)
    }
}

/// Takes the lock of a result that is made without a record; it is let go when the value is dropped.
pub fn hold(name: &'static str, result: &Path, console: &Console) -> Result<impl Sized + use<>, Failure> {
    Lock::take(result, name, false, console)
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;
    use crate::CommonArgs;

    const AGAIN: AgainArgs = AgainArgs { if_changed: true };

    #[test]
    fn a_result_is_current_until_input_setting_or_output_changes() {
        let dir = tempfile::tempdir().unwrap();
        let (input, result) = (dir.path().join("in.csv"), dir.path().join("out"));
        let console = Console::new(&CommonArgs { quiet: 2, ..CommonArgs::default() });
        let begin = |level: u32, again| {
            Stage::new("test", &result, &json!({ "level": level }))
                .unwrap()
                .begin(again, Inputs::default().file("in", &input), &console)
                .unwrap()
        };
        let make = |level| {
            let running = begin(level, AGAIN).expect("something to do");
            fs::create_dir_all(&result).unwrap();
            fs::write(result.join("a"), format!("made with {level}")).unwrap();
            running.finish(&["a"]).unwrap();
        };
        fs::write(&input, "one").unwrap();
        make(1);
        assert!(begin(1, AGAIN).is_none());
        assert!(begin(1, AgainArgs::default()).is_some(), "without the option it is made again");
        assert!(begin(2, AGAIN).is_some(), "another setting");
        fs::write(&input, "two").unwrap();
        make(1);
        assert!(begin(1, AGAIN).is_none());
        fs::write(result.join("a"), "damaged").unwrap();
        assert!(begin(1, AGAIN).is_some(), "a damaged result");
        make(1);
        fs::remove_file(&input).unwrap();
        assert!(begin(1, AGAIN).is_some(), "an input that is gone: the stage has to say so");
        let text = fs::read_to_string(result.join("stage.json")).unwrap();
        assert!(!text.contains(dir.path().to_str().unwrap()), "a path in {text}");
    }

    #[test]
    fn work_that_was_begun_is_known_again() {
        let dir = tempfile::tempdir().unwrap();
        let result = dir.path().join("run");
        let console = Console::new(&CommonArgs { quiet: 2, ..CommonArgs::default() });
        let begin = |level: u32| {
            let stage = Stage::new("test", &result, &level).unwrap();
            stage.begin(AGAIN, Inputs::default(), &console).unwrap().unwrap()
        };
        let running = begin(1);
        assert!(!running.is_unfinished());
        running.mark().unwrap();
        drop(running);
        assert!(begin(1).is_unfinished());
        assert!(!begin(2).is_unfinished());
    }

    #[test]
    fn folders_are_known_by_names_and_contents() {
        let dir = tempfile::tempdir().unwrap();
        let all = || Inputs::default().folder("model", dir.path(), |name| !name.starts_with("report/"));
        fs::create_dir_all(dir.path().join("report")).unwrap();
        fs::create_dir_all(dir.path().join("sparse/0")).unwrap();
        fs::write(dir.path().join("sparse/0/images.txt"), "1").unwrap();
        let before = all();
        fs::write(dir.path().join("report/x"), "1").unwrap();
        fs::write(dir.path().join(".hidden"), "1").unwrap();
        assert_eq!(all(), before);
        fs::rename(dir.path().join("sparse/0"), dir.path().join("sparse/1")).unwrap();
        assert_ne!(all(), before);
    }
}
