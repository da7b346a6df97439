//! How libraries tell what they are doing without printing: stages, progress, notes and counted warnings.

use std::sync::Mutex;

/// Recovered trouble: the work goes on, the user is told, and the end says how often.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Warning {
    /// A short, stable name of the sort, such as `lost-face`; warnings are counted by it.
    pub kind: &'static str,
    /// What happened, where, and what was done about it.
    pub message: String,
}

impl Warning {
    /// A warning of `kind`.
    pub fn new(kind: &'static str, message: impl Into<String>) -> Self {
        Self { kind, message: message.into() }
    }
}

/// Where a library sends its news; the binary decides what becomes of it.
pub trait Reporter: Sync {
    /// A new stage begins, of `total` steps where known.
    fn stage(&self, name: &str, total: Option<u64>);
    /// `steps` more steps of the current stage are done.
    fn advance(&self, steps: u64);
    /// A line worth reading beside the progress, such as the current loss.
    fn note(&self, text: &str);
    /// Something went wrong and was recovered.
    fn warn(&self, warning: Warning);
    /// Whether the user asked to stop; long loops look here and leave whole files behind.
    fn cancelled(&self) -> bool {
        false
    }
}

/// Hears nothing and says nothing.
#[derive(Clone, Copy, Debug, Default)]
pub struct Silent;

impl Reporter for Silent {
    fn stage(&self, _: &str, _: Option<u64>) {}
    fn advance(&self, _: u64) {}
    fn note(&self, _: &str) {}
    fn warn(&self, _: Warning) {}
}

/// Keeps the warnings, for tests and for reports.
#[derive(Debug, Default)]
pub struct Collected {
    warnings: Mutex<Vec<Warning>>,
}

impl Collected {
    /// The warnings so far.
    pub fn warnings(&self) -> Vec<Warning> {
        self.warnings.lock().map(|w| w.clone()).unwrap_or_default()
    }

    /// How many warnings of `kind` there were.
    pub fn count(&self, kind: &str) -> usize {
        self.warnings().iter().filter(|w| w.kind == kind).count()
    }
}

impl Reporter for Collected {
    fn stage(&self, _: &str, _: Option<u64>) {}
    fn advance(&self, _: u64) {}
    fn note(&self, _: &str) {}
    fn warn(&self, warning: Warning) {
        if let Ok(mut warnings) = self.warnings.lock() {
            warnings.push(warning);
        }
    }
}
