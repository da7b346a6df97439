//! `bench-confies table2`: NeRF, NeRF + latent, Nerfies, HyperNeRF, CoNeRF-M, CoNeRF and CoNFies under the same
//! conditions: every other frame held out, codes between neighbours, the same steps or the same time.

use std::path::PathBuf;

use risorius_console::{Console, Failure};
use risorius_trainer::config::ModelKind;
use serde::Serialize;
use serde_json::Value;

use super::rows::{self, Job, Row};
use super::{create, text};
use crate::child;

/// Options of `bench-confies table2`.
#[derive(Debug, clap::Args)]
#[command(
    after_help = "Example:\n  bench-confies table2 --dataset datasets/ada --work work/table2 --preset cpu --steps 3000\n\nWrites table2.csv, table2.md and table2.json into WORK. A run that was stopped goes on where it was: rows that are\nmeasured stay, and with `--steps` the fit that was stopped goes on from its checkpoint."
)]
pub(super) struct Args {
    /// A dataset made by `dataset build` or imported
    #[arg(long, value_name = "DIR")]
    dataset: PathBuf,
    /// Where runs, rows and tables go
    #[arg(long, value_name = "DIR")]
    work: PathBuf,
    /// Models, in the order of the table
    #[arg(
        long,
        value_name = "NAMES",
        value_delimiter = ',',
        default_value = "nerf,nerf-latent,nerfies,hypernerf,conerf-m,conerf,confies"
    )]
    models: Vec<ModelKind>,
    /// Sizes and schedules of all of them
    #[arg(long, value_name = "NAME", default_value = "cpu")]
    preset: String,
    /// The same steps for every model
    #[arg(long, value_name = "N", conflicts_with = "budget", required_unless_present = "budget")]
    steps: Option<u64>,
    /// The same time for every model
    #[arg(long, value_name = "TIME")]
    budget: Option<String>,
    /// Every so many frames is fitted; 0 keeps the dataset's own lists
    #[arg(long, value_name = "N", default_value_t = 2)]
    interval: usize,
    /// Image scale [default: the dataset's]
    #[arg(long, value_name = "S")]
    image_scale: Option<u32>,
    /// Seed
    #[arg(long, value_name = "N", default_value_t = 0)]
    seed: u64,
    /// Change a setting of all models, as `trainer fit --set`; may be repeated
    #[arg(long, value_name = "KEY=VALUE")]
    set: Vec<String>,
    /// LPIPS networks, or none [default: those that are fetched]
    #[arg(long, value_name = "NAME")]
    lpips: Option<String>,
    /// Say what would be fitted and about how long it takes, without doing it
    #[arg(long)]
    dry_run: bool,
}

/// What the paper has for a model: PSNR in dB, MS-SSIM, LPIPS; means over CoNeRF's real scenes, so not comparable in value
/// with another dataset, only in order.
fn of_paper(kind: ModelKind) -> Option<[f64; 3]> {
    Some(match kind {
        ModelKind::Nerf => [28.795, 0.951, 0.210],
        ModelKind::NerfLatent => [32.653, 0.981, 0.182],
        ModelKind::Nerfies => [32.274, 0.981, 0.180],
        ModelKind::Hypernerf => [32.520, 0.981, 0.169],
        ModelKind::ConerfM => [32.061, 0.979, 0.167],
        ModelKind::Conerf => [32.342, 0.981, 0.168],
        ModelKind::Confies => [32.356, 0.982, 0.166],
        ModelKind::HypernerfAp => return None,
    })
}

#[derive(Serialize)]
struct Planned {
    model: &'static str,
    command: String,
    parameters: u64,
    expected_secs: f64,
}

pub(super) fn run(args: &Args, console: &Console) -> Result<(), Failure> {
    create(&args.work)?;
    let jobs: Vec<(ModelKind, Job<'_>)> = args.models.iter().map(|&kind| (kind, job(args, kind))).collect();
    if args.dry_run {
        return plan(args, &jobs, console);
    }
    let rows = jobs
        .iter()
        .map(|(kind, job)| Ok((*kind, job.measure(&args.work, console)?)))
        .collect::<Result<Vec<(ModelKind, Row)>, Failure>>()?;
    let header = [
        "model",
        "parameters",
        "steps",
        "fit s",
        "CPU s",
        "peak MiB",
        "training rays dB",
        "PSNR dB",
        "MS-SSIM",
        "LPIPS",
        "paper: PSNR",
        "MS-SSIM",
        "LPIPS",
    ];
    let cells: Vec<Vec<String>> = rows.iter().map(|(kind, row)| cells(*kind, row)).collect();
    let only: Vec<&Row> = rows.iter().map(|(_, row)| row).collect();
    let table = rows::write(&args.work, "table2", &header, &cells, &only)?;
    console.finish(&only, table.trim_end());
    Ok(())
}

fn job(args: &Args, kind: ModelKind) -> Job<'_> {
    let mut fit: Vec<String> = ["--field", "confies", "--preset"].map(str::to_owned).into();
    fit.push(args.preset.clone());
    fit.extend(["--model".to_owned(), kind.name().to_owned()]);
    fit.extend(["--interval".to_owned(), args.interval.to_string(), "--seed".to_owned(), args.seed.to_string()]);
    if let Some(steps) = args.steps {
        fit.extend(["--steps".to_owned(), steps.to_string()]);
    }
    if let Some(budget) = &args.budget {
        fit.extend(["--budget".to_owned(), budget.clone()]);
    }
    if let Some(scale) = args.image_scale {
        fit.extend(["--image-scale".to_owned(), scale.to_string()]);
    }
    fit.extend(args.set.iter().flat_map(|s| ["--set".to_owned(), s.clone()]));
    let mut eval = vec!["--interpolate".to_owned()];
    eval.extend(args.lpips.iter().flat_map(|l| ["--lpips".to_owned(), l.clone()]));
    Job { name: kind.name().to_owned(), dataset: &args.dataset, fit, eval, resumes: args.steps.is_some() }
}

fn plan(args: &Args, jobs: &[(ModelKind, Job<'_>)], console: &Console) -> Result<(), Failure> {
    let mut planned = Vec::new();
    for (kind, job) in jobs {
        let mut command = job.command(&args.work);
        let shown = format!("trainer {}", command.join(" "));
        command.push("--dry-run".to_owned());
        let words: Vec<&str> = command.iter().map(String::as_str).collect();
        let document = child::run("trainer", &words, &args.work)?.document;
        let secs = document.get("expected").and_then(|e| e.get("expected_secs")).and_then(Value::as_f64);
        planned.push(Planned {
            model: kind.name(),
            command: shown,
            parameters: document.get("parameters").and_then(Value::as_u64).unwrap_or(0),
            expected_secs: if args.budget.is_some() { f64::NAN } else { secs.unwrap_or(f64::NAN) },
        });
    }
    let total: f64 = planned.iter().map(|p| p.expected_secs).sum();
    let line = |p: &Planned| {
        format!("{:12} {:>9} parameters, about {:.0} s: {}", p.model, p.parameters, p.expected_secs, p.command)
    };
    let mut words: Vec<String> = planned.iter().map(line).collect();
    words.push(match &args.budget {
        Some(budget) => format!("{} fits of {budget} each into {}", planned.len(), text(&args.work)),
        None => format!("about {total:.0} s in all, evaluation not counted, into {}", text(&args.work)),
    });
    console.finish(&planned, &words.join("\n"));
    Ok(())
}

fn cells(kind: ModelKind, row: &Row) -> Vec<String> {
    let mean =
        |name: &str, digits: usize| row.means.get(name).map_or_else(|| "–".to_owned(), |v| format!("{v:.digits$}"));
    let lpips = ["lpips_vgg", "lpips_alex"].into_iter().find(|n| row.means.contains_key(*n)).unwrap_or("lpips_vgg");
    let mut cells = vec![
        row.name.clone(),
        row.parameters.to_string(),
        row.steps.to_string(),
        format!("{:.1}", row.wall_secs),
        format!("{:.1}", row.cpu_secs),
        format!("{:.0}", row.peak_mib),
        format!("{:.2}", row.train_psnr_db),
        mean("psnr_db", 2),
        mean("ms_ssim", 4),
        mean(lpips, 4),
    ];
    match of_paper(kind) {
        Some([psnr, ssim, lpips]) => {
            cells.extend([format!("{psnr:.2}"), format!("{ssim:.3}"), format!("{lpips:.3}")]);
        }
        None => cells.extend(["–", "–", "–"].map(str::to_owned)),
    }
    cells
}
