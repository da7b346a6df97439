//! What is behind the lips and only open mouths show: upper teeth that stay with the head, lower teeth and a tongue that
//! go with the jaw, and darkness at the back.
//!
//! Teeth stand on a parabola behind the inner lips, x = ±0.46 of the mouth's width, and curve back towards the corners.

use std::ops::Range;

use glam::DVec3;

use super::{LandmarkMotion, MouthSeeds, Seed};
use crate::init::face::Axes;

/// How much deeper than the inner lips teeth stand, in widths of the mouth.
const TEETH_BEHIND: f64 = 0.13;
/// How much deeper than the middle ones the last teeth stand, in widths of the mouth.
const ARC: f64 = 0.35;

/// A sheet of seeds: columns × rows over u −1…1 and v 0…1.
struct Sheet {
    columns: usize,
    rows: usize,
    color: [f32; 3],
    opacity: f32,
}

const UPPER: Sheet = Sheet { columns: 30, rows: 6, color: [0.62, 0.57, 0.52], opacity: 0.3 };
const LOWER: Sheet = Sheet { columns: 28, rows: 6, color: [0.55, 0.5, 0.45], opacity: 0.3 };
const TONGUE: Sheet = Sheet { columns: 14, rows: 9, color: [0.45, 0.2, 0.2], opacity: 0.3 };
const DARK: Sheet = Sheet { columns: 14, rows: 9, color: [0.1, 0.04, 0.04], opacity: 0.5 };

/// The seeds of the mouth's inside, put behind those there are; nothing where the landmarks make no mouth.
pub(crate) fn add(motion: &LandmarkMotion, axes: &Axes, seeds: &mut Vec<Seed>) -> Option<MouthSeeds> {
    let at = |l: usize| axes.rotation * DVec3::from(motion.rest[l]);
    let (left, right) = (at(60), at(64));
    let (upper, lower) = (at(62), at(66));
    let width = (right - left).length();
    // Where the lips meet; their inner rims touch at rest.
    let middle = 0.5 * (upper + lower);
    if !middle.is_finite() || !(0.2..1.2).contains(&(width / axes.radius)) {
        return None;
    }
    // The corners tell how the mouth lies; the lips' middle how far it stands out.
    let across = (right - left) / width;
    let place = |x: f64, y: f64, z: f64| middle + width * (across * x + DVec3::new(0.0, y, z));
    let mut sheet = |s: &Sheet, of: &dyn Fn(f64, f64) -> DVec3| -> Range<usize> {
        let first = seeds.len();
        for row in 0..s.rows {
            for column in 0..s.columns {
                // Every other row is shifted by half a seed.
                let shift = if row % 2 == 0 { 0.25 } else { 0.75 };
                let u = 2.0 * (column as f64 + shift) / s.columns as f64 - 1.0;
                let v = (row as f64 + 0.5) / s.rows as f64;
                let sides = [of(u - 0.01, v), of(u + 0.01, v), of(u, v - 0.01), of(u, v + 0.01)];
                let facing = (sides[1] - sides[0]).cross(sides[3] - sides[2]).normalize_or(DVec3::Z);
                let spacing = (sides[1] - sides[0]).length() * 100.0 / s.columns as f64
                    + (sides[3] - sides[2]).length() * 50.0 / s.rows as f64;
                let narrow = |v: DVec3| (axes.rotation.transpose() * v).to_array().map(|v| v as f32);
                seeds.push(Seed {
                    mean: narrow(of(u, v)),
                    normal: narrow(if facing.z > 0.0 { -facing } else { facing }),
                    color: s.color,
                    sigma: (0.4 * spacing) as f32,
                    thickness: (0.15 * spacing) as f32,
                    opacity: s.opacity,
                    regions: [0.0; crate::model::REGIONS],
                    head_weight: 1.0,
                    deformable: true,
                });
            }
        }
        first..seeds.len()
    };
    let arc = |u: f64| TEETH_BEHIND + ARC * u * u;
    let upper = sheet(&UPPER, &|u, v| place(0.46 * u, 0.06 - 0.22 * v, arc(u)));
    let lower = sheet(&LOWER, &|u, v| place(0.42 * u, 0.02 + 0.2 * v, arc(u) + 0.05));
    let tongue = sheet(&TONGUE, &|u, v| place(0.33 * u, 0.18 - 0.1 * v, 0.25 + 0.6 * v));
    let dark = sheet(&DARK, &|u, v| place(0.5 * u, -0.25 + 0.7 * v, 0.9 - 0.25 * u * u));
    Some(MouthSeeds { upper_teeth: upper, lower_teeth: lower, tongue, darkness: dark })
}
