//! Texts of the four programs in the words of this one: `tracker poses` is typed `risorius tracker poses` here.

use clap::Command;
use clap::builder::StyledStr;
use risorius_console::Failure;

/// The programs that are commands of this one.
const PROGRAMS: [&str; 4] = ["capture", "tracker", "dataset", "trainer"];

/// `text` with the commands in backticks as they are typed here.
pub(crate) fn ours(text: &str) -> String {
    let mut parts = text.split('`').map(str::to_owned).collect::<Vec<_>>();
    for part in parts.iter_mut().skip(1).step_by(2) {
        if let Some(rest) = part.strip_prefix("tools/models") {
            *part = format!("risorius models{rest}");
        } else if PROGRAMS.iter().any(|p| part.strip_prefix(p).is_some_and(|rest| rest.starts_with(' '))) {
            *part = format!("risorius {part}");
        }
    }
    parts.join("`")
}

/// The failure with its hint in our words.
pub(crate) fn of_failure(failure: Failure) -> Failure {
    match failure.hint().map(ours) {
        Some(hint) => failure.with_hint(hint),
        None => failure,
    }
}

/// The command line with examples of the four programs as they are typed here.
pub(crate) fn with_our_examples(command: Command) -> Command {
    PROGRAMS.iter().fold(command, |command, name| command.mut_subcommand(name, rewritten))
}

fn rewritten(command: Command) -> Command {
    let after = command.get_after_help().map(lines_of);
    let long = command.get_long_about().map(|text| ours(&text.to_string()));
    let names: Vec<String> = command.get_subcommands().map(|c| c.get_name().to_owned()).collect();
    let command = names.iter().fold(command, |command, name| command.mut_subcommand(name, rewritten));
    let command = match after {
        Some(text) => command.after_help(text),
        None => command,
    };
    match long {
        Some(text) => command.long_about(text),
        None => command,
    }
}

/// Examples stand in lines of their own, commands within text in backticks.
fn lines_of(text: &StyledStr) -> String {
    let of = |line: &str| {
        let bare = line.trim_start();
        let typed = PROGRAMS.iter().any(|p| bare.strip_prefix(p).is_some_and(|rest| rest.starts_with(' ')));
        let indent = &line[..line.len() - bare.len()];
        if typed && !indent.is_empty() {
            let joined = PROGRAMS.iter().fold(bare.to_owned(), |text, p| {
                ["&& ", "| "]
                    .iter()
                    .fold(text, |text, sign| text.replace(&format!("{sign}{p} "), &format!("{sign}risorius {p} ")))
            });
            return format!("{indent}risorius {joined}");
        }
        ours(line)
    };
    text.to_string().lines().map(of).collect::<Vec<_>>().join("\n")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn commands_are_named_as_they_are_typed() {
        let text =
            "`tools/models --metrics` fetches them, then `tracker run TAKE`; `--models DIR` and the trackers stay";
        let said = "`risorius models --metrics` fetches them, then `risorius tracker run TAKE`; `--models DIR` and the trackers stay";
        assert_eq!(ours(text), said);
        let failure = of_failure(Failure::input("no track").with_hint("`capture check TAKE`"));
        assert_eq!(failure.hint(), Some("`risorius capture check TAKE`"));
    }

    #[test]
    fn examples_are_as_they_are_typed() {
        let text = "Example:\n  capture record --out a && capture check a\n  tracker live | trainer view a";
        let said = "Example:\n  risorius capture record --out a && risorius capture check a\n  risorius tracker live | risorius trainer view a";
        assert_eq!(lines_of(&text.into()), said);
    }
}
