//! Value noise and scattered spots from an integer hash: the grain of skin, hair, cloth and wallpaper.

use glam::Vec3;

fn hash(cell: [i32; 3], seed: u32) -> u32 {
    let mut h = seed ^ 0x9e37_79b9;
    for c in cell {
        h = (h ^ c as u32).wrapping_mul(0x85eb_ca6b);
        h = (h ^ (h >> 13)).wrapping_mul(0xc2b2_ae35);
    }
    h ^ (h >> 16)
}

fn unit(h: u32) -> f32 {
    (h >> 8) as f32 / (1u32 << 24) as f32
}

/// A number in 0..1 that belongs to a cell of the integer lattice.
pub(crate) fn cell(cell: [i32; 3], seed: u32) -> f32 {
    unit(hash(cell, seed))
}

/// Smooth noise in 0..1 with features of about one unit.
pub(crate) fn value(p: Vec3, seed: u32) -> f32 {
    let base = p.floor();
    let f = p - base;
    let f = f * f * (Vec3::splat(3.0) - 2.0 * f);
    let [x, y, z] = [base.x as i32, base.y as i32, base.z as i32];
    let corner = |dx, dy, dz| cell([x + dx, y + dy, z + dz], seed);
    let mix = |a: f32, b: f32, t: f32| a + (b - a) * t;
    let near = mix(mix(corner(0, 0, 0), corner(1, 0, 0), f.x), mix(corner(0, 1, 0), corner(1, 1, 0), f.x), f.y);
    let far = mix(mix(corner(0, 0, 1), corner(1, 0, 1), f.x), mix(corner(0, 1, 1), corner(1, 1, 1), f.x), f.y);
    mix(near, far, f.z)
}

/// Two octaves of [`value`], 0..1.
pub(crate) fn fractal(p: Vec3, seed: u32) -> f32 {
    value(p, seed) * 0.65 + value(p * 2.17, seed ^ 0x51) * 0.35
}

/// One spot per lattice cell at a random place: distance to the nearest one (in cells) and that spot's own number.
pub(crate) fn spots(p: Vec3, seed: u32) -> (f32, f32) {
    let base = p.floor();
    let mut best = (f32::MAX, 0.0);
    for dz in -1..=1 {
        for dy in -1..=1 {
            for dx in -1..=1 {
                let c = [base.x as i32 + dx, base.y as i32 + dy, base.z as i32 + dz];
                let h = hash(c, seed);
                let jitter = Vec3::new(unit(h), unit(h.rotate_left(11)), unit(h.rotate_left(21)));
                let centre = Vec3::new(c[0] as f32, c[1] as f32, c[2] as f32) + 0.15 + 0.7 * jitter;
                let d = (p - centre).length_squared();
                if d < best.0 {
                    best = (d, unit(h.wrapping_mul(0x2745_4f2d)));
                }
            }
        }
    }
    (best.0.sqrt(), best.1)
}

/// The same on a plane, with a third of the work.
pub(crate) fn spots_on_plane(x: f32, y: f32, seed: u32) -> (f32, f32) {
    let (bx, by) = (x.floor(), y.floor());
    let mut best = (f32::MAX, 0.0);
    for dy in -1..=1 {
        for dx in -1..=1 {
            let c = [bx as i32 + dx, by as i32 + dy, 0];
            let h = hash(c, seed);
            let (jx, jy) = (0.15 + 0.7 * unit(h), 0.15 + 0.7 * unit(h.rotate_left(11)));
            let (ox, oy) = (c[0] as f32 + jx - x, c[1] as f32 + jy - y);
            let d = ox * ox + oy * oy;
            if d < best.0 {
                best = (d, unit(h.wrapping_mul(0x2745_4f2d)));
            }
        }
    }
    (best.0.sqrt(), best.1)
}

/// The usual cubic step from 0 at `from` to 1 at `to`; `from` may be the larger.
pub(crate) fn step(from: f32, to: f32, x: f32) -> f32 {
    let t = ((x - from) / (to - from)).clamp(0.0, 1.0);
    t * t * (3.0 - 2.0 * t)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn noise_stays_in_its_range_and_joins_its_cells() {
        for i in 0..500 {
            let p = Vec3::new(i as f32 * 0.37 - 60.0, i as f32 * 0.11, -i as f32 * 0.23);
            assert!((0.0..=1.0).contains(&value(p, 3)));
            let edge = Vec3::new(i as f32, p.y, p.z);
            let (left, right) = (value(edge - Vec3::X * 1e-4, 3), value(edge + Vec3::X * 1e-4, 3));
            assert!((left - right).abs() < 1e-3);
        }
    }
}
