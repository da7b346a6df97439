//! Renders lists of shots to files. A folder of pictures knows what it is made of (`render.json`), so that a render that was
//! stopped goes on where it was, and never mixes two lists.

use std::path::{Path, PathBuf};

use glam::{DVec2, DVec3};
use image::codecs::png::{CompressionType, FilterType, PngEncoder};
use image::{ExtendedColorType, ImageEncoder as _, RgbImage};
use risorius_formats::pose_report::{json_error, write_json};
use risorius_formats::views::ViewList;
use risorius_formats::{Camera, FormatError, Reporter, Warning, atomic, hash};
use risorius_video::Writer;
use serde::{Deserialize, Serialize};

use crate::avatar::Avatar;
use crate::cutout;
use crate::error::{Result, TrainerError};
use crate::expression::{Expression, Unseen};
use crate::field::{Look, Outputs, Render};
use crate::studio::Studio;

/// One picture to take.
#[derive(Clone, Debug)]
pub struct Shot {
    /// Name of the file without `.png`.
    pub id: String,
    /// The camera.
    pub camera: Camera,
    /// The face.
    pub expression: Expression,
}

/// Where pictures go.
#[derive(Clone, Debug, Default)]
pub struct Sink {
    /// A folder for `<id>.png`.
    pub folder: Option<PathBuf>,
    /// A video of all pictures in order, with its frame rate.
    pub video: Option<(PathBuf, f64)>,
    /// How pictures are taken.
    pub look: Look,
    /// What is written beside pictures.
    pub maps: Maps,
    /// Whether pictures that lie in the folder from a render before, of the same list, are kept.
    pub resume: bool,
}

/// What is written beside pictures.
#[derive(Clone, Copy, Debug, Default)]
pub struct Maps {
    /// `<id>_depth.png`: 16 bit, thousandths of a world unit along the ray, 0 where there is no head.
    pub depth: bool,
    /// `<id>_masks.png`: the first three regions as red, green, blue.
    pub masks: bool,
    /// Whether pictures are RGBA and show the head alone: its own colours, straight, and its opacity.
    pub alpha: bool,
}

/// `render.json`: what a folder of pictures is made of.
#[derive(Debug, PartialEq, Serialize, Deserialize)]
struct Made {
    version: u32,
    /// Hash over ids, cameras, expressions, and how pictures are taken.
    shots_sha256: String,
    pictures: usize,
    /// Whether all of them are there.
    finished: bool,
}

/// What was rendered.
#[derive(Clone, Debug, Serialize)]
pub struct RenderSummary {
    /// Pictures rendered now.
    pub rendered: usize,
    /// Pictures that were there already.
    pub kept: usize,
    /// Wall seconds.
    pub seconds: f64,
    /// Seconds per picture.
    pub seconds_per_picture: f64,
    /// The folder with the pictures.
    pub folder: Option<PathBuf>,
    /// The video.
    pub video: Option<PathBuf>,
}

/// The shots of a view list; what the capture does not show is warned about once.
pub fn shots_of_views(avatar: &Avatar, views: &ViewList, reporter: &dyn Reporter) -> Vec<Shot> {
    let mut unseen = Unseen::default();
    let shots: Vec<Shot> = views
        .views
        .iter()
        .map(|view| {
            let expression = unseen.expression(&avatar.saved.table, &view.aus);
            Shot { id: view.id.clone(), camera: Camera::from(&view.camera), expression }
        })
        .collect();
    unseen.warn(reporter);
    let past = shots.iter().filter(|shot| !shows(&shot.camera, avatar.saved.center_in_world)).count();
    if 2 * past > shots.len() {
        let message = format!(
            "{past} of {} views look past the avatar's head: are their cameras of the world that it was fitted in? COLMAP gives \
             every capture a world of its own; `tracker poses --colmap-model` takes cameras that are known",
            shots.len()
        );
        reporter.warn(Warning::new("other-world", message));
    }
    shots
}

/// Whether a point lies in the picture.
fn shows(camera: &Camera, point_in_world: DVec3) -> bool {
    let at = camera.project(point_in_world);
    let size = DVec2::new(f64::from(camera.intrinsics.width), f64::from(camera.intrinsics.height));
    camera.camera_from_world.transform_point(point_in_world).z > 0.0
        && at.cmpge(DVec2::ZERO).all()
        && at.cmple(size).all()
}

/// Renders every shot.
pub fn render(avatar: &Avatar, shots: &[Shot], sink: &Sink, reporter: &dyn Reporter) -> Result<RenderSummary> {
    let started = std::time::Instant::now();
    let mut writer: Option<Writer> = None;
    let outputs = Outputs { depth: sink.maps.depth, masks: sink.maps.masks, head: sink.maps.alpha };
    let mut studio = Studio::new(avatar, Look { outputs, ..sink.look });
    let made = sink.folder.as_ref().map(|folder| begin(folder, avatar, shots, sink)).transpose()?;
    let mut kept = 0;
    reporter.stage("render", Some(shots.len() as u64));
    for (i, shot) in shots.iter().enumerate() {
        if reporter.cancelled() {
            return Err(TrainerError::Interrupted { done: format!("{i} of {} pictures", shots.len()) });
        }
        let there = sink.folder.as_ref().filter(|folder| sink.resume && is_whole(folder, &shot.id, sink.maps));
        let picture = if let Some(folder) = there {
            kept += 1;
            // Only a video needs it again.
            sink.video.as_ref().map(|_| crate::data::read_rgb(&folder.join(format!("{}.png", shot.id)))).transpose()?
        } else {
            let (picture, render) = studio.picture_and_maps(&shot.camera, &shot.expression, reporter)?;
            if let Some(folder) = &sink.folder {
                write_maps(folder, &shot.id, &render, sink.maps)?;
                let path = folder.join(format!("{}.png", shot.id));
                // Last: a picture that is there has its maps.
                if sink.maps.alpha {
                    let cut = cutout::straight(&render.head, render.rgb.dimensions(), picture.dimensions());
                    write_pixels(&path, cut.as_raw(), picture.dimensions(), ExtendedColorType::Rgba8)?;
                } else {
                    write_png(&path, &picture)?;
                }
            }
            Some(picture)
        };
        if let (Some((path, fps)), Some(picture)) = (&sink.video, &picture) {
            if writer.is_none() {
                writer = Some(Writer::create(path, picture.width(), picture.height(), *fps)?);
            }
            if let Some(writer) = &mut writer {
                writer.push(picture)?;
            }
        }
        reporter.advance(1);
    }
    if let Some(writer) = writer {
        writer.finish()?;
    }
    if let (Some(folder), Some(made)) = (&sink.folder, made) {
        write_json(folder.join(MADE), &Made { finished: true, ..made })?;
    }
    let seconds = started.elapsed().as_secs_f64();
    let rendered = shots.len() - kept;
    Ok(RenderSummary {
        rendered,
        kept,
        seconds,
        seconds_per_picture: seconds / rendered.max(1) as f64,
        folder: sink.folder.clone(),
        video: sink.video.as_ref().map(|(path, _)| path.clone()),
    })
}

/// The name of the note in a folder of pictures.
const MADE: &str = "render.json";

/// Notes what the folder is made of; an error where a render of another list would be gone on with.
fn begin(folder: &Path, avatar: &Avatar, shots: &[Shot], sink: &Sink) -> Result<Made> {
    let made = Made { version: 1, shots_sha256: digest(avatar, shots, sink), pictures: shots.len(), finished: false };
    let path = folder.join(MADE);
    if sink.resume && path.is_file() {
        let bytes = std::fs::read(&path).map_err(|e| FormatError::io(&path, "read", &e))?;
        let before: Made = serde_json::from_slice(&bytes).map_err(|e| json_error(&e).in_file(&path))?;
        if before.shots_sha256 != made.shots_sha256 {
            return Err(TrainerError::Run {
                path: folder.to_owned(),
                message: "holds pictures of another list, another avatar or other options".to_owned(),
                hint: "leave `--resume` out to make them anew, or name another folder".to_owned(),
            });
        }
    }
    write_json(&path, &made)?;
    Ok(made)
}

fn digest(avatar: &Avatar, shots: &[Shot], sink: &Sink) -> String {
    use std::fmt::Write as _;
    let mut text = format!("{:?} {:?} {:?}\n", avatar.saved.default_camera, avatar.saved.table, sink.maps);
    let _ = writeln!(text, "{:?}", sink.look);
    for shot in shots {
        let _ = writeln!(text, "{} {:?} {:?}", shot.id, shot.camera, shot.expression);
    }
    hash::sha256_of_bytes(text.as_bytes())
}

fn is_whole(folder: &Path, id: &str, maps: Maps) -> bool {
    let has = |ending: &str| folder.join(format!("{id}{ending}.png")).is_file();
    has("") && (!maps.depth || has("_depth")) && (!maps.masks || has("_masks"))
}

/// Writes depth and masks of a view beside its picture.
fn write_maps(folder: &Path, id: &str, render: &Render, maps: Maps) -> Result<()> {
    let size = render.rgb.dimensions();
    if maps.depth {
        let level = |d: &f32| ((d * 1000.0).round().clamp(0.0, 65535.0) as u16).to_ne_bytes();
        let depth: Vec<u8> = render.depth.iter().flat_map(level).collect();
        write_pixels(&folder.join(format!("{id}_depth.png")), &depth, size, ExtendedColorType::L16)?;
    }
    if maps.masks {
        let byte = |n: usize, i: usize| render.masks.get(n).map_or(0, |m| (m[i].clamp(0.0, 1.0) * 255.0).round() as u8);
        let masks: Vec<u8> =
            (0..size.0 as usize * size.1 as usize).flat_map(|i| [byte(0, i), byte(1, i), byte(2, i)]).collect();
        write_pixels(&folder.join(format!("{id}_masks.png")), &masks, size, ExtendedColorType::Rgb8)?;
    }
    Ok(())
}

/// Writes a PNG, whole or not at all.
pub fn write_png(path: &Path, image: &RgbImage) -> Result<()> {
    write_pixels(path, image.as_raw(), image.dimensions(), ExtendedColorType::Rgb8)
}

fn write_pixels(path: &Path, pixels: &[u8], (width, height): (u32, u32), color: ExtendedColorType) -> Result<()> {
    let mut bytes = Vec::new();
    PngEncoder::new_with_quality(&mut bytes, CompressionType::Fast, FilterType::Adaptive)
        .write_image(pixels, width, height, color)
        .map_err(|e| TrainerError::Image { path: path.to_owned(), message: e.to_string() })?;
    Ok(atomic::write_file(path, &bytes)?)
}
