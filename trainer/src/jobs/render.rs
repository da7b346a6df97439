//! Renders lists of shots to files.

use std::path::{Path, PathBuf};

use image::ImageEncoder as _;
use image::RgbImage;
use image::codecs::png::{CompressionType, FilterType, PngEncoder};
use risorius_formats::views::ViewList;
use risorius_formats::{Camera, Reporter, Warning, atomic};
use risorius_video::Writer;
use serde::Serialize;

use crate::avatar::{Avatar, Render};
use crate::error::{Result, TrainerError};
use crate::studio::{Look, Studio};

/// One picture to take.
#[derive(Clone, Debug)]
pub struct Shot {
    /// Name of the file without `.png`.
    pub id: String,
    /// The camera.
    pub camera: Camera,
    /// K attributes, −1..1.
    pub attributes: Vec<f32>,
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
    /// Whether `<id>_depth.png` (16 bit, thousandths of a world unit) and `<id>_masks.png` are written as well.
    pub maps: bool,
}

/// What was rendered.
#[derive(Clone, Debug, Serialize)]
pub struct RenderSummary {
    /// Pictures rendered now.
    pub rendered: usize,
    /// Wall seconds.
    pub seconds: f64,
    /// Seconds per picture.
    pub seconds_per_picture: f64,
    /// The folder with the pictures.
    pub folder: Option<PathBuf>,
    /// The video.
    pub video: Option<PathBuf>,
}

/// The shots of a view list; AUs that the avatar does not know are warned about once.
pub fn shots_of_views(avatar: &Avatar, views: &ViewList, reporter: &dyn Reporter) -> Vec<Shot> {
    let mut unknown = std::collections::BTreeSet::new();
    let shots = views
        .views
        .iter()
        .map(|view| {
            let (attributes, missing) = avatar.attributes_from_intensities(&view.aus);
            unknown.extend(missing);
            Shot { id: view.id.clone(), camera: Camera::from(&view.camera), attributes }
        })
        .collect();
    warn_unknown(&unknown, reporter);
    shots
}

/// Tells which AUs have no effect.
pub fn warn_unknown(unknown: &std::collections::BTreeSet<risorius_formats::ActionUnit>, reporter: &dyn Reporter) {
    for unit in unknown {
        let message = format!("`{unit}` ({}) never moved in the capture; it stays neutral", unit.facs_name());
        reporter.warn(Warning::new("inactive-au", message));
    }
}

/// Renders every shot; `adorn` may change or extend a picture before it is written.
pub fn render(
    avatar: &Avatar,
    shots: &[Shot],
    sink: &Sink,
    reporter: &dyn Reporter,
    mut adorn: impl FnMut(usize, RgbImage) -> Result<RgbImage>,
) -> Result<RenderSummary> {
    let started = std::time::Instant::now();
    let mut writer: Option<Writer> = None;
    let mut studio = Studio::new(avatar, sink.look);
    reporter.stage("render", Some(shots.len() as u64));
    for (i, shot) in shots.iter().enumerate() {
        if reporter.cancelled() {
            return Err(TrainerError::Interrupted { done: format!("{i} of {} pictures", shots.len()) });
        }
        let (picture, maps) = studio.picture_and_maps(&shot.camera, &shot.attributes, reporter)?;
        let picture = adorn(i, picture)?;
        if let Some(folder) = &sink.folder {
            write_png(&folder.join(format!("{}.png", shot.id)), &picture)?;
            if sink.maps {
                write_maps(folder, &shot.id, &maps)?;
            }
        }
        if let Some((path, fps)) = &sink.video {
            if writer.is_none() {
                writer = Some(Writer::create(path, picture.width(), picture.height(), *fps)?);
            }
            if let Some(writer) = &mut writer {
                writer.push(&picture)?;
            }
        }
        reporter.advance(1);
    }
    if let Some(writer) = writer {
        writer.finish()?;
    }
    let seconds = started.elapsed().as_secs_f64();
    Ok(RenderSummary {
        rendered: shots.len(),
        seconds,
        seconds_per_picture: seconds / shots.len().max(1) as f64,
        folder: sink.folder.clone(),
        video: sink.video.as_ref().map(|(path, _)| path.clone()),
    })
}

/// Writes depth and masks of a view beside its picture.
fn write_maps(folder: &Path, id: &str, render: &Render) -> Result<()> {
    let (width, height) = render.rgb.dimensions();
    let depth: Vec<u8> =
        render.depth.iter().flat_map(|d| ((d * 1000.0).round().clamp(0.0, 65535.0) as u16).to_ne_bytes()).collect();
    let path = folder.join(format!("{id}_depth.png"));
    write_pixels(&path, &depth, (width, height), image::ExtendedColorType::L16)?;
    let byte = |n: usize, i: usize| render.masks.get(n).map_or(0, |m| (m[i].clamp(0.0, 1.0) * 255.0).round() as u8);
    let masks: Vec<u8> = (0..render.depth.len()).flat_map(|i| [byte(0, i), byte(1, i), byte(2, i)]).collect();
    write_pixels(&folder.join(format!("{id}_masks.png")), &masks, (width, height), image::ExtendedColorType::Rgb8)
}

/// Writes a PNG, whole or not at all.
pub fn write_png(path: &Path, image: &RgbImage) -> Result<()> {
    write_pixels(path, image.as_raw(), image.dimensions(), image::ExtendedColorType::Rgb8)
}

fn write_pixels(
    path: &Path,
    pixels: &[u8],
    (width, height): (u32, u32),
    color: image::ExtendedColorType,
) -> Result<()> {
    let mut bytes = Vec::new();
    PngEncoder::new_with_quality(&mut bytes, CompressionType::Fast, FilterType::Adaptive)
        .write_image(pixels, width, height, color)
        .map_err(|e| TrainerError::Image { path: path.to_owned(), message: e.to_string() })?;
    Ok(atomic::write_file(path, &bytes)?)
}
