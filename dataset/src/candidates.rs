//! Every frame of every take with what is known of it, and the region outlines of those that may be chosen.

use std::collections::BTreeSet;

use glam::DVec3;
use risorius_formats::head_hull::world_from_head;
use risorius_formats::nerfies::Polygons;
use risorius_formats::{AttributeTable, Camera, Isometry, Landmarks68, Reporter, Similarity, Warning};

use crate::TAKE_OFFSET;
use crate::align::TakeInput;
use crate::error::{DatasetError, Result};
use crate::regions::{self, RegionStyle, Rejection};
use crate::rows::{FrameRow, FrameState, Rows, TakeRows};
use crate::signals::Signals;
use crate::views;

/// What a usable frame has beyond its row.
pub(crate) struct Sight {
    /// See [`Landmarks68::asymmetry`]; infinite without landmarks.
    pub(crate) asymmetry: f32,
    /// Its region outlines.
    pub(crate) polygons: Result<Polygons, Rejection>,
}

/// The middle and the axes of the head in the first take's world; the world's own axes where the face is unknown.
pub(crate) fn head_axes(input: &TakeInput) -> Isometry {
    let fallback = Isometry::new(glam::DMat3::IDENTITY, input.report.head_center);
    world_from_head(&input.report.landmarks_in_world).unwrap_or(fallback)
}

/// All frames as rows, and a [`Sight`] for each usable one, take after take in the order of frames.
pub(crate) fn collect(
    inputs: &[TakeInput],
    signals: &[Signals],
    worlds: &[Similarity],
    table: &AttributeTable,
    styles: &[RegionStyle],
    reporter: &dyn Reporter,
) -> Result<(Rows, Vec<Sight>)> {
    let mut takes = Vec::with_capacity(inputs.len());
    let mut sights = Vec::new();
    let world_from_head = head_axes(&inputs[0]);
    for ((input, signals), world) in inputs.iter().zip(signals).zip(worlds) {
        let before = sights.len();
        takes.push(take_rows(input, signals, world, &world_from_head, styles, &mut sights));
        if sights.len() == before {
            let (cameras, valid) = (input.cameras.len(), signals.frames.len());
            return Err(DatasetError::NoCandidates { path: input.take.sparse_dir(), cameras, valid });
        }
        let frame_count = input.take.manifest.frame_count;
        if inputs.len() > 1 && frame_count > TAKE_OFFSET {
            return Err(DatasetError::Option {
                message: format!(
                    "take `{}` has {frame_count} frames; with several takes at most {TAKE_OFFSET} can be numbered",
                    input.name
                ),
                hint: "build from this take alone".to_owned(),
            });
        }
    }
    let rejected = sights.iter().filter(|s| s.polygons.is_err()).count();
    if rejected > 0 {
        let message = format!(
            "{rejected} of {} frames have no usable region masks (turned too far, or outside the picture)",
            sights.len()
        );
        reporter.warn(Warning::new("rejected-masks", message));
    }
    Ok((Rows { table: table.clone(), takes }, sights))
}

fn take_rows(
    input: &TakeInput,
    signals: &Signals,
    world: &Similarity,
    world_from_head: &Isometry,
    styles: &[RegionStyle],
    sights: &mut Vec<Sight>,
) -> TakeRows {
    let manifest = &input.take.manifest;
    let runs = &input.report.interpolated_runs;
    let interpolated: BTreeSet<u32> = runs.iter().flat_map(|&[from, to]| from..=to).collect();
    let mut valid = signals.frames.iter().peekable();
    let mut frames = Vec::with_capacity(input.take.frames.len());
    for (frame, record) in (0u32..).zip(&input.take.frames) {
        let own = valid.next_if(|v| v.frame == frame);
        let camera = input
            .cameras
            .get(&frame)
            .map(|camera| Camera { camera_from_world: world.transform_pose(&camera.camera_from_world), ..*camera });
        let state = match signals.states[frame as usize] {
            FrameState::Usable if camera.is_none() => FrameState::Unposed,
            FrameState::Usable if record.repeated => FrameState::Repeated,
            state => state,
        };
        let view = camera.and_then(|c| views::direction(&c, world_from_head)).map(views::yaw_pitch_deg);
        let mut masks = None;
        if let (FrameState::Usable, Some(own), Some(camera)) = (state, own, input.cameras.get(&frame)) {
            let landmarks = input.track.rows[own.row].landmarks.as_deref();
            let outlines = regions::polygons(landmarks, styles, manifest.width, manifest.height);
            let polygons = outlines.and_then(|polygons| {
                let face = &input.report.landmarks_in_world;
                regions::check_view(landmarks, face, camera, view).map(|()| polygons)
            });
            masks = Some(polygons.as_ref().map_or_else(|r| r.name().to_owned(), |_| "ok".to_owned()));
            sights.push(Sight { asymmetry: landmarks.map_or(f32::INFINITY, Landmarks68::asymmetry), polygons });
        }
        frames.push(FrameRow {
            frame,
            timestamp_nanos: record.timestamp_nanos,
            state,
            confidence: signals.confidences[frame as usize],
            sharpness: record.sharpness,
            luma_mean: record.luma_mean,
            clipped_share: record.clipped_share,
            id: None,
            split: None,
            masks,
            intensities: own.map(|o| o.intensities.clone()),
            camera,
            view,
            interpolated: interpolated.contains(&frame),
        });
    }
    TakeRows { name: input.name.clone(), frames }
}

/// The largest share of usable frames whose chin may lie below the drop that [`head_hull`] allows for: a few outliers
/// must not make the head longer.
const CHIN_OUTLIERS: f64 = 0.01;

/// Corners of a convex body around the head of a take, in the dataset's world: the one of the head route, else one from
/// the triangulated face. `None` without a face.
pub(crate) fn head_hull(
    input: &TakeInput,
    rows: &TakeRows,
    signals: &Signals,
    world: &Similarity,
) -> Option<Vec<DVec3>> {
    let in_world = |corners: &[DVec3]| corners.iter().map(|&p| world.transform_point(p)).collect();
    if let Some(hull) = &input.report.head_hull_in_world {
        return Some(in_world(hull));
    }
    let landmarks = &input.report.landmarks_in_world;
    let world_from_head = world_from_head(landmarks)?;
    let head_from_world = world_from_head.inverse();
    let face: Vec<DVec3> = landmarks.iter().map(|&p| head_from_world.transform_point(p)).collect();
    let chin = landmarks[8];
    let length = (face[8].y - face[17..27].iter().map(|p| p.y).sum::<f64>() / 10.0).abs();
    let below = chin + world_from_head.rotation.y_axis * length;
    let mut drops: Vec<f64> = signals
        .frames
        .iter()
        .filter(|v| rows.frames[v.frame as usize].state == FrameState::Usable)
        .filter_map(|v| {
            let camera = input.cameras.get(&v.frame)?;
            let points = &input.track.rows[v.row].landmarks.as_ref()?.points_px;
            let [x, y] = points[8].map(f64::from);
            let (from, to) = (camera.project(chin), camera.project(below));
            let down = to - from;
            // In lengths of the face, along its own way down in the picture.
            let share = (glam::DVec2::new(x, y) - from).dot(down) / down.length_squared();
            share.is_finite().then_some(share * length)
        })
        .collect();
    drops.sort_unstable_by(f64::total_cmp);
    let place = ((drops.len() as f64 * (1.0 - CHIN_OUTLIERS)) as usize).min(drops.len().saturating_sub(1));
    let drop = drops.get(place).copied().unwrap_or(0.0).clamp(0.0, length);
    let hull = risorius_formats::head_hull::head_hull(&face, drop);
    let corners: Vec<DVec3> = hull.iter().map(|&p| world_from_head.transform_point(p)).collect();
    Some(in_world(&corners))
}
