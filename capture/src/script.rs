//! A guided script: what the person in front of the camera is asked to do, and when they did it.

use std::path::Path;

use risorius_formats::{FormatError, FrameRecord};
use serde::{Deserialize, Serialize};

use crate::Result;

/// One thing to do.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Step {
    /// A short name, such as `AU12`.
    pub label: String,
    /// The action units that it should show, such as `AU06`; none for a neutral face.
    #[serde(default)]
    pub aus: Vec<String>,
    /// What the person reads.
    pub text: String,
    /// Rest with a neutral face before it, seconds.
    #[serde(default)]
    pub rest_secs: f64,
    /// How long it is done, seconds.
    pub secs: f64,
}

/// Steps, one after the other, from the first frame on.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Script {
    /// The script's name.
    pub name: String,
    /// The steps.
    #[serde(rename = "step")]
    pub steps: Vec<Step>,
}

/// What stands on the screen at a moment.
#[derive(Clone, Debug, PartialEq)]
pub struct Prompt {
    /// Number of the step, from 0.
    pub step: usize,
    /// Whether it is the rest before the step.
    pub is_rest: bool,
    /// What the person reads.
    pub text: String,
    /// Seconds to the end of the step or the rest.
    pub secs_left: f64,
}

/// A row of `marks.csv`: frames in which something was to be done.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Mark {
    /// The step's name; `neutral` for a rest.
    pub label: String,
    /// Its action units, joined by `+`.
    pub aus: String,
    /// Begin, since the first frame.
    pub start_nanos: i64,
    /// End, since the first frame.
    pub end_nanos: i64,
    /// The first frame of it.
    pub first_frame: u32,
    /// The last frame of it.
    pub last_frame: u32,
}

/// The name of the table of marks in a take.
pub const MARKS_FILE: &str = "marks.csv";

const REST_SECS: f64 = 1.0;
const SHOW_SECS: f64 = 2.5;

/// The 17 units that OpenFace rates, as people are asked for them.
const SINGLE: [(&str, &str); 17] = [
    ("AU01", "raise the inner ends of your brows, as if worried"),
    ("AU02", "raise the outer ends of your brows"),
    ("AU04", "frown: pull your brows down and together"),
    ("AU05", "open your eyes wide"),
    ("AU06", "lift your cheeks, as in a hearty laugh, lips at rest"),
    ("AU07", "narrow your eyes, as against the sun"),
    ("AU09", "wrinkle your nose"),
    ("AU10", "raise your upper lip and show the upper teeth"),
    ("AU12", "smile: pull the corners of your mouth up"),
    ("AU14", "press the corners of your mouth in: dimples"),
    ("AU15", "pull the corners of your mouth down"),
    ("AU17", "push your chin up, as if pouting"),
    ("AU20", "stretch your lips sideways, as if scared"),
    ("AU23", "tighten your lips"),
    ("AU25", "part your lips, teeth together"),
    ("AU26", "drop your jaw"),
    ("AU45", "blink slowly, several times"),
];

/// Combinations, most of them of two regions of the face.
const COMBINED: [(&str, &[&str], &str); 8] = [
    ("smile", &["AU06", "AU12"], "smile with your cheeks and eyes"),
    ("smile with teeth", &["AU06", "AU12", "AU25"], "laugh: smile with your teeth showing"),
    ("surprise", &["AU01", "AU02", "AU05", "AU26"], "be surprised: brows up, eyes wide, jaw dropped"),
    ("anger", &["AU04", "AU07", "AU23"], "be angry: frown, narrow eyes, tight lips"),
    ("sadness", &["AU01", "AU04", "AU15"], "be sad: inner brows up, corners of the mouth down"),
    ("disgust", &["AU09", "AU10", "AU17"], "be disgusted: wrinkled nose, upper lip raised"),
    ("wink and smile", &["AU12", "AU45"], "smile with your eyes closed"),
    ("brows and jaw", &["AU02", "AU26"], "raise your brows and drop your jaw"),
];

impl Script {
    /// The paper's task: each action unit alone, then combinations, then a slow orbit. Two minutes.
    pub fn au() -> Self {
        let step = |label: &str, aus: &[&str], text: &str, rest_secs: f64, secs: f64| Step {
            label: label.to_owned(),
            aus: aus.iter().map(|a| (*a).to_owned()).collect(),
            text: text.to_owned(),
            rest_secs,
            secs,
        };
        let mut steps = vec![step("neutral", &[], "look at the camera with a relaxed face", 0.0, 3.0)];
        steps.extend(SINGLE.iter().map(|(au, text)| step(au, &[au], text, REST_SECS, SHOW_SECS)));
        steps.extend(COMBINED.iter().map(|(label, aus, text)| step(label, aus, text, REST_SECS, SHOW_SECS)));
        steps.push(step(
            "orbit",
            &[],
            "relaxed face; move the camera slowly from one side of the head to the other and back",
            REST_SECS,
            28.5,
        ));
        Self { name: "au".to_owned(), steps }
    }

    /// `au`, or a TOML file of `[[step]]` tables.
    pub fn load(name: &str) -> Result<Self> {
        if name == "au" {
            return Ok(Self::au());
        }
        let path = Path::new(name);
        let text = std::fs::read_to_string(path).map_err(|e| {
            FormatError::io(path, "read", &e).or_hint("`au` is built in; anything else is a file of [[step]] tables")
        })?;
        let script: Self = toml::from_str(&text).map_err(|e| {
            let line = e.span().map_or(1, |s| 1 + text.bytes().take(s.start).filter(|&b| b == b'\n').count());
            FormatError::syntax(e.message().trim().replace('\n', ", ")).in_file(path).at_line(line as u64)
        })?;
        let possible = |secs: f64| secs.is_finite() && (0.0..=3600.0).contains(&secs);
        if script.steps.is_empty() || script.steps.iter().any(|s| !possible(s.secs) || !possible(s.rest_secs)) {
            let message = "needs at least one step, and times between 0 and 3600 seconds";
            return Err(FormatError::syntax(message).in_file(path).into());
        }
        Ok(script)
    }

    /// How long it takes, seconds.
    pub fn secs(&self) -> f64 {
        self.steps.iter().map(|s| s.rest_secs + s.secs).sum()
    }

    /// The rests and steps as (step, whether it is the rest, begin, end), seconds.
    fn spans(&self) -> impl Iterator<Item = (usize, bool, f64, f64)> + '_ {
        let mut at = 0.0;
        self.steps.iter().enumerate().flat_map(move |(i, step)| {
            let (begin, middle, end) = (at, at + step.rest_secs, at + step.rest_secs + step.secs);
            at = end;
            [(i, true, begin, middle), (i, false, middle, end)].into_iter().filter(|s| s.3 > s.2)
        })
    }

    /// What stands on the screen `secs` after the first frame; `None` after the end.
    pub fn at(&self, secs: f64) -> Option<Prompt> {
        let (step, is_rest, _, end) = self.spans().find(|s| secs < s.3)?;
        let text = &self.steps[step].text;
        let text = if is_rest { format!("relax; next: {text}") } else { text.clone() };
        Some(Prompt { step, is_rest, text, secs_left: end - secs })
    }

    /// The marks of a take's frames; what was not reached has none.
    pub fn marks(&self, frames: &[FrameRecord]) -> Vec<Mark> {
        let mut out = Vec::new();
        for (step, is_rest, begin, end) in self.spans() {
            let (start_nanos, end_nanos) = ((begin * 1e9).round() as i64, (end * 1e9).round() as i64);
            let first = frames.partition_point(|f| f.timestamp_nanos < start_nanos);
            let after = frames.partition_point(|f| f.timestamp_nanos < end_nanos);
            if after == first {
                continue;
            }
            let step = &self.steps[step];
            out.push(Mark {
                label: if is_rest { "neutral".to_owned() } else { step.label.clone() },
                aus: if is_rest { String::new() } else { step.aus.join("+") },
                start_nanos,
                end_nanos,
                first_frame: first as u32,
                last_frame: after as u32 - 1,
            });
        }
        out
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use risorius_formats::FrameIndex;

    #[test]
    fn the_au_script_has_every_unit_alone_and_takes_two_minutes() {
        let script = Script::au();
        assert!((118.0..=122.0).contains(&script.secs()), "{}", script.secs());
        let alone: Vec<_> = script.steps.iter().filter(|s| s.aus.len() == 1).map(|s| s.aus[0].as_str()).collect();
        assert_eq!(alone, SINGLE.map(|(au, _)| au));
    }

    #[test]
    fn marks_cover_each_frame_once() {
        let script = Script::au();
        let frames: Vec<FrameRecord> = (0..9000u32)
            .map(|i| FrameRecord {
                index: FrameIndex(i),
                timestamp_nanos: i64::from(i) * 8_333_333,
                ..FrameRecord::default()
            })
            .collect();
        let marks = script.marks(&frames);
        assert_eq!(marks[0].first_frame, 0);
        assert!(
            marks.windows(2).all(|w| w[0].last_frame + 1 == w[1].first_frame && w[0].end_nanos == w[1].start_nanos)
        );
        // The recording ended early: the last mark ends with it.
        assert_eq!(marks.last().unwrap().last_frame, 8999);
        let smile = marks.iter().find(|m| m.aus == "AU12").unwrap();
        let prompt = script.at(smile.start_nanos as f64 * 1e-9 + 0.5).unwrap();
        assert!(prompt.text.starts_with("smile") && !prompt.is_rest && (prompt.secs_left - 2.0).abs() < 1e-6);
        assert_eq!(script.at(1e6), None);
    }
}
