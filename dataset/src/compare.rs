//! Ways of choosing frames beside each other, on the candidates of a dataset: no picture is touched.

use serde::Serialize;

use crate::balance::{Bins, Quota};
use crate::choose;
use crate::options::{BuildOptions, Sampling};
use crate::rows::Rows;
use crate::stats::{self, Evenness};
use crate::views::{self, Coverage};

/// One way of choosing and what it gives.
#[derive(Clone, Debug, Serialize)]
pub struct Compared {
    /// What was asked for, in the words of the command line.
    pub choice: String,
    /// Frames chosen.
    pub frames: usize,
    /// How even the blocks are; the blocks are the same for all ways: 6 levels over 0–5.
    pub evenness: Evenness,
    /// How the views are covered.
    pub coverage: Coverage,
    /// Mean sharpness rank within the take.
    pub sharpness_rank: f64,
    /// Mean absolute correlation of two AUs.
    pub correlation: f64,
}

/// Levels of the blocks that all ways are judged by.
const JUDGED_LEVELS: usize = 6;

/// Compares ways of choosing `frames` among the usable frames of `rows`; `base` gives what is not varied.
pub fn compare(rows: &Rows, frames: usize, base: &BuildOptions) -> Vec<Compared> {
    let usable = rows.usable();
    let levels = rows.levels(&usable, JUDGED_LEVELS, Bins::Scale);
    let everything: Vec<usize> = (0..usable.len()).collect();
    let units = rows.table.attributes.len();
    let before = stats::histograms(&levels, &everything, units, JUDGED_LEVELS);
    let views: Vec<[f64; 2]> = usable.iter().map(|u| u.view).collect();
    let judge = |choice: String, chosen: &[usize]| Compared {
        choice,
        frames: chosen.len(),
        evenness: stats::evenness(&stats::histograms(&levels, chosen, units, JUDGED_LEVELS), &before, &rows.active()),
        coverage: views::coverage(&views, chosen),
        sharpness_rank: stats::sharpness_rank(&usable, chosen),
        correlation: stats::correlation(rows, &usable, chosen),
    };
    let mut result = vec![judge("all usable frames".to_owned(), &everything)];
    for (choice, options) in ways(base) {
        result.push(judge(choice, &choose::select(rows, &usable, frames, &options)));
    }
    result
}

/// The ways that are compared, in the words of the command line.
fn ways(base: &BuildOptions) -> Vec<(String, BuildOptions)> {
    let paper = BuildOptions {
        sampling: Sampling::Balanced,
        levels: 6,
        bins: Bins::Scale,
        quota: Quota::Running,
        count_existing: false,
        ..base.clone()
    };
    let entropy = BuildOptions { sampling: Sampling::Entropy, ..paper.clone() };
    let mut no_views = entropy.clone();
    no_views.entropy.view_weight = 0.0;
    let mut no_time = entropy.clone();
    no_time.entropy.time_weight = 0.0;
    let mut sharper = entropy.clone();
    sharper.entropy.sharp_weight = 0.4;
    let list = [
        ("uniform", BuildOptions { sampling: Sampling::Uniform, ..paper.clone() }),
        ("paper", paper.clone()),
        ("paper --quota fixed", BuildOptions { quota: Quota::Fixed, ..paper.clone() }),
        ("paper --quota ceiling", BuildOptions { quota: Quota::Ceiling, ..paper.clone() }),
        ("paper --count-existing", BuildOptions { count_existing: true, ..paper.clone() }),
        ("paper --bins range", BuildOptions { bins: Bins::Range, ..paper.clone() }),
        ("paper --levels 11", BuildOptions { levels: 11, ..paper.clone() }),
        ("paper --levels 11 --count-existing", BuildOptions { levels: 11, count_existing: true, ..paper }),
        ("entropy --view-weight 0", no_views),
        ("entropy --time-weight 0", no_time),
        ("entropy --sharp-weight 0.4", sharper),
        ("entropy --levels 11", BuildOptions { levels: 11, ..entropy.clone() }),
        ("entropy", entropy),
    ];
    list.into_iter().map(|(name, options)| (name.to_owned(), options)).collect()
}
