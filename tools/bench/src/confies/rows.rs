//! Rows of a table that takes hours: each is kept in a file of its own as soon as it is measured, so that a run that was
//! stopped goes on with the row that it was at.

use std::collections::BTreeMap;
use std::path::Path;

use risorius_console::{Console, Failure};
use risorius_formats::pose_report::{json_error, write_json};
use risorius_formats::{FormatError, atomic};
use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::text;
use crate::child;

/// One fit and how good it is.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) struct Row {
    pub(super) name: String,
    /// What was asked of `trainer fit` besides dataset and folder.
    pub(super) asked: Vec<String>,
    pub(super) parameters: u64,
    pub(super) steps: u64,
    /// Seconds of the whole command on the wall, loading and saving included.
    pub(super) wall_secs: f64,
    pub(super) cpu_secs: f64,
    pub(super) peak_mib: f64,
    pub(super) train_psnr_db: f64,
    /// What `trainer eval` says over all views: `psnr_db`, `ms_ssim`, `lpips_vgg` …
    pub(super) means: BTreeMap<String, f64>,
    /// PSNR by kind of view and part of the picture.
    pub(super) psnr_db: BTreeMap<String, f64>,
}

/// How a row is measured.
pub(super) struct Job<'a> {
    pub(super) name: String,
    pub(super) dataset: &'a Path,
    /// Options of `trainer fit`.
    pub(super) fit: Vec<String>,
    /// Options of `trainer eval`.
    pub(super) eval: Vec<String>,
    /// Whether a fit that was stopped goes on from its checkpoint: with steps, not with a budget of time.
    pub(super) resumes: bool,
}

impl Job<'_> {
    /// The command of the fit.
    pub(super) fn command(&self, work: &Path) -> Vec<String> {
        let mut args = vec!["fit".to_owned(), text(self.dataset), "--out".to_owned(), text(&work.join(&self.name))];
        args.extend(self.fit.iter().cloned());
        args
    }

    /// The row of an earlier run, or a new one.
    pub(super) fn measure(&self, work: &Path, console: &Console) -> Result<Row, Failure> {
        let file = work.join("rows").join(format!("{}.json", self.name));
        if let Some(row) = self.kept(&file)? {
            console.say(&format!("{}: measured before", self.name));
            return Ok(row);
        }
        let run = work.join(&self.name);
        let goes_on = self.resumes && run.join("checkpoints").is_dir() && run.join("settings.toml").is_file();
        let mut fit = self.command(work);
        if goes_on {
            fit = vec!["fit".to_owned(), text(self.dataset), "--out".to_owned(), text(&run), "--resume".to_owned()];
        } else {
            fit.push("--force".to_owned());
        }
        console.say(&format!("trainer {}", fit.join(" ")));
        let mut eval = vec!["eval".to_owned(), text(&run)];
        eval.extend(self.eval.iter().cloned());
        let called = |args: &[String]| {
            let args: Vec<&str> = args.iter().map(String::as_str).collect();
            child::run("trainer", &args, work)
        };
        let (fitted, judged) = (called(&fit)?, called(&eval)?);
        let number = |v: &Value, key: &str| v.get(key).and_then(Value::as_f64).unwrap_or(f64::NAN);
        let count = |key: &str| fitted.document.get(key).and_then(Value::as_u64).unwrap_or(0);
        let means = judged.document.get("means").and_then(|m| m.get("all")).cloned().unwrap_or_default();
        let row = Row {
            name: self.name.clone(),
            asked: self.fit.clone(),
            parameters: count("parameters"),
            steps: count("steps"),
            // Of a fit that went on, its own clock counts what came before; CPU time and memory are of the last part.
            wall_secs: if goes_on { number(&fitted.document, "seconds") } else { fitted.wall_secs },
            cpu_secs: fitted.cpu_secs,
            peak_mib: fitted.peak_mib,
            train_psnr_db: number(&fitted.document, "train_psnr_db"),
            means: serde_json::from_value(means).unwrap_or_default(),
            psnr_db: crate::splat::fits::psnr_of(&judged.document),
        };
        write_json(&file, &row)?;
        Ok(row)
    }

    fn kept(&self, file: &Path) -> Result<Option<Row>, Failure> {
        if !file.is_file() {
            return Ok(None);
        }
        let bytes = std::fs::read(file).map_err(|e| FormatError::io(file, "read", &e))?;
        let row: Row = serde_json::from_slice(&bytes).map_err(|e| json_error(&e).in_file(file))?;
        if row.asked != self.fit {
            let message = format!("{}: was measured with `{}`", file.display(), row.asked.join(" "));
            return Err(Failure::input(message).with_hint("choose another `--work`, or remove the file"));
        }
        Ok(Some(row))
    }
}

/// Writes `NAME.csv`, `NAME.md` and `NAME.json`.
pub(super) fn write(
    work: &Path,
    name: &str,
    header: &[&str],
    cells: &[Vec<String>],
    document: &impl Serialize,
) -> Result<String, Failure> {
    let line = |cells: &[String]| format!("| {} |\n", cells.join(" | "));
    let head: Vec<String> = header.iter().map(|h| (*h).to_owned()).collect();
    let mut table = line(&head) + "|" + &"---|".repeat(header.len()) + "\n";
    let mut csv = header.join(",") + "\n";
    for row in cells {
        table.push_str(&line(row));
        csv.push_str(&(row.join(",") + "\n"));
    }
    atomic::write_file(work.join(format!("{name}.csv")), csv.as_bytes())?;
    atomic::write_file(work.join(format!("{name}.md")), table.as_bytes())?;
    write_json(work.join(format!("{name}.json")), document)?;
    Ok(table)
}
