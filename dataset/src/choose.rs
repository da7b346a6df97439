//! Which of the usable frames make the dataset, and which of those are held out.

use risorius_formats::{Intensity, Reporter, Warning};

use crate::balance;
use crate::entropy::{self, Seen};
use crate::options::{BuildOptions, Sampling};
use crate::rows::{Rows, UsableRow};
use crate::split::{self, Facts, Role, SplitOptions};
use crate::views;

/// A chosen frame: its index among the usable ones, and whether it is held out.
pub type Chosen = (usize, Role);

/// The chosen frames, ascending: those with masks first; the others, which still show the head from its sides, only
/// fill up what is missing.
pub fn choose(rows: &Rows, options: &BuildOptions, reporter: &dyn Reporter) -> Vec<Chosen> {
    let usable = rows.usable();
    if usable.len() < options.frames {
        let message =
            format!("{} frames were asked for, and {} can be used: all are taken", options.frames, usable.len());
        reporter.warn(Warning::new("few-candidates", message));
    }
    let split = options.split();
    let roles = split::roles(&facts(rows, &usable), split);
    let pool = |role: Role| -> Vec<usize> { (0..usable.len()).filter(|&c| roles[c] == role).collect() };
    let (train, val) = (pool(Role::Train), pool(Role::Val));
    let held_out = if split.kind.comes_first() {
        if val.is_empty() || train.len() < 2 {
            let message = format!(
                "the split `{}` leaves {} frames for fitting and {} to hold out; take a longer capture or another split",
                split.kind.name(),
                train.len(),
                val.len()
            );
            reporter.warn(Warning::new("empty-split", message));
        }
        ((options.frames as f64 * split.val_share).round() as usize).min(val.len())
    } else {
        0
    };
    let mut chosen: Vec<Chosen> = pick(rows, &usable, &val, held_out, options).map(|c| (c, Role::Val)).collect();
    chosen.extend(pick(rows, &usable, &train, options.frames - held_out, options).map(|c| (c, Role::Train)));
    chosen.sort_unstable_by_key(|c| c.0);
    by_place(chosen, split)
}

fn by_place(mut chosen: Vec<Chosen>, split: SplitOptions) -> Vec<Chosen> {
    let count = chosen.len();
    for (place, entry) in chosen.iter_mut().enumerate() {
        if split::is_held_out(split.kind, place, count) {
            entry.1 = Role::Val;
        }
    }
    chosen
}

/// `target` frames of `pool` by the objective.
fn pick<'a>(
    rows: &Rows,
    usable: &[UsableRow<'_>],
    pool: &'a [usize],
    target: usize,
    options: &BuildOptions,
) -> impl Iterator<Item = usize> + use<'a> {
    let (good, poor): (Vec<usize>, Vec<usize>) =
        pool.iter().partition(|&&c| usable[c].row.masks.as_deref() == Some("ok"));
    let views: Vec<UsableRow<'_>> = good.iter().map(|&c| usable[c]).collect();
    let picked = select(rows, &views, target, options);
    let missing = target - picked.len();
    let fill: Vec<usize> = balance::spread(poor.len(), missing).into_iter().map(|i| poor[i]).collect();
    picked.into_iter().map(move |i| good[i]).chain(fill)
}

/// `target` of `usable` by the objective, ascending.
pub(crate) fn select(rows: &Rows, usable: &[UsableRow<'_>], target: usize, options: &BuildOptions) -> Vec<usize> {
    let levels = rows.levels(usable, options.levels, options.bins);
    let active = rows.active();
    match options.sampling {
        Sampling::Balanced => balance::select_balanced(&levels, &active, target, options.balance()),
        Sampling::Uniform => balance::select_uniform(usable.len(), target),
        Sampling::Entropy => {
            let seen: Vec<Seen<'_>> = usable
                .iter()
                .zip(&levels)
                .map(|(u, levels)| Seen {
                    levels,
                    cell: views::cell(u.view),
                    take: u.take,
                    secs: u.row.timestamp_nanos as f64 * 1e-9,
                    sharpness: u.row.sharpness,
                })
                .collect();
            entropy::select(&seen, &active, target, options.entropy)
        }
    }
}

/// What the splits look at.
pub(crate) fn facts(rows: &Rows, usable: &[UsableRow<'_>]) -> Vec<Facts> {
    let attributes = &rows.table.attributes;
    let combination = |u: &UsableRow<'_>| {
        let raised = attributes.iter().zip(u.intensities).take(64).enumerate();
        raised
            .filter(|(_, (a, v))| a.active && a.scale().attribute(Intensity(**v)) >= split::RAISED)
            .fold(0, |bits, (k, _)| bits | 1u64 << k)
    };
    let fact = |u: &UsableRow<'_>| Facts {
        take: u.take,
        secs: u.row.timestamp_nanos as f64 * 1e-9,
        view: u.view,
        combination: combination(u),
    };
    usable.iter().map(fact).collect()
}
