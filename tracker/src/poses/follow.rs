//! Frames between key frames, placed one by one: patches of the nearest key frames are found in each frame, and the pose
//! is the one under which their 3-D points project there.
//!
//! Nothing drifts: every frame is compared with key frames, not with the frame before, which only says where to look. A
//! patch is cut where its point *projects* in the key frame, so a frame next to a key frame gets the key frame's pose and
//! what the detector had wrong cancels out. The two nearest key frames are used, the nearer counts more, so that one
//! fades into the next.

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::mpsc::sync_channel;

use glam::{DVec2, DVec3};
use rayon::prelude::*;
use risorius_formats::{FrameRecord, Intrinsics, Isometry, Reporter};
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
/// A frame that is this many times as far from its neighbours' mean as others is dropped.
const OUTLIER: f64 = 12.0;
/// … and at least this far, pixels.
const OUTLIER_PX: f64 = 1.5;
/// A frame that stands out is dropped if its patches miss by this many times what is usual.
const MISFIT: f64 = 2.0;
/// A step of this many times the usual one, and of this many pixels, is a cut.
const CUT: f64 = 12.0;
const CUT_PX: f64 = 25.0;
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
    /// Frames that fit well and yet stand far from the frame before: the video was cut there.
    pub(crate) cuts: Vec<u32>,
}

/// A pose and how well it fits.
struct Fit {
    pose: Isometry,
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
                        let point = model.points.get(&p.point3d?)?.position;
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
                        Some((strength, Mark { point, pixel, patches }))
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

    /// Places all frames of the video that have no pose yet.
    pub(crate) fn run(
        &self,
        placed: &BTreeMap<u32, Isometry>,
        video: &Path,
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
                    let mut reader = Reader::open(video)?;
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

    /// The nearest key frames and how much each counts, 0 … 1.
    fn nearest(&self, pose: &Isometry) -> Vec<(&Key, f64)> {
        let centre = pose.camera_center();
        let mut by_distance: Vec<(f64, &Key)> = self
            .keys
            .iter()
            .map(|k| {
                let turn = se3::rotation_angle(&(k.pose.rotation * pose.rotation.transpose()));
                (turn + k.pose.camera_center().distance(centre) / self.depth, k)
            })
            .collect();
        by_distance.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.frame.cmp(&b.1.frame)));
        by_distance.truncate(NEAREST);
        let first = by_distance.first().map_or(0.0, |d| d.0) + 1e-3;
        by_distance.into_iter().map(|(d, k)| (k, first / (d + 1e-3))).collect()
    }

    /// Fits the pose level by level, starting from `guess`; levels count from the finest of the picture.
    fn fit(&self, guess: &Isometry, picture: &Picture, levels: &[usize]) -> Option<Fit> {
        let mut pose = *guess;
        let keys = self.nearest(guess);
        let marks: Vec<(&Key, &Mark, f64)> =
            keys.iter().flat_map(|(key, weight)| key.marks.iter().map(move |m| (*key, m, *weight))).collect();
        let sigma = std::array::from_fn(|i| if i < 3 { LOOSE } else { LOOSE * self.depth });
        let prior = Prior { pose: *guess, sigma };
        let mut fit = None;
        for &level in levels {
            let scale = f64::from(1u32 << level);
            let found: Vec<Option<(DVec3, DVec2, f64)>> = marks
                .par_iter()
                .with_min_len(16)
                .map(|(key, mark, weight)| {
                    let patch = mark.patches.get(level)?;
                    let (at, warp) = expected(&self.lens, &key.pose, &pose, mark.pixel, mark.point)?;
                    let m = patch.find(picture, at, warp)?;
                    let near = m.centre.distance(at) <= 8.0 * scale;
                    (m.similarity >= SAME && near).then_some((
                        mark.point,
                        m.centre,
                        SIGMA_PX * scale / weight.max(1e-3).sqrt(),
                    ))
                })
                .collect();
            let found: Vec<(DVec3, DVec2, f64)> = found.into_iter().flatten().collect();
            if found.len() < 6 {
                if level == 0 {
                    return None;
                }
                continue;
            }
            let shape: Vec<DVec3> = found.iter().map(|f| f.0).collect();
            let points: Vec<RigidPoint> =
                found.iter().enumerate().map(|(landmark, f)| RigidPoint { landmark, sigma_px: f.2 }).collect();
            let view = FrameView { pixels: found.iter().map(|f| f.1).collect() };
            pose = refine_pose(&self.lens, pose, &shape, &points, &view, Some(&prior));
            if level == 0 {
                let mut errors: Vec<f64> = found
                    .iter()
                    .map(|(point, pixel, _)| self.lens.project(pose.transform_point(*point)).distance(*pixel))
                    .collect();
                let agreeing = errors.iter().filter(|e| **e <= AGREES_PX).count();
                let share = agreeing as f64 / marks.len().max(1) as f64;
                let error_px = median(&mut errors)?;
                fit = Some(Fit { pose, agreeing, share, error_px });
            }
        }
        fit
    }

    /// Drops poses that stand out from their neighbours in time.
    fn drop_outliers(&self, placed: &BTreeMap<u32, Isometry>, result: &mut Followed) {
        let mut all = placed.clone();
        all.extend(result.poses.iter().map(|(f, p)| (*f, *p)));
        let focal = 0.5 * (self.lens.fx + self.lens.fy);
        let off = |frame: u32| {
            let (a, b) = (all.get(&frame.checked_sub(1)?)?, all.get(&(frame + 1))?);
            let (t0, t1, t2) = (self.secs(frame - 1), self.secs(frame), self.secs(frame + 1));
            let share = if t2 > t0 { (t1 - t0) / (t2 - t0) } else { 0.5 };
            let half = se3::log(&b.compose(&a.inverse())).to_array().map(|v| v * share);
            let expected = se3::exp(Twist::from_array(half)).compose(a);
            let twist = se3::log(&all[&frame].compose(&expected.inverse()));
            // A turn moves the picture, a shift moves what is near.
            Some(focal * (twist.rotation.length() + twist.translation.length() / self.depth))
        };
        let distances: BTreeMap<u32, f64> = result.poses.keys().filter_map(|&f| Some((f, off(f)?))).collect();
        let Some(usual) = median(&mut distances.values().copied().collect::<Vec<_>>()) else { return };
        let limit = (OUTLIER * usual).max(OUTLIER_PX);
        let usual_error = median(&mut result.errors_px.values().copied().collect::<Vec<_>>()).unwrap_or(0.0);
        for (&frame, &distance) in &distances {
            // The neighbours of a wild frame look wild too: only the worst of three goes.
            let worst =
                [frame.wrapping_sub(1), frame + 1].iter().all(|f| distances.get(f).is_none_or(|d| *d <= distance));
            // On both sides of a cut the pictures fit their poses.
            let fits = result.errors_px.get(&frame).is_some_and(|e| *e <= MISFIT * usual_error);
            if distance > limit && worst && !fits {
                result.poses.remove(&frame);
                result.errors_px.remove(&frame);
                result.dropped.push(frame);
            }
        }
        result.cuts = self.cuts(&all, usual);
    }

    /// Frames that the camera cannot have reached from the frame before.
    fn cuts(&self, all: &BTreeMap<u32, Isometry>, usual: f64) -> Vec<u32> {
        let focal = 0.5 * (self.lens.fx + self.lens.fy);
        let steps: Vec<(u32, f64)> = all
            .iter()
            .zip(all.iter().skip(1))
            .filter(|((a, _), (b, _))| **b == **a + 1)
            .map(|((_, a), (b, pose))| {
                let twist = se3::log(&pose.compose(&a.inverse()));
                (*b, focal * (twist.rotation.length() + twist.translation.length() / self.depth))
            })
            .collect();
        let Some(step) = median(&mut steps.iter().map(|s| s.1).collect::<Vec<_>>()) else { return Vec::new() };
        let limit = (CUT * step).max(OUTLIER * usual).max(CUT_PX);
        steps.into_iter().filter(|s| s.1 > limit).map(|s| s.0).collect()
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
