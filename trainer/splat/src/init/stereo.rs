//! A cloud of surfels from frames with parallax: plane sweeps of some views, fused.

use glam::DVec3;
use rayon::prelude::*;
use risorius_formats::Isometry;

use super::choose;
use super::fuse::{self, DepthMap, Surfel};
use super::smooth;
use super::sweep::{self, Planes, Posed};
use super::view::View;
use crate::scene::Scene;

/// How the sweep is made; lengths in metres.
#[derive(Clone, Debug, PartialEq)]
pub struct StereoSettings {
    /// Reference views of the head, among the frames with the smallest activations.
    pub head_views: usize,
    /// Reference views of the room, among all frames.
    pub room_views: usize,
    /// Neighbours of each.
    pub neighbours: usize,
    /// Depths to try.
    pub planes: usize,
    /// Smallest side of the voxels of the head, for a face of 0.1 m radius.
    pub head_voxel_m: f64,
    /// Smallest side of the voxels of the room, likewise.
    pub room_voxel_m: f64,
    /// Seeds at most, about: where there are more, voxels grow.
    pub seeds: usize,
}

impl Default for StereoSettings {
    fn default() -> Self {
        Self {
            head_views: 14,
            room_views: 18,
            neighbours: 5,
            planes: 128,
            head_voxel_m: 0.0024,
            room_voxel_m: 0.006,
            seeds: 75_000,
        }
    }
}

/// Share of frames that count as calm.
const CALM: f64 = 0.2;
/// Share of frames that are calm enough where more of the head's views are needed.
const CALMER: f64 = 0.5;
/// The smallest side of a voxel, pixels of the reduced pictures.
const VOXEL_PX: f64 = 1.45;

/// Reference views and the frames that their neighbours come from.
#[derive(Clone, Debug, Default)]
pub(crate) struct Choice {
    /// Reference views with their neighbours.
    pub(crate) views: Vec<(usize, Vec<usize>)>,
}

impl Choice {
    /// `count` references of `pool`, with neighbours of `pool`, or of all frames where these are too few.
    fn new(pool: &[usize], poses: &[Isometry], count: usize, neighbours: usize, face_distance: f64) -> Self {
        let all: Vec<usize> = (0..poses.len()).collect();
        let with = |r: usize| {
            let mut near = choose::neighbours(r, pool, poses, neighbours);
            if near.len() < 3.min(neighbours) {
                near = choose::neighbours(r, &all, poses, neighbours);
            }
            (r, near)
        };
        let views = choose::spread(pool, poses, face_distance, count).into_iter().map(with);
        Self { views: views.filter(|v| !v.1.is_empty()).collect() }
    }
}

/// Poses that see one rigid body, and which frames show it.
#[derive(Clone, Debug)]
pub(crate) struct Rig {
    /// `camera_from_head` or `camera_from_room` per frame.
    pub(crate) poses: Vec<Isometry>,
    /// What to look at.
    pub(crate) choice: Choice,
    /// Median distance of the cameras from the face, metres.
    pub(crate) face_distance: f64,
    /// Depths to try.
    pub(crate) planes: Planes,
}

/// Which part a rig is for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Part {
    /// Calm frames, the head.
    Head,
    /// All frames, the room.
    Room,
    /// Both, where the head is still.
    Both,
}

impl Rig {
    /// `None` without frames whose cameras have a finite place.
    pub(crate) fn new(scene: &Scene<'_>, poses: Vec<Isometry>, part: Part, settings: &StereoSettings) -> Option<Self> {
        let usable: Vec<usize> = (0..poses.len()).filter(|&i| is_usable(&poses[i])).collect();
        let mut distances: Vec<f64> = usable.iter().map(|&i| poses[i].camera_center().length()).collect();
        distances.sort_by(f64::total_cmp);
        let face_distance = *distances.get(distances.len() / 2)?;
        let nearest = distances[distances.len() / 50];
        let radius = f64::from(scene.face_radius_m);
        let near = (nearest - 1.2 * radius).max(0.3 * nearest).max(1e-3);
        // Where only the head may be fitted, nothing lies far behind it.
        let only_head = scene.head_hull.is_some();
        let far = if only_head { face_distance + 2.5 * radius } else { 40.0 * face_distance };
        let planes =
            Planes { nearest: 1.0 / near, farthest: 1.0 / far.max(1.1 * near), count: settings.planes.clamp(3, 4096) };
        let sum = |i: &usize| scene.frames[*i].activations.as_ref().map(|a| a.iter().map(|v| v.max(0.0)).sum());
        let sums: Vec<Option<f32>> = usable.iter().map(sum).collect();
        let calm: Vec<usize> =
            choose::smallest(&sums, CALM, 4 * settings.head_views).into_iter().map(|k| usable[k]).collect();
        let n = settings.neighbours;
        let mut choice = Choice::default();
        if part != Part::Room {
            choice.views.extend(Choice::new(&calm, &poses, settings.head_views, n, face_distance).views);
        }
        if part == Part::Both && !only_head || part == Part::Room {
            choice.views.extend(Choice::new(&usable, &poses, settings.room_views, n, face_distance).views);
        } else {
            // Where no view of the room shows the head too, more of the head's are needed.
            let calmer: Vec<usize> =
                choose::smallest(&sums, CALMER, 4 * settings.head_views).into_iter().map(|k| usable[k]).collect();
            let more = Choice::new(&calmer, &poses, settings.room_views * 2 / 3, n, face_distance).views;
            let known: Vec<usize> = choice.views.iter().map(|v| v.0).collect();
            choice.views.extend(more.into_iter().filter(|v| !known.contains(&v.0)));
        }
        Some(Self { poses, choice, face_distance, planes })
    }

    /// Frames whose pictures are needed.
    pub(crate) fn frames(&self) -> impl Iterator<Item = usize> {
        self.choice.views.iter().flat_map(|(r, n)| std::iter::once(*r).chain(n.iter().copied()))
    }

    /// The depth map of each reference view; `views` holds the pictures of frames by index.
    pub(crate) fn depth_maps<'a>(&self, views: &'a [Option<View>]) -> Vec<DepthMap<'a>> {
        let posed = |&i: &usize| Some(Posed { view: views[i].as_ref()?, pose: &self.poses[i] });
        let map = |(reference, near): &(usize, Vec<usize>)| {
            let view = views[*reference].as_ref()?;
            let pose = self.poses[*reference];
            let near: Vec<Posed<'_>> = near.iter().filter_map(posed).collect();
            let inverse = sweep::inverse_depths(Posed { view, pose: &pose }, &near, &self.planes);
            Some(DepthMap { view, pose, inverse })
        };
        let mut maps: Vec<DepthMap<'a>> = self.choice.views.par_iter().filter_map(map).collect();
        fuse::smooth(&mut maps, self.planes.step());
        maps
    }

    /// The cloud of the maps; `head` tells how much a place belongs to the head, 0–1; `radius` is the face's, metres.
    pub(crate) fn surfels(
        &self,
        maps: &[DepthMap<'_>],
        head: &(dyn Fn(DVec3) -> f64 + Sync),
        radius: f64,
        settings: &StereoSettings,
    ) -> Vec<Surfel> {
        let points = fuse::agreed(maps, self.planes.step(), 2.0 * self.face_distance);
        let centers = maps.iter().map(|m| m.pose.camera_center());
        let toward = centers.sum::<DVec3>() / maps.len().max(1) as f64;
        // Metres per metre of distance: voxels smaller than pixels stay empty.
        let pixels: Vec<f64> = maps.iter().map(|m| VOXEL_PX / m.view.focal.x.max(1.0)).collect();
        let pixel = pixels.iter().sum::<f64>() / pixels.len().max(1) as f64;
        let (mut factor, mut growth) = (radius / 0.1, 1.0);
        let mut surfels = Vec::new();
        for _ in 0..4 {
            let voxel_at = |at: DVec3| {
                let least = if head(at) > 0.5 { settings.head_voxel_m } else { settings.room_voxel_m };
                (factor * least).max(growth * pixel * (at - toward).length())
            };
            let unit = factor * settings.head_voxel_m;
            surfels = fuse::in_voxels(&points, &voxel_at, unit, 2, toward);
            fuse::keep_opaque(&mut surfels, maps, self.planes.step());
            surfels = smooth::smooth(&surfels);
            if surfels.len() <= settings.seeds * 11 / 10 {
                break;
            }
            let more = (surfels.len() as f64 / settings.seeds as f64).sqrt();
            (factor, growth) = (more * factor, more * growth);
        }
        surfels
    }
}

fn is_usable(pose: &Isometry) -> bool {
    let center = pose.camera_center();
    center.is_finite() && center.length() > 1e-6 && pose.orthonormality_error() < 1e-3
}
