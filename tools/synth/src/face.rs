//! What an expression does to the skin: regions, displacement, openings and paint.
//!
//! Skin points are named by where they are at rest on the standard head. Each action unit only acts through smooth
//! bumps of compact support, and each support lies inside one region with a margin of at least 2 mm, so that the
//! other regions stay bit-identical.

use glam::Vec3;

use crate::expression::{Brow, FaceState, Lids, Mouth};
use crate::noise::{step, value};
use crate::person::Person;

/// Label of brows and forehead.
pub const BROW_LABEL: u8 = 1;
/// Label of the eyes and what surrounds them.
pub const EYE_LABEL: u8 = 2;
/// Label of mouth, lower cheeks and jaw.
pub const MOUTH_LABEL: u8 = 3;

/// The region of a skin point: 0 the rest, 1 brow, 2 eye, 3 mouth.
pub(crate) fn region(rest: Vec3) -> u8 {
    let x = rest.x.abs();
    if rest.z < 0.0 {
        0
    } else if rest.y < 0.005 - 0.5 * x {
        MOUTH_LABEL
    } else if x > 0.066 || rest.z < 0.020 || rest.y > 0.082 {
        0
    } else if rest.y < 0.0325 {
        EYE_LABEL
    } else {
        BROW_LABEL
    }
}

/// 1 in the middle, 0 from `radius` on, smooth.
fn bump(p: Vec3, centre: Vec3, radius: f32) -> f32 {
    let q = 1.0 - (p - centre).length_squared() / (radius * radius);
    if q > 0.0 { q * q * q } else { 0.0 }
}

/// How far the skin at `rest` moves, metres. Only called for points of a region.
pub(crate) fn displacement(rest: Vec3, label: u8, state: &FaceState) -> Vec3 {
    let side = if rest.x < 0.0 { -1.0 } else { 1.0 };
    let m = Vec3::new(rest.x.abs(), rest.y, rest.z);
    let moved = match label {
        BROW_LABEL => brow_displacement(m, state),
        EYE_LABEL => eye_displacement(m, state),
        MOUTH_LABEL => mouth_displacement(m, state),
        _ => return Vec3::ZERO,
    };
    Vec3::new(moved.x * side, moved.y, moved.z)
}

fn brow_displacement(m: Vec3, state: &FaceState) -> Vec3 {
    let mut d = Vec3::ZERO;
    for (centre, radius, s) in [
        (Vec3::new(0.018, 0.0505, 0.088), 0.0155, 0.1),
        (Vec3::new(0.034, 0.0515, 0.084), 0.0155, 0.5),
        (Vec3::new(0.048, 0.0500, 0.074), 0.0145, 0.85),
    ] {
        let lift = state.brow.lift(s);
        d += Vec3::new(0.0, 0.35 * lift, 0.12 * lift.abs()) * bump(m, centre, radius);
    }
    // Knitted brows: the skin between them bulges.
    d + Vec3::new(-0.001, -0.0005, 0.0022) * state.strength(4) * bump(m, Vec3::new(0.011, 0.046, 0.090), 0.0105)
}

fn eye_displacement(m: Vec3, state: &FaceState) -> Vec3 {
    let s = |unit| state.strength(unit);
    let cheek = bump(m, Vec3::new(0.042, 0.0000, 0.070), 0.0130);
    let wrinkle = bump(m, Vec3::new(0.0085, 0.0150, 0.086), 0.0095);
    Vec3::new(0.0, 0.0022, 0.0040) * (s(6) * cheek) + Vec3::new(0.0, 0.0012, 0.0016) * (s(9) * wrinkle)
}

/// How strongly the jaw's fall carries a skin point, 0..1.
pub(crate) fn jaw_weight(m: Vec3) -> f32 {
    step(-0.050, -0.082, m.y) * step(0.006, 0.055, m.z)
}

fn mouth_displacement(m: Vec3, state: &FaceState) -> Vec3 {
    let s = |unit| state.strength(unit);
    let corner = Vec3::new(state.mouth.corner[0], state.mouth.corner[1], m.z);
    let mut d = Vec3::new(0.0, -0.0150, -0.0050) * (s(26) * jaw_weight(m));
    d += Vec3::new(0.0015, 0.0025, 0.0052) * (s(12) * bump(m, Vec3::new(0.040, -0.0355, 0.066), 0.0150));
    d += Vec3::new(0.0005, 0.0010, 0.0014) * (s(10) * bump(m, Vec3::new(0.020, -0.0340, 0.082), 0.0120));
    d.z -= 0.0036 * s(14) * bump(m, corner + Vec3::new(0.005, 0.0, 0.0), 0.0085);
    d.z -= 0.0016 * s(20) * bump(m, corner + Vec3::new(0.003, 0.0, 0.0), 0.0120);
    d += Vec3::new(0.0, -0.0008, 0.0016) * (s(15) * bump(m, corner + Vec3::new(0.002, -0.010, 0.0), 0.0110));
    d += Vec3::new(0.0, 0.0030, 0.0030) * (s(17) * bump(m, Vec3::new(0.0, -0.0860, 0.088), 0.0180));
    if m.z > 0.045 {
        d.z += lip_relief(m, &state.mouth);
    }
    d
}

/// How far the lips stand out, metres.
fn lip_relief(m: Vec3, mouth: &Mouth) -> f32 {
    let t = m.x / mouth.corner[0];
    if t >= 1.0 {
        return 0.0;
    }
    let [a, b, c, e] = mouth.lines(t);
    let hump = |top: f32, bottom: f32| {
        let k = (m.y - bottom) / (top - bottom).max(1e-4);
        if (0.0..1.0).contains(&k) { 4.0 * k * (1.0 - k) } else { 0.0 }
    };
    let full = 1.0 - t * t;
    full * (0.0026 * hump(a, b) * (mouth.upper_lip / 0.007) + 0.0034 * hump(c, e) * (mouth.lower_lip / 0.0088))
}

/// Whether there is no skin at `rest`: between the lids or between the lips.
pub(crate) fn is_open(rest: Vec3, label: u8, state: &FaceState) -> bool {
    let x = rest.x.abs();
    match label {
        EYE_LABEL => {
            let u = (x - Lids::CENTRE[0]) / Lids::HALF_WIDTH;
            if u.abs() >= 1.0 || (rest.y - Lids::CENTRE[1]).abs() > 0.013 {
                return false;
            }
            let [upper, lower] = state.lids.edges(u);
            rest.y < upper && rest.y > lower
        }
        MOUTH_LABEL => {
            let t = x / state.mouth.corner[0];
            if t >= 1.0 || rest.z < 0.045 || (rest.y - Mouth::HEIGHT).abs() > 0.03 {
                return false;
            }
            let [_, upper, lower, _] = state.mouth.lines(t);
            upper - lower > 0.0003 && rest.y < upper && rest.y > lower
        }
        _ => false,
    }
}

/// A soft line: 1 on it, 0 from `width` on.
fn line(distance: f32, width: f32) -> f32 {
    let q = 1.0 - (distance / width) * (distance / width);
    if q > 0.0 { q * q } else { 0.0 }
}

/// Colour and gloss of the skin at `rest` over its unchanging colour `base`.
pub(crate) fn paint(rest: Vec3, label: u8, base: Vec3, person: &Person, state: &FaceState) -> (Vec3, f32) {
    let m = Vec3::new(rest.x.abs(), rest.y, rest.z);
    match label {
        BROW_LABEL => (paint_brow(rest, m, base, person, state), 0.10),
        EYE_LABEL => (paint_eye(m, base, person, state), 0.10),
        MOUTH_LABEL => paint_mouth(rest, m, base, person, state),
        _ => (base, 0.10),
    }
}

fn paint_brow(rest: Vec3, m: Vec3, base: Vec3, person: &Person, state: &FaceState) -> Vec3 {
    let mut colour = base;
    // Furrows of the forehead, above where the brows go.
    if m.y > 0.058 && m.y < 0.079 {
        let [inner, outer] = [state.strength(1) * step(0.034, 0.010, m.x), state.strength(2) * step(0.018, 0.036, m.x)];
        let wave = m.y + 0.0012 * (m.x * 150.0).sin();
        let furrow = [0.0615, 0.0675, 0.0735].iter().map(|&y| line(wave - y, 0.0012)).sum::<f32>();
        let fade = step(0.060, 0.046, m.x) * step(0.058, 0.0605, m.y) * step(0.079, 0.076, m.y);
        colour *= 1.0 - 0.38 * furrow * fade * (inner + outer).min(1.0);
    }
    // The two upright furrows of knitted brows.
    let knit = line(m.x - 0.0062 - 0.12 * (m.y - 0.047), 0.0013) * step(0.0355, 0.040, m.y) * step(0.060, 0.054, m.y);
    colour *= 1.0 - 0.45 * knit * state.strength(4);
    let [inner, outer] = state.brow.ends();
    let s = (m.x - inner) / (outer - inner);
    if (-0.1..1.05).contains(&s) {
        let off = m.y - state.brow.height(s.clamp(0.0, 1.0));
        let half = Brow::half_thickness(s) * step(1.05, 0.97, s);
        // Hairs lean outwards.
        let hairs = value(Vec3::new((rest.x.abs() - 0.8 * off) * 1500.0, off * 350.0, 0.0), person.seed ^ 7);
        let cover = step(half + 0.0010, half - 0.0010, off.abs()) * (0.62 + 0.38 * hairs);
        colour = colour.lerp(person.hair * 0.75, (cover * step(-0.04, 0.06, s)).clamp(0.0, 1.0) * 0.92);
    }
    colour
}

fn paint_eye(m: Vec3, base: Vec3, person: &Person, state: &FaceState) -> Vec3 {
    let mut colour = base;
    // Crow's feet, bags under the eye, and the wrinkled nose bridge.
    let feet = m.x > 0.050 && m.x < 0.0645;
    if feet {
        let fan = (0.35f32, 0.0);
        let lines = [-1.0f32, 0.0, 1.0]
            .iter()
            .map(|k| line(m.y - 0.0165 - k * (0.0022 + fan.0 * (m.x - 0.050)), 0.0010))
            .sum::<f32>();
        colour *= 1.0 - 0.34 * state.strength(6) * lines * step(0.050, 0.053, m.x) * step(0.0640, 0.058, m.x);
    }
    let u = (m.x - Lids::CENTRE[0]) / Lids::HALF_WIDTH;
    let bag = line(m.y - (Lids::CENTRE[1] - 0.0100 + 0.0035 * u * u), 0.0016) * step(1.05, 0.6, u.abs());
    colour *= 1.0 - bag * (0.10 + 0.22 * state.strength(7) + 0.12 * state.strength(6));
    if m.x < 0.016 && m.y > 0.0075 && m.y < 0.0260 {
        let slanted = m.y - 0.45 * m.x;
        let lines = [0.0075f32, 0.0115, 0.0155].iter().map(|&y| line(slanted - y, 0.0013)).sum::<f32>();
        colour *= 1.0 - 0.48 * state.strength(9) * lines * step(0.0155, 0.011, m.x) * step(0.0075, 0.010, m.y);
    }
    if u.abs() < 1.25 {
        let [upper, lower] = state.lids.edges(u);
        let (over, under) = (m.y - upper, lower - m.y);
        // The lid's fold follows the lid and fades when it closes.
        let open = (1.0 - state.strength(45)).max(0.0);
        let fold = line(over - 0.0036 * (1.0 - 0.5 * u * u), 0.0011) * step(1.15, 0.75, u.abs());
        // Widened eyes stay clear of the brows' region.
        let clear = step(0.0312, 0.0292, m.y);
        colour *= 1.0 - 0.40 * clear * fold * (0.25 + 0.75 * open);
        if u.abs() < 1.0 {
            if (0.0..0.0075).contains(&over) {
                colour = colour.lerp(person.lips, 0.12 * clear);
            }
            // Lashes: a dark line above the opening, a faint one below.
            let lash = step(0.0013 + 0.0005 * u, 0.0006 + 0.0005 * u, over)
                * (0.75 + 0.25 * u.max(0.0))
                * step(-0.0010, -0.0006, over)
                * clear;
            colour = colour.lerp(person.hair * 0.25, 0.92 * lash);
            let rim = line(under, 0.0011) * open;
            colour = colour.lerp(person.lips * 0.6, 0.55 * rim);
        }
    }
    colour
}

/// Distance from `p` to the line from `a` to `b`, bent outwards by `bend`; all in the plane of the face.
fn bent_line(p: [f32; 2], a: [f32; 2], b: [f32; 2], bend: f32) -> (f32, f32) {
    let t = ((p[1] - a[1]) / (b[1] - a[1])).clamp(-0.2, 1.2);
    let x = a[0] + (b[0] - a[0]) * t + bend * 4.0 * t * (1.0 - t);
    ((p[0] - x).abs(), t)
}

fn paint_mouth(rest: Vec3, m: Vec3, base: Vec3, person: &Person, state: &FaceState) -> (Vec3, f32) {
    let mut colour = base;
    let s = |unit| state.strength(unit);
    // Nostrils.
    let nostril = bump(m, Vec3::new(0.0068 * person.nose_size, -0.0288, 0.0985), 0.0046);
    colour *= 1.0 - 0.85 * nostril.sqrt();
    if m.z < 0.040 {
        return (colour, 0.10);
    }
    let mouth = &state.mouth;
    // Folds from the nose's wings past the corners.
    let end = [mouth.corner[0] + 0.0095, mouth.corner[1] - 0.001];
    let (off, t) = bent_line([m.x, m.y], [0.0180, -0.0240], end, 0.0028);
    let fold = line(off, 0.0027) * step(-0.06, 0.22, t) * step(1.12, 0.70, t);
    colour *= 1.0 - fold * (0.10 + 0.34 * s(12).max(0.8 * s(10)) + 0.12 * s(14)).min(0.6);
    // Marionette line under a drawn-down corner, dimple beside it.
    let (off, t) =
        bent_line([m.x, m.y], [mouth.corner[0] + 0.002, mouth.corner[1]], [mouth.corner[0] + 0.005, -0.079], 0.001);
    colour *= 1.0 - 0.42 * s(15) * line(off, 0.0018) * step(0.0, 0.2, t) * step(1.0, 0.6, t);
    let beside = ((m.x - mouth.corner[0] - 0.0050).abs() / 0.7).hypot(m.y - mouth.corner[1]);
    colour *= 1.0 - 0.55 * s(14) * line(beside, 0.0046);
    // A stretched mouth shows two small upright folds, a raised chin is dimpled.
    let (off, t) = bent_line([m.x, m.y], [mouth.corner[0] + 0.006, -0.046], [mouth.corner[0] + 0.006, -0.068], 0.002);
    colour *= 1.0 - 0.34 * s(20) * line(off, 0.0016) * step(0.0, 0.3, t) * step(1.0, 0.7, t);
    let chin = bump(m, Vec3::new(0.0, -0.0860, 0.088), 0.0160);
    if chin > 0.0 && s(17) > 0.0 {
        let pits = value(rest * 420.0, person.seed ^ 0x15);
        colour *= 1.0 - 0.50 * s(17) * chin.sqrt() * step(0.45, 0.75, pits);
    }
    // The groove above the lip.
    colour *= 1.0 - 0.10 * line(m.x, 0.0032) * step(-0.031, -0.036, m.y) * step(-0.050, -0.045, m.y);
    let t = m.x / mouth.corner[0];
    if t > 1.10 || (m.y - Mouth::HEIGHT).abs() > 0.04 {
        return (colour, 0.10);
    }
    let [top, upper, lower, bottom] = mouth.lines(t);
    let blur = 0.0007;
    let cover = step(top + blur, top - blur, m.y) * step(bottom - blur, bottom + blur, m.y) * step(1.02, 0.97, t);
    let grain = value(Vec3::new(rest.x * 900.0, rest.y * 130.0, 0.0), person.seed ^ 5);
    let above = m.y > 0.5 * (upper + lower);
    let lip = person.lips * (if above { 0.82 } else { 1.0 }) * (0.86 + 0.24 * grain);
    colour = colour.lerp(lip, cover * 0.92);
    // Shadow where the lips meet, out to the corners.
    let gap = if above { m.y - upper } else { lower - m.y };
    let seam = line(gap.max(0.0), 0.0013) * step(1.06, 0.96, t);
    colour *= 1.0 - 0.80 * seam;
    // Shade under the lower lip.
    colour *= 1.0 - 0.16 * line(m.y - bottom + 0.0030, 0.0042) * step(0.9, 0.4, t);
    (colour, 0.10 + 0.30 * cover * (1.0 - seam))
}
