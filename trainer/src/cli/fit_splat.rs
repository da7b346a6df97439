//! `trainer fit --field splat`.

use risorius_console::{Console, Failure};
use serde::Serialize;

use super::fit::{FitArgs, OUTPUTS, TrainerFile, begin, changed, describe, read_settings};
use crate::data::TrainData;
use crate::splat::SplatSettings;
use crate::splat::fit::fit;

#[derive(Serialize)]
struct Plan<'a> {
    frames: usize,
    attributes: usize,
    regions: usize,
    image_scale: u32,
    settings: &'a SplatSettings,
}

pub(super) fn run(args: &FitArgs, console: &Console) -> Result<(), Failure> {
    let of_confies = [
        ("--preset", args.preset.is_some()),
        ("--model", args.model.is_some()),
        ("--rays", args.rays.is_some()),
        ("--interval", args.interval.is_some()),
        ("--memory-limit", args.memory_limit.is_some()),
    ];
    if let Some((name, _)) = of_confies.iter().find(|(_, given)| *given) {
        return Err(Failure::usage(format!("`{name}` belongs to `--field confies`")));
    }
    args.device.device()?;
    let mut settings = resolve(args, args.resume)?;
    let (mut work, mut resume) = (None, args.resume);
    if !args.dry_run {
        let Some((running, goes_on)) = begin(args, &settings, console)? else { return Ok(()) };
        if goes_on {
            settings = resolve(args, true)?;
        }
        (work, resume) = (Some(running), goes_on);
    }
    let data = TrainData::load(&args.dataset, settings.image_scale, console)?;
    if args.dry_run {
        let plan = Plan {
            frames: data.frames.len(),
            attributes: data.table.attributes.len(),
            regions: data.table.regions.len(),
            image_scale: data.scale,
            settings: &settings,
        };
        let length = match settings.steps {
            Some(steps) => format!("{steps} steps"),
            None => format!("{:.0} s", settings.budget_secs),
        };
        let human = format!(
            "would fit up to {} Gaussians to {} frames (scale {}) for {length}",
            settings.splat.gaussians, plan.frames, plan.image_scale
        );
        console.finish(&plan, &human);
        return Ok(());
    }
    let Some(running) = work else { return Err(Failure::bug("a fit without a lock")) };
    running.mark()?;
    let summary = fit(&data, &settings, &args.out, resume, console)?;
    running.finish(&OUTPUTS)?;
    console.finish(&summary, &describe(&summary));
    Ok(())
}

/// Command line, then the settings of the run to resume, then `risorius.toml`, then defaults.
fn resolve(args: &FitArgs, resume: bool) -> Result<SplatSettings, Failure> {
    let mut settings = if resume { read_settings(&args.out)? } else { SplatSettings::default() };
    if !resume {
        let file: TrainerFile = risorius_console::settings("trainer")?;
        settings.steps = file.fit.steps;
        settings.budget_secs = file.fit.budget_secs()?.unwrap_or(settings.budget_secs);
        settings.splat.seed = file.fit.seed.unwrap_or(settings.splat.seed);
        settings.image_scale = file.fit.image_scale.unwrap_or(settings.image_scale);
    }
    if args.steps.is_some() {
        settings.steps = args.steps;
    }
    if let Some(budget) = args.budget {
        settings.budget_secs = budget;
        settings.steps = None;
    }
    if !args.skips.no_skip.is_empty() {
        settings.splat.skips = args.skips.skips()?;
    }
    settings.checkpoint_every = args.checkpoint_every.unwrap_or(settings.checkpoint_every);
    settings.splat.seed = args.seed.unwrap_or(settings.splat.seed);
    settings.image_scale = args.image_scale.unwrap_or(settings.image_scale);
    args.set.iter().try_fold(settings, |settings, change| changed(&settings, change))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_setting_changes_and_others_stay() {
        let before = SplatSettings::default();
        let after = changed(&before, "image_scale=2").unwrap();
        assert_eq!(after, SplatSettings { image_scale: 2, ..before.clone() });
        let after = changed(&before, "splat.gaussians = 5000").unwrap();
        assert_eq!(after.splat.gaussians, 5000);
        for wrong in ["image_scale", "finest=3", "splat.gaussians=true", "nowhere.at=1", "image_scale=\"x"] {
            assert!(changed(&before, wrong).is_err(), "{wrong}");
        }
    }
}
