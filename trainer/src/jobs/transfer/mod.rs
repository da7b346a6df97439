//! Expression transfer: the AUs of a second video, or of a table of curves, drive one avatar or several.

mod driver;
mod fit;

use std::path::{Path, PathBuf};

use image::RgbImage;
use image::imageops::{self, FilterType};
use risorius_formats::views::ViewList;
use risorius_formats::{ActionUnit, Camera, ErrorKind, FormatError, Reporter, Take, Warning};
use risorius_video::Writer;
use serde::{Deserialize, Serialize};

pub use driver::Driver;
pub use fit::{DrivenUnit, Fitted};

use super::render::{Sink, write_png};
use crate::avatar::Avatar;
use crate::error::{Result, TrainerError};
use crate::eval::{self, Evaluation, ViewScore};
use crate::expression::Unseen;
use crate::field::{Look, Outputs};
use crate::path::turned;
use crate::studio::Studio;

/// Whose range turns the driver's intensities into the avatar's.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum Range {
    /// The driver's: its strongest smile becomes the avatar's strongest. Evens out people and trackers.
    #[default]
    Driver,
    /// The avatar's: intensity 3 stays intensity 3.
    Avatar,
}

/// How to transfer.
#[derive(Clone, Debug)]
pub struct TransferSettings {
    /// Whose range counts.
    pub range: Range,
    /// Pictures per second of the result: fewer than the driver's take its frames nearest in time, more lie between them.
    pub fps: f64,
    /// Whether the driver is shown beside the avatars, where it has a video.
    pub side_by_side: bool,
    /// Factor on the turns of the head: 0 keeps it still, 1 copies them.
    pub head: f64,
}

/// An avatar with the name of its run.
pub struct Named<'a> {
    /// Its name.
    pub name: String,
    /// The avatar.
    pub avatar: &'a Avatar,
}

/// What a transfer did.
#[derive(Clone, Debug, Serialize)]
pub struct TransferSummary {
    /// Pictures rendered, of each avatar.
    pub pictures: usize,
    /// Wall seconds.
    pub seconds: f64,
    /// Seconds per picture.
    pub seconds_per_picture: f64,
    /// Frames of the driver.
    pub driver_frames: usize,
    /// Frames of the driver without a face, held from their neighbours.
    pub held_frames: usize,
    /// AUs that drive the first avatar.
    pub driven: Vec<ActionUnit>,
    /// Avatar by avatar.
    pub avatars: Vec<DrivenAvatar>,
    /// The video.
    pub video: Option<PathBuf>,
}

/// What became of one avatar.
#[derive(Clone, Debug, Serialize)]
pub struct DrivenAvatar {
    /// Its name.
    pub name: String,
    /// The AUs that drive it.
    pub units: Vec<DrivenUnit>,
    /// Its pictures.
    pub folder: Option<PathBuf>,
    /// Share of values beyond the range, clamped.
    pub clamped_share: f64,
    /// Turns of the head beyond what its cameras saw, as a share of pictures.
    pub unseen_share: f64,
}

/// A picture to be made.
#[derive(Clone, Debug)]
struct Slot {
    id: String,
    secs: f64,
    driver_frame: Option<u32>,
}

/// Renders the avatars wearing the driver's expressions.
pub fn transfer(
    avatars: &[Named<'_>],
    driver: &Driver,
    settings: &TransferSettings,
    sink: &Sink,
    reporter: &dyn Reporter,
) -> Result<TransferSummary> {
    let started = std::time::Instant::now();
    let slots = slots(driver, settings.fps);
    let times: Vec<f64> = slots.iter().map(|s| s.secs).collect();
    let fitted =
        avatars.iter().map(|a| fitted(a, driver, settings.range, &times, reporter)).collect::<Result<Vec<_>>>()?;
    if settings.head != 0.0 && driver.turns.is_none() {
        reporter.warn(Warning::new("no-head", "the driver's table does not tell how the head turns; it stays still"));
    }
    let height = avatars.first().map_or(0, |a| a.avatar.saved.default_camera.height);
    let drivers = match driver.take.as_ref().filter(|_| settings.side_by_side) {
        Some(take) => driver_pictures(take, &slots, height)?,
        None => Vec::new(),
    };
    let folder_of = |name: &str| {
        let folder = sink.folder.clone()?;
        Some(if avatars.len() > 1 { folder.join(name) } else { folder })
    };
    let mut studios: Vec<Studio<'_>> = avatars.iter().map(|a| Studio::new(a.avatar, sink.look)).collect();
    let mut writer: Option<Writer> = None;
    let mut unseen = vec![0usize; avatars.len()];
    reporter.stage("render", Some(slots.len() as u64));
    for (i, slot) in slots.iter().enumerate() {
        if reporter.cancelled() {
            return Err(TrainerError::Interrupted { done: format!("{i} of {} pictures", slots.len()) });
        }
        let turn = driver.turn_at(slot.secs, settings.head);
        let mut row: Vec<RgbImage> = drivers.get(i).cloned().into_iter().collect();
        for (n, named) in avatars.iter().enumerate() {
            let saved = &named.avatar.saved;
            let camera = turned(&Camera::from(&saved.default_camera), saved.center_in_world, turn);
            let (picture, _) = studios[n].picture_and_maps(&camera, &fitted[n].expressions[i], reporter)?;
            let angle = glam::DQuat::from_mat3(&turn).to_axis_angle().1.abs();
            unseen[n] += usize::from(angle > saved.orbit_rad[0].max(saved.orbit_rad[1]) / 0.75);
            if let Some(folder) = folder_of(&named.name) {
                write_png(&folder.join(format!("{}.png", slot.id)), &picture)?;
            }
            row.push(if picture.height() == height { picture } else { resized(&picture, height) });
        }
        if let Some((path, fps)) = &sink.video {
            let picture = beside(&row);
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
    let driven_avatar = |(n, named): (usize, &Named<'_>)| {
        let units = fitted[n].units.clone();
        DrivenAvatar {
            name: named.name.clone(),
            clamped_share: units.iter().map(|u| u.beyond_share).sum::<f64>() / units.len().max(1) as f64,
            unseen_share: unseen[n] as f64 / slots.len().max(1) as f64,
            folder: folder_of(&named.name),
            units,
        }
    };
    Ok(TransferSummary {
        pictures: slots.len(),
        seconds,
        seconds_per_picture: seconds / (slots.len() * avatars.len()).max(1) as f64,
        driver_frames: driver.times_secs.len(),
        held_frames: driver.held_frames,
        driven: fitted.first().map(|f| f.units.iter().map(|u| u.unit).collect()).unwrap_or_default(),
        avatars: avatars.iter().enumerate().map(driven_avatar).collect(),
        video: sink.video.as_ref().map(|(path, _)| path.clone()),
    })
}

/// Expressions of an avatar, with its warnings; an error where nothing drives it.
fn fitted(named: &Named<'_>, driver: &Driver, range: Range, times: &[f64], reporter: &dyn Reporter) -> Result<Fitted> {
    let fitted = fit::fit(named.avatar, driver, range, times);
    Unseen { inactive: fitted.unknown.clone(), ..Unseen::default() }.warn(reporter);
    for u in fitted.units.iter().filter(|u| u.beyond_share > 0.0) {
        let message = format!(
            "{}: {} of the driver goes {:.1} beyond {:.1}–{:.1} in {:.0} % of the pictures; clamped",
            named.name,
            u.unit,
            u.beyond_most,
            u.range[0],
            u.range[1],
            u.beyond_share * 100.0
        );
        reporter.warn(Warning::new("out-of-range", message));
    }
    if fitted.units.is_empty() {
        return Err(TrainerError::Setting {
            message: format!("the driver moves none of the AUs of {}", named.name),
            hint: "see `tracker check` for the AU ranges of the driver".to_owned(),
        });
    }
    Ok(fitted)
}

/// Views that name the frame of the driver whose expression they show.
#[derive(Deserialize)]
struct DriverFrames {
    views: Vec<DriverFrame>,
}

#[derive(Deserialize)]
struct DriverFrame {
    driver_frame: Option<usize>,
}

/// Renders the views of a list with the driver's expression at their `driver_frame` instead of their own AUs, and scores
/// them against the list's images.
pub fn transfer_views(
    avatar: &Named<'_>,
    driver: &Driver,
    range: Range,
    list: &Path,
    folder: &Path,
    reporter: &dyn Reporter,
) -> Result<Evaluation> {
    let views = ViewList::read(list)?;
    let bytes = std::fs::read(list).map_err(|e| FormatError::io(list, "read", &e))?;
    let frames: DriverFrames =
        serde_json::from_slice(&bytes).map_err(|e| risorius_formats::pose_report::json_error(&e).in_file(list))?;
    let mut times = Vec::with_capacity(views.views.len());
    for (view, frame) in views.views.iter().zip(&frames.views) {
        let fail = |message: String| {
            FormatError::new(ErrorKind::Inconsistent, message)
                .in_file(list)
                .with_hint("`driver_frame` is a frame of the driver, counted from 0")
        };
        let frame = frame.driver_frame.ok_or_else(|| fail(format!("view `{}` has no `driver_frame`", view.id)))?;
        let time = driver.times_secs.get(frame).copied();
        times.push(time.ok_or_else(|| fail(format!("view `{}`: the driver has no frame {frame}", view.id)))?);
    }
    let fitted = fitted(avatar, driver, range, &times, reporter)?;
    let base = list.parent().unwrap_or(Path::new("."));
    let outputs = Outputs { depth: true, masks: true, head: false };
    let mut studio = Studio::new(avatar.avatar, Look { outputs, ..Look::default() });
    let mut scores = Vec::new();
    reporter.stage("render", Some(views.views.len() as u64));
    for (view, expression) in views.views.iter().zip(&fitted.expressions) {
        let camera = Camera::from(&view.camera);
        let (picture, maps) = studio.picture_and_maps(&camera, expression, reporter)?;
        write_png(&folder.join(format!("{}.png", view.id)), &picture)?;
        if let Some(image) = &view.image {
            let path = base.join(image);
            let truth = crate::data::read_rgb(&path)?;
            scores.push(ViewScore {
                id: view.id.clone(),
                kind: view.kind.clone(),
                psnr_db: eval::score(&picture, &truth, &path)?,
                parts_psnr_db: eval::score_parts(&picture, &truth, &maps, &avatar.avatar.saved.table.regions),
                ms_ssim: eval::ms_ssim(&picture, &truth),
                ..ViewScore::default()
            });
        }
        reporter.advance(1);
    }
    Evaluation::new(scores)
        .ok_or_else(|| FormatError::new(ErrorKind::Missing, "names no true image to compare with").in_file(list).into())
}

/// The pictures to make. At the driver's rate or below they stand on its frames, and are named by them.
fn slots(driver: &Driver, fps: f64) -> Vec<Slot> {
    let last = driver.times_secs.last().copied().unwrap_or(0.0);
    if fps > driver.fps() * 1.001 {
        let count = (last * fps + 1e-6).floor() as usize + 1;
        let nearest = |secs: f64| driver.times_secs.partition_point(|t| *t < secs - 0.5 / driver.fps()) as u32;
        return (0..count)
            .map(|i| {
                let secs = i as f64 / fps;
                Slot { id: format!("{i:06}"), secs, driver_frame: Some(nearest(secs)) }
            })
            .collect();
    }
    let mut chosen = Vec::new();
    let mut next = 0.0;
    for (frame, secs) in driver.times_secs.iter().enumerate() {
        if *secs >= next - 1e-6 {
            chosen.push(Slot { id: format!("{frame:06}"), secs: *secs, driver_frame: Some(frame as u32) });
            next += 1.0 / fps;
        }
    }
    chosen
}

/// The driver's picture for every slot, at the height of the result.
fn driver_pictures(take: &Take, slots: &[Slot], height: u32) -> Result<Vec<RgbImage>> {
    let mut frames: Vec<u32> = slots.iter().filter_map(|s| s.driver_frame).collect();
    frames.dedup();
    let mut images = Vec::with_capacity(frames.len());
    risorius_video::read_take_frames(take, &frames, |_, image| -> Result<()> {
        images.push(resized(&image, height));
        Ok(())
    })?;
    let of = |slot: &Slot| {
        let at = frames.binary_search(&slot.driver_frame?).ok()?;
        images.get(at).cloned()
    };
    Ok(slots.iter().filter_map(of).collect())
}

fn resized(image: &RgbImage, height: u32) -> RgbImage {
    let width = (f64::from(image.width()) * f64::from(height) / f64::from(image.height().max(1))).round().max(1.0);
    imageops::resize(image, width as u32, height, FilterType::Triangle)
}

fn beside(pictures: &[RgbImage]) -> RgbImage {
    let width = pictures.iter().map(RgbImage::width).sum();
    let height = pictures.iter().map(RgbImage::height).max().unwrap_or(0);
    let mut all = RgbImage::new(width, height);
    let mut x = 0;
    for picture in pictures {
        imageops::replace(&mut all, picture, x, 0);
        x += i64::from(picture.width());
    }
    all
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use super::*;

    fn driver(fps: f64, frames: usize) -> Driver {
        Driver {
            take: None,
            times_secs: (0..frames).map(|i| i as f64 / fps).collect(),
            intensities: BTreeMap::new(),
            turns: None,
            held_frames: 0,
        }
    }

    #[test]
    fn pictures_stand_on_frames_or_between_them() {
        let fewer = slots(&driver(120.0, 121), 12.0);
        assert_eq!(fewer.len(), 13);
        assert_eq!((fewer[1].id.as_str(), fewer[1].driver_frame), ("000010", Some(10)));
        let more = slots(&driver(10.0, 11), 25.0);
        assert_eq!(more.len(), 26);
        assert!((more[1].secs - 0.04).abs() < 1e-12 && more[3].driver_frame == Some(1), "{:?}", more[3]);
        let same = slots(&driver(30.0, 4), 30.0);
        assert_eq!(same.iter().map(|s| s.driver_frame.unwrap()).collect::<Vec<_>>(), [0, 1, 2, 3]);
    }

    #[test]
    fn a_turned_head_stays_in_the_middle() {
        let camera = Camera {
            intrinsics: risorius_formats::Intrinsics::pinhole(64, 64, 80.0),
            camera_from_world: risorius_formats::Isometry::new(
                glam::DMat3::from_rotation_y(0.3),
                glam::DVec3::new(0.1, -0.2, 2.0),
            ),
        };
        let center = glam::DVec3::new(0.05, 0.1, 0.0);
        let turn = glam::DMat3::from_rotation_y(0.2);
        let after = turned(&camera, center, turn);
        assert!((after.project(center) - camera.project(center)).length() < 1e-9);
        // A point of the head moves in camera space by the turn.
        let p = center + glam::DVec3::new(0.1, 0.0, 0.0);
        let local =
            |c: &Camera, q| c.camera_from_world.transform_point(q) - c.camera_from_world.transform_point(center);
        assert!((local(&after, p) - turn * local(&camera, p)).length() < 1e-9);
    }
}
