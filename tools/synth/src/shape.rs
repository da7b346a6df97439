//! The head and body at rest as signed distances: smooth-blended ellipsoids, in the head frame.
//!
//! Metres; +x the subject's left, +y up, +z out of the face; the origin lies between the ears at the height of the
//! nose bridge. Everything here is the standard head: a person's stretch is applied to the finished points.

use glam::Vec3;

use crate::person::Person;

/// Where the rays that find the head's surface start.
pub(crate) const HEAD_CENTRE: Vec3 = Vec3::new(0.0, -0.005, 0.0);
/// Where the rays that find the body's surface start.
pub(crate) const BODY_CENTRE: Vec3 = Vec3::new(0.0, -0.26, -0.03);
/// Centre of the eyeball on the subject's left.
pub(crate) const EYEBALL: Vec3 = Vec3::new(0.0315, 0.018, 0.0655);
/// Radius of the eyeball.
pub(crate) const EYEBALL_RADIUS: f32 = 0.0132;

fn ellipsoid(p: Vec3, centre: Vec3, radii: Vec3) -> f32 {
    let q = (p - centre) / radii;
    let (k0, k1) = (q.length(), (q / radii).length());
    if k1 > 1e-6 { k0 * (k0 - 1.0) / k1 } else { -radii.min_element() }
}

/// A capsule whose radius goes from `ra` to `rb`.
fn cone(p: Vec3, a: Vec3, b: Vec3, ra: f32, rb: f32) -> f32 {
    let (pa, ba) = (p - a, b - a);
    let t = (pa.dot(ba) / ba.length_squared()).clamp(0.0, 1.0);
    (pa - ba * t).length() - (ra + (rb - ra) * t)
}

/// Union with a blend of width `k`.
fn join(a: f32, b: f32, k: f32) -> f32 {
    let h = (k - (a - b).abs()).max(0.0) / k;
    a.min(b) - h * h * k * 0.25
}

/// `a` without `b`, blended over `k`.
fn carve(a: f32, b: f32, k: f32) -> f32 {
    -join(-a, b, k)
}

/// Distance to the skin of the head, metres; negative inside.
pub(crate) fn head(p: Vec3, person: &Person) -> f32 {
    // Both halves are the same.
    let m = Vec3::new(p.x.abs(), p.y, p.z);
    let jaw = Vec3::new(person.jaw_width, 1.0, 1.0);
    let mut d = ellipsoid(m, Vec3::new(0.0, 0.046, -0.014), Vec3::new(0.075, 0.090, 0.096));
    d = join(d, ellipsoid(m, Vec3::new(0.0, -0.016, 0.026), Vec3::new(0.061, 0.084, 0.063)), 0.030);
    let jaw_line = cone(m, Vec3::new(0.0445, -0.046, 0.010) * jaw, Vec3::new(0.013, -0.086, 0.063) * jaw, 0.017, 0.015);
    d = join(d, jaw_line, 0.026);
    d = join(d, ellipsoid(m, Vec3::new(0.0, -0.087, 0.068), Vec3::new(0.019, 0.016, 0.019) * jaw), 0.022);
    // Cheek bones and cheeks.
    d = join(d, ellipsoid(m, Vec3::new(0.044, -0.006, 0.052), Vec3::new(0.020, 0.016, 0.022)), 0.022);
    d = join(d, ellipsoid(m, Vec3::new(0.034, -0.036, 0.058), Vec3::new(0.020, 0.022, 0.022)), 0.022);
    // Forehead and brow ridge.
    d = join(d, ellipsoid(m, Vec3::new(0.0, 0.062, 0.046), Vec3::new(0.052, 0.034, 0.036)), 0.03);
    d = join(d, ellipsoid(m, Vec3::new(0.026, 0.043, 0.072), Vec3::new(0.028, 0.009, 0.012)), 0.016);
    // Sockets, then the lids' skin over the eyeballs.
    d = carve(d, ellipsoid(m, Vec3::new(0.031, 0.019, 0.0955), Vec3::new(0.021, 0.015, 0.016)), 0.018);
    d = join(
        d,
        ellipsoid(m, EYEBALL, Vec3::new(EYEBALL_RADIUS + 0.0022, EYEBALL_RADIUS + 0.0012, EYEBALL_RADIUS + 0.0013)),
        0.006,
    );
    // Muzzle around the mouth, and the hollow between lower lip and chin.
    d = join(d, ellipsoid(m, Vec3::new(0.0, -0.054, 0.074), Vec3::new(0.029, 0.020, 0.0175)), 0.018);
    d = carve(d, ellipsoid(m, Vec3::new(0.0, -0.0735, 0.104), Vec3::new(0.020, 0.005, 0.012)), 0.010);
    nose(m, d, person.nose_size)
}

fn nose(m: Vec3, mut d: f32, size: f32) -> f32 {
    let tip = Vec3::new(0.0, -0.020, 0.099 + 0.006 * size);
    d = join(d, cone(m, Vec3::new(0.0, 0.026, 0.081), tip, 0.0055, 0.0074 * size), 0.014);
    d = join(d, ellipsoid(m, tip, Vec3::new(0.0085, 0.0082, 0.0085) * size), 0.011);
    // Fills the fold between side and wing, which rays from inside would cross twice.
    d = join(d, ellipsoid(m, Vec3::new(0.0064, -0.0140, 0.0920), Vec3::new(0.0056, 0.0105, 0.0100) * size), 0.009);
    let wing = Vec3::new(0.0112 * size, -0.0240, 0.0935);
    d = join(d, ellipsoid(m, wing, Vec3::new(0.0062, 0.0064, 0.0088) * size), 0.009);
    d
}

/// Distance to an ear, metres.
pub(crate) fn ear(p: Vec3) -> f32 {
    let m = Vec3::new(p.x.abs(), p.y, p.z) - EAR;
    // Leans back and stands off the head.
    let q = Vec3::new(m.x + 0.35 * m.z, m.y + 0.20 * m.z, m.z - 0.20 * m.y);
    let mut d = ellipsoid(q, Vec3::ZERO, Vec3::new(0.0072, 0.031, 0.0185));
    d = carve(d, ellipsoid(q, Vec3::new(0.0112, 0.004, 0.002), Vec3::new(0.0075, 0.019, 0.0105)), 0.004);
    join(d, ellipsoid(q, Vec3::new(0.0, -0.024, 0.004), Vec3::new(0.0055, 0.010, 0.009)), 0.006)
}

/// Centre of the ear on the subject's left.
pub(crate) const EAR: Vec3 = Vec3::new(0.0765, 0.004, -0.012);

/// Distance to neck, shoulders and chest, metres.
pub(crate) fn body(p: Vec3) -> f32 {
    let m = Vec3::new(p.x.abs(), p.y, p.z);
    let neck = cone(m, Vec3::new(0.0, -0.05, -0.012), Vec3::new(0.0, -0.20, -0.035), 0.047, 0.056);
    let shoulder = cone(m, Vec3::new(0.03, -0.215, -0.04), Vec3::new(0.165, -0.262, -0.045), 0.060, 0.058);
    let chest = ellipsoid(m, Vec3::new(0.0, -0.34, -0.03), Vec3::new(0.17, 0.15, 0.095));
    join(join(shoulder, chest, 0.05), neck, 0.045)
}

/// The point where a ray from inside leaves the solid: bisection on the last change of sign within `reach` metres.
pub(crate) fn leave(distance: impl Fn(Vec3) -> f32, from: Vec3, direction: Vec3, reach: f32) -> Vec3 {
    // From outside towards the centre, so that the outermost surface is found.
    let mut outside = reach;
    let mut inside = 0.0;
    let mut t = reach;
    // Rays that graze the side of the nose need many steps.
    for _ in 0..600 {
        let d = distance(from + direction * t);
        if d <= 0.0 {
            inside = t;
            break;
        }
        outside = t;
        t -= (d * 0.6).max(2e-4);
        if t <= 0.0 {
            break;
        }
    }
    for _ in 0..18 {
        let middle = 0.5 * (inside + outside);
        if distance(from + direction * middle) > 0.0 { outside = middle } else { inside = middle }
    }
    from + direction * (0.5 * (inside + outside))
}

/// How much of the sky a point on the surface sees, 0..1, from a few distances along its normal.
pub(crate) fn openness(distance: impl Fn(Vec3) -> f32, p: Vec3, normal: Vec3) -> f32 {
    let mut blocked = 0.0;
    for (reach, weight) in [(0.004f32, 0.30), (0.010, 0.30), (0.022, 0.25), (0.045, 0.20)] {
        blocked += weight * (1.0 - (distance(p + normal * reach) / reach)).clamp(0.0, 1.0);
    }
    (1.0 - blocked).clamp(0.0, 1.0)
}

/// How much of a soft light in `direction` reaches a point, 0..1.
pub(crate) fn lit(distance: impl Fn(Vec3) -> f32, p: Vec3, direction: Vec3) -> f32 {
    let mut t = 0.004;
    let mut open: f32 = 1.0;
    for _ in 0..28 {
        let d = distance(p + direction * t);
        open = open.min(0.5 + 5.0 * d / t);
        t += d.clamp(0.002, 0.02);
        if open <= 0.0 || t > 0.16 {
            break;
        }
    }
    let open = open.clamp(0.0, 1.0);
    open * open * (3.0 - 2.0 * open)
}
