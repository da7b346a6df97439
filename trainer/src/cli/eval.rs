//! `trainer eval`.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use risorius_console::{AgainArgs, Console, Failure, Inputs, Stage};
use risorius_formats::intensities::Intensities;
use risorius_formats::nerfies::{Dataset, rgb_path};
use risorius_formats::pose_report::write_json;
use risorius_formats::views::{View, ViewCamera, ViewList};
use risorius_formats::{ActionUnit, Attribute, AttributeTable, Warning};
use serde::Serialize;
use serde_json::json;

use super::{DeviceArgs, SkipArgs, need, run_inputs};
use crate::avatar::Avatar;
use crate::data::{intensities_of, read_rgb};
use crate::error::TrainerError;
use crate::eval::control::{Control, Decoupling};
use crate::eval::report::{self, Report};
use crate::eval::{Evaluation, Lpips, LpipsNetwork, lpips};
use crate::field::Look;
use crate::jobs::control::{ControlSettings, control, control_csv, decoupling, default_tracker, write_text};
use crate::jobs::evaluate::{Judged, evaluate};
use crate::jobs::interpolate;

/// Options of `trainer eval`.
#[derive(Debug, clap::Args)]
#[command(
    after_help = "Examples:\n  trainer eval runs/ada --views test/views.json\n  trainer eval runs/ada                                  the dataset's validation frames: the interpolation protocol where it was built with every other frame\n  trainer eval runs/ada --interpolate                    the same with codes between neighbours instead of AUs\n  trainer eval runs/ada --views test/views.json --renders renders\n  trainer eval runs/ada --views test/views.json --lpips alex --control --decoupling\n\nWrites eval.json, views.csv and report.html into RUN/eval, and control.csv with `--control`."
)]
pub(super) struct EvalArgs {
    /// The run's folder
    run: PathBuf,
    /// Views with true images [default: the dataset's validation frames]
    #[arg(long, value_name = "VIEWS.json")]
    views: Option<PathBuf>,
    /// Render validation frames with the codes between their neighbours', and the attributes these codes give, instead
    /// of the annotated AUs: the paper's interpolation test, of `--field confies` only
    #[arg(long, conflicts_with_all = ["views", "no_views"])]
    interpolate: bool,
    /// Score pictures that `trainer render` made before, instead of rendering
    #[arg(long, value_name = "DIR", requires = "views")]
    renders: Option<PathBuf>,
    /// LPIPS networks: alex, vgg or none; may be repeated [default: those that are fetched]
    #[arg(long, value_name = "NAME", value_delimiter = ',', value_parser = ["alex", "vgg", "none"])]
    lpips: Vec<String>,
    /// Also sweep each AU, have `tracker run` read the renders again, and report ICC and cross-talk
    #[arg(long)]
    control: bool,
    /// Levels of a sweep, each on the way up and down [default: 11]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(2..=101), requires = "control")]
    control_steps: Option<u32>,
    /// Views that AUs are swept in: the avatar's own, then to its sides [default: 1]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=5), requires = "control")]
    control_views: Option<u32>,
    /// AUs that the tracker can read, for a mean over them [default: all]
    #[arg(long, value_name = "AU12,…", value_delimiter = ',', requires = "control")]
    readable: Vec<ActionUnit>,
    /// Also measure what each AU changes outside its region's mask
    #[arg(long)]
    decoupling: bool,
    /// Only `--control` and `--decoupling`, no comparison with true images
    #[arg(long, conflicts_with_all = ["views", "renders"])]
    no_views: bool,
    /// Where results go [default: RUN/eval]
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Folder with the networks of LPIPS and of the tracker [default: where `tools/models` puts them]
    #[arg(long, value_name = "DIR")]
    models: Option<PathBuf>,
    /// The program `tracker` [default: the one beside this program]
    #[arg(long, value_name = "FILE")]
    tracker: Option<PathBuf>,
    #[command(flatten)]
    again: AgainArgs,
    #[command(flatten)]
    skips: SkipArgs,
    #[command(flatten)]
    device: DeviceArgs,
}

/// All that was measured: the scores stand at the top level.
#[derive(Serialize)]
struct Document {
    #[serde(flatten)]
    evaluation: Option<Evaluation>,
    #[serde(skip_serializing_if = "Option::is_none")]
    control: Option<Control>,
    #[serde(skip_serializing_if = "Option::is_none")]
    decoupling: Option<Decoupling>,
    report: PathBuf,
}

pub(super) fn run(args: &EvalArgs, console: &Console) -> Result<(), Failure> {
    need(&args.run, "a run made by `trainer fit`")?;
    if args.no_views && !(args.control || args.decoupling) {
        return Err(Failure::usage("nothing to do: `--no-views` goes with `--control` or `--decoupling`"));
    }
    let views = match (&args.views, args.no_views) {
        (_, true) => None,
        (Some(path), _) => Some((ViewList::read(path)?, path.clone())),
        (None, _) => Some(validation_views(&args.run)?),
    };
    let folder = args.out.clone().unwrap_or_else(|| args.run.join("eval"));
    let models = args.models.clone().unwrap_or_else(lpips::default_dir);
    let there = [LpipsNetwork::Alex, LpipsNetwork::Vgg].map(|n| Lpips::is_in(&models, n));
    let asked = json!({
        "lpips": args.lpips,
        "networks": there,
        "control": args.control,
        "control_steps": args.control_steps,
        "control_views": args.control_views,
        "readable": args.readable.iter().map(ToString::to_string).collect::<Vec<_>>(),
        "decoupling": args.decoupling,
        "no_skip": args.skips.no_skip,
    });
    let stage = Stage::new("trainer eval", &folder, &asked)?;
    let inputs = inputs(args, views.as_ref());
    let Some(running) = stage.begin(args.again, inputs, console)? else { return Ok(()) };
    let mut networks = if views.is_some() { open_networks(args, &models, console)? } else { Vec::new() };
    let avatar = if args.renders.is_none() || args.control || args.decoupling {
        Some(Avatar::open(&args.run, &args.device.device()?)?)
    } else {
        None
    };
    if let Some(avatar) = avatar.as_ref().filter(|_| !args.interpolate) {
        super::warn_if_unsteered(avatar, console);
    }
    let renders = args.renders.clone().unwrap_or_else(|| folder.join("renders"));
    let evaluation = match (&views, &avatar) {
        (None, _) => None,
        (Some((views, list)), Some(avatar)) if args.interpolate => {
            let dataset = Dataset::read(list.parent().unwrap_or(Path::new(".")))?;
            let places = interpolate::places(avatar, &args.run, &dataset)?;
            Some(evaluate(views, list, Judged::Between(avatar, &places, &renders), &mut networks, console)?)
        }
        (Some((views, list)), Some(avatar)) if args.renders.is_none() => {
            let look = Look { skips: args.skips.skips()?, ..Look::default() };
            Some(evaluate(views, list, Judged::Avatar(avatar, look, &renders), &mut networks, console)?)
        }
        (Some((views, list)), _) => Some(evaluate(views, list, Judged::Folder(&renders), &mut networks, console)?),
    };
    let decoupled = match &avatar {
        Some(avatar) if args.decoupling => Some(decoupling(avatar, &folder.join("decoupling"), console)?),
        _ => None,
    };
    let controlled = match &avatar {
        Some(avatar) if args.control => {
            let settings = ControlSettings {
                steps: args.control_steps.unwrap_or(11) as usize,
                views: args.control_views.unwrap_or(1) as usize,
                readable: args.readable.clone(),
                tracker: args.tracker.clone().unwrap_or_else(default_tracker),
                models: args.models.clone(),
            };
            // Its settings only name the tracker: if that cannot run, it cannot for any avatar.
            let broken = |e: TrainerError| {
                let is_tracker = matches!(e, TrainerError::Setting { .. });
                let failure = Failure::from(e);
                if is_tracker { failure.of_installation() } else { failure }
            };
            Some(control(avatar, &settings, &folder.join("control"), console).map_err(broken)?)
        }
        _ => None,
    };
    if let Some(control) = &controlled {
        write_text(&folder.join("control.csv"), &control_csv(control))?;
    }
    if let Some(evaluation) = &evaluation {
        write_text(&folder.join("views.csv"), &report::csv(evaluation))?;
    }
    let name = args.run.canonicalize().ok().and_then(|p| Some(p.file_name()?.to_string_lossy().into_owned()));
    let page = Report {
        name: name.as_deref().unwrap_or("avatar"),
        evaluation: evaluation.as_ref(),
        control: controlled.as_ref(),
        decoupling: decoupled.as_ref(),
    };
    let pair = |i: usize| {
        let (views, list) = views.as_ref()?;
        let view = views.views.iter().filter(|v| v.image.is_some()).nth(i)?;
        let truth = list.parent().unwrap_or(Path::new(".")).join(view.image.as_deref()?);
        Some((read_rgb(&renders.join(format!("{}.png", view.id))).ok()?, read_rgb(&truth).ok()?))
    };
    write_text(&folder.join("report.html"), &page.html(pair)?)?;
    let report = folder.join("report.html");
    let document = Document { evaluation, control: controlled, decoupling: decoupled, report };
    write_json(folder.join("eval.json"), &document)?;
    running.finish(&["eval.json", "report.html"])?;
    console.finish(&document, &human(&document));
    Ok(())
}

/// What an evaluation reads: the avatar, the list of views and the true pictures, or the pictures to be judged.
fn inputs(args: &EvalArgs, views: Option<&(ViewList, PathBuf)>) -> Inputs {
    let mut inputs = run_inputs(Inputs::default(), "", &args.run);
    if let Some((list, path)) = views {
        let base = path.parent().unwrap_or(Path::new(".")).to_owned();
        let wanted: std::collections::BTreeSet<String> =
            list.views.iter().filter_map(|v| Some(v.image.as_ref()?.to_string_lossy().into_owned())).collect();
        inputs = inputs.file("views", path).folder("pictures", base, |name| wanted.contains(name));
    }
    match &args.renders {
        Some(renders) => {
            inputs.folder("renders", renders, |name| Path::new(name).extension().is_some_and(|e| e == "png"))
        }
        None => inputs,
    }
}

fn open_networks(args: &EvalArgs, models: &Path, console: &Console) -> Result<Vec<(LpipsNetwork, Lpips)>, Failure> {
    use risorius_formats::Reporter as _;
    let all = [LpipsNetwork::Alex, LpipsNetwork::Vgg];
    let wanted: Vec<LpipsNetwork> = if args.lpips.is_empty() {
        let there: Vec<LpipsNetwork> = all.into_iter().filter(|n| Lpips::is_in(models, *n)).collect();
        if there.is_empty() {
            let message = "LPIPS is left out: its networks are not here; `tools/models --metrics` fetches them";
            console.warn(Warning::new("no-lpips", message));
        }
        there
    } else {
        all.into_iter().filter(|n| args.lpips.iter().any(|l| l == n.name())).collect()
    };
    let opened = wanted.into_iter().map(|n| Ok((n, Lpips::open(models, n)?))).collect::<Result<_, TrainerError>>();
    // Unless the user named the folder.
    opened.map_err(|e| if args.models.is_some() { e.into() } else { Failure::from(e).of_installation() })
}

fn human(document: &Document) -> String {
    let mut text = String::new();
    let row = |name: &str, psnr: f64| format!("{name:>30}  {psnr:6.2} dB");
    if let Some(evaluation) = &document.evaluation {
        for (kind, parts) in &evaluation.mean_parts_psnr_db {
            for (part, psnr) in parts {
                let _ = writeln!(text, "{}", row(&format!("{kind}: {part}"), *psnr));
            }
        }
        for (kind, psnr) in &evaluation.mean_psnr_db_by_kind {
            let _ = writeln!(text, "{}", row(kind, *psnr));
        }
        for (name, value) in evaluation.means.get("all").into_iter().flatten().filter(|(n, _)| *n != "psnr_db") {
            let unit = if name.ends_with("_mm") { " mm" } else { "" };
            let _ = writeln!(text, "{:>30}  {value:8.4}{unit}", format!("mean {}", name.trim_end_matches("_mm")));
        }
        let _ = writeln!(text, "{}  ({} views)", row("mean PSNR", evaluation.mean_psnr_db), evaluation.views.len());
    }
    if let Some(d) = &document.decoupling {
        let _ = writeln!(
            text,
            "{:>30}  {} levels of 255 at most outside an AU's mask, {:.4} on average",
            "decoupling", d.outside_max, d.outside_mean
        );
    }
    if let Some(c) = &document.control {
        for u in &c.units {
            let icc = u.sweep.map_or_else(|| "     –".to_owned(), |i| format!("{:6.3}", i.icc_3_1));
            let _ = writeln!(text, "{:>30}  {icc}", format!("{} {}", u.unit, u.name));
        }
        let _ = writeln!(
            text,
            "{:>30}  {:6.3}  (readable AUs {:.3}, cross-talk {:.3})",
            "mean control ICC(3,1)", c.mean_icc_3_1, c.mean_readable_icc_3_1, c.mean_cross_talk
        );
    }
    let _ = writeln!(text, "{:>30}  {}", "report", document.report.display());
    text
}

/// The dataset's held-out frames as a view list: their cameras, their images, and their AUs: the intensities that frames
/// for fitting are fitted with, and where the dataset does not tell them, those of the annotated attributes.
fn validation_views(run: &Path) -> Result<(ViewList, PathBuf), TrainerError> {
    let manifest = risorius_formats::run::RunManifest::read(run.join("run.json"))?;
    let saved = crate::saved::SavedModel::read(run)?;
    let dataset = Dataset::read(&manifest.dataset)?;
    let scale = saved.image_scale;
    let table = &saved.table;
    let mut views = Vec::new();
    let intensities = Intensities::read(&manifest.dataset)?;
    let (_, held_out) = crate::data::split(&dataset, interpolate::interval_of(run));
    for id in &held_out {
        let Some(camera) = dataset.cameras.get(id) else { continue };
        let aus = aus_of(&dataset, intensities.as_ref(), table, id);
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

/// The intensities of a frame as they would be fitted, else those of its annotated attributes.
fn aus_of(
    dataset: &Dataset,
    intensities: Option<&Intensities>,
    table: &AttributeTable,
    id: &str,
) -> BTreeMap<ActionUnit, f32> {
    let known = intensities.and_then(|i| intensities_of(i, table, id));
    if let Some(row) = known {
        return table.attributes.iter().zip(row).filter(|(a, _)| a.active).map(|(a, v)| (a.unit, v.0)).collect();
    }
    let number = id.parse::<u32>().ok();
    let of_frame = dataset.annotations.iter().filter(|a| Some(a.frame) == number);
    of_frame
        .filter_map(|a| {
            let spec = table.attributes.get(a.class)?;
            Some((spec.unit, spec.scale().intensity(Attribute(a.value)).0))
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use risorius_formats::nerfies::Annotation;
    use risorius_formats::{AttributeSpec, Intensity, SceneBounds};

    use super::*;

    #[test]
    fn a_strong_expression_is_judged_as_it_was_fitted() {
        let unit = ActionUnit(12);
        let spec = AttributeSpec::from_range(unit, 0, 0.0, 5.0, 0.0);
        let value = spec.scale().attribute(Intensity(4.5)).0;
        let dataset = Dataset {
            ids: vec!["000007".to_owned()],
            train_ids: Vec::new(),
            val_ids: Vec::new(),
            metadata: BTreeMap::new(),
            scene: SceneBounds { center_in_world: glam::DVec3::ZERO, scale: 1.0, near: 1.0, far: 2.0 },
            cameras: BTreeMap::new(),
            mapping: Vec::new(),
            annotations: vec![Annotation { class: 0, frame: 7, value }],
            extras: None,
        };
        let table = AttributeTable { regions: vec!["mouth".to_owned()], attributes: vec![spec] };
        let intensities = Intensities { units: vec![unit], rows: [("000007".to_owned(), vec![4.5])].into() };
        assert_eq!(aus_of(&dataset, Some(&intensities), &table, "000007"), [(unit, 4.5)].into());
        // Attributes alone end at 80 % of the strongest.
        assert_eq!(aus_of(&dataset, None, &table, "000007"), [(unit, 4.0)].into());
    }
}
