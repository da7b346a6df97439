//! The report: a table for programs, plots, and a page.

use std::fmt::Write as _;
use std::path::Path;

use risorius_console::Failure;
use risorius_formats::html::escaped;
use risorius_formats::{FormatError, atomic};

use crate::{Report, Row, plot};

/// The report's name for programs, below the working folder.
pub(crate) const JSON: &str = "report.json";

/// Writes `report.csv`, `report.json`, `errors.svg`, `growth.svg`, `memory.svg` and `report.html` into `work`.
pub(crate) fn write(report: &Report, work: &Path) -> Result<(), Failure> {
    let fail = |e: String| Failure::from(FormatError::syntax(e).in_file(work));
    let errors = plot::svg(&plot::errors(report)).map_err(fail)?;
    let growth = plot::svg(&plot::growth(report)).map_err(fail)?;
    let memory = plot::memory(report).map_err(fail)?;
    let json = serde_json::to_string_pretty(report).map_err(|e| fail(e.to_string()))? + "\n";
    let page = page(report, &[("Error against run time", &errors), ("How cost grows", &growth), ("Memory", &memory)]);
    for (name, text) in [
        ("report.csv", &csv(report)),
        (JSON, &json),
        ("errors.svg", &errors),
        ("growth.svg", &growth),
        ("memory.svg", &memory),
        ("report.html", &page),
    ] {
        atomic::write_file(work.join(name), text.as_bytes())?;
    }
    Ok(())
}

fn cells(row: &Row) -> [String; 7] {
    let (what, error) = row.error.clone().map_or((String::new(), String::new()), |(w, e)| (w, format!("{e:.3}")));
    [
        row.name.clone(),
        format!("{:.2}", row.wall_secs),
        format!("{:.2}", row.cpu_secs),
        format!("{:.2}", row.cost),
        format!("{:.0}", row.peak_mib),
        if what.is_empty() { String::new() } else { format!("{error} ({what})") },
        row.instructions.map_or_else(String::new, |n| format!("{:.1}", n as f64 * 1e-6)),
    ]
}

const HEAD: [&str; 7] = ["command", "wall s", "CPU s", "cost", "peak MiB", "error", "million instructions"];

/// A Markdown table.
pub(crate) fn table(report: &Report) -> String {
    let mut lines = vec![
        format!("{}, {} threads; unit of cost {:.2} CPU s", report.processor, report.threads, report.unit_cpu_secs),
        format!("| {} |", HEAD.join(" | ")),
        format!("|{}", "---|".repeat(HEAD.len())),
    ];
    lines.extend(report.rows.iter().map(|row| format!("| {} |", cells(row).join(" | "))));
    lines.join("\n")
}

fn csv(report: &Report) -> String {
    let mut text =
        String::from("name,wall_secs,cpu_secs,cost,peak_mib,error_kind,error,instructions,grows_with,command\n");
    for row in &report.rows {
        let grows: Vec<String> = row.grows_with.iter().map(|(axis, value)| format!("{axis}={value}")).collect();
        let optional = |v: Option<f64>| v.map_or_else(String::new, |v| v.to_string());
        let _ = writeln!(
            text,
            "{},{},{},{},{},\"{}\",{},{},\"{}\",\"{}\"",
            row.name,
            row.wall_secs,
            row.cpu_secs,
            row.cost,
            row.peak_mib,
            row.error.as_ref().map_or("", |e| e.0.as_str()),
            optional(row.error.as_ref().map(|e| e.1)),
            row.instructions.map_or_else(String::new, |n| n.to_string()),
            grows.join(" "),
            row.command.replace('"', "'"),
        );
    }
    text
}

fn page(report: &Report, plots: &[(&str, &String)]) -> String {
    let mut text = String::from(
        "<!doctype html>\n<html lang=\"en\"><meta charset=\"utf-8\"><title>Risorius, measured</title>\n<style>\
         body{font:15px/1.45 system-ui,sans-serif;margin:2em auto;max-width:62em;padding:0 1em;color:#222}\
         table{border-collapse:collapse;font-size:13px}td,th{padding:.2em .6em;border-bottom:1px solid #ddd;text-align:right}\
         td:first-child,th:first-child{text-align:left}svg{max-width:100%;height:auto}code{font-size:12px}</style>\n\
         <h1>Risorius, measured</h1>\n",
    );
    let _ = writeln!(
        text,
        "<p>{}, {} threads{}. Cost is CPU time in units of {:.2} CPU seconds, a fixed piece of work measured in the same \
         run.</p>",
        escaped(&report.processor),
        report.threads,
        if report.quick { ", the quick form" } else { "" },
        report.unit_cpu_secs
    );
    for (title, svg) in plots {
        let _ = writeln!(text, "<h2>{title}</h2>\n{svg}");
    }
    let _ = writeln!(text, "<h2>All commands</h2>\n<table><tr><th>{}</th></tr>", HEAD.join("</th><th>"));
    for row in &report.rows {
        let cells = cells(row).map(|c| escaped(&c)).join("</td><td>");
        let _ = writeln!(text, "<tr title=\"{}\"><td>{cells}</td></tr>", escaped(&row.command));
    }
    text.push_str("</table>\n<p>Point at a row to see its command line.</p>\n</html>\n");
    text
}
