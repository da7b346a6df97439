//! From `main` to the exit code: parsing, Ctrl-C, panics.

use std::io::Write;
use std::panic::{self, AssertUnwindSafe, PanicHookInfo};
use std::process::ExitCode;
use std::sync::atomic::Ordering;

use crate::printer::{self, CANCELLED};
use crate::{Common, Console, Failure};

/// Parses the command line, runs `body` and turns its outcome into an exit code.
///
/// Wrong usage exits with 2. The first Ctrl-C makes `Reporter::cancelled` true, the second ends the process. A panic is
/// reported as the bug it is, in one line, and exits with 2.
pub fn run<C: clap::Parser + Common>(body: impl FnOnce(&C, &Console) -> Result<(), Failure>) -> ExitCode {
    run_as(C::command(), body)
}

/// As [`run`], with the command line of `C` in other words, such as other examples.
pub fn run_as<C: clap::Parser + Common>(
    command: clap::Command,
    body: impl FnOnce(&C, &Console) -> Result<(), Failure>,
) -> ExitCode {
    let program = command.get_name().to_owned();
    install_panic_hook(program.clone());
    let mut known = command.clone();
    let parsed = command.try_get_matches().and_then(|m| C::from_arg_matches(&m).map_err(|e| e.format(&mut known)));
    let args = match parsed {
        Ok(args) => args,
        Err(e) => return report_usage(&e),
    };
    // Without a handler Ctrl-C just ends the process, which is no reason not to work.
    let _ = ctrlc::set_handler(on_interrupt);
    let console = Console::new(args.common());
    let outcome = panic::catch_unwind(AssertUnwindSafe(|| body(&args, &console)));
    let Ok(result) = outcome else {
        // The hook has told the user; scripts hear it here.
        if console.is_json() {
            print_json(&Failure::bug(format!("this is a bug in {program}")));
        }
        return ExitCode::from(2);
    };
    if let Err(failure) = &result {
        console.fail(failure);
    }
    let late = console.close();
    if let Some(failure) = &late {
        printer::print_failure(failure, false);
    }
    match result.err().or(late) {
        Some(failure) => ExitCode::from(failure.status()),
        None => ExitCode::SUCCESS,
    }
}

/// Help and version go to stdout with 0, wrong usage to stderr with 2.
fn report_usage(error: &clap::Error) -> ExitCode {
    // A closed pipe behind `--help` is no error.
    let _ = error.print();
    if error.use_stderr() && std::env::args_os().any(|a| a == "--json") {
        let text = error.to_string();
        let first = text.lines().next().unwrap_or_default();
        print_json(&Failure::usage(first.strip_prefix("error: ").unwrap_or(first)));
    }
    ExitCode::from(u8::try_from(error.exit_code()).unwrap_or(2))
}

fn print_json(failure: &Failure) {
    let _ = writeln!(std::io::stdout().lock(), "{:#}", failure.to_json());
}

fn on_interrupt() {
    if CANCELLED.swap(true, Ordering::Relaxed) {
        #[expect(clippy::exit, reason = "the second Ctrl-C means now")]
        std::process::exit(130);
    }
    let _ = writeln!(std::io::stderr().lock(), "\nstopping; press Ctrl-C again to end at once");
}

fn install_panic_hook(program: String) {
    panic::set_hook(Box::new(move |info| {
        let _ = writeln!(std::io::stderr().lock(), "{}", panic_line(&program, info));
        if std::env::var_os("RUST_BACKTRACE").is_some_and(|v| v != "0") {
            let _ = writeln!(std::io::stderr().lock(), "{}", std::backtrace::Backtrace::force_capture());
        }
    }));
}

fn panic_line(program: &str, info: &PanicHookInfo<'_>) -> String {
    let what = info.payload_as_str().unwrap_or("panic").lines().next().unwrap_or_default();
    let place = info.location().map(|l| format!(" ({}:{})", l.file(), l.line())).unwrap_or_default();
    format!("error: this is a bug in {program} {}: {what}{place}; please report it", env!("CARGO_PKG_VERSION"))
}
