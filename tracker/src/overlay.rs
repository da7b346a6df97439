//! `tracker check --overlay`: the whole video with the track drawn on it, for the eye.

use std::path::Path;

use glam::{DVec2, DVec3};
use image::{Rgb, RgbImage};
use risorius_formats::{Landmarks68, Reporter, Take, TrackRow};
use risorius_video::{Reader, Writer};

use crate::error::{Result, TrackerError};
use crate::poses::focal::table_camera;
use crate::poses::read_track;
use crate::preview::{dot, line};

const POINTS: Rgb<u8> = Rgb([40, 255, 40]);
const LINES: Rgb<u8> = Rgb([30, 160, 30]);
const LOST: Rgb<u8> = Rgb([255, 40, 40]);
const BAR: Rgb<u8> = Rgb([255, 200, 40]);
const AXES: [Rgb<u8>; 3] = [Rgb([255, 60, 60]), Rgb([60, 255, 60]), Rgb([80, 120, 255])];
/// Length of the drawn axes, millimetres.
const AXIS_MM: f64 = 60.0;

/// Chains of landmarks that are joined, and whether they close.
const CHAINS: [(std::ops::Range<usize>, bool); 9] = [
    (0..17, false),
    (17..22, false),
    (22..27, false),
    (27..31, false),
    (31..36, false),
    (36..42, true),
    (42..48, true),
    (48..60, true),
    (60..68, true),
];

/// Writes the video with landmarks, the head's axes and a bar for each AU to `out` (`.mp4`); lost frames get a red frame.
///
/// Returns how many frames were drawn.
pub fn draw(take_dir: impl AsRef<Path>, out: &Path, reporter: &dyn Reporter) -> Result<usize> {
    let take = Take::open(take_dir)?;
    let track = read_track(&take)?;
    let focal = table_camera(&track.rows).map(|c| (c.focal_px, DVec2::new(c.cx, c.cy)));
    let mut rows: Vec<Option<&TrackRow>> = vec![None; take.frames.len()];
    for row in track.rows.iter().filter(|r| r.success) {
        if let Some(slot) = rows.get_mut(row.frame.0 as usize) {
            *slot = Some(row);
        }
    }
    let fps = if take.fps() > 0.0 { take.fps() } else { 30.0 };
    let mut writer = Writer::create(out, take.manifest.width, take.manifest.height, fps)?;
    let mut reader = Reader::open_take(&take)?;
    reporter.stage("draw", Some(rows.len() as u64));
    let mut drawn = 0;
    for row in rows {
        if reporter.cancelled() {
            return Err(TrackerError::Cancelled { doing: "drawing".to_owned() });
        }
        let Some(mut frame) = reader.next_frame()? else { break };
        match row {
            Some(row) => draw_row(&mut frame.image, row, focal),
            None => draw_lost(&mut frame.image),
        }
        writer.push(&frame.image)?;
        drawn += 1;
        reporter.advance(1);
    }
    writer.finish()?;
    Ok(drawn)
}

fn draw_row(picture: &mut RgbImage, row: &TrackRow, focal: Option<(f64, DVec2)>) {
    if let Some(landmarks) = &row.landmarks {
        draw_landmarks(picture, landmarks);
    }
    if let (Some(pose), Some((focal_px, center))) = (row.head_pose, focal) {
        let camera_from_head = pose.camera_from_head();
        let project = |p: DVec3| {
            let p = camera_from_head.transform_point(p);
            (p.z > 0.0).then(|| p.truncate() / p.z * focal_px + center)
        };
        for (axis, color) in [DVec3::X, DVec3::Y, DVec3::NEG_Z].into_iter().zip(AXES) {
            if let (Some(a), Some(b)) = (project(DVec3::ZERO), project(axis * AXIS_MM)) {
                line(picture, a, b, color);
            }
        }
    }
    draw_bars(picture, &row.intensities);
}

fn draw_landmarks(picture: &mut RgbImage, landmarks: &Landmarks68) {
    let at = |i: usize| DVec2::from(landmarks.points_px[i].map(f64::from));
    for (chain, closes) in CHAINS {
        let (first, last) = (chain.start, chain.end - 1);
        chain.clone().skip(1).for_each(|i| line(picture, at(i - 1), at(i), LINES));
        if closes {
            line(picture, at(last), at(first), LINES);
        }
    }
    (0..68).for_each(|i| dot(picture, at(i), POINTS));
}

/// A bar for each AU along the left edge, from the top; a full one is a fifth of the picture wide.
fn draw_bars(picture: &mut RgbImage, intensities: &[Option<f32>]) {
    let (full, step) = (f64::from(picture.width()) * 0.2, (f64::from(picture.height()) / 60.0).max(3.0));
    for (k, value) in intensities.iter().enumerate() {
        let length = full * f64::from(value.unwrap_or(0.0)) / 5.0;
        for thick in 0..(step * 0.5) as u32 {
            let y = step * (k + 1) as f64 + f64::from(thick);
            line(picture, DVec2::new(2.0, y), DVec2::new(2.0 + length, y), BAR);
        }
    }
}

fn draw_lost(picture: &mut RgbImage) {
    let (w, h) = (f64::from(picture.width()) - 1.0, f64::from(picture.height()) - 1.0);
    for inset in 0..4 {
        let i = f64::from(inset);
        let corners = [DVec2::new(i, i), DVec2::new(w - i, i), DVec2::new(w - i, h - i), DVec2::new(i, h - i)];
        for k in 0..4 {
            line(picture, corners[k], corners[(k + 1) % 4], LOST);
        }
    }
}
