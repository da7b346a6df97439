//! Where Gaussians begin: depth maps by plane sweep, AU motion from landmarks, or the face's shape alone.

mod choose;
mod coverage;
mod face;
mod fuse;
mod motion;
mod mouth;
mod rigid;
mod shape;
mod smooth;
mod stereo;
mod sway;
mod sweep;
mod view;

use std::ops::Range;

use glam::DVec3;
use rayon::prelude::*;
use risorius_formats::Isometry;

use self::face::Axes;
use self::fuse::Surfel;
use self::stereo::{Part, Rig};
use self::view::{Undistortion, View};
use crate::scene::Scene;

pub use self::stereo::StereoSettings;

/// A Gaussian to begin with.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Seed {
    /// Where, metres, head and room at rest.
    pub mean: [f32; 3],
    /// Unit normal of the surface it lies in.
    pub normal: [f32; 3],
    /// Colour, 0–1.
    pub color: [f32; 3],
    /// Standard deviation in the surface, metres.
    pub sigma: f32,
    /// Standard deviation across it, metres.
    pub thickness: f32,
    /// Opacity, 0–1.
    pub opacity: f32,
    /// Share of the frames with masks in which it projects onto each region.
    pub regions: [f32; crate::model::REGIONS],
    /// How much of the head's motion it follows, 0–1.
    pub head_weight: f32,
    /// Whether it may carry deltas (it lies in the face).
    pub deformable: bool,
}

/// The motion of the 68 landmarks: X_l(a) = rest_l + Σ_k a_k deltas_kl, metres in the head frame.
#[derive(Clone, Debug, PartialEq)]
pub struct LandmarkMotion {
    /// Positions without any AU.
    pub rest: [[f64; 3]; 68],
    /// Per AU, the displacement of each landmark at activation 1.
    pub deltas: Vec<[[f64; 3]; 68]>,
    /// RMS of the reprojection error, pixels.
    pub error_px: f64,
}

/// Which seeds are the mouth's inside, as ranges of [`Start::seeds`].
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct MouthSeeds {
    /// Rigid with the head.
    pub upper_teeth: Range<usize>,
    /// Follow the jaw: the mean motion of the chin's landmarks 7, 8 and 9.
    pub lower_teeth: Range<usize>,
    /// Follows the jaw.
    pub tongue: Range<usize>,
    /// Behind everything, rigid with the head.
    pub darkness: Range<usize>,
}

impl MouthSeeds {
    /// Whether the seed of this index follows the jaw.
    pub fn follows_jaw(&self, seed: usize) -> bool {
        self.lower_teeth.contains(&seed) || self.tongue.contains(&seed)
    }

    /// All of them; they lie next to each other.
    pub fn all(&self) -> Range<usize> {
        self.upper_teeth.start..self.darkness.end
    }
}

/// All that a fit begins with.
#[derive(Clone, Debug, PartialEq)]
pub struct Start {
    /// The Gaussians.
    pub seeds: Vec<Seed>,
    /// The mouth's inside among them, where landmarks tell where it is.
    pub mouth: Option<MouthSeeds>,
    /// The landmarks' motion, where frames have landmarks and AUs.
    pub motion: Option<LandmarkMotion>,
    /// Head pose per frame (`room_from_head`): the frames' own, or estimated from landmarks where the head sways.
    pub head_poses: Vec<Isometry>,
}

/// How a start is found.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct StartSettings {
    /// The plane sweep.
    pub stereo: StereoSettings,
}

/// Standard deviations of a seed in and across its surface, in sides of its voxel.
const SIGMAS: [f64; 2] = [0.55, 0.2];
/// Opacity of seeds of a surface.
const OPACITY: f32 = 0.7;

/// What a fit of `scene` begins with; `say` is told what takes long. The result is the same for any number of threads.
pub fn start(scene: &Scene<'_>, settings: &StartSettings, say: &dyn Fn(&str)) -> Start {
    say("motion of the landmarks");
    let radius = f64::from(scene.face_radius_m).max(0.01);
    let (motion, head_poses) = sway::solve(scene, &motion::tracks(scene), radius);
    let axes = Axes::new(scene, motion.as_ref().map(|m| &m.rest));
    say("depth of the views");
    let mut seeds = from_stereo(scene, &head_poses, &axes, &settings.stereo);
    let rest = motion.as_ref().map(|m| &m.rest);
    let cover = coverage::of(&seeds, &axes, rest);
    if cover < coverage::ENOUGH {
        say("the head's shape, because the views show too little of it");
        let spacing = settings.stereo.head_voxel_m * (axes.radius / 0.1);
        let shape = shape::seeds(scene, &head_poses, &axes, rest, spacing);
        coverage::complete(&mut seeds, shape, &axes, cover);
    }
    face::label(scene, &head_poses, &axes, &mut seeds);
    let outside = seeds.len();
    let mouth = motion.as_ref().and_then(|m| mouth::add(m, &axes, &mut seeds));
    face::shares(scene, &head_poses, &mut seeds[outside..]);
    Start { seeds, mouth, motion, head_poses }
}

/// Seeds of the surfaces that plane sweeps see; none without parallax.
fn from_stereo(scene: &Scene<'_>, head_poses: &[Isometry], axes: &Axes, settings: &StereoSettings) -> Vec<Seed> {
    let still = head_poses.iter().all(|p| *p == Isometry::IDENTITY);
    let cameras = || scene.frames.iter().map(|f| f.camera.camera_from_world);
    let from_head = || cameras().zip(head_poses).map(|(c, h)| c.compose(h)).collect::<Vec<_>>();
    let rigs = if still {
        vec![(Part::Both, Rig::new(scene, cameras().collect(), Part::Both, settings))]
    } else {
        vec![
            (Part::Head, Rig::new(scene, from_head(), Part::Head, settings)),
            (Part::Room, Rig::new(scene, cameras().collect(), Part::Room, settings)),
        ]
    };
    let rigs: Vec<(Part, Rig)> = rigs.into_iter().filter_map(|(part, rig)| Some((part, rig?))).collect();
    let needed: std::collections::BTreeSet<usize> = rigs.iter().flat_map(|(_, r)| r.frames()).collect();
    let lens = scene.frames.first().map(|f| Undistortion::new(&f.camera.intrinsics)).unwrap_or_default();
    let views: Vec<Option<View>> = (0..scene.frames.len())
        .into_par_iter()
        .map(|i| if needed.contains(&i) { View::new(&scene.frames[i], &lens) } else { None })
        .collect();
    let head = |at: DVec3| f64::from(axes.head_weight(at));
    let mut seeds = Vec::new();
    for (part, rig) in &rigs {
        let maps = rig.depth_maps(&views);
        let surfels = rig.surfels(&maps, &head, axes.radius, settings);
        seeds.extend(surfels.iter().map(|s| seed_of(s, axes)).filter(|s| match part {
            // The neck follows both: what one of them misses, the other shows.
            Part::Head => s.head_weight > 0.2,
            Part::Room => s.head_weight <= 0.5,
            Part::Both => true,
        }));
    }
    seeds
}

fn seed_of(surfel: &Surfel, axes: &Axes) -> Seed {
    let narrow = |v: DVec3| v.to_array().map(|v| v as f32);
    Seed {
        mean: narrow(surfel.at),
        normal: narrow(surfel.normal),
        color: surfel.color,
        sigma: (SIGMAS[0] * surfel.voxel) as f32,
        thickness: (SIGMAS[1] * surfel.voxel) as f32,
        opacity: OPACITY,
        regions: [0.0; crate::model::REGIONS],
        head_weight: axes.head_weight(surfel.at),
        deformable: false,
    }
}

#[cfg(test)]
mod tests;
