//! A small take with known answers: a schematic face whose AUs follow simple curves, in front of a moving camera.

use std::path::{Path, PathBuf};

use glam::DVec3;
use image::{Rgb, RgbImage};
use risorius_formats::au::OPENFACE_INTENSITIES;
use risorius_formats::colmap::{self, Model, ModelCamera, ModelImage};
use risorius_formats::pose_report::{PoseMethod, PoseReport};
use risorius_formats::take::{SourceKind, TAKE_VERSION};
use risorius_formats::{
    FrameIndex, FrameRecord, Intrinsics, Isometry, Landmarks68, TakeManifest, Track, TrackRow, frame, openface,
};

pub(crate) const WIDTH: u32 = 108;
pub(crate) const HEIGHT: u32 = 120;
pub(crate) const FRAMES: u32 = 90;

/// What may be changed before the take is written.
pub(crate) struct Take {
    pub(crate) manifest: TakeManifest,
    pub(crate) frames: Vec<FrameRecord>,
    pub(crate) track: Track,
    pub(crate) model: Model,
    pub(crate) report: PoseReport,
}

/// The intensity of unit `k` in frame `f`: rises and falls once, later for later units; unit 4 (AU06) never moves.
pub(crate) fn intensity(f: u32, k: usize) -> f32 {
    let phase = (f as f32 - 4.0 * k as f32 - 12.0) / 14.0;
    if k == 4 || phase.abs() >= 1.0 { 0.2 } else { 0.2 + 4.5 * (0.5 + 0.5 * (std::f32::consts::PI * phase).cos()) }
}

pub(crate) fn pixel(f: u32, x: u32, y: u32) -> Rgb<u8> {
    Rgb([(x * 2 + f) as u8, (y * 2) as u8, (x ^ y ^ f) as u8])
}

/// A schematic face in head units, about 2 wide, y down.
fn face_points() -> [DVec3; 68] {
    let mut p = [[0.0f64; 2]; 68];
    for (k, q) in p.iter_mut().enumerate().take(17) {
        let a = std::f64::consts::PI * (1.0 - k as f64 / 16.0);
        *q = [a.cos(), -0.1 + 1.2 * a.sin()];
    }
    for k in 0..5 {
        let lift = [0.0, 0.06, 0.1, 0.08, 0.04][k];
        p[17 + k] = [-0.76 + 0.14 * k as f64, -0.44 - lift];
        p[26 - k] = [0.76 - 0.14 * k as f64, -0.44 - lift];
    }
    for k in 0..4 {
        p[27 + k] = [0.0, -0.2 + 0.12 * k as f64];
    }
    for k in 0..5 {
        p[31 + k] = [-0.16 + 0.08 * k as f64, 0.24];
    }
    for (k, q) in
        [[-0.18, 0.0], [-0.06, -0.06], [0.06, -0.06], [0.18, 0.0], [0.06, 0.04], [-0.06, 0.04]].into_iter().enumerate()
    {
        p[36 + k] = [-0.44 + q[0], -0.2 + q[1]];
        p[42 + k] = [0.44 + q[0], -0.2 + q[1]];
    }
    for k in 0..20 {
        let a = std::f64::consts::PI * (1.0 + k as f64 / 6.0);
        p[48 + k] = [0.3 * a.cos(), 0.56 + 0.1 * a.sin()];
    }
    // A curved face: the sides lie farther back.
    p.map(|[x, y]| DVec3::new(x, y, 0.5 * x * x))
}

pub(crate) fn take() -> Take {
    let face = face_points();
    let intrinsics = Intrinsics::pinhole(WIDTH, HEIGHT, 160.0);
    let mut model = Model::default();
    model.cameras.insert(1, ModelCamera::from_intrinsics(&intrinsics));
    let mut rows = Vec::new();
    for f in 0..FRAMES {
        let angle = 0.15 * (f as f64 * 0.1).sin();
        let pose = Isometry::from_wxyz([(angle / 2.0).cos(), 0.0, (angle / 2.0).sin(), 0.0], DVec3::new(0.0, 0.0, 5.0));
        let points_px = face.map(|p| intrinsics.project(pose.transform_point(p)).to_array().map(|v| v as f32));
        let image =
            ModelImage { camera_from_world: pose, camera_id: 1, name: FrameIndex(f).image_name(), points: vec![] };
        model.images.insert(f + 1, image);
        rows.push(TrackRow {
            frame: FrameIndex(f),
            face_id: 0,
            timestamp_secs: None,
            confidence: 0.98,
            success: true,
            intensities: (0..17).map(|k| Some(intensity(f, k))).collect(),
            presences: vec![],
            landmarks: Some(Box::new(Landmarks68 { points_px })),
            landmarks_in_camera_mm: None,
            head_pose: None,
        });
    }
    Take {
        manifest: TakeManifest {
            version: TAKE_VERSION,
            subject: String::new(),
            consent: String::new(),
            source: SourceKind::Images,
            media: PathBuf::from("images"),
            media_sha256: "0".repeat(64),
            original_name: "images".into(),
            device: None,
            width: WIDTH,
            height: HEIGHT,
            rotation_degrees: 0,
            fps_asked: Some(30.0),
            fps_measured: 30.0,
            frame_count: FRAMES,
            dropped_frames: 0,
            repeated_frames: 0,
            written_by: "test".into(),
        },
        frames: (0..FRAMES)
            .map(|f| FrameRecord {
                index: FrameIndex(f),
                timestamp_nanos: i64::from(f) * 33_333_333,
                ..FrameRecord::default()
            })
            .collect(),
        track: Track { units: OPENFACE_INTENSITIES.to_vec(), presence_units: vec![], rows },
        model,
        report: PoseReport {
            method: PoseMethod::ColmapModel,
            frames: FRAMES,
            frames_tried: FRAMES,
            frames_registered: FRAMES,
            frames_followed: 0,
            frames_interpolated: 0,
            registered_share: 1.0,
            reprojection_error_px: None,
            landmark_error_px: None,
            head_center: DVec3::new(0.0, 0.1, 0.2),
            head_radius: 1.2,
            head_depth: [4.8, 5.6],
            near: 3.8,
            far: 7.0,
            background_depth: None,
            units_per_metre: None,
            landmarks_in_world: face.to_vec(),
            head_hull_in_world: None,
            head_box: None,
            problems: vec![],
            interpolated_runs: vec![],
            seconds: 0.0,
            notes: vec![],
        },
    }
}

impl Take {
    pub(crate) fn write(&self, dir: &Path) {
        self.manifest.write(dir.join("take.toml")).unwrap();
        frame::write_frames(dir.join("frames.csv"), &self.frames).unwrap();
        openface::write(dir.join("track/openface.csv"), &self.track).unwrap();
        colmap::write_text(dir.join("poses/sparse"), &self.model).unwrap();
        self.report.write(dir.join("poses/report.json")).unwrap();
        std::fs::create_dir_all(dir.join("images")).unwrap();
        for f in 0..self.manifest.frame_count {
            let image = RgbImage::from_fn(self.manifest.width, self.manifest.height, |x, y| pixel(f, x, y));
            image.save(dir.join("images").join(FrameIndex(f).image_name())).unwrap();
        }
    }
}

/// Every file below `dir` with its bytes, sorted.
pub(crate) fn files(dir: &Path) -> Vec<(PathBuf, Vec<u8>)> {
    let mut found = Vec::new();
    let mut stack = vec![dir.to_owned()];
    while let Some(folder) = stack.pop() {
        for entry in std::fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                stack.push(path);
            } else {
                found.push((path.strip_prefix(dir).unwrap().to_owned(), std::fs::read(&path).unwrap()));
            }
        }
    }
    found.sort();
    found
}
