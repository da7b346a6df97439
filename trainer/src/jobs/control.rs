//! AU control and decoupling: each AU is swept alone, the renders are read again by the tracker, as the paper does with
//! OpenFace (its table I); and what an AU changes outside its region's mask is measured.
//!
//! The tracker is another stage: they meet in a folder. The sweep is written as a take of images, and the program
//! `tracker` is run on it.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::Command;

use risorius_formats::openface::{self, ReadOptions};
use risorius_formats::take::{SourceKind, TAKE_VERSION, TakeManifest};
use risorius_formats::{
    ActionUnit, Camera, ErrorKind, FormatError, FrameIndex, FrameRecord, Intensity, Reporter, Take, atomic, frame, hash,
};

use super::render::write_png;
use crate::avatar::Avatar;
use crate::error::{Result, TrainerError};
use crate::eval::control::{Control, ControlFrame, Decoupling, Spill};
use crate::expression::Expression;
use crate::field::{Look, Outputs, Render};
use crate::path::Orbit;
use crate::studio::Studio;

/// Frames per second of the sweep's take.
const FPS: f64 = 25.0;
/// Resting frames at the start of every view, and between AUs.
const REST: (usize, usize) = (12, 2);
/// The tracker sees pictures enlarged to this many times the fitted size.
const ENLARGED: u32 = 2;
/// Masks below this are 0 of 255 levels.
const OUTSIDE: f32 = 0.5 / 255.0;
/// Masks below this hardly count.
const FAINT: f32 = 0.02;

/// How AUs are swept.
#[derive(Clone, Debug)]
pub struct ControlSettings {
    /// Levels from neutral to the strongest that the capture saw; each is shown on the way up and on the way down.
    pub steps: usize,
    /// Views: the avatar's own, then others to its sides.
    pub views: usize,
    /// AUs that the tracker is said to read; empty means all.
    pub readable: Vec<ActionUnit>,
    /// The program `tracker`.
    pub tracker: PathBuf,
    /// The tracker's folder of networks, if not its own default.
    pub models: Option<PathBuf>,
}

/// The tracker's program: beside this one, else whatever the system finds.
pub fn default_tracker() -> PathBuf {
    let beside = std::env::current_exe().ok().and_then(|exe| Some(exe.parent()?.join("tracker")));
    beside.filter(|p| p.is_file()).unwrap_or_else(|| "tracker".into())
}

/// One frame of the plan.
struct Planned {
    view: usize,
    swept: Option<usize>,
    asked: Expression,
}

/// Every frame of the sweep.
fn plan(avatar: &Avatar, settings: &ControlSettings) -> Vec<Planned> {
    let table = &avatar.saved.table.attributes;
    let neutral = avatar.neutral();
    let mut frames = Vec::new();
    for view in 0..settings.views.max(1) {
        let rest = |frames: &mut Vec<Planned>, count| {
            frames.extend((0..count).map(|_| Planned { view, swept: None, asked: neutral.clone() }));
        };
        rest(&mut frames, REST.0);
        for (k, spec) in table.iter().enumerate().filter(|(_, a)| a.active) {
            let steps = settings.steps.max(2);
            let up = (0..steps).map(|i| i as f32 / (steps - 1) as f32);
            for share in up.clone().chain(up.rev()) {
                let asked = neutral.with(k, Intensity(spec.neutral + (spec.au_max - spec.neutral) * share));
                frames.push(Planned { view, swept: Some(k), asked });
            }
            rest(&mut frames, REST.1);
        }
    }
    frames
}

/// The camera of a view: the avatar's own, then around it within what the training cameras saw.
fn view_camera(avatar: &Avatar, view: usize) -> Camera {
    let saved = &avatar.saved;
    let reference = Camera::from(&saved.default_camera);
    if view == 0 {
        return reference;
    }
    let angle = std::f64::consts::TAU * (view - 1) as f64 / 4.0;
    let orbit = Orbit {
        yaw_deg: (saved.orbit_rad[0] * angle.cos()).to_degrees(),
        pitch_deg: (saved.orbit_rad[1] * angle.sin()).to_degrees(),
        ..Orbit::default()
    };
    orbit.camera(&reference, saved.center_in_world)
}

/// The same view with more pixels.
fn enlarged(camera: &Camera) -> Camera {
    let i = &camera.intrinsics;
    let by = f64::from(ENLARGED);
    let intrinsics = risorius_formats::Intrinsics {
        width: i.width * ENLARGED,
        height: i.height * ENLARGED,
        fx: i.fx * by,
        fy: i.fy * by,
        cx: i.cx * by,
        cy: i.cy * by,
        skew: i.skew * by,
        ..*i
    };
    Camera { intrinsics, camera_from_world: camera.camera_from_world }
}

/// Renders the sweep into a take at `folder`, has it tracked, and compares.
pub fn control(avatar: &Avatar, settings: &ControlSettings, folder: &Path, reporter: &dyn Reporter) -> Result<Control> {
    let frames = plan(avatar, settings);
    if frames.iter().all(|f| f.swept.is_none()) {
        return Err(TrainerError::Setting {
            message: "the avatar has no active AU".to_owned(),
            hint: "see `dataset stats` for what moved in the capture".to_owned(),
        });
    }
    render_take(avatar, &frames, folder, reporter)?;
    reporter.stage("read the sweep again", None);
    run_tracker(settings, folder)?;
    let take = Take::open(folder)?;
    let track = openface::read(take.openface_path(), &ReadOptions::default(), reporter)?;
    let table = &avatar.saved.table.attributes;
    let rows: BTreeMap<u32, usize> = track.rows.iter().enumerate().map(|(i, r)| (r.frame.0, i)).collect();
    let columns: Vec<Option<usize>> = table.iter().map(|a| track.unit_index(a.unit)).collect();
    let active: Vec<usize> = (0..table.len()).filter(|&k| table[k].active).collect();
    let read = |frame: usize, k: usize| {
        let row = &track.rows[*rows.get(&(frame as u32))?];
        if !row.success {
            return None;
        }
        Some(f64::from(row.intensities[columns[k]?]?))
    };
    let frames: Vec<ControlFrame> = frames
        .iter()
        .enumerate()
        .map(|(i, f)| ControlFrame {
            swept: f.swept.and_then(|k| active.iter().position(|&a| a == k)),
            asked: active.iter().map(|&k| f64::from(f.asked.0[k].0)).collect(),
            read: active.iter().map(|&k| read(i, k)).collect(),
        })
        .collect();
    let units: Vec<(String, String, bool)> = active
        .iter()
        .map(|&k| {
            let unit = table[k].unit;
            let readable = settings.readable.is_empty() || settings.readable.contains(&unit);
            (unit.to_string(), unit.facs_name().to_owned(), readable)
        })
        .collect();
    Ok(Control::new(&units, &frames))
}

fn render_take(avatar: &Avatar, frames: &[Planned], folder: &Path, reporter: &dyn Reporter) -> Result<()> {
    if folder.exists() {
        std::fs::remove_dir_all(folder).map_err(|e| FormatError::io(folder, "remove", &e))?;
    }
    let images = folder.join("images");
    std::fs::create_dir_all(&images).map_err(|e| FormatError::io(&images, "create the folder", &e))?;
    let mut studio = Studio::new(avatar, Look::default());
    let mut hashes = Vec::with_capacity(frames.len());
    let mut size = (0, 0);
    reporter.stage("render the sweep", Some(frames.len() as u64));
    for (i, planned) in frames.iter().enumerate() {
        if reporter.cancelled() {
            return Err(TrainerError::Interrupted { done: format!("{i} of {} frames", frames.len()) });
        }
        let camera = enlarged(&view_camera(avatar, planned.view));
        let (picture, _) = studio.picture_and_maps(&camera, &planned.asked, reporter)?;
        let path = images.join(FrameIndex(i as u32).image_name());
        write_png(&path, &picture)?;
        hashes.push(hash::sha256_of_file(&path)?);
        size = picture.dimensions();
        reporter.advance(1);
    }
    let records: Vec<FrameRecord> = (0..frames.len())
        .map(|i| FrameRecord {
            index: FrameIndex(i as u32),
            timestamp_nanos: (i as f64 * 1e9 / FPS).round() as i64,
            ..FrameRecord::default()
        })
        .collect();
    frame::write_frames(folder.join("frames.csv"), &records)?;
    let manifest = TakeManifest {
        version: TAKE_VERSION,
        subject: String::new(),
        consent: String::new(),
        source: SourceKind::Images,
        media: "images".into(),
        media_sha256: hash::sha256_of_bytes((hashes.join("\n") + "\n").as_bytes()),
        original_name: "AU sweep".to_owned(),
        device: None,
        width: size.0,
        height: size.1,
        rotation_degrees: 0,
        fps_asked: Some(FPS),
        fps_measured: FPS,
        frame_count: frames.len() as u32,
        dropped_frames: 0,
        repeated_frames: 0,
        written_by: format!("risorius {}", env!("CARGO_PKG_VERSION")),
    };
    manifest.write(folder.join("take.toml"))?;
    Ok(())
}

fn run_tracker(settings: &ControlSettings, take: &Path) -> Result<()> {
    let mut command = Command::new(&settings.tracker);
    command.arg("run").arg(take).args(["--no-progress", "-q"]);
    if let Some(models) = &settings.models {
        command.arg("--models").arg(models);
    }
    let hint =
        "build it with `cargo build --release`, fetch its networks with `tools/models`; `--tracker FILE` names it";
    let output = command.output().map_err(|e| TrainerError::Setting {
        message: format!("`{}` cannot be started: {e}", settings.tracker.display()),
        hint: hint.to_owned(),
    })?;
    if output.status.success() {
        return Ok(());
    }
    let said = String::from_utf8_lossy(&output.stderr);
    Err(TrainerError::Setting {
        message: format!(
            "`tracker run` failed: {}",
            said.lines().next().unwrap_or_default().trim_start_matches("error: ")
        ),
        hint: hint.to_owned(),
    })
}

/// Raises each AU alone to the strongest that the capture saw and measures what changes outside the masks of its regions.
pub fn decoupling(avatar: &Avatar, folder: &Path, reporter: &dyn Reporter) -> Result<Decoupling> {
    let table = &avatar.saved.table;
    let camera = view_camera(avatar, 0);
    let outputs = Outputs { masks: true, ..Outputs::default() };
    let mut studio = Studio::new(avatar, Look { outputs, ..Look::default() });
    let neutral = avatar.neutral();
    let rest = studio.render(&camera, &neutral, reporter)?;
    let mut units = Vec::new();
    reporter.stage("decoupling", Some(table.attributes.len() as u64));
    for (k, spec) in table.attributes.iter().enumerate() {
        if reporter.cancelled() {
            return Err(TrainerError::Interrupted { done: format!("{k} of {} AUs", table.attributes.len()) });
        }
        if spec.active {
            let raised = neutral.with(k, spec.scale().most());
            let edited = studio.render(&camera, &raised, reporter)?;
            let regions = avatar.field.regions_of(k, spec.region);
            let spill = spill(&rest, &edited, &regions);
            let names: Vec<&str> = regions.iter().map(|&r| table.regions[r].as_str()).collect();
            units.push(Spill { unit: spec.unit.to_string(), region: names.join(", "), ..spill });
            write_png(&folder.join(format!("{}.png", spec.unit)), &difference(&rest, &edited))?;
        }
        reporter.advance(1);
    }
    if units.is_empty() {
        return Err(FormatError::new(ErrorKind::Empty, "the avatar has no active AU").in_file(folder).into());
    }
    Ok(Decoupling {
        outside_max: units.iter().map(|u| u.outside_max).max().unwrap_or(0),
        outside_mean: units.iter().map(|u| u.outside_mean).sum::<f64>() / units.len() as f64,
        outside_999: units.iter().map(|u| u.outside_999).max().unwrap_or(0),
        units,
    })
}

fn spill(rest: &Render, edited: &Render, regions: &[usize]) -> Spill {
    let mut outside = [0u64; 256];
    let mut faint_max = 0;
    let (mut inside_sum, mut inside_count) = (0.0, 0usize);
    let (a, b) = (rest.rgb.as_raw().as_chunks::<3>().0, edited.rgb.as_raw().as_chunks::<3>().0);
    for (i, (a, b)) in a.iter().zip(b).enumerate() {
        let mask = regions.iter().map(|&r| rest.masks[r][i].max(edited.masks[r][i])).fold(0.0, f32::max);
        for (a, b) in a.iter().zip(b) {
            let change = a.abs_diff(*b);
            if mask < FAINT {
                faint_max = change.max(faint_max);
            }
            if mask < OUTSIDE {
                outside[usize::from(change)] += 1;
            } else if mask >= 0.5 {
                inside_sum += f64::from(change);
                inside_count += 1;
            }
        }
    }
    let count: u64 = outside.iter().sum();
    let mut seen = 0;
    let outside_999 = outside.iter().position(|n| {
        seen += n;
        seen as f64 >= 0.999 * count as f64
    });
    Spill {
        unit: String::new(),
        region: String::new(),
        outside_max: outside.iter().rposition(|n| *n > 0).unwrap_or(0) as u8,
        outside_mean: outside.iter().enumerate().map(|(v, n)| v as f64 * *n as f64).sum::<f64>() / count.max(1) as f64,
        outside_999: outside_999.unwrap_or(0) as u8,
        inside_mean: inside_sum / inside_count.max(1) as f64,
        faint_max,
    }
}

/// The change, eight times as strong, on grey.
fn difference(a: &Render, b: &Render) -> image::RgbImage {
    let bytes = a.rgb.as_raw().iter().zip(b.rgb.as_raw());
    let bytes = bytes.map(|(a, b)| (128 + (i32::from(*b) - i32::from(*a)) * 8).clamp(0, 255) as u8).collect();
    image::RgbImage::from_raw(a.rgb.width(), a.rgb.height(), bytes).unwrap_or_default()
}

/// Writes the control table as CSV.
pub fn control_csv(control: &Control) -> String {
    use std::fmt::Write as _;
    let mut text = String::from("unit,icc_3_1,icc_2_1,icc_1_1,icc_3_1_all_frames,correlation");
    for u in &control.units {
        let _ = write!(text, ",reads_{}", u.unit);
    }
    text.push('\n');
    let shown = |v: Option<f64>| v.map_or_else(String::new, |v| format!("{v:.4}"));
    for (u, row) in control.units.iter().zip(&control.cross_talk) {
        let of = |f: fn(&crate::eval::Icc) -> f64| shown(u.sweep.as_ref().map(f));
        let _ = write!(
            text,
            "{},{},{},{},{},{}",
            u.unit,
            of(|i| i.icc_3_1),
            of(|i| i.icc_2_1),
            of(|i| i.icc_1_1),
            shown(u.all_frames.map(|i| i.icc_3_1)),
            shown(u.correlation)
        );
        for v in row {
            let _ = write!(text, ",{}", shown(*v));
        }
        text.push('\n');
    }
    text
}

/// Writes a text file, whole or not at all.
pub(crate) fn write_text(path: &Path, text: &str) -> Result<()> {
    Ok(atomic::write_file(path, text.as_bytes())?)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn spill_is_measured_outside_the_mask_only() {
        let camera = Camera {
            intrinsics: risorius_formats::Intrinsics::pinhole(10, 10, 10.0),
            camera_from_world: risorius_formats::Isometry::IDENTITY,
        };
        let mut rest = Render::empty(&camera, 2, Outputs { masks: true, ..Outputs::default() });
        for i in 0..50 {
            rest.masks[1][i] = 1.0;
        }
        let mut edited = rest.clone();
        edited.rgb.put_pixel(3, 1, image::Rgb([200, 128, 128]));
        let clean = spill(&rest, &edited, &[1]);
        assert_eq!((clean.outside_max, clean.outside_999), (0, 0));
        assert!(clean.inside_mean > 0.0 && clean.faint_max == 0);
        edited.rgb.put_pixel(3, 8, image::Rgb([128, 131, 128]));
        edited.rgb.put_pixel(4, 8, image::Rgb([128, 128, 137]));
        edited.masks[1][84] = 0.01;
        let spilt = spill(&rest, &edited, &[1]);
        assert_eq!((spilt.outside_max, spilt.faint_max), (3, 9));
        assert!((spilt.outside_mean - 3.0 / 147.0).abs() < 1e-12);
    }
}
