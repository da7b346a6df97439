//! The card of an avatar: what each stage took, how good it came out, what to know, what to type next.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use risorius_console::Failure;
use risorius_formats::atomic::write_file;
use risorius_formats::pose_report::write_json;
use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::board::seconds;
use super::face::FaceCoverage;
use super::stages::AvatarStage;

/// Longer commands do not push aside what the others do.
const MOST_WIDTH: usize = 64;

/// A stage that is done.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct StageEntry {
    pub(super) stage: AvatarStage,
    /// `None` where it was made by other commands.
    pub(super) wall_secs: Option<f64>,
    /// Of this process and COLMAP; `None` where the system does not tell.
    pub(super) cpu_secs: Option<f64>,
    /// Whether the last command found it done.
    pub(super) was_there: bool,
    /// One line for people.
    pub(super) outcome: String,
    pub(super) warnings: Vec<String>,
    /// Hash of the result's record, by which it is known again.
    pub(super) record_sha256: Option<String>,
}

/// PSNR on frames that were not fitted, means over them, dB.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct HeldOutScores {
    pub(super) frames: usize,
    pub(super) whole_db: f64,
    pub(super) head_db: Option<f64>,
    pub(super) background_db: Option<f64>,
    pub(super) au_regions_db: Option<f64>,
}

impl HeldOutScores {
    /// From the document of `trainer eval`.
    pub(super) fn of(document: &Value) -> Option<Self> {
        let part = |name: &str| document["mean_parts_psnr_db"]["all"][name].as_f64();
        Some(Self {
            frames: document["views"].as_array()?.len(),
            whole_db: document["mean_psnr_db"].as_f64()?,
            head_db: part("head"),
            background_db: part("background"),
            au_regions_db: part("AU regions"),
        })
    }
}

/// `card.json`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub(super) struct AvatarCard {
    pub(super) version: u32,
    pub(super) written_by: String,
    /// Whether all stages are done.
    pub(super) finished: bool,
    /// Why the last command stopped.
    pub(super) stopped: Option<String>,
    pub(super) video: PathBuf,
    pub(super) take: PathBuf,
    pub(super) run: PathBuf,
    pub(super) stages: Vec<StageEntry>,
    /// Of the stages that `risorius avatar` ran, whenever that was.
    pub(super) wall_secs: f64,
    pub(super) cpu_secs: f64,
    pub(super) held_out: Option<HeldOutScores>,
    pub(super) face: Option<FaceCoverage>,
    pub(super) avatar_bytes: u64,
    pub(super) folder_bytes: u64,
    pub(super) warnings: Vec<String>,
    /// Commands to type next, each with what it does.
    pub(super) next: Vec<[String; 2]>,
}

impl AvatarCard {
    /// The card of an earlier command, as far as it can be read.
    pub(super) fn read(path: &Path) -> Self {
        std::fs::read(path).ok().and_then(|bytes| serde_json::from_slice(&bytes).ok()).unwrap_or_default()
    }

    pub(super) fn write(&self, path: &Path) -> Result<(), Failure> {
        Ok(write_json(path, self)?)
    }

    pub(super) fn write_text(&self, path: &Path) -> Result<(), Failure> {
        Ok(write_file(path, (self.text() + "\n").as_bytes())?)
    }

    pub(super) fn entry(&self, stage: AvatarStage) -> Option<&StageEntry> {
        self.stages.iter().find(|e| e.stage == stage)
    }

    /// Adds or replaces the entry of a stage.
    pub(super) fn put(&mut self, entry: StageEntry) {
        self.stages.retain(|e| e.stage != entry.stage);
        self.stages.push(entry);
        self.stages.sort_by_key(|e| e.stage);
        self.wall_secs = self.stages.iter().filter_map(|e| e.wall_secs).sum();
        self.cpu_secs = self.stages.iter().filter_map(|e| e.cpu_secs).sum();
        self.warnings = self.stages.iter().flat_map(|e| e.warnings.iter().cloned()).collect();
    }

    /// For people.
    pub(super) fn text(&self) -> String {
        let mut text = format!("The avatar is in {}\n", self.run.display());
        let _ = write!(text, "\nStages");
        for e in &self.stages {
            let time = e.wall_secs.map_or_else(|| "–".to_owned(), seconds);
            let there = if e.was_there { " (was there)" } else { "" };
            let _ = write!(text, "\n  {:<14} {time:>12}  {}{there}", e.stage.title(), e.outcome);
        }
        let _ = write!(
            text,
            "\n  {:<14} {:>12}  {} of CPU time",
            "in all",
            seconds(self.wall_secs),
            seconds(self.cpu_secs)
        );
        if let Some(s) = &self.held_out {
            let _ = write!(
                text,
                "\n\nQuality: PSNR over {} frames that were held out of the fit (higher is better; at 30 dB the error is 8 of 255 levels)",
                s.frames
            );
            let rows = [
                ("whole picture", Some(s.whole_db)),
                ("AU regions", s.au_regions_db),
                ("head", s.head_db),
                ("background", s.background_db),
            ];
            for (name, db) in rows.into_iter().filter_map(|(n, db)| Some((n, db?))) {
                let _ = write!(text, "\n  {name:<14} {db:>9.1} dB");
            }
        }
        if let Some(face) = &self.face {
            let _ = write!(text, "\n\nExpressions: {}", expressions(face));
        }
        let _ =
            write!(text, "\n\nSize: the avatar {}, the folder {}", bytes(self.avatar_bytes), bytes(self.folder_bytes));
        if !self.warnings.is_empty() {
            let _ = write!(text, "\n\nTo know");
            for w in &self.warnings {
                let _ = write!(text, "\n  - {w}");
            }
        }
        let _ = write!(text, "\n\nNext");
        let width = self
            .next
            .iter()
            .map(|[command, _]| command.chars().count())
            .filter(|&n| n <= MOST_WIDTH)
            .max()
            .unwrap_or(0);
        for [command, what] in &self.next {
            let _ = write!(text, "\n  {command:<width$}   {what}");
        }
        text
    }
}

/// Which AUs moved, from the strongest on.
fn expressions(face: &FaceCoverage) -> String {
    let mut covered: Vec<_> = face.covered().collect();
    covered.sort_by(|a, b| b.max.total_cmp(&a.max));
    let list = |units: &[&super::face::AuCoverage]| {
        let one = |u: &&super::face::AuCoverage| format!("{} {:.1}–{:.1}", u.unit, u.min, u.max);
        units.chunks(6).map(|row| row.iter().map(one).collect::<Vec<_>>().join("   ")).collect::<Vec<_>>().join("\n  ")
    };
    let rest: Vec<_> = face.units.iter().filter(|u| !u.is_covered).collect();
    let mut text = format!("{} of {} AUs change by 1 or more of 5", covered.len(), face.units.len());
    if !covered.is_empty() {
        let _ = write!(text, "\n  {}", list(&covered));
    }
    if !rest.is_empty() {
        let _ = write!(text, "\n  less: {}", list(&rest).replace("\n  ", "\n        "));
    }
    text
}

fn bytes(n: u64) -> String {
    let n = n as f64;
    match n {
        _ if n < 1e6 => format!("{:.0} kB", n * 1e-3),
        _ if n < 1e9 => format!("{:.1} MB", n * 1e-6),
        _ => format!("{:.1} GB", n * 1e-9),
    }
}

/// Bytes of the files below a folder.
pub(super) fn folder_bytes(dir: &Path) -> u64 {
    let entries = std::fs::read_dir(dir).into_iter().flatten().flatten();
    entries
        .filter_map(|e| {
            let kind = e.file_type().ok()?;
            if kind.is_dir() {
                Some(folder_bytes(&e.path()))
            } else {
                e.metadata().ok().filter(|_| kind.is_file()).map(|m| m.len())
            }
        })
        .sum()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn entries_are_replaced_and_summed() {
        let entry = |stage, wall: f64, warnings: &[&str]| StageEntry {
            stage,
            wall_secs: Some(wall),
            cpu_secs: Some(2.0 * wall),
            was_there: false,
            outcome: "done".to_owned(),
            warnings: warnings.iter().map(|w| (*w).to_owned()).collect(),
            record_sha256: None,
        };
        let mut card = AvatarCard::default();
        card.put(entry(AvatarStage::Fit, 30.0, &["b"]));
        card.put(entry(AvatarStage::Record, 1.0, &["a"]));
        card.put(entry(AvatarStage::Fit, 31.0, &["c"]));
        assert_eq!((card.wall_secs, card.cpu_secs), (32.0, 64.0));
        assert_eq!(card.warnings, ["a", "c"]);
        let text = card.text();
        assert!(text.find("record").unwrap() < text.find("fit").unwrap(), "{text}");
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("card.json");
        card.write(&path).unwrap();
        assert_eq!(AvatarCard::read(&path), card);
        assert_eq!(AvatarCard::read(&dir.path().join("none")), AvatarCard::default());
    }

    #[test]
    fn scores_come_from_the_document_of_an_evaluation() {
        let document = serde_json::json!({
            "views": [1, 2], "mean_psnr_db": 30.5, "mean_parts_psnr_db": { "all": { "AU regions": 29.0 } }
        });
        let scores = HeldOutScores::of(&document).unwrap();
        assert_eq!((scores.frames, scores.whole_db, scores.au_regions_db, scores.head_db), (2, 30.5, Some(29.0), None));
        assert!(HeldOutScores::of(&serde_json::json!({ "up_to_date": true })).is_none());
    }
}
