//! Gaze and eye landmarks from the mesh's lids and irises, in OpenFace's columns, axes and signs.
//!
//! Gaze of an eye in the head frame: angles asin((e − κ) / ρ), where e is the middle of the iris from the middle of the eye
//! corners in the aligned mesh (outer eye corners 1 apart; x to the image's right, y down), κ the person's e when looking
//! ahead and ρ the eyeball's apparent radius. κ is the median over the clip, ρ a multiple of the person's iris radius: the
//! network draws irises nearer to the middle than they are, so that ρ is larger than the anatomical 12 mm. The head turns
//! the direction into camera axes. An eye whose lids are closed has no gaze of its own.

use glam::{DMat3, DVec2, DVec3};
use risorius_formats::Similarity;
use risorius_formats::openface::Eyes;

use crate::aus::Calibration;
use crate::aus::memory::Memory;
use crate::poses::triangulate::median;
use crate::run::mesh::{Mesh, flat};

pub use risorius_formats::openface::EYE_LANDMARKS;
/// Points of the lids.
const LIDS: usize = 12;
/// Numbers kept of an eye.
const OF_EYE: usize = 2 + 1 + 2 * LIDS + 2 + 1 + 1;
/// Numbers kept of a frame.
pub const EYE_NUMBERS: usize = 2 * OF_EYE;

/// Which points of the mesh are an eye.
struct EyePoints {
    iris: usize,
    corners: [usize; 2],
    /// Middle of the upper and of the lower lid.
    middle: [usize; 2],
    /// From the image-left corner over the upper lid and back below.
    lids: [usize; LIDS],
}

/// Image-left eye first.
const EYES: [EyePoints; 2] = [
    EyePoints {
        iris: 468,
        corners: [33, 133],
        middle: [159, 145],
        lids: [33, 161, 160, 159, 158, 157, 133, 154, 153, 145, 144, 163],
    },
    EyePoints {
        iris: 473,
        corners: [362, 263],
        middle: [386, 374],
        lids: [362, 384, 385, 386, 387, 388, 263, 390, 373, 374, 380, 381],
    },
];

/// Apparent radius of the eyeball over the radius of the iris, across and down.
const RADIUS_OF_IRIS: [f64; 2] = [3.5, 4.8];
/// Radius of the iris, outer-eye distances, before a person is known.
const IRIS: f64 = 0.063;
/// OpenFace's iris over the mesh's, and its pupil over its iris.
const OPENFACE_IRIS: f32 = 1.2;
const OPENFACE_PUPIL: f32 = 0.433;
/// An eye is closed below this share of the person's usual opening.
const CLOSED: f64 = 0.45;
/// Which quantile of the openings is the usual one.
const USUAL: f64 = 0.8;
/// Largest sine of an angle between eye and head.
const LARGEST_SINE: f64 = 0.8;

/// What is kept of one eye in one frame.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Eye {
    iris_px: [f32; 2],
    iris_radius_px: f32,
    lids_px: [[f32; 2]; LIDS],
    /// Middle of the iris from the middle of the corners, aligned.
    offset: DVec2,
    /// Between the lids, over the width of the eye.
    opening: f64,
    iris_radius: f64,
}

/// The numbers of a frame's eyes.
pub fn numbers(mesh: &Mesh, canonical_from_picture: &Similarity) -> [f32; EYE_NUMBERS] {
    let aligned = |i: usize| canonical_from_picture.transform_point(DVec3::from(mesh[i].map(f64::from))).truncate();
    let mut out = [0.0; EYE_NUMBERS];
    for (eye, out) in EYES.iter().zip(out.chunks_exact_mut(OF_EYE)) {
        let [a, b] = eye.corners.map(aligned);
        let [upper, lower] = eye.middle.map(aligned);
        let iris = aligned(eye.iris);
        let rim = || (1..5).map(|k| eye.iris + k);
        let [x, y] = flat(mesh, eye.iris);
        let radius_px = rim().map(|i| (mesh[i][0] - x).hypot(mesh[i][1] - y)).sum::<f32>() / 4.0;
        let radius = rim().map(|i| aligned(i).distance(iris)).sum::<f64>() / 4.0;
        let offset = iris - 0.5 * (a + b);
        let opening = upper.distance(lower) / a.distance(b).max(1e-9);
        let lids = eye.lids.iter().flat_map(|i| flat(mesh, *i));
        let rest = [offset.x as f32, offset.y as f32, opening as f32, radius as f32];
        for (slot, value) in out.iter_mut().zip([x, y, radius_px].into_iter().chain(lids).chain(rest)) {
            *slot = value;
        }
    }
    out
}

fn eyes(numbers: &[f32; EYE_NUMBERS]) -> [Eye; 2] {
    [0, 1].map(|i| {
        let n = &numbers[i * OF_EYE..(i + 1) * OF_EYE];
        let rest = 3 + 2 * LIDS;
        Eye {
            iris_px: [n[0], n[1]],
            iris_radius_px: n[2],
            lids_px: std::array::from_fn(|k| [n[3 + 2 * k], n[4 + 2 * k]]),
            offset: DVec2::new(n[rest].into(), n[rest + 1].into()),
            opening: n[rest + 2].into(),
            iris_radius: n[rest + 3].into(),
        }
    })
}

/// A person's eyeballs.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct EyeModel {
    /// Offset of the iris of an eye that looks ahead.
    ahead: [DVec2; 2],
    /// Apparent radius, across and down.
    radius: [f64; 2],
    /// Opening below which an eye is closed.
    closed: [f64; 2],
}

/// Gaze and eye landmarks of one frame.
#[derive(Clone, Debug, PartialEq)]
pub struct Gaze {
    /// Unit vectors in camera axes (x right, y down, z away), image-left eye first.
    pub directions: [DVec3; 2],
    /// Radians, of the mean of both: positive to the image's right, positive down.
    pub angles: [f64; 2],
    /// Which eyes are open; what is said of the gaze of a closed one is a guess.
    pub open: [bool; 2],
    /// Pixels.
    pub landmarks_px: Box<[[f32; 2]; EYE_LANDMARKS]>,
    /// Millimetres in camera space, on the rays of those in pixels; empty until the head's distance is known.
    pub landmarks_mm: Vec<[f32; 3]>,
}

impl Gaze {
    /// What an OpenFace table has of it.
    pub fn eyes(&self) -> Eyes<'_> {
        let Self { directions, angles, landmarks_px, landmarks_mm, .. } = self;
        Eyes { directions: *directions, angles: *angles, landmarks_px, landmarks_mm }
    }
}

/// Finds gaze with an eye model of the whole video or, online, of the frames before.
#[derive(Clone, Debug)]
pub struct Gazer {
    model: EyeModel,
    online: Option<Memory<[f32; EYE_NUMBERS]>>,
}

impl Gazer {
    /// Learns a person's eyes from frames of a video; online, from none yet.
    pub fn learn(frames: &[[f32; EYE_NUMBERS]], calibration: Calibration) -> Self {
        match calibration {
            Calibration::WholeVideo => Self { model: EyeModel::learn(frames), online: None },
            Calibration::Online => Self { model: EyeModel::learn(&[]), online: Some(Memory::default()) },
        }
    }

    /// The gaze of a frame; an online calibration learns from it first.
    pub fn gaze(&mut self, numbers: &[f32; EYE_NUMBERS], camera_from_head: &DMat3) -> Gaze {
        if let Some(memory) = &mut self.online {
            memory.push(*numbers);
            if memory.is_due() {
                self.model = EyeModel::learn(memory.frames());
            }
        }
        self.model.gaze(numbers, camera_from_head)
    }
}

impl EyeModel {
    /// From frames of a video; of people in general where there are none.
    pub fn learn(frames: &[[f32; EYE_NUMBERS]]) -> Self {
        let seen: Vec<[Eye; 2]> = frames.iter().map(eyes).collect();
        let mut radii: Vec<f64> = seen.iter().flatten().map(|e| e.iris_radius).collect();
        let iris = median(&mut radii).filter(|r| *r > 0.0).unwrap_or(IRIS);
        let closed = [0, 1].map(|i| {
            let mut openings: Vec<f64> = seen.iter().map(|e| e[i].opening).collect();
            openings.sort_unstable_by(f64::total_cmp);
            CLOSED * openings.get((USUAL * openings.len() as f64) as usize).copied().unwrap_or(0.0)
        });
        let ahead = [0, 1].map(|i| {
            let open = || seen.iter().map(|e| &e[i]).filter(|e| e.opening >= closed[i]);
            let middle = |axis: usize| median(&mut open().map(|e| e.offset[axis]).collect::<Vec<_>>()).unwrap_or(0.0);
            DVec2::new(middle(0), middle(1))
        });
        Self { ahead, radius: RADIUS_OF_IRIS.map(|k| k * iris), closed }
    }

    /// The gaze of a frame with the head's rotation (OpenFace's axes).
    pub fn gaze(&self, numbers: &[f32; EYE_NUMBERS], camera_from_head: &DMat3) -> Gaze {
        let eyes = eyes(numbers);
        let directions = [0, 1].map(|i| {
            let sine = (eyes[i].offset - self.ahead[i]) / DVec2::from(self.radius);
            let sine = sine.clamp_length_max(LARGEST_SINE);
            *camera_from_head * DVec3::new(sine.x, sine.y, -(1.0 - sine.length_squared()).sqrt())
        });
        let mean = directions[0] + directions[1];
        Gaze {
            directions,
            angles: [mean.x.atan2(-mean.z), mean.y.atan2(-mean.z)],
            open: [0, 1].map(|i| eyes[i].opening >= self.closed[i]),
            landmarks_px: Box::new(landmarks(&eyes)),
            landmarks_mm: Vec::new(),
        }
    }
}

/// The 56 points: the iris clockwise from its image-left point, the lids clockwise from the image-left corner, the pupil
/// the other way round from its lower left.
fn landmarks(eyes: &[Eye; 2]) -> [[f32; 2]; EYE_LANDMARKS] {
    let mut out = [[0.0; 2]; EYE_LANDMARKS];
    for (eye, out) in eyes.iter().zip(out.chunks_exact_mut(EYE_LANDMARKS / 2)) {
        // The eyes' own horizontal: a face may be rolled.
        let [a, b] = [eye.lids_px[0], eye.lids_px[6]];
        let roll = (b[1] - a[1]).atan2(b[0] - a[0]);
        let around = |radius: f32, eighth: f32| {
            let (sin, cos) = (roll + eighth * std::f32::consts::FRAC_PI_4).sin_cos();
            [eye.iris_px[0] + radius * cos, eye.iris_px[1] + radius * sin]
        };
        let iris = OPENFACE_IRIS * eye.iris_radius_px;
        for k in 0..8 {
            out[k] = around(iris, 4.0 + k as f32);
            out[8 + LIDS + k] = around(OPENFACE_PUPIL * iris, 3.0 - k as f32);
        }
        out[8..8 + LIDS].copy_from_slice(&eye.lids_px);
    }
    out
}

#[cfg(test)]
mod tests;
