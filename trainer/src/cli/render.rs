//! `trainer render`.

use std::path::PathBuf;

use risorius_console::{Console, Failure};
use risorius_formats::curves::interpolate;
use risorius_formats::views::ViewList;
use risorius_formats::{ActionUnit, Camera};
use serde::Serialize;

use super::{DeviceArgs, SkipArgs, need, parse_au};
use crate::avatar::Avatar;
use crate::expression::{Expression, Unseen};
use crate::field::Look;
use crate::jobs::render::{Maps, Shot, Sink, render, shots_of_views};
use crate::jobs::transfer::Driver;
use crate::path::{self, CameraPath};
use crate::presets::{PRESETS, Preset};

/// Options of `trainer render`.
#[derive(Debug, clap::Args)]
#[command(
    after_help = "Examples:\n  trainer render runs/ada --views test/views.json --out renders\n  trainer render runs/ada --au AU12=3.5 --au AU02=2 --out smile\n  trainer render runs/ada --preset surprise --orbit 60 --video orbit.mp4\n  trainer render runs/ada --path runs/ada/paths/path_001.toml --out frames --depth --alpha\n  trainer render runs/ada --curves keys.csv --spiral 100 --out frames --resume\n\nA path is a TOML file with `[[key]]`s: `secs`, `orbit = { yaw_deg, pitch_deg, zoom, shift_x, shift_y }`, `aus = { AU12 = 4 }`, `preset = \"smile\"`. Curves are a table `secs,AU12,…`, read at every picture's time."
)]
pub(super) struct RenderArgs {
    /// The run's folder
    run: PathBuf,
    /// Cameras and AUs to render
    #[arg(long, value_name = "VIEWS.json", conflicts_with_all = ["au", "orbit", "spiral", "path", "preset", "curves"])]
    views: Option<PathBuf>,
    /// An AU's intensity 0-5; may be repeated, the others stay neutral
    #[arg(long, value_name = "AU12=3.5", value_parser = parse_au)]
    au: Vec<(ActionUnit, f32)>,
    /// An expression by its name: neutral, smile, surprise, sadness, anger, fear, disgust, contempt, "eyes closed", "open mouth"
    #[arg(long, value_name = "NAME", value_parser = parse_preset)]
    preset: Option<&'static Preset>,
    /// Views on an ellipse around the head
    #[arg(long, value_name = "N", conflicts_with_all = ["spiral", "path"])]
    orbit: Option<usize>,
    /// Views that wind outwards from the middle
    #[arg(long, value_name = "N", conflicts_with = "path")]
    spiral: Option<usize>,
    /// Turns of the spiral [default: 3]
    #[arg(long, value_name = "N", requires = "spiral")]
    turns: Option<f64>,
    /// Keys of cameras and expressions, written by hand or saved from the viewer
    #[arg(long, value_name = "PATH.toml")]
    path: Option<PathBuf>,
    /// AU curves over time, as CSV
    #[arg(long, value_name = "FILE.csv", conflicts_with_all = ["au", "preset"])]
    curves: Option<PathBuf>,
    #[command(flatten)]
    curve_options: super::curves::CurvesArgs,
    /// A folder for the pictures
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// A video of the pictures
    #[arg(long, value_name = "OUT.mp4")]
    video: Option<PathBuf>,
    /// Pictures per second [default: the path's, else 15]
    #[arg(long, value_name = "FPS")]
    fps: Option<f64>,
    /// Render every pixel of a view that is finer than the images that were fitted, where `--field confies` would enlarge
    #[arg(long)]
    full: bool,
    /// Also write depth of every view: 16-bit PNG, thousandths of a world unit along the ray
    #[arg(long, requires = "out")]
    depth: bool,
    /// Also write region masks of every view, as red, green and blue
    #[arg(long, requires = "out")]
    masks: bool,
    /// Depth and masks
    #[arg(long, requires = "out")]
    maps: bool,
    /// Make everything but the head transparent: RGBA whose opacity is the head's, with soft edges; colours are straight
    #[arg(long, requires = "out")]
    alpha: bool,
    /// Keep the pictures that are in the folder from a render that was stopped
    #[arg(long, requires = "out")]
    resume: bool,
    /// Say what would be rendered, without doing it
    #[arg(long)]
    dry_run: bool,
    #[command(flatten)]
    skips: SkipArgs,
    #[command(flatten)]
    device: DeviceArgs,
}

pub(super) fn parse_preset(text: &str) -> Result<&'static Preset, String> {
    Preset::named(text).ok_or_else(|| {
        let names: Vec<&str> = PRESETS.iter().map(|p| p.name).collect();
        format!("presets: {}", names.join(", "))
    })
}

#[derive(Serialize)]
struct Plan {
    pictures: usize,
    width: u32,
    height: u32,
    fps: f64,
}

pub(super) fn run(args: &RenderArgs, console: &Console) -> Result<(), Failure> {
    if args.out.is_none() && args.video.is_none() {
        return Err(Failure::usage("nothing to write: give `--out DIR`, `--video OUT.mp4` or both"));
    }
    if args.fps.is_some_and(|f| !(f.is_finite() && f > 0.0 && f <= 240.0)) {
        return Err(Failure::usage("`--fps` must be above 0, and at most 240"));
    }
    need(&args.run, "a run made by `trainer fit`")?;
    let views = args.views.as_ref().map(ViewList::read).transpose()?;
    let mut keys = args.path.as_ref().map(CameraPath::read).transpose()?;
    if let (Some(keys), Some(fps)) = (&mut keys, args.fps) {
        keys.fps = fps;
    }
    let curve_options = args.curve_options.options()?;
    let curves = args.curves.as_ref().map(|path| Driver::of_table(path, &curve_options, 0.0, console)).transpose()?;
    let avatar = Avatar::open(&args.run, &args.device.device()?)?;
    super::warn_if_unsteered(&avatar, console);
    let fps = keys.as_ref().map_or(args.fps.unwrap_or(15.0), |k| k.fps);
    let shots = match &views {
        Some(views) => shots_of_views(&avatar, views, console),
        None => shots_of_options(&avatar, args, keys.as_ref(), curves.as_ref(), fps, console),
    };
    if args.dry_run {
        let size = shots.first().map_or((0, 0), |s| (s.camera.intrinsics.width, s.camera.intrinsics.height));
        let plan = Plan { pictures: shots.len(), width: size.0, height: size.1, fps };
        let human = format!("{} pictures of {}×{} pixels; nothing was written", plan.pictures, plan.width, plan.height);
        console.finish(&plan, &human);
        return Ok(());
    }
    let sink = Sink {
        folder: args.out.clone(),
        video: args.video.clone().map(|path| (path, fps)),
        look: Look { skips: args.skips.skips()?, full: args.full, ..Look::default() },
        maps: Maps { depth: args.depth || args.maps, masks: args.masks || args.maps, alpha: args.alpha },
        resume: args.resume,
    };
    let summary = render(&avatar, &shots, &sink, console)?;
    let kept = if summary.kept > 0 { format!(", {} kept", summary.kept) } else { String::new() };
    let human = format!(
        "{} pictures in {:.1} s, {:.2} s each{kept}",
        summary.rendered, summary.seconds, summary.seconds_per_picture
    );
    console.finish(&summary, &human);
    Ok(())
}

/// What cameras and expressions say together: the longer of the two lists sets the number of pictures, the shorter one
/// stays at its last.
fn shots_of_options(
    avatar: &Avatar,
    args: &RenderArgs,
    keys: Option<&CameraPath>,
    curves: Option<&Driver>,
    fps: f64,
    console: &Console,
) -> Vec<Shot> {
    let mut unseen = Unseen::default();
    let mut face_of = |aus: &std::collections::BTreeMap<ActionUnit, f32>| unseen.expression(&avatar.saved.table, aus);
    let mut fixed = args.preset.map(Preset::intensities).unwrap_or_default();
    fixed.extend(args.au.iter().copied());
    let reference = Camera::from(&avatar.saved.default_camera);
    let (center, extent) = (avatar.saved.center_in_world, avatar.saved.orbit_rad);
    let moments = keys.map(CameraPath::moments).unwrap_or_default();
    let mut cameras = match (args.orbit, args.spiral) {
        (Some(count), _) => path::orbit(&reference, center, extent, count),
        (None, Some(count)) => path::spiral(&reference, center, extent, args.turns.unwrap_or(3.0), count),
        (None, None) => moments.iter().filter_map(|m| Some(m.orbit?.camera(&reference, center))).collect(),
    };
    if cameras.is_empty() {
        cameras.push(reference);
    }
    let mut faces: Vec<Expression> = moments.iter().filter_map(|m| Some(face_of(m.aus.as_ref()?))).collect();
    if let Some(curves) = curves {
        let last = curves.times_secs.last().copied().unwrap_or(0.0);
        let at = |secs: f64| {
            let value = |values: &Vec<f32>| interpolate(&curves.times_secs, values, secs);
            curves.intensities.iter().map(|(unit, values)| (*unit, value(values))).collect()
        };
        faces = (0..=(last * fps + 1e-6) as usize).map(|i| face_of(&at(i as f64 / fps))).collect();
    }
    if faces.is_empty() || !fixed.is_empty() {
        faces = vec![face_of(&fixed)];
    }
    unseen.warn(console);
    let count = cameras.len().max(faces.len()).max(moments.len());
    (0..count)
        .map(|i| Shot {
            id: if count > 999 { format!("{i:06}") } else { format!("{i:03}") },
            camera: cameras[i.min(cameras.len() - 1)],
            expression: faces[i.min(faces.len() - 1)].clone(),
        })
        .collect()
}
