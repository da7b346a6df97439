//! The frames that the key frames leave over: placed by patches, else interpolated and corrected by the landmarks.

use std::collections::BTreeMap;

use glam::DVec2;
use risorius_formats::polygon::hull_contains;
use risorius_formats::{Reporter, Take, Track, TrackRow, Warning};

use super::between::Between;
use super::depths::Head;
use super::follow::Follow;
use super::model::PlacedFrame;
use super::picture::Picture;
use super::triangulate::median;
use super::{Placed, PosesOptions, interpolate, joint, sharpen};
use crate::error::Result;

/// Makes the key frames exact and places the frames between them by patches.
pub(super) fn follow_frames(
    placed: &mut Placed,
    take: &Take,
    pictures: &BTreeMap<u32, Picture>,
    face: &BTreeMap<u32, Vec<DVec2>>,
    reporter: &dyn Reporter,
) -> Result<()> {
    reporter.stage("refine the key frames", None);
    let sharpened = sharpen::sharpen(&mut placed.model, pictures);
    if let Some(done) = &sharpened {
        placed.notes.push(format!(
            "key frames refined on {} points in {} views: median error {:.2} px",
            done.points, done.views, done.median_error_px
        ));
        placed.notes.extend(done.notes.iter().cloned());
        placed.focal_share = Some(done.focal_share);
    } else {
        placed.notes.push("key frames as COLMAP left them: too few points whose patches are found again".to_owned());
    }
    let avoid = |frame: u32, pixel: DVec2| face.get(&frame).is_some_and(|hull| hull_contains(hull, pixel));
    let Some(follow) = Follow::new(&placed.model, pictures, &take.frames, avoid) else {
        placed.notes.push("too few patches to place the frames between key frames; they are interpolated".to_owned());
        return Ok(());
    };
    let poses = placed.model.poses();
    let spread = if sharpened.is_some() { joint::SPREAD } else { 0 };
    let keep = joint::spread(take.frames.len(), &poses, spread);
    let mut followed = follow.run(&poses, take, &keep, reporter)?;
    let mut errors: Vec<f64> = followed.errors_px.values().copied().collect();
    placed.notes.push(format!(
        "{} frames placed by patches of the nearest key frames: median error {:.2} px; {} not found, {} stood out",
        followed.poses.len(),
        median(&mut errors).unwrap_or(0.0),
        followed.lost.len(),
        followed.dropped.len()
    ));
    placed.frames_followed = followed.poses.len();
    reporter.stage("refine all frames", None);
    if let Some(joint) =
        sharpened.as_ref().and_then(|done| joint::refine(&mut placed.model, pictures, done, &follow, &mut followed))
    {
        placed.notes.extend(joint.notes);
        if joint.kept {
            placed.focal_share = Some(joint.focal_share);
        }
    }
    if let Some(first) = followed.cuts.first() {
        let message = format!(
            "{} jumps between one frame and the next: cuts in the video, or frames missing; the first before frame {first}",
            followed.cuts.len()
        );
        reporter.warn(Warning::new("cut", message.clone()));
        placed.notes.push(message);
    }
    for (frame, camera_from_world) in followed.poses {
        let lens = placed.model.frames.range(..frame).next_back().map_or(1, |(_, f)| f.lens);
        placed.model.frames.insert(frame, PlacedFrame { lens, camera_from_world, points: Vec::new() });
    }
    Ok(())
}

/// Interpolates what is left between placed frames.
pub(super) fn interpolate_between(
    placed: &mut Placed,
    take: &Take,
    landmarks: Option<(&Track, &Head)>,
    options: &PosesOptions,
    reporter: &dyn Reporter,
) {
    let max_gap_secs = options.max_gap_secs;
    let mut result = interpolate::interpolate(&placed.model.poses(), &take.frames, max_gap_secs);
    if let Some((track, head)) = landmarks
        && !result.poses.is_empty()
    {
        let usable = |r: &&TrackRow| r.is_valid(options.min_confidence) && r.landmarks.is_some();
        let rows = track.rows.iter().filter(usable).map(|r| (r.frame.0, r)).collect();
        let between =
            Between { placed: &placed.model, frames: &take.frames, rows: &rows, face: &head.landmarks, max_gap_secs };
        placed.notes.push(match between.correct(&mut result) {
            Some(count) => format!("{count} interpolated poses were corrected by the landmarks"),
            None => "too few placed frames to correct the interpolated poses by the landmarks".to_owned(),
        });
    }
    for (&frame, &camera_from_world) in &result.poses {
        // The lens of the frame before: a take has one camera, foreign models may have several.
        let lens = placed.model.frames.range(..frame).next_back().map_or(1, |(_, f)| f.lens);
        placed.model.frames.insert(frame, PlacedFrame { lens, camera_from_world, points: Vec::new() });
    }
    let left: u32 = result.gaps.iter().map(|r| r[1] - r[0] + 1).sum();
    if left > 0 {
        let message = format!(
            "{left} frames lie in {} gaps longer than {max_gap_secs} s between placed frames and got no pose",
            result.gaps.len()
        );
        reporter.warn(Warning::new("pose-gap", message.clone()));
        placed.notes.push(message);
    }
    placed.interpolated_runs = result.runs;
}
