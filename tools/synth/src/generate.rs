//! The whole capture: video, table, cameras, masks, held-out stills, driver and transfer.

use std::collections::BTreeMap;
use std::path::Path;

use image::{ImageBuffer, Luma, RgbImage};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use risorius_formats::atomic::{self, AtomicDir};
use risorius_formats::au::OPENFACE_INTENSITIES;
use risorius_formats::views::{View, ViewList};
use risorius_formats::{Camera, FormatError, FrameIndex, Isometry, Reporter, colmap, openface};
use risorius_video::Writer;
use serde::Serialize;

use crate::error::SynthError;
use crate::expression::Expression;
use crate::person::Person;
use crate::scene::Scene;
use crate::script::{self, Script, Segment};
use crate::settings::Settings;
use crate::sparse::SparseModel;
use crate::table::{self, Noise, Shot};

/// Every how many frames a label image is written.
const MASK_STEP: u32 = 30;
/// Stills per kind.
const STILLS: usize = 4;
/// Views of the transfer.
const TRANSFERS: u32 = 8;
/// Points of the COLMAP model.
const POINTS: usize = 360;

/// What was made.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Summary {
    /// Frames of the video.
    pub frames: u32,
    /// Held-out stills.
    pub stills: usize,
    /// Label images.
    pub masks: usize,
    /// Frames of the driver's video; 0 without one.
    pub driver_frames: u32,
    /// Stills of the transfer; 0 without a driver.
    pub transfer_views: usize,
    /// Points of the COLMAP model.
    pub points: usize,
}

/// What shows a folder to be a capture of ours.
const MANIFEST_FILE: &str = "manifest.json";

/// `manifest.json`.
#[derive(Serialize)]
struct Manifest<'a> {
    what: &'static str,
    written_by: String,
    settings: &'a Settings,
    conventions: &'static str,
    noise: NoiseNote,
    active_units: Vec<String>,
    script: &'a [Segment],
    #[serde(skip_serializing_if = "Option::is_none")]
    driver_script: Option<&'a [Segment]>,
    masks: &'static str,
    stills: &'static str,
    transfer_driver_frames: Vec<u32>,
    summary: &'a Summary,
}

#[derive(Serialize)]
struct NoiseNote {
    landmark_sigma_px: f64,
    au_sigma: f64,
    lost_share: f64,
    note: &'static str,
}

/// Makes the capture in `out`, whole or not at all.
pub fn generate(settings: &Settings, out: impl AsRef<Path>, reporter: &dyn Reporter) -> Result<Summary, SynthError> {
    settings.validate()?;
    atomic::check_replaceable(&out, "a capture of this program", &[MANIFEST_FILE])?;
    let folder = AtomicDir::create(&out)?;
    let dir = folder.path();
    reporter.stage("build the scene", None);
    let scene = Scene::new(Person::subject(settings.seed as u32), settings.seed as u32);
    let script = Script::capture(settings.frames, settings.seed);
    let shots = capture_shots(settings, &script);

    let (masks, points) = write_video(settings, &scene, &shots, dir, reporter)?;
    let noise = settings.table_noise();
    openface::write(dir.join("openface.csv"), &table::track(&scene, &shots, settings.fps, &noise, settings.seed))?;
    let stills = write_stills(settings, &scene, &shots, &dir.join("test"), reporter)?;
    let driver = if settings.driver { Some(write_driver(settings, &scene, dir, reporter)?) } else { None };

    let summary = Summary {
        frames: settings.frames,
        stills,
        masks,
        driver_frames: driver.as_ref().map_or(0, |d| d.frames),
        transfer_views: driver.as_ref().map_or(0, |d| d.chosen.len()),
        points,
    };
    write_manifest(settings, &script, driver.as_ref(), &noise, &summary, dir)?;
    folder.commit()?;
    Ok(summary)
}

/// Cameras and expressions of the capture's video; they do not depend on each other.
pub fn capture_shots(settings: &Settings, script: &Script) -> Vec<Shot> {
    let lens = script::lens(settings.width, settings.height);
    (0..settings.frames)
        .map(|frame| Shot {
            camera: script::capture_camera(lens, frame, settings.frames, settings.seed, settings.static_camera),
            expression: script.expression(frame),
            world_from_head: Isometry::IDENTITY,
        })
        .collect()
}

fn stop_if_asked(reporter: &dyn Reporter) -> Result<(), SynthError> {
    if reporter.cancelled() { Err(SynthError::Cancelled) } else { Ok(()) }
}

fn write_video(
    settings: &Settings,
    scene: &Scene,
    shots: &[Shot],
    dir: &Path,
    reporter: &dyn Reporter,
) -> Result<(usize, usize), SynthError> {
    reporter.stage("render the video", Some(shots.len() as u64));
    let middle = script::capture_camera(shots[0].camera.intrinsics, 0, 2, settings.seed, true);
    let mut sparse = SparseModel::new(scene, &middle, POINTS, settings.seed);
    let mut writer = Writer::create(dir.join("video.mp4"), settings.width, settings.height, settings.fps)?;
    let mut masks = 0;
    for (frame, shot) in (0u32..).zip(shots) {
        stop_if_asked(reporter)?;
        let view = scene.render(&shot.camera, &shot.expression);
        writer.push(&view.rgb)?;
        sparse.add(frame, &shot.camera, &view);
        if frame % MASK_STEP == 0 {
            view.labels.write_png(dir.join("masks").join(FrameIndex(frame).image_name()))?;
            masks += 1;
        }
        reporter.advance(1);
    }
    writer.finish()?;
    let model = sparse.finish();
    colmap::write_text(dir.join("truth_colmap"), &model)?;
    Ok((masks, model.points.len()))
}

fn write_png(path: &Path, image: &RgbImage) -> Result<(), SynthError> {
    let mut bytes = std::io::Cursor::new(Vec::new());
    image
        .write_to(&mut bytes, image::ImageFormat::Png)
        .map_err(|e| FormatError::syntax(format!("cannot encode: {e}")).in_file(path))?;
    Ok(atomic::write_file(path, bytes.get_ref())?)
}

/// Depth in whole millimetres as a 16-bit PNG.
fn write_depth(path: &Path, depth_m: &[f32], width: u32, height: u32) -> Result<(), SynthError> {
    let millimetres: Vec<u16> = depth_m.iter().map(|d| (d * 1000.0).round().clamp(0.0, 65_535.0) as u16).collect();
    let mut bytes = std::io::Cursor::new(Vec::new());
    ImageBuffer::<Luma<u16>, _>::from_raw(width, height, millimetres)
        .ok_or_else(|| FormatError::syntax("cannot encode: the size does not fit").in_file(path))?
        .write_to(&mut bytes, image::ImageFormat::Png)
        .map_err(|e| FormatError::syntax(format!("cannot encode: {e}")).in_file(path))?;
    Ok(atomic::write_file(path, bytes.get_ref())?)
}

fn view_of(id: String, kind: &str, camera: &Camera, expression: &Expression) -> View {
    let aus: BTreeMap<_, _> = OPENFACE_INTENSITIES.into_iter().map(|u| (u, expression.intensity(u))).collect();
    View {
        image: Some(format!("{id}.png").into()),
        id,
        kind: Some(kind.to_owned()),
        camera: camera.into(),
        aus,
        depth: None,
    }
}

fn write_views(path: &Path, views: Vec<View>) -> Result<(), SynthError> {
    let list = ViewList { views };
    let mut text = serde_json::to_string_pretty(&list)
        .map_err(|e| FormatError::syntax(format!("cannot encode: {e}")).in_file(path))?;
    text.push('\n');
    Ok(atomic::write_file(path, text.as_bytes())?)
}

/// Views that the video does not show: new cameras, new expressions, both.
fn write_stills(
    settings: &Settings,
    scene: &Scene,
    shots: &[Shot],
    dir: &Path,
    reporter: &dyn Reporter,
) -> Result<usize, SynthError> {
    reporter.stage("render the held-out stills", Some(3 * STILLS as u64));
    let mut rng = ChaCha8Rng::seed_from_u64(settings.seed ^ 0xf5);
    let mut views = Vec::new();
    for (k, kind) in ["novel_view", "unseen_expression", "novel_view_unseen_expression"].into_iter().enumerate() {
        for i in 0..STILLS {
            stop_if_asked(reporter)?;
            // Random frames, but spread over the video.
            let share = shots.len() / STILLS;
            let frame = (i * share + rng.random_range(0..share.max(1))).min(shots.len() - 1);
            let (yaw, pitch) = (rng.random_range(-0.45..0.45), rng.random_range(-0.20..0.20));
            let novel = script::camera_at(
                shots[frame].camera.intrinsics,
                yaw,
                pitch,
                0.55,
                glam::DVec3::new(0.0, 0.002, 0.02),
                0.0,
            );
            let unseen = script::unseen_expression(i + if k == 2 { STILLS } else { 0 }, &mut rng);
            let camera = if k == 1 || settings.static_camera { shots[frame].camera } else { novel };
            let expression = if k == 0 { shots[frame].expression } else { unseen };
            let id = format!("{kind}_{i:03}");
            let rendered = scene.render(&camera, &expression);
            write_png(&dir.join(format!("{id}.png")), &rendered.rgb)?;
            let depth = format!("{id}_depth.png");
            write_depth(&dir.join(&depth), &rendered.depth, settings.width, settings.height)?;
            let mut view = view_of(id, kind, &camera, &expression);
            view.depth = Some(depth.into());
            views.push(view);
            reporter.advance(1);
        }
    }
    let count = views.len();
    write_views(&dir.join("views.json"), views)?;
    Ok(count)
}

struct Driver {
    frames: u32,
    script: Script,
    chosen: Vec<u32>,
}

/// The second person, and the first one wearing that one's expressions.
fn write_driver(
    settings: &Settings,
    subject: &Scene,
    dir: &Path,
    reporter: &dyn Reporter,
) -> Result<Driver, SynthError> {
    let frames = ((settings.fps * 3.0).round() as u32).clamp(2, settings.frames.max(2));
    reporter.stage("render the driver", Some(u64::from(frames)));
    let scene = Scene::new(Person::driver(settings.seed as u32), settings.seed as u32 ^ 0x77);
    let script = Script::driver(frames, settings.seed);
    let camera = script::driver_camera(script::lens(settings.width, settings.height));
    let shots: Vec<Shot> = (0..frames)
        .map(|frame| Shot {
            camera,
            expression: script.expression(frame),
            world_from_head: script::driver_head(frame, frames),
        })
        .collect();
    let mut writer = Writer::create(dir.join("driver.mp4"), settings.width, settings.height, settings.fps)?;
    for shot in &shots {
        stop_if_asked(reporter)?;
        writer.push(&scene.render_posed(&shot.camera, &shot.expression, &shot.world_from_head).rgb)?;
        reporter.advance(1);
    }
    writer.finish()?;
    let track = table::track(&scene, &shots, settings.fps, &settings.table_noise(), settings.seed ^ 0x99);
    openface::write(dir.join("driver_openface.csv"), &track)?;

    let chosen: Vec<u32> =
        (0..TRANSFERS.min(frames)).map(|i| (2 * i + 1) * frames / (2 * TRANSFERS.min(frames))).collect();
    let mut views = Vec::new();
    for &frame in &chosen {
        // From where the subject's video looked at about that time.
        let at = u64::from(frame) * u64::from(settings.frames) / u64::from(frames);
        let lens = script::lens(settings.width, settings.height);
        let camera = script::capture_camera(lens, at as u32, settings.frames, settings.seed, settings.static_camera);
        let expression = shots[frame as usize].expression;
        let id = format!("driver_{frame:06}");
        write_png(&dir.join("transfer").join(format!("{id}.png")), &subject.render(&camera, &expression).rgb)?;
        views.push(view_of(id, "transfer", &camera, &expression));
    }
    write_views(&dir.join("transfer").join("views.json"), views)?;
    Ok(Driver { frames, script, chosen })
}

fn write_manifest(
    settings: &Settings,
    script: &Script,
    driver: Option<&Driver>,
    noise: &Noise,
    summary: &Summary,
    dir: &Path,
) -> Result<(), SynthError> {
    let path = dir.join(MANIFEST_FILE);
    let manifest = Manifest {
        what: "a capture with known answers: an analytic head in a room, rendered by Risorius itself",
        written_by: format!("synth {}", env!("CARGO_PKG_VERSION")),
        settings,
        conventions: "world = head frame of the subject, metres: +x the subject's left, +y up, +z out of the face; \
                      camera_from_world with OpenCV axes; the centre of the first pixel is (0.5, 0.5), in OpenFace tables (0, 0)",
        noise: NoiseNote {
            landmark_sigma_px: noise.landmark_sigma_px,
            au_sigma: noise.au_sigma,
            lost_share: noise.lost_share,
            note: "2-D landmarks and intensities are noisy, 3-D landmarks and head poses are exact",
        },
        active_units: OPENFACE_INTENSITIES.iter().map(ToString::to_string).collect(),
        script: &script.segments,
        driver_script: driver.map(|d| &d.script.segments[..]),
        masks: "every 30th frame: 0 none, 1 brows and forehead, 2 eyes, 3 mouth and lower face",
        stills: "test/: 8-bit sRGB, 2x2 samples per pixel; depth along the camera's axis in mm, 16-bit PNG",
        transfer_driver_frames: driver.map(|d| d.chosen.clone()).unwrap_or_default(),
        summary,
    };
    let mut text = serde_json::to_string_pretty(&manifest)
        .map_err(|e| FormatError::syntax(format!("cannot encode: {e}")).in_file(&path))?;
    text.push('\n');
    Ok(atomic::write_file(path, text.as_bytes())?)
}
