//! A child process without a shell: its output goes to a log, which also tells the progress; it ends when the user stops
//! or its time is up.
//!
//! The output goes straight into the file, not through a pipe: a grandchild that outlives a killed child could keep a
//! pipe open for ever.

use std::ffi::OsString;
use std::fs::{File, OpenOptions};
use std::io::{Read, Seek, SeekFrom, Write};
use std::path::Path;
use std::process::{Child, Command, ExitStatus, Stdio};
use std::time::{Duration, Instant};

use risorius_formats::{FormatError, Reporter};

use crate::error::{Result, TrackerError};

/// How often the child, its log and the user are looked at.
const POLL: Duration = Duration::from_millis(40);

/// Runs the steps of one program.
pub(crate) struct Runner<'a> {
    /// The program: a path, or a name to be found by the system.
    pub(crate) program: &'a Path,
    /// Words before each step: what to run, where the program is an interpreter.
    pub(crate) before: &'a [OsString],
    /// Where the output goes; it is appended.
    pub(crate) log: &'a Path,
    /// The log's place once everything is done, for messages.
    pub(crate) final_log: &'a Path,
    /// When the work began.
    pub(crate) started: Instant,
    /// How long all steps together may take.
    pub(crate) limit: Option<Duration>,
    /// Hears the progress.
    pub(crate) reporter: &'a dyn Reporter,
}

/// Reads the state of the work from a line of output: steps done so far.
pub(crate) type Progress = fn(&str) -> Option<u64>;

impl Runner<'_> {
    /// Runs `program step args…` to its end and returns what it wrote.
    pub(crate) fn run(&self, step: &str, args: &[OsString], progress: Option<Progress>) -> Result<String> {
        let io = |e: std::io::Error| FormatError::io(self.log, "write", &e);
        let mut log = OpenOptions::new().create(true).append(true).open(self.log).map_err(io)?;
        let words: Vec<_> = args.iter().map(|a| a.to_string_lossy()).collect();
        writeln!(log, "\n$ {} {step} {}", self.program.display(), words.join(" ")).map_err(io)?;
        let start = log.metadata().map_err(io)?.len();
        let mut command = Command::new(self.program);
        end_with_us(&mut command);
        let child = command
            .args(self.before)
            .arg(step)
            .args(args)
            // Builds with a window system must not look for a screen.
            .env("QT_QPA_PLATFORM", "offscreen")
            .stdin(Stdio::null())
            .stdout(log.try_clone().map_err(io)?)
            .stderr(log)
            .spawn()
            .map_err(|e| self.missing(&e))?;
        let mut child = Guard(child);
        let mut tail = Tail::open(self.log, start).map_err(io)?;
        let mut done = 0;
        loop {
            let status = child.0.try_wait().map_err(io)?;
            for line in tail.lines(status.is_some()).map_err(io)? {
                if let Some(now) = progress.and_then(|p| p(&line)).filter(|now| *now > done) {
                    self.reporter.advance(now - done);
                    done = now;
                }
            }
            if self.reporter.cancelled() {
                return Err(TrackerError::Cancelled { doing: format!("running `colmap {step}`") });
            }
            if let Some(status) = status {
                return self.outcome(step, status, &tail);
            }
            if self.limit.is_some_and(|limit| self.started.elapsed() > limit) {
                let secs = self.limit.unwrap_or_default().as_secs();
                return Err(TrackerError::ColmapTimeout {
                    step: step.to_owned(),
                    secs,
                    log: self.final_log.to_owned(),
                });
            }
            std::thread::sleep(POLL);
        }
    }

    fn missing(&self, error: &std::io::Error) -> TrackerError {
        let reason = match error.kind() {
            std::io::ErrorKind::NotFound => "not found".to_owned(),
            std::io::ErrorKind::PermissionDenied => "not an executable file".to_owned(),
            _ => error.to_string(),
        };
        TrackerError::ColmapMissing { program: self.program.to_owned(), reason }
    }

    fn outcome(&self, step: &str, status: ExitStatus, tail: &Tail) -> Result<String> {
        if status.success() {
            return Ok(tail.text.clone());
        }
        let last_line = tail.text.lines().rev().map(str::trim).find(|l| !l.is_empty()).unwrap_or("it wrote nothing");
        Err(TrackerError::ColmapFailed {
            step: step.to_owned(),
            status: status.to_string(),
            last_line: last_line.to_owned(),
            log: self.final_log.to_owned(),
        })
    }
}

/// Has the system end the child with this process, should it be killed: a COLMAP that goes on alone would write into the
/// database of the run that follows.
#[cfg(target_os = "linux")]
fn end_with_us(command: &mut Command) {
    use std::os::unix::process::CommandExt as _;
    let die = || {
        // SAFETY: between fork and exec only calls that are safe in signal handlers are allowed; this is one system call
        // with two numbers, which touches no memory.
        #[expect(unsafe_code, reason = "the standard library has no safe form of it")]
        let failed = unsafe { libc::prctl(libc::PR_SET_PDEATHSIG, libc::SIGKILL) } != 0;
        if failed { Err(std::io::Error::last_os_error()) } else { Ok(()) }
    };
    // SAFETY: `die` allocates nothing, takes no lock and returns.
    #[expect(unsafe_code, reason = "the standard library has no safe form of it")]
    unsafe {
        command.pre_exec(die);
    }
}

#[cfg(not(target_os = "linux"))]
fn end_with_us(_: &mut Command) {}

/// Kills the child when it goes out of scope before its end.
struct Guard(Child);

impl Drop for Guard {
    fn drop(&mut self) {
        // An error means that it has ended already.
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// The end of a growing file, line by line.
struct Tail {
    file: File,
    text: String,
    seen: usize,
}

impl Tail {
    fn open(path: &Path, start: u64) -> std::io::Result<Self> {
        let mut file = File::open(path)?;
        file.seek(SeekFrom::Start(start))?;
        Ok(Self { file, text: String::new(), seen: 0 })
    }

    /// The lines that were completed since the last call; at the end also an unfinished one.
    fn lines(&mut self, ended: bool) -> std::io::Result<Vec<String>> {
        let mut bytes = Vec::new();
        self.file.read_to_end(&mut bytes)?;
        self.text.push_str(&String::from_utf8_lossy(&bytes));
        let fresh = &self.text[self.seen..];
        let end = if ended { fresh.len() } else { fresh.rfind('\n').map_or(0, |i| i + 1) };
        let lines = fresh[..end].lines().map(str::to_owned).collect();
        self.seen += end;
        Ok(lines)
    }
}

/// The number behind `before` in `line`, as in `Processed file [12/80]`.
pub(crate) fn number_after(line: &str, before: &str) -> Option<u64> {
    let rest = &line[line.find(before)? + before.len()..];
    let end = rest.find(|c: char| !c.is_ascii_digit()).unwrap_or(rest.len());
    rest[..end].parse().ok()
}
