//! Fits as a user runs them, judged on views with true pictures.

use std::collections::BTreeMap;
use std::path::Path;

use risorius_console::Failure;
use serde::Serialize;
use serde_json::Value;

use crate::child;

/// One fit and how good it is.
#[derive(Clone, Debug, Serialize)]
pub(super) struct Fit {
    pub(super) name: String,
    pub(super) steps: u64,
    /// Seconds of the whole command on the wall, loading and saving included.
    pub(super) wall_secs: f64,
    pub(super) cpu_secs: f64,
    pub(super) peak_mib: f64,
    pub(super) pixels_per_sec: f64,
    /// Bytes of `model.safetensors`.
    pub(super) avatar_bytes: u64,
    /// Mean PSNR of the pictures, dB: `all`, each kind of view, and their parts as `kind: part`.
    pub(super) psnr_db: BTreeMap<String, f64>,
}

/// Fits for a time or a number of steps and evaluates.
pub(super) fn measure(
    work: &Path,
    views: &Path,
    dataset: &Path,
    name: &str,
    length: [&str; 2],
    no_skip: Option<&str>,
) -> Result<Fit, Failure> {
    let text = |path: &Path| path.to_string_lossy().into_owned();
    let (dataset, out, views) = (text(dataset), text(&work.join(name)), text(views));
    let mut args = vec!["fit", &dataset, "--out", &out, "--field", "splat", "--force", length[0], length[1]];
    args.extend(no_skip.iter().flat_map(|skip| ["--no-skip", skip]));
    let fit = child::run("trainer", &args, work)?;
    let eval = child::run("trainer", &["eval", &out, "--views", &views], work)?;
    let number = |v: &Value, key: &str| v.get(key).and_then(Value::as_f64).unwrap_or(f64::NAN);
    let psnr_db = psnr_of(&eval.document);
    let avatar_bytes = std::fs::metadata(work.join(name).join("model.safetensors")).map_or(0, |m| m.len());
    Ok(Fit {
        name: name.to_owned(),
        steps: fit.document.get("steps").and_then(Value::as_u64).unwrap_or(0),
        wall_secs: fit.wall_secs,
        cpu_secs: fit.cpu_secs,
        peak_mib: fit.peak_mib,
        pixels_per_sec: number(&fit.document, "pixels_per_sec"),
        avatar_bytes,
        psnr_db,
    })
}

/// Mean PSNR of the pictures from the document of `trainer eval`: `all`, each kind of view, and parts as `kind: part`.
pub(crate) fn psnr_of(eval: &Value) -> BTreeMap<String, f64> {
    let mean = eval.get("mean_psnr_db").and_then(Value::as_f64).unwrap_or(f64::NAN);
    let mut psnr_db = BTreeMap::from([("all".to_owned(), mean)]);
    let entries = |v: Option<&Value>| v.and_then(Value::as_object).cloned().into_iter().flatten().collect::<Vec<_>>();
    for (kind, psnr) in entries(eval.get("mean_psnr_db_by_kind")) {
        psnr_db.insert(kind, psnr.as_f64().unwrap_or(f64::NAN));
    }
    for (kind, parts) in entries(eval.get("mean_parts_psnr_db")) {
        for (part, psnr) in entries(Some(&parts)) {
            psnr_db.insert(format!("{kind}: {part}"), psnr.as_f64().unwrap_or(f64::NAN));
        }
    }
    psnr_db
}

/// The columns that the table shows of [`Fit::psnr_db`].
const SHOWN: [&str; 5] = ["all", "all: head", "all: background", "all: AU regions", "unseen_expression: AU regions"];

/// A Markdown table.
pub(super) fn table(fits: &[Fit]) -> String {
    let mut lines = vec![
        format!("| fit | steps | wall s | CPU s | peak MiB | M pixels/s | avatar MB | {} |", SHOWN.join(" | ")),
        format!("|{}", "---|".repeat(7 + SHOWN.len())),
    ];
    for f in fits {
        let psnr = SHOWN.map(|k| f.psnr_db.get(k).map_or("–".to_owned(), |v| format!("{v:.2}"))).join(" | ");
        lines.push(format!(
            "| {} | {} | {:.1} | {:.1} | {:.0} | {:.2} | {:.1} | {psnr} |",
            f.name,
            f.steps,
            f.wall_secs,
            f.cpu_secs,
            f.peak_mib,
            f.pixels_per_sec * 1e-6,
            f.avatar_bytes as f64 * 1e-6
        ));
    }
    lines.join("\n")
}

/// All rows and all kinds of PSNR.
pub(super) fn csv(fits: &[&Fit]) -> String {
    let keys: std::collections::BTreeSet<&String> = fits.iter().flat_map(|f| f.psnr_db.keys()).collect();
    let mut head = vec!["name,steps,wall_secs,cpu_secs,peak_mib,pixels_per_sec,avatar_bytes".to_owned()];
    head.extend(keys.iter().map(|key| format!("psnr_db {key}")));
    let row = |f: &&Fit| {
        let mut cells = vec![format!(
            "{},{},{:.3},{:.3},{:.1},{:.0},{}",
            f.name, f.steps, f.wall_secs, f.cpu_secs, f.peak_mib, f.pixels_per_sec, f.avatar_bytes
        )];
        cells.extend(keys.iter().map(|key| f.psnr_db.get(*key).map_or_else(String::new, |v| format!("{v:.3}"))));
        cells.join(",")
    };
    let lines: Vec<String> = std::iter::once(head.join(",")).chain(fits.iter().map(row)).collect();
    lines.join("\n") + "\n"
}
