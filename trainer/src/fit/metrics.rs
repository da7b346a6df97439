//! `RUN/metrics.jsonl`: one line per logged step, unweighted terms; the same numbers as TensorBoard events.

use std::fs::{File, OpenOptions};
use std::io::{BufRead, BufReader, BufWriter, Write};
use std::path::{Path, PathBuf};

use risorius_formats::{FormatError, atomic};
use serde::{Deserialize, Serialize};

use super::tensorboard::EventFile;
use crate::error::Result;

/// Steps between lines.
const LOG_EVERY: u64 = 10;

/// One line; `N` are the field's own numbers.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Line<N> {
    /// The step, from 1.
    pub step: u64,
    /// Wall seconds since the fit began, resumed parts included.
    pub seconds: f64,
    /// PSNR of the step's pixels, dB.
    pub psnr_db: f64,
    /// The rest.
    #[serde(flatten)]
    pub numbers: N,
}

impl<N> Line<N> {
    /// The line of a step whose mean squared colour error is `mse`.
    pub fn new(step: u64, seconds: f64, mse: f64, numbers: N) -> Self {
        Self { step, seconds: (seconds * 1e3).round() / 1e3, psnr_db: crate::eval::psnr_from_mse(mse), numbers }
    }
}

/// What every line has.
#[derive(Deserialize)]
struct Stepped {
    step: u64,
}

/// The open log.
#[derive(Debug)]
pub struct MetricsLog {
    path: PathBuf,
    writer: BufWriter<File>,
    events: EventFile,
}

impl MetricsLog {
    /// Opens the log to go on after `step`; lines beyond it (of a run that died after its checkpoint) are dropped.
    pub fn open(run: &Path, step: u64) -> Result<Self> {
        let path = run.join("metrics.jsonl");
        let mut kept = Vec::new();
        if let (Ok(file), true) = (File::open(&path), step > 0) {
            for line in BufReader::new(file).lines().map_while(std::result::Result::ok) {
                let keep = serde_json::from_str::<Stepped>(&line).is_ok_and(|m| m.step <= step);
                if keep {
                    kept.extend(line.as_bytes());
                    kept.push(b'\n');
                }
            }
        }
        atomic::write_file(&path, &kept)?;
        let file = OpenOptions::new().append(true).open(&path).map_err(|e| FormatError::io(&path, "open", &e))?;
        Ok(Self { path, writer: BufWriter::new(file), events: EventFile::create(run)? })
    }

    /// Whether this step has a line.
    pub fn is_due(step: u64) -> bool {
        step.is_multiple_of(LOG_EVERY) || step == 1
    }

    /// Writes one line, which must have a `step`.
    pub fn write(&mut self, line: &impl Serialize) -> Result<()> {
        let fail = |e: &std::io::Error| FormatError::io(&self.path, "write", e);
        let encode = |e: serde_json::Error| FormatError::syntax(format!("cannot encode: {e}")).in_file(&self.path);
        let text = serde_json::to_string(line).map_err(encode)?;
        let value = serde_json::to_value(line).map_err(encode)?;
        writeln!(self.writer, "{text}").map_err(|e| fail(&e))?;
        self.writer.flush().map_err(|e| fail(&e))?;
        let step = value.get("step").and_then(serde_json::Value::as_u64).unwrap_or(0);
        let mut scalars = Vec::new();
        flatten("", &value, &mut scalars);
        self.events.scalars(step, &scalars)
    }

    /// Syncs the log.
    pub fn finish(self) -> Result<()> {
        let Self { path, writer, events: _ } = self;
        let file = writer.into_inner().map_err(|e| FormatError::io(&path, "write", &e.into_error()))?;
        file.sync_all().map_err(|e| FormatError::io(&path, "write", &e))?;
        Ok(())
    }
}

/// The numbers of a line, the step left out; nested ones as `outer/inner`.
fn flatten(prefix: &str, value: &serde_json::Value, out: &mut Vec<(String, f64)>) {
    match value {
        serde_json::Value::Object(map) => {
            for (name, value) in map.iter().filter(|(name, _)| !(prefix.is_empty() && *name == "step")) {
                let path = if prefix.is_empty() { name.clone() } else { format!("{prefix}/{name}") };
                flatten(&path, value, out);
            }
        }
        serde_json::Value::Array(items) => {
            for (i, item) in items.iter().enumerate() {
                flatten(&format!("{prefix}/{i}"), item, out);
            }
        }
        _ => out.extend(value.as_f64().map(|v| (prefix.to_owned(), v))),
    }
}

/// The mean of the last steps' errors.
#[derive(Clone, Debug, Default)]
pub struct Recent {
    values: std::collections::VecDeque<f64>,
}

impl Recent {
    /// Adds a mean squared error.
    pub fn add(&mut self, mse: f64) {
        self.values.push_back(mse);
        if self.values.len() > 100 {
            self.values.pop_front();
        }
    }

    /// PSNR of the mean, dB.
    pub fn psnr_db(&self) -> f64 {
        crate::eval::psnr_from_mse(self.values.iter().sum::<f64>() / self.values.len().max(1) as f64)
    }
}
