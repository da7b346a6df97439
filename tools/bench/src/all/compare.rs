//! What costs more than in a baseline, in instructions where both counted them, else in CPU time; never on the wall.

use std::path::Path;

use risorius_console::Failure;
use risorius_formats::pose_report::json_error;
use risorius_formats::{FormatError, atomic};

use crate::{Report, Row, VERSION};

/// Instructions of one thread hardly vary: two runs on a busy machine differed by 0.002 % at most.
const INSTRUCTION_SLACK: f64 = 1.02;
/// The CPU time of shorter commands is mostly the program's start, and varied by half.
const LEAST_CPU_SECS: f64 = 0.3;
/// Memory may grow by this factor and this much, MiB, before it is named.
const MEMORY_SLACK: (f64, f64) = (1.25, 32.0);

/// The outcome of a comparison.
#[derive(Debug, Default)]
pub(crate) struct Verdict {
    /// What costs more.
    pub(crate) dearer: Vec<String>,
    /// What costs less.
    cheaper: Vec<String>,
    /// What cannot be compared.
    alone: Vec<String>,
    compared: usize,
}

impl Verdict {
    /// For people.
    pub(crate) fn words(&self) -> String {
        let mut lines = vec![format!("compared with the baseline: {} commands", self.compared)];
        lines.extend(self.dearer.iter().map(|s| format!("DEARER   {s}")));
        lines.extend(self.cheaper.iter().map(|s| format!("cheaper  {s}")));
        lines.extend(self.alone.iter().map(|s| format!("alone    {s}")));
        if self.dearer.is_empty() {
            lines.push("nothing has become dearer".to_owned());
        }
        lines.join("\n")
    }
}

/// Compares each command with that of the same name.
pub(crate) fn compare(now: &Report, before: &Report, slack: f64) -> Verdict {
    let mut verdict = Verdict::default();
    for row in &now.rows {
        match before.rows.iter().find(|b| b.name == row.name) {
            Some(old) => {
                verdict.compared += 1;
                one(row, old, slack, &mut verdict);
            }
            None => verdict.alone.push(format!("{}: not in the baseline", row.name)),
        }
    }
    for old in before.rows.iter().filter(|old| !now.rows.iter().any(|row| row.name == old.name)) {
        verdict.alone.push(format!("{}: only in the baseline", old.name));
    }
    verdict
}

fn one(row: &Row, old: &Row, slack: f64, verdict: &mut Verdict) {
    let (what, ratio, slack) = match (row.instructions, old.instructions) {
        (Some(new), Some(old)) => ("instructions", new as f64 / old.max(1) as f64, INSTRUCTION_SLACK),
        _ if row.cpu_secs.max(old.cpu_secs) < LEAST_CPU_SECS => ("CPU time", 1.0, slack),
        _ => ("CPU time", row.cost / old.cost.max(1e-9), slack),
    };
    if ratio > slack {
        verdict.dearer.push(format!("{}: {ratio:.2} times the {what} ({})", row.name, row.command));
    } else if ratio < 1.0 / slack {
        verdict.cheaper.push(format!("{}: {ratio:.2} times the {what}", row.name));
    }
    let (factor, more) = MEMORY_SLACK;
    if row.peak_mib > old.peak_mib * factor + more {
        verdict.dearer.push(format!("{}: {:.0} MiB of memory, {:.0} before", row.name, row.peak_mib, old.peak_mib));
    }
}

/// Refuses a baseline that was not measured in the same way as a run that is `quick` or not.
pub(crate) fn check_comparable(quick: bool, before: &Report) -> Result<(), Failure> {
    if before.version != VERSION {
        return Err(Failure::input(format!("the baseline is of version {}, not {VERSION}", before.version))
            .with_hint("write a new one with `--write-baseline`"));
    }
    if before.quick != quick {
        let form = |quick: bool| if quick { "the quick form" } else { "the whole one" };
        return Err(Failure::input(format!(
            "the baseline was made by {}, this is {}",
            form(before.quick),
            form(quick)
        ))
        .with_hint("give or leave out `--quick`, as for the baseline"));
    }
    Ok(())
}

/// Reads a baseline, or the report of a run.
pub(crate) fn read(path: &Path) -> Result<Report, Failure> {
    let bytes = std::fs::read(path).map_err(|e| FormatError::io(path, "read", &e))?;
    Ok(serde_json::from_slice(&bytes).map_err(|e| json_error(&e).in_file(path))?)
}

/// Writes a baseline.
pub(crate) fn write(report: &Report, path: &Path) -> Result<(), Failure> {
    let text = serde_json::to_string_pretty(report).map_err(|e| json_error(&e).in_file(path))?;
    Ok(atomic::write_file(path, (text + "\n").as_bytes())?)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn row(name: &str, cost: f64, instructions: Option<u64>) -> Row {
        Row { name: name.to_owned(), cpu_secs: 2.0, cost, peak_mib: 100.0, instructions, ..Row::default() }
    }

    fn report(rows: Vec<Row>) -> Report {
        Report { version: VERSION, processor: String::new(), threads: 2, unit_cpu_secs: 1.0, quick: true, rows }
    }

    #[test]
    fn only_what_was_measured_in_the_same_way_is_compared() {
        let quick = report(vec![]);
        assert!(check_comparable(true, &quick).is_ok() && check_comparable(false, &quick).is_err());
        assert!(check_comparable(true, &Report { version: VERSION + 1, ..quick }).is_err());
    }

    #[test]
    fn what_is_dearer_is_named_by_what_was_counted() {
        let before = report(vec![row("a", 4.0, None), row("b", 4.0, Some(1000)), row("c", 4.0, None)]);
        let same = compare(&before, &before, 1.5);
        assert!(same.dearer.is_empty() && same.compared == 3);
        // The clock says twice as much of `b`, but instructions say the same; `a` is within the slack.
        let mut more = row("d", 4.0, None);
        more.peak_mib = 300.0;
        let now = report(vec![row("a", 5.5, None), row("b", 8.0, Some(1010)), row("c", 6.5, None), more.clone()]);
        let verdict = compare(&now, &before, 1.5);
        assert_eq!(verdict.dearer.len(), 1, "{verdict:?}");
        assert!(verdict.dearer[0].starts_with("c: 1.62 times the CPU time"));
        assert_eq!(verdict.alone, ["d: not in the baseline"]);
        let now = report(vec![row("b", 4.0, Some(1100)), Row { name: "a".to_owned(), ..more }]);
        let verdict = compare(&now, &before, 1.5);
        assert_eq!(verdict.dearer.len(), 2, "{verdict:?}");
        assert!(verdict.dearer[0].starts_with("b: 1.10 times the instructions"));
        assert!(verdict.dearer[1].contains("300 MiB"));
        // A clock on the wall that went ten times as slowly says nothing.
        let slow: Vec<Row> = before.rows.iter().map(|r| Row { wall_secs: 20.0, ..r.clone() }).collect();
        assert!(compare(&report(slow), &before, 1.5).dearer.is_empty());
    }
}
