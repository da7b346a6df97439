//! Takes, tracks and cameras brought together: rows and images are joined by frame number, never by position.

use std::collections::BTreeMap;
use std::path::Path;

use risorius_formats::pose_report::PoseReport;
use risorius_formats::{
    Camera, ErrorKind, FormatError, FrameIndex, Intrinsics, Reporter, Take, Track, colmap, openface,
};

use crate::error::{DatasetError, Result};

/// A tracked and posed take.
#[derive(Debug)]
pub struct TakeInput {
    /// The take.
    pub take: Take,
    /// The name of its folder.
    pub name: String,
    /// Its track.
    pub track: Track,
    /// The camera of each posed frame, for the full-size image.
    pub cameras: BTreeMap<u32, Camera>,
    /// How the cameras were found.
    pub report: PoseReport,
}

impl TakeInput {
    /// Opens a take with its track and its poses.
    pub fn open(dir: &Path, reporter: &dyn Reporter) -> Result<Self> {
        let take = Take::open(dir)?;
        let name = std::path::absolute(dir).ok().and_then(|d| d.file_name().map(|n| n.to_string_lossy().into_owned()));
        let path = take.openface_path();
        if !path.exists() {
            return Err(FormatError::new(ErrorKind::Missing, "the take is not tracked yet")
                .in_file(&path)
                .with_hint("run `tracker run TAKE`, or `tracker import TAKE --openface FILE.csv`")
                .into());
        }
        let track = openface::read(&path, &openface::ReadOptions::default(), reporter)?;
        let path = take.pose_report_path();
        if !path.exists() || !take.sparse_dir().is_dir() {
            return Err(FormatError::new(ErrorKind::Missing, "the take has no cameras yet")
                .in_file(&path)
                .with_hint("run `tracker poses TAKE`")
                .into());
        }
        let report = PoseReport::read(&path)?;
        if !(report.near > 0.0 && report.far > report.near && report.far.is_finite()) {
            let message = format!("near {} and far {} bound nothing", report.near, report.far);
            return Err(FormatError::new(ErrorKind::Inconsistent, message)
                .in_file(&path)
                .with_hint("run `tracker poses TAKE` again")
                .into());
        }
        let cameras = read_cameras(&take)?;
        Ok(Self { take, name: name.unwrap_or_else(|| "take".to_owned()), track, cameras, report })
    }
}

fn read_cameras(take: &Take) -> Result<BTreeMap<u32, Camera>> {
    let dir = take.sparse_dir();
    let model = colmap::read_model(&dir)?;
    let images_path = dir.join("images.txt");
    let expected = (take.manifest.width, take.manifest.height);
    let mut intrinsics: BTreeMap<u32, Intrinsics> = BTreeMap::new();
    for (&id, camera) in &model.cameras {
        let found = (u32::try_from(camera.width).unwrap_or(u32::MAX), u32::try_from(camera.height).unwrap_or(u32::MAX));
        if found != expected {
            return Err(DatasetError::Size { path: dir.join("cameras.txt"), what: "the take has", expected, found });
        }
        intrinsics.insert(id, camera.intrinsics().map_err(|e| e.in_file(dir.join("cameras.txt")))?);
    }
    let mut cameras = BTreeMap::new();
    for image in model.images.values() {
        let bad = |message: String| FormatError::new(ErrorKind::Inconsistent, message).in_file(&images_path);
        let frame = FrameIndex::from_image_name(&image.name, 0)
            .ok_or_else(|| bad(format!("the image name `{}` has no frame number", image.name)))?;
        if frame.0 >= take.manifest.frame_count {
            return Err(
                bad(format!("image `{}`: the take has only {} frames", image.name, take.manifest.frame_count)).into()
            );
        }
        let lens = intrinsics.get(&image.camera_id).ok_or_else(|| {
            bad(format!("image `{}` names camera {}, which is not there", image.name, image.camera_id))
        })?;
        if cameras.insert(frame.0, Camera { intrinsics: *lens, camera_from_world: image.camera_from_world }).is_some() {
            return Err(bad(format!("two images are frame {}", frame.0)).into());
        }
    }
    Ok(cameras)
}
