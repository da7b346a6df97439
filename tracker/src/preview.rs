//! Pictures for the eye: landmarks, the reprojected mean face and the body around the head, drawn on a spread of frames.

use std::path::Path;

use glam::DVec2;
use image::{Rgb, RgbImage};
use risorius_formats::polygon::projected_hull;
use risorius_formats::pose_report::PoseReport;
use risorius_formats::{FormatError, FrameIndex, Reporter, Silent, Take};

use crate::error::Result;
use crate::poses::{model, read_track};

/// Writes `count` pictures into `out`: tracked landmarks green, mean face red, outline of the head hull blue.
///
/// Returns the frames that were drawn.
pub fn draw(take_dir: impl AsRef<Path>, out: &Path, count: usize, reporter: &dyn Reporter) -> Result<Vec<u32>> {
    let take = Take::open(take_dir)?;
    let track = read_track(&take)?;
    let report = PoseReport::read(take.pose_report_path())?;
    let placed = model::load(take.sparse_dir(), &take, 0, &Silent)?.model;
    let all: Vec<u32> = placed.frames.keys().copied().collect();
    let step = all.len().div_ceil(count.max(1)).max(1);
    let chosen: Vec<u32> = all.into_iter().step_by(step).collect();
    std::fs::create_dir_all(out).map_err(|e| FormatError::io(out, "create the folder", &e))?;
    reporter.stage("draw", Some(chosen.len() as u64));
    let drawn = |frame: u32, mut picture: RgbImage| -> Result<()> {
        if let Some(camera) = placed.camera(frame) {
            if let Some(hull) = &report.head_hull_in_world {
                let outline = projected_hull(hull, &camera);
                for i in 0..outline.len() {
                    line(&mut picture, outline[i], outline[(i + 1) % outline.len()], Rgb([60, 120, 255]));
                }
            }
            for p in &report.landmarks_in_world {
                dot(&mut picture, camera.project(*p), Rgb([255, 40, 40]));
            }
        }
        let row = track.rows.iter().find(|r| r.frame.0 == frame);
        for p in row.and_then(|r| r.landmarks.as_ref()).iter().flat_map(|l| &l.points_px) {
            dot(&mut picture, DVec2::new(p[0].into(), p[1].into()), Rgb([40, 255, 40]));
        }
        let path = out.join(FrameIndex(frame).image_name());
        picture.save(&path).map_err(|e| FormatError::syntax(format!("cannot write: {e}")).in_file(&path))?;
        reporter.advance(1);
        Ok(())
    };
    risorius_video::read_take_frames(&take, &chosen, drawn)?;
    Ok(chosen)
}

pub(crate) fn dot(picture: &mut RgbImage, at: DVec2, color: Rgb<u8>) {
    for dy in -1..=1 {
        for dx in -1..=1 {
            put(picture, at + DVec2::new(f64::from(dx), f64::from(dy)), color);
        }
    }
}

pub(crate) fn line(picture: &mut RgbImage, a: DVec2, b: DVec2, color: Rgb<u8>) {
    if !(a.is_finite() && b.is_finite()) || (b - a).length() > 1e5 {
        return;
    }
    let steps = (b - a).abs().max_element().ceil().max(1.0) as u32;
    for i in 0..=steps {
        put(picture, a.lerp(b, f64::from(i) / f64::from(steps)), color);
    }
}

fn put(picture: &mut RgbImage, at: DVec2, color: Rgb<u8>) {
    if at.x >= 0.0
        && at.y >= 0.0
        && let Some(pixel) = picture.get_pixel_mut_checked(at.x as u32, at.y as u32)
    {
        *pixel = color;
    }
}
