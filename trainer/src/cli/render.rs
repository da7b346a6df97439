//! `trainer render`.

use std::path::PathBuf;

use risorius_console::{Console, Failure};
use risorius_formats::views::ViewList;
use risorius_formats::{ActionUnit, Camera};

use super::{DeviceArgs, SkipArgs, need, parse_au};
use crate::avatar::Avatar;
use crate::jobs::render::{Shot, Sink, render, shots_of_views, warn_unknown};
use crate::path;
use crate::studio::Look;

/// Options of `trainer render`.
#[derive(Debug, clap::Args)]
#[command(
    after_help = "Examples:\n  trainer render runs/ada --views test/views.json --out renders\n  trainer render runs/ada --au AU12=3.5 --au AU02=2 --out smile\n  trainer render runs/ada --au AU12=4 --orbit 60 --video orbit.mp4"
)]
pub(super) struct RenderArgs {
    /// The run's folder
    run: PathBuf,
    /// Cameras and AUs to render
    #[arg(long, value_name = "VIEWS.json", conflicts_with_all = ["au", "orbit"])]
    views: Option<PathBuf>,
    /// An AU's intensity 0-5; may be repeated, the others stay neutral
    #[arg(long, value_name = "AU12=3.5", value_parser = parse_au)]
    au: Vec<(ActionUnit, f32)>,
    /// Views on an ellipse around the head
    #[arg(long, value_name = "N")]
    orbit: Option<usize>,
    /// A folder for the pictures
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// A video of the pictures
    #[arg(long, value_name = "OUT.mp4")]
    video: Option<PathBuf>,
    /// Frame rate of the video [default: 15]
    #[arg(long, value_name = "FPS")]
    fps: Option<f64>,
    /// Render every pixel, also where the view is finer than the images that were fitted
    #[arg(long)]
    full: bool,
    /// Bake the expression first: many times faster for many views, with an error that `eval --baked` measures
    #[arg(long)]
    baked: bool,
    /// Also write depth (16-bit PNG, thousandths of a world unit) and region masks (red, green, blue) of every view
    #[arg(long, conflicts_with = "baked", requires = "out")]
    maps: bool,
    #[command(flatten)]
    skips: SkipArgs,
    #[command(flatten)]
    device: DeviceArgs,
}

pub(super) fn run(args: &RenderArgs, console: &Console) -> Result<(), Failure> {
    if args.out.is_none() && args.video.is_none() {
        return Err(Failure::usage("nothing to write: give `--out DIR`, `--video OUT.mp4` or both"));
    }
    need(&args.run, "a run made by `trainer fit`")?;
    let views = args.views.as_ref().map(ViewList::read).transpose()?;
    let avatar = Avatar::open(&args.run, &args.device.device()?)?;
    let shots = match &views {
        Some(views) => shots_of_views(&avatar, views, console),
        None => shots_of_options(&avatar, args, console),
    };
    let fps = args.fps.unwrap_or(15.0);
    let look = Look { skips: args.skips.skips()?, baked: args.baked, full: args.full };
    let sink =
        Sink { folder: args.out.clone(), video: args.video.clone().map(|path| (path, fps)), look, maps: args.maps };
    let summary = render(&avatar, &shots, &sink, console, |_, picture| Ok(picture))?;
    let human =
        format!("{} pictures in {:.1} s, {:.2} s each", summary.rendered, summary.seconds, summary.seconds_per_picture);
    console.finish(&summary, &human);
    Ok(())
}

fn shots_of_options(avatar: &Avatar, args: &RenderArgs, console: &Console) -> Vec<Shot> {
    let (attributes, unknown) = avatar.attributes_from_intensities(&args.au.iter().copied().collect());
    warn_unknown(&unknown.into_iter().collect(), console);
    let reference = Camera::from(&avatar.saved.default_camera);
    let cameras = match args.orbit {
        Some(count) => path::orbit(&reference, avatar.saved.center_in_world, avatar.saved.orbit_rad, count),
        None => vec![reference],
    };
    let shot = |(i, camera)| Shot { id: format!("{i:03}"), camera, attributes: attributes.clone() };
    cameras.into_iter().enumerate().map(shot).collect()
}
