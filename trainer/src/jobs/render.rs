//! Renders lists of shots to files, and compares them with the truth.

use std::path::{Path, PathBuf};

use image::ImageEncoder as _;
use image::RgbImage;
use image::codecs::png::{CompressionType, FilterType, PngEncoder};
use risorius_formats::views::ViewList;
use risorius_formats::{Camera, FormatError, Reporter, Warning, atomic};
use risorius_video::Writer;
use serde::Serialize;

use crate::avatar::Avatar;
use crate::error::{Result, TrainerError};
use crate::eval::{self, Evaluation, ViewScore};

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
    /// Whether every pixel is rendered, also where the view is finer than the fitted images.
    pub full: bool,
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
    reporter.stage("render", Some(shots.len() as u64));
    for (i, shot) in shots.iter().enumerate() {
        if reporter.cancelled() {
            return Err(TrainerError::Interrupted { done: format!("{i} of {} pictures", shots.len()) });
        }
        let picture = adorn(i, avatar.picture(&shot.camera, &shot.attributes, sink.full, reporter)?)?;
        if let Some(folder) = &sink.folder {
            write_png(&folder.join(format!("{}.png", shot.id)), &picture)?;
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

/// Writes a PNG, whole or not at all.
pub fn write_png(path: &Path, image: &RgbImage) -> Result<()> {
    let mut bytes = Vec::new();
    PngEncoder::new_with_quality(&mut bytes, CompressionType::Fast, FilterType::Adaptive)
        .write_image(image.as_raw(), image.width(), image.height(), image::ExtendedColorType::Rgb8)
        .map_err(|e| TrainerError::Image { path: path.to_owned(), message: e.to_string() })?;
    Ok(atomic::write_file(path, &bytes)?)
}

/// Compares the renders in `renders` with the true images that the list names.
pub fn evaluate(views: &ViewList, list_path: &Path, renders: &Path) -> Result<Evaluation> {
    let base = list_path.parent().unwrap_or(Path::new("."));
    let mut scores = Vec::new();
    for view in &views.views {
        let Some(truth) = &view.image else { continue };
        let render = crate::data::read_rgb(&renders.join(format!("{}.png", view.id)))?;
        scores.push(ViewScore {
            id: view.id.clone(),
            kind: view.kind.clone(),
            psnr_db: eval::score(&render, &base.join(truth))?,
        });
    }
    Evaluation::new(scores).ok_or_else(|| {
        FormatError::new(risorius_formats::ErrorKind::Missing, "names no true image to compare with")
            .in_file(list_path)
            .with_hint("a view's `image` names the true picture, relative to the list")
            .into()
    })
}
