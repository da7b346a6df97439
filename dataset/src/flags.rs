//! What to worry about in a dataset, in words: each flag has a stable kind, a number and a sentence.

use serde::{Deserialize, Serialize};

use crate::rows::UsableRow;
use crate::split::SplitKind;
use crate::stats::Report;

/// Something worth a look.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Flag {
    /// A short, stable name.
    pub kind: String,
    /// How many frames, AUs or blocks it is about.
    pub count: usize,
    /// What it means.
    pub message: String,
}

/// A frame is blurred below this share of the median sharpness of its take.
const BLUR: f32 = 0.4;
/// A frame is badly exposed when more than this share of its pixels is clipped.
const CLIPPED: f32 = 0.2;
/// Views within this span teach little about the sides of a head, degrees.
const NARROW_DEG: f64 = 20.0;
/// An AU with fewer chosen frames above half of its range is seldom seen.
const FEW_RAISED: usize = 8;

pub(crate) fn collect(report: &Report, usable: &[UsableRow<'_>], chosen: &[usize]) -> Vec<Flag> {
    let mut flags = Vec::new();
    let mut add = |kind: &str, count: usize, message: String| {
        if count > 0 {
            flags.push(Flag { kind: kind.to_owned(), count, message });
        }
    };
    let n = chosen.len();
    let names = |wanted: &dyn Fn(usize) -> bool| -> Vec<String> {
        (0..report.attributes.len()).filter(|&k| wanted(k)).map(|k| report.attributes[k].unit.to_string()).collect()
    };
    let inactive = names(&|k| !report.attributes[k].active);
    add("inactive-au", inactive.len(), format!("{} hardly move and cannot be learned", inactive.join(", ")));
    let raised = |k: usize| report.together.after.get(k).and_then(|row| row.get(k)).copied().unwrap_or(0);
    let seldom = names(&|k| report.attributes[k].active && raised(k) < FEW_RAISED);
    add(
        "seldom-raised",
        seldom.len(),
        format!("{} are raised above half of their range in fewer than {FEW_RAISED} chosen frames", seldom.join(", ")),
    );
    let medians = median_sharpness(usable);
    let blurred = chosen.iter().filter(|&&c| {
        let u = &usable[c];
        u.row.sharpness.zip(medians.get(u.take).copied().flatten()).is_some_and(|(s, m)| s < BLUR * m)
    });
    let blurred = blurred.count();
    add(
        "blurred",
        blurred,
        format!("{blurred} of {n} chosen frames are below {:.0} % of their take's median sharpness", 100.0 * BLUR),
    );
    let clipped = chosen.iter().filter(|&&c| usable[c].row.clipped_share.is_some_and(|s| s > CLIPPED)).count();
    add(
        "clipped",
        clipped,
        format!("{clipped} of {n} chosen frames have more than {:.0} % clipped pixels", 100.0 * CLIPPED),
    );
    let between = chosen.iter().filter(|&&c| usable[c].row.interpolated).count();
    add("interpolated-camera", between, format!("{between} of {n} chosen frames have a camera between found ones"));
    add(
        "without-masks",
        report.chosen_without_masks,
        format!("{} of {n} chosen frames have no region masks", report.chosen_without_masks),
    );
    let span = |[lo, hi]: [f64; 2]| hi - lo;
    let yaw = span(report.coverage.yaw_deg);
    add("narrow-views", usize::from(n > 0 && yaw < NARROW_DEG), format!("the views span {yaw:.0}° of yaw only"));
    let missing = report.coverage.cells - report.coverage.cells_chosen.min(report.coverage.cells);
    add(
        "views-left-out",
        missing,
        format!("{missing} of {} cells of camera directions have no chosen frame", report.coverage.cells),
    );
    let empty = report.evenness_after.empty_blocks;
    add("empty-blocks", empty, format!("{empty} (AU, intensity) blocks have candidates but no chosen frame"));
    let split = &report.split;
    if let (SplitKind::Periodic | SplitKind::EveryOther, Some([median, _])) = (split.kind, split.nearest_ms) {
        let message = format!(
            "held-out frames are {median:.0} ms (median) from a frame for fitting: they test memory; `--split time-blocks` does not"
        );
        add("neighbours-held-out", split.val, message);
    }
    flags
}

/// The median sharpness of each take's usable frames.
fn median_sharpness(usable: &[UsableRow<'_>]) -> Vec<Option<f32>> {
    let takes = usable.iter().map(|u| u.take + 1).max().unwrap_or(0);
    let of = |take: usize| {
        let mut values: Vec<f32> = usable
            .iter()
            .filter(|u| u.take == take)
            .filter_map(|u| u.row.sharpness)
            .filter(|s| s.is_finite())
            .collect();
        crate::neutral::median(&mut values)
    };
    (0..takes).map(of).collect()
}
