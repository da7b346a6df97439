//! Frames between key frames, placed one by one: patches of the nearest key frames are found in each frame, and the pose
//! is the one under which their 3-D points project there.
//!
//! Nothing drifts: every frame is compared with key frames, not with the frame before, which only says where to look. A
//! patch is cut where its point *projects* in the key frame, so a frame next to a key frame gets the key frame's pose and
//! what the detector had wrong cancels out. The two nearest key frames are used, the nearer counts more, so that one
//! fades into the next.

mod again;
mod outliers;

use std::collections::{BTreeMap, BTreeSet};
use std::sync::mpsc::sync_channel;

use glam::{DVec2, DVec3};
use rayon::prelude::*;
use risorius_formats::{FrameRecord, Intrinsics, Isometry, Reporter, Take};
use risorius_video::{Reader, VideoError};

use super::interpolate::interpolate;
use super::model::TakeModel;
use super::patch::Template;
use super::picture::Picture;
use super::refine::{FrameView, Prior, RigidPoint, refine_pose};
use super::sharpen::expected;
use super::triangulate::median;
use crate::error::{Result, TrackerError};
use crate::se3::{self, Twist};

/// Patches that a key frame keeps.
const MARKS: usize = 110;
/// Key frames that a frame is compared with.
const NEAREST: usize = 2;
/// A patch is the same where it correlates at least this much.
const SAME: f32 = 0.75;
/// Noise of a found patch, pixels.
const SIGMA_PX: f64 = 0.25;
/// A patch agrees with the pose within this, pixels.
const AGREES_PX: f64 = 1.5;
/// Agreeing patches that a pose needs, and their least share.
const LEAST_MARKS: usize = 14;
const LEAST_SHARE: f64 = 0.35;
/// How far the pose may be from where it was expected: radians, and shares of the depth.
const LOOSE: f64 = 0.03;
/// Decoded pictures that wait.
const WAITING: usize = 4;

/// What following needs.
pub(crate) struct Follow<'a> {
    /// The lens of all frames.
    lens: Intrinsics,
    keys: Vec<Key>,
    frames: &'a [FrameRecord],
    /// Median depth of the points.
    depth: f64,
}

/// A placed frame and its patches.
struct Key {
    frame: u32,
    pose: Isometry,
    marks: Vec<Mark>,
}

/// A point, where it projects in its key frame, and its patches from fine to coarse.
struct Mark {
    id: u64,
    point: DVec3,
    pixel: DVec2,
    patches: Vec<Template>,
}

/// Frames that were placed.
#[derive(Clone, Debug, Default)]
pub(crate) struct Followed {
    /// Their `camera_from_world`.
    pub(crate) poses: BTreeMap<u32, Isometry>,
    /// Median distance of the found patches from the projected points, pixels, by frame.
    pub(crate) errors_px: BTreeMap<u32, f64>,
    /// Frames that could not be placed.
    pub(crate) lost: Vec<u32>,
    /// Frames that were placed, but stood out and fit badly.
    pub(crate) dropped: Vec<u32>,
    /// Where patches were found in the placed frames.
    pub(crate) sights: BTreeMap<u32, Vec<Sight>>,
    /// Pictures of the frames that were to be kept.
    pub(crate) pictures: BTreeMap<u32, Picture>,
    /// Frames that fit well and yet stand far from the frame before: the video was cut there.
    pub(crate) cuts: Vec<u32>,
}

/// A patch that was found: which of which key frame, and where. Kept for every frame of a video, hence small.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Sight {
    key: u16,
    mark: u16,
    pixel: [f32; 2],
}

/// A pose and how well it fits.
struct Fit {
    pose: Isometry,
    sights: Vec<Sight>,
    agreeing: usize,
    share: f64,
    error_px: f64,
}

impl Fit {
    fn is_good(&self) -> bool {
        self.agreeing >= LEAST_MARKS && self.share >= LEAST_SHARE
    }
}

impl<'a> Follow<'a> {
    /// From key frames with their pictures; `None` where too few patches can be cut.
    pub(crate) fn new(
        model: &TakeModel,
        pictures: &BTreeMap<u32, Picture>,
        frames: &'a [FrameRecord],
        avoid: impl Fn(u32, DVec2) -> bool + Sync,
    ) -> Option<Self> {
        if model.lenses.len() != 1 {
            return None;
        }
        let lens = *model.lenses.first_key_value()?.1;
        let placed: Vec<(&u32, &Picture)> = pictures.iter().filter(|(f, _)| model.frames.contains_key(f)).collect();
        let keys: Vec<Key> = placed
            .par_iter()
            .filter_map(|(frame, picture)| {
                let placed = model.frames.get(frame)?;
                let pose = placed.camera_from_world;
                let mut marks: Vec<(f32, Mark)> = placed
                    .points
                    .iter()
                    .filter_map(|p| {
                        let id = p.point3d?;
                        let point = model.points.get(&id)?.position;
                        let pixel = lens.project(pose.transform_point(point));
                        if avoid(**frame, pixel) {
                            return None;
                        }
                        let finest = Template::cut(picture, picture.finest(), pixel, false)?;
                        let strength = finest.strength;
                        let mut patches = vec![finest];
                        // Coarse patches help to find the fine ones; near the border they are missing.
                        for level in picture.finest() + 1..=(picture.finest() + 3).min(picture.coarsest()) {
                            let Some(patch) = Template::cut(picture, level, pixel, false) else { break };
                            patches.push(patch);
                        }
                        Some((strength, Mark { id, point, pixel, patches }))
                    })
                    .collect();
                marks.sort_by(|a, b| b.0.total_cmp(&a.0));
                let marks = spread(marks.into_iter().map(|m| m.1).collect(), &lens);
                (marks.len() >= LEAST_MARKS).then_some(Key { frame: **frame, pose, marks })
            })
            .collect();
        let mut depths: Vec<f64> =
            keys.iter().flat_map(|k| k.marks.iter().map(|m| k.pose.transform_point(m.point).z)).collect();
        let depth = median(&mut depths)?;
        (keys.len() >= 2).then_some(Self { lens, keys, frames, depth })
    }

    /// Places all frames of the video that have no pose yet; pictures of the frames in `keep` are kept.
    pub(crate) fn run(
        &self,
        placed: &BTreeMap<u32, Isometry>,
        take: &Take,
        keep: &BTreeSet<u32>,
        reporter: &dyn Reporter,
    ) -> Result<Followed> {
        // Where to look when the frame before does not tell; however long the gap.
        let guesses = interpolate(placed, self.frames, f64::INFINITY).poses;
        let wanted: Vec<u32> = (0..self.frames.len() as u32).filter(|f| !placed.contains_key(f)).collect();
        reporter.stage("place the other frames", Some(wanted.len() as u64));
        let mut result = Followed::default();
        let (sender, receiver) = sync_channel::<(u32, Picture)>(WAITING);
        std::thread::scope(|scope| -> Result<()> {
            let decode = std::thread::Builder::new()
                .name("decode".to_owned())
                .spawn_scoped(scope, move || -> Result<(), VideoError> {
                    let mut reader = Reader::open_take(take)?;
                    for (index, _) in self.frames.iter().enumerate() {
                        if placed.contains_key(&(index as u32)) {
                            if !reader.skip_frame()? {
                                break;
                            }
                            continue;
                        }
                        let Some(frame) = reader.next_frame()? else { break };
                        if sender.send((frame.index, Picture::new(&frame.image))).is_err() {
                            break;
                        }
                    }
                    Ok(())
                })
                .map_err(|e| TrackerError::Threads { message: e.to_string() })?;
            while let Ok((frame, picture)) = receiver.recv() {
                if reporter.cancelled() {
                    drop(receiver);
                    return Err(TrackerError::Cancelled { doing: "placing the frames between key frames".into() });
                }
                match self.place(frame, &picture, placed, &guesses, &result.poses) {
                    Some(fit) => {
                        result.poses.insert(frame, fit.pose);
                        result.errors_px.insert(frame, fit.error_px);
                        result.sights.insert(frame, fit.sights);
                        if keep.contains(&frame) {
                            result.pictures.insert(frame, picture);
                        }
                    }
                    None => result.lost.push(frame),
                }
                reporter.advance(1);
            }
            match decode.join() {
                Ok(done) => Ok(done?),
                Err(_) => Err(TrackerError::Threads { message: "the decoder stopped".to_owned() }),
            }
        })?;
        self.drop_outliers(placed, &mut result);
        Ok(result)
    }

    fn secs(&self, frame: u32) -> f64 {
        self.frames[frame as usize].timestamp_nanos as f64 * 1e-9
    }

    fn place(
        &self,
        frame: u32,
        picture: &Picture,
        placed: &BTreeMap<u32, Isometry>,
        guesses: &BTreeMap<u32, Isometry>,
        followed: &BTreeMap<u32, Isometry>,
    ) -> Option<Fit> {
        let at = |f: Option<u32>| f.and_then(|f| placed.get(&f).or_else(|| followed.get(&f)));
        let (before, earlier) = (at(frame.checked_sub(1)), at(frame.checked_sub(2)));
        if let (Some(a), Some(b)) = (before, earlier) {
            // Goes on as it went.
            let (t0, t1, t2) = (self.secs(frame - 2), self.secs(frame - 1), self.secs(frame));
            let share = if t1 > t0 { ((t2 - t1) / (t1 - t0)).clamp(0.0, 4.0) } else { 1.0 };
            let step = se3::log(&a.compose(&b.inverse())).to_array().map(|v| v * share);
            let guess = se3::exp(Twist::from_array(step)).compose(a);
            if let Some(fit) = self.fit(&guess, picture, &[1, 0]).filter(Fit::is_good) {
                return Some(fit);
            }
        }
        let nearest = || {
            let distance = |k: &&Key| k.frame.abs_diff(frame);
            self.keys.iter().min_by_key(distance).map(|k| k.pose)
        };
        let others = [before.copied(), guesses.get(&frame).copied(), nearest()];
        others.into_iter().flatten().find_map(|guess| self.fit(&guess, picture, &[3, 2, 1, 0]).filter(Fit::is_good))
    }

    /// How far a camera is from a key frame's, radians and shares of the depth.
    fn distance(&self, key: &Isometry, pose: &Isometry) -> f64 {
        let turn = se3::rotation_angle(&(key.rotation * pose.rotation.transpose()));
        turn + key.camera_center().distance(pose.camera_center()) / self.depth
    }

    /// The nearest key frames and how much each counts, 0 … 1.
    fn nearest(&self, pose: &Isometry) -> Vec<(usize, f64)> {
        let mut by_distance: Vec<(f64, usize)> =
            self.keys.iter().enumerate().map(|(i, k)| (self.distance(&k.pose, pose), i)).collect();
        by_distance.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        by_distance.truncate(NEAREST);
        let first = by_distance.first().map_or(0.0, |d| d.0) + 1e-3;
        by_distance.into_iter().map(|(d, k)| (k, first / (d + 1e-3))).collect()
    }

    fn loose(&self, pose: &Isometry) -> Prior {
        Prior { pose: *pose, sigma: std::array::from_fn(|i| if i < 3 { LOOSE } else { LOOSE * self.depth }) }
    }

    /// Fits the pose level by level, starting from `guess`; levels count from the finest of the picture.
    fn fit(&self, guess: &Isometry, picture: &Picture, levels: &[usize]) -> Option<Fit> {
        let mut pose = *guess;
        let keys = self.nearest(guess);
        let marks: Vec<(usize, usize, f64)> = keys
            .iter()
            .flat_map(|&(key, weight)| (0..self.keys[key].marks.len()).map(move |mark| (key, mark, weight)))
            .collect();
        let prior = self.loose(guess);
        let mut fit = None;
        for &level in levels {
            let scale = f64::from(1u32 << level);
            let found: Vec<Option<(Sight, DVec3, DVec2, f64)>> = marks
                .par_iter()
                .with_min_len(16)
                .map(|&(key, index, weight)| {
                    let mark = &self.keys[key].marks[index];
                    let patch = mark.patches.get(level)?;
                    let (at, warp) = expected(&self.lens, &self.keys[key].pose, &pose, mark.pixel, mark.point)?;
                    let m = patch.find(picture, at, warp)?;
                    let near = m.centre.distance(at) <= 8.0 * scale;
                    let sight = Sight { key: key as u16, mark: index as u16, pixel: m.centre.as_vec2().to_array() };
                    (m.similarity >= SAME && near).then_some((
                        sight,
                        mark.point,
                        m.centre,
                        SIGMA_PX * scale / weight.max(1e-3).sqrt(),
                    ))
                })
                .collect();
            let found: Vec<(Sight, DVec3, DVec2, f64)> = found.into_iter().flatten().collect();
            if found.len() < 6 {
                if level == 0 {
                    return None;
                }
                continue;
            }
            let (seen, sights) = Seen::of(found);
            pose = seen.pose(&self.lens, pose, &prior);
            if level == 0 {
                let mut errors = seen.errors_px(&self.lens, &pose);
                let agreeing = errors.iter().filter(|e| **e <= AGREES_PX).count();
                let share = agreeing as f64 / marks.len().max(1) as f64;
                let error_px = median(&mut errors)?;
                fit = Some(Fit { pose, sights, agreeing, share, error_px });
            }
        }
        fit
    }

    /// Indices of the key frames nearest to a pose.
    pub(crate) fn nearest_keys(&self, pose: &Isometry) -> Vec<u32> {
        self.nearest(pose).into_iter().map(|(key, _)| self.keys[key].frame).collect()
    }
}

/// Points and where they were seen in one frame.
struct Seen {
    shape: Vec<DVec3>,
    points: Vec<RigidPoint>,
    view: FrameView,
}

impl Seen {
    fn of(found: impl IntoIterator<Item = (Sight, DVec3, DVec2, f64)>) -> (Self, Vec<Sight>) {
        let mut seen = Self { shape: Vec::new(), points: Vec::new(), view: FrameView { pixels: Vec::new() } };
        let mut sights = Vec::new();
        for (landmark, (sight, point, pixel, sigma_px)) in found.into_iter().enumerate() {
            seen.shape.push(point);
            seen.points.push(RigidPoint { landmark, sigma_px });
            seen.view.pixels.push(pixel);
            sights.push(sight);
        }
        (seen, sights)
    }

    fn pose(&self, lens: &Intrinsics, start: Isometry, prior: &Prior) -> Isometry {
        refine_pose(lens, start, &self.shape, &self.points, &self.view, Some(prior))
    }

    fn errors_px(&self, lens: &Intrinsics, pose: &Isometry) -> Vec<f64> {
        let error = |(point, pixel): (&DVec3, &DVec2)| lens.project(pose.transform_point(*point)).distance(*pixel);
        self.shape.iter().zip(&self.view.pixels).map(error).collect()
    }
}

/// The first [`MARKS`] of a list in falling order, no more than a few of each part of the picture.
fn spread(marks: Vec<Mark>, lens: &Intrinsics) -> Vec<Mark> {
    const CELLS: f64 = 8.0;
    let most = MARKS.div_ceil(40);
    let mut count = BTreeMap::new();
    let cell = |p: DVec2| {
        let side = |v: f64, size: u32| (v / f64::from(size) * CELLS).clamp(0.0, CELLS - 1.0) as u8;
        (side(p.x, lens.width), side(p.y, lens.height))
    };
    let (mut first, mut rest) = (Vec::new(), Vec::new());
    for mark in marks {
        let n = count.entry(cell(mark.pixel)).or_insert(0usize);
        *n += 1;
        if *n <= most { first.push(mark) } else { rest.push(mark) }
    }
    first.extend(rest);
    first.truncate(MARKS);
    first
}

#[cfg(test)]
#[path = "follow_tests.rs"]
mod tests;
