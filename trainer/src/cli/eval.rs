//! `trainer eval`.

use std::path::PathBuf;

use risorius_console::{Console, Failure};
use risorius_formats::pose_report::write_json;
use risorius_formats::views::{View, ViewCamera, ViewList};

use super::{DeviceArgs, SkipArgs, need};
use crate::avatar::Avatar;
use crate::error::TrainerError;
use crate::jobs::render::{Judged, evaluate};
use crate::studio::Look;

/// Options of `trainer eval`.
#[derive(Debug, clap::Args)]
#[command(
    after_help = "Examples:\n  trainer eval runs/ada --views test/views.json\n  trainer eval runs/ada\n  trainer eval runs/ada --views test/views.json --renders renders"
)]
pub(super) struct EvalArgs {
    /// The run's folder
    run: PathBuf,
    /// Views with true images [default: the dataset's validation frames]
    #[arg(long, value_name = "VIEWS.json")]
    views: Option<PathBuf>,
    /// Score pictures that `trainer render` made before, instead of rendering
    #[arg(long, value_name = "DIR", requires = "views")]
    renders: Option<PathBuf>,
    /// Judge the baked avatar (see `trainer render --baked`)
    #[arg(long)]
    baked: bool,
    #[command(flatten)]
    skips: SkipArgs,
    #[command(flatten)]
    device: DeviceArgs,
}

pub(super) fn run(args: &EvalArgs, console: &Console) -> Result<(), Failure> {
    need(&args.run, "a run made by `trainer fit`")?;
    let (views, list_path) = match &args.views {
        Some(path) => (ViewList::read(path)?, path.clone()),
        None => validation_views(&args.run)?,
    };
    let folder = args.run.join("eval");
    let evaluation = if let Some(renders) = &args.renders {
        evaluate(&views, &list_path, Judged::Folder(renders), console)?
    } else {
        let avatar = Avatar::open(&args.run, &args.device.device()?)?;
        let look = Look { skips: args.skips.skips()?, baked: args.baked, full: false };
        evaluate(&views, &list_path, Judged::Avatar(&avatar, look, &folder.join("renders")), console)?
    };
    write_json(folder.join("eval.json"), &evaluation)?;
    let row = |name: &str, psnr: f64| format!("{name:>30}  {psnr:6.2} dB");
    let mut lines = Vec::new();
    for (kind, parts) in &evaluation.mean_parts_psnr_db {
        lines.extend(parts.iter().map(|(part, psnr)| row(&format!("{kind}: {part}"), *psnr)));
    }
    lines.extend(evaluation.mean_psnr_db_by_kind.iter().map(|(kind, psnr)| row(kind, *psnr)));
    lines.push(format!("{}  ({} views)", row("mean PSNR", evaluation.mean_psnr_db), evaluation.views.len()));
    let human = lines.join("\n");
    console.finish(&evaluation, &human);
    Ok(())
}

/// The dataset's held-out frames as a view list: their cameras, their annotated AUs, their images.
fn validation_views(run: &std::path::Path) -> Result<(ViewList, PathBuf), TrainerError> {
    use risorius_formats::nerfies::{Dataset, rgb_path};
    let manifest = risorius_formats::run::RunManifest::read(run.join("run.json"))?;
    let saved = crate::saved::SavedModel::read(run)?;
    let dataset = Dataset::read(&manifest.dataset)?;
    let scale = saved.image_scale;
    let table = &saved.table;
    let mut views = Vec::new();
    for id in &dataset.val_ids {
        let Some(camera) = dataset.cameras.get(id) else { continue };
        let number = id.parse::<u32>().ok();
        let aus = dataset
            .annotations
            .iter()
            .filter(|a| Some(a.frame) == number && a.class < table.attributes.len())
            .map(|a| (table.attributes[a.class].unit, table.attributes[a.class].intensity_from_attribute(a.value)))
            .collect();
        views.push(View {
            id: id.clone(),
            image: Some(rgb_path("", scale, id)),
            kind: None,
            camera: ViewCamera::from(&camera.reduced(scale)),
            aus,
            depth: None,
        });
    }
    if views.is_empty() {
        return Err(TrainerError::Dataset {
            path: manifest.dataset,
            message: "holds no validation frames".to_owned(),
            hint: "give views with true images: `--views VIEWS.json`".to_owned(),
        });
    }
    // Images are relative to the list's file; the list stands for a file in the dataset's folder.
    Ok((ViewList { views }, manifest.dataset.join("dataset.json")))
}
