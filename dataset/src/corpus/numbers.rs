//! What a run says about itself: `run.json`, `metrics.jsonl` and `eval/eval.json`, as rows.

use std::fs;
use std::io::ErrorKind;
use std::path::Path;

use polars::prelude::Column;
use risorius_formats::FormatError;
use risorius_formats::pose_report::json_error;
use risorius_formats::run::RunManifest;
use serde_json::Value;

use crate::error::Result;
use crate::tables::column;

/// One number of an evaluation.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Number {
    /// The view, for numbers of one view.
    pub(super) view: Option<String>,
    /// The kind of view, or `all`.
    pub(super) kind: Option<String>,
    /// The part of the picture; `None` is the whole.
    pub(super) part: Option<String>,
    /// The AU, for numbers of AU control.
    pub(super) au: Option<String>,
    /// Which number.
    pub(super) metric: String,
    /// The number.
    pub(super) value: f64,
}

/// The row of a fit.
pub(super) fn fit_row(run: &Path) -> Result<Vec<Column>> {
    let manifest = RunManifest::read(run.join("run.json"))?;
    let model = fs::metadata(run.join("model.safetensors")).map(|m| m.len()).ok();
    Ok(vec![
        column("field", vec![manifest.field]),
        column("seed", vec![manifest.seed]),
        column("steps", vec![manifest.steps]),
        column("seconds", vec![manifest.seconds]),
        column("train_psnr_db", vec![train_psnr_db(run)]),
        column("model_bytes", vec![model]),
        column("dataset_sha256", vec![manifest.dataset_sha256]),
        column("written_by", vec![manifest.written_by]),
    ])
}

/// PSNR of the last logged step; `None` where the log has none.
fn train_psnr_db(run: &Path) -> Option<f64> {
    let text = fs::read_to_string(run.join("metrics.jsonl")).ok()?;
    let last: Value = serde_json::from_str(text.trim_end().lines().last()?).ok()?;
    last.get("psnr_db")?.as_f64()
}

/// The numbers of `eval.json`: per view, means per kind and part, AU control. Empty where there is no file.
pub(super) fn of_evaluation(path: &Path) -> Result<Vec<Number>> {
    let bytes = match fs::read(path) {
        Ok(bytes) => bytes,
        Err(e) if e.kind() == ErrorKind::NotFound => return Ok(Vec::new()),
        Err(e) => return Err(FormatError::io(path, "read", &e).into()),
    };
    let document: Value = serde_json::from_slice(&bytes).map_err(|e| json_error(&e).in_file(path))?;
    let mut all = Vec::new();
    for (kind, numbers) in entries(&document["means"]) {
        push(&mut all, &Number { kind: Some(kind.clone()), ..Number::default() }, numbers);
    }
    for (part, numbers) in entries(&document["mean_parts"]) {
        let of = Number { kind: Some("all".to_owned()), part: Some(part.clone()), ..Number::default() };
        push(&mut all, &of, numbers);
    }
    for view in document["views"].as_array().into_iter().flatten() {
        let text = |name: &str| view[name].as_str().map(str::to_owned);
        let of = Number { view: text("id"), kind: text("kind"), ..Number::default() };
        push(&mut all, &of, view);
    }
    let control = &document["control"];
    for unit in control["units"].as_array().into_iter().flatten() {
        let of = Number {
            kind: Some("control".to_owned()),
            au: unit["unit"].as_str().map(str::to_owned),
            ..Number::default()
        };
        push(&mut all, &of, &unit["sweep"]);
        // An AU that is read as a constant has no agreement: 0, as in the paper.
        if unit["sweep"].is_null() {
            all.extend(["icc_1_1", "icc_2_1", "icc_3_1"].map(|m| Number {
                metric: m.to_owned(),
                value: 0.0,
                ..of.clone()
            }));
        }
    }
    push(&mut all, &Number { kind: Some("control".to_owned()), ..Number::default() }, control);
    Ok(all)
}

fn entries(value: &Value) -> impl Iterator<Item = (&String, &Value)> {
    value.as_object().into_iter().flatten()
}

/// Adds the plain numbers among the entries of `values`.
fn push(all: &mut Vec<Number>, of: &Number, values: &Value) {
    for (metric, value) in entries(values) {
        if let Some(value) = value.as_f64().filter(|v| v.is_finite()) {
            all.push(Number { metric: metric.clone(), value, ..of.clone() });
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_evaluation_becomes_rows() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("eval.json");
        assert!(of_evaluation(&path).unwrap().is_empty());
        let text = r#"{"views": [{"id": "v0", "kind": "novel", "psnr_db": 20.5, "ms_ssim": {"value": 0.9}}],
            "means": {"all": {"psnr_db": 20.5}}, "mean_parts": {"head": {"ssim": 0.8}},
            "control": {"mean_icc_3_1": 0.45, "cross_talk": [[1.0]], "units": [
              {"unit": "AU01", "sweep": {"icc_3_1": 0.9}}, {"unit": "AU09", "sweep": null}]}}"#;
        fs::write(&path, text).unwrap();
        let rows = of_evaluation(&path).unwrap();
        let find = |metric: &str, au: Option<&str>, view: Option<&str>| {
            let hit = rows.iter().find(|n| n.metric == metric && n.au.as_deref() == au && n.view.as_deref() == view);
            hit.map(|n| (n.kind.clone().unwrap(), n.part.clone(), n.value))
        };
        assert_eq!(find("psnr_db", None, None), Some(("all".to_owned(), None, 20.5)));
        assert_eq!(find("psnr_db", None, Some("v0")), Some(("novel".to_owned(), None, 20.5)));
        assert_eq!(find("ssim", None, None), Some(("all".to_owned(), Some("head".to_owned()), 0.8)));
        assert_eq!(find("icc_3_1", Some("AU01"), None), Some(("control".to_owned(), None, 0.9)));
        assert_eq!(find("icc_3_1", Some("AU09"), None), Some(("control".to_owned(), None, 0.0)));
        assert_eq!(find("mean_icc_3_1", None, None), Some(("control".to_owned(), None, 0.45)));
        assert_eq!(rows.len(), 8);
        fs::write(&path, "{").unwrap();
        assert!(of_evaluation(&path).unwrap_err().to_string().contains("eval.json"));
    }
}
