//! The room behind: papered walls, pictures, a bookshelf, a chest and a lamp, all with texture to hold on to.

use glam::Vec3;

use crate::noise::{cell, fractal, spots_on_plane, step, value};
use crate::person::srgb;

/// The walls, metres.
const LOW: Vec3 = Vec3::new(-1.10, -1.30, -1.35);
const HIGH: Vec3 = Vec3::new(1.10, 1.25, 2.60);

/// A box with its centre and half sides, and what it shows.
struct Furniture {
    centre: Vec3,
    half: Vec3,
    kind: Kind,
}

#[derive(Clone, Copy, PartialEq)]
enum Kind {
    Shelf,
    Chest,
}

const FURNITURE: [Furniture; 2] = [
    Furniture { centre: Vec3::new(-0.60, -0.18, -1.20), half: Vec3::new(0.30, 0.78, 0.14), kind: Kind::Shelf },
    Furniture { centre: Vec3::new(0.62, -0.70, -1.05), half: Vec3::new(0.34, 0.46, 0.28), kind: Kind::Chest },
];
const LAMP: Vec3 = Vec3::new(0.50, -0.09, -1.05);
const LAMP_RADIUS: f32 = 0.15;

/// A picture on a wall: which wall (0 back, 1 left, 2 right), its centre and half sides there, and its pattern.
const PICTURES: [(u8, [f32; 2], [f32; 2], u32); 7] = [
    (0, [0.02, 0.40], [0.19, 0.25], 0),
    (0, [0.62, 0.52], [0.20, 0.27], 1),
    (0, [0.04, -0.52], [0.16, 0.20], 4),
    (1, [-0.55, 0.30], [0.26, 0.32], 2),
    (1, [-0.70, -0.50], [0.20, 0.22], 0),
    (2, [-0.60, 0.25], [0.26, 0.34], 3),
    (2, [-0.10, -0.10], [0.18, 0.24], 1),
];

/// The room; its seed chooses the colours of wallpaper, pictures and books.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Room {
    pub(crate) seed: u32,
}

impl Room {
    /// Distance along a unit ray from inside the room, and the linear colour there.
    pub(crate) fn look(self, from: Vec3, direction: Vec3) -> (f32, Vec3) {
        let inverse = direction.recip();
        let far = ((LOW - from) * inverse).max((HIGH - from) * inverse);
        let mut t = far.min_element();
        let mut colour = None;
        for piece in &FURNITURE {
            let a = (piece.centre - piece.half - from) * inverse;
            let b = (piece.centre + piece.half - from) * inverse;
            let (enter, exit) = (a.min(b).max_element(), a.max(b).min_element());
            if enter > 1e-3 && enter < exit && enter < t {
                t = enter;
                colour = Some(self.furniture(piece, from + direction * enter));
            }
        }
        let to_lamp = from - LAMP;
        let half_b = to_lamp.dot(direction);
        let discriminant = half_b * half_b - to_lamp.length_squared() + LAMP_RADIUS * LAMP_RADIUS;
        if discriminant > 0.0 {
            let hit = -half_b - discriminant.sqrt();
            if hit > 1e-3 && hit < t {
                t = hit;
                colour = Some(self.lamp((from + direction * hit - LAMP) / LAMP_RADIUS));
            }
        }
        (t, colour.unwrap_or_else(|| self.wall(from + direction * t)))
    }

    fn random_colour(self, id: i32, saturation: f32, brightness: f32) -> Vec3 {
        let tone = |k| cell([id, k, 77], self.seed);
        let grey = Vec3::splat(0.30 + 0.5 * tone(3));
        grey.lerp(Vec3::new(tone(0), tone(1), tone(2)), saturation) * brightness
    }

    fn wall(self, p: Vec3) -> Vec3 {
        let from_back = p.z - LOW.z;
        let (side, u, v) = if from_back < 1e-4 {
            (0u8, p.x, p.y)
        } else if p.x < LOW.x + 1e-4 {
            (1, p.z, p.y)
        } else if p.x > HIGH.x - 1e-4 {
            (2, -p.z - 0.9, p.y)
        } else {
            return self.floor_or_ceiling(p);
        };
        for &(wall, [cu, cv], [hu, hv], pattern) in &PICTURES {
            let (du, dv) = ((u - cu).abs() / hu, (v - cv).abs() / hv);
            if wall == side && du < 1.0 && dv < 1.0 {
                let frame = ((1.0 - du) * hu).min((1.0 - dv) * hv);
                if frame < 0.018 {
                    return srgb(72, 48, 34) * (0.8 + 0.5 * value(p * 60.0, self.seed ^ 9));
                }
                let id = i32::from(wall) * 100 + (cu * 50.0) as i32;
                return self.picture(pattern, (u - cu) / hu, (v - cv) / hu, id);
            }
        }
        let corner = step(0.0, 0.35, from_back.abs() + if side == 0 { (HIGH.x - p.x.abs()).max(0.0) } else { 0.0 });
        let base = [srgb(126, 158, 156), srgb(150, 160, 138), srgb(162, 146, 136)][side as usize];
        let mut colour = base * (0.72 + 0.28 * corner) * (0.80 + 0.22 * (v + 0.5)).clamp(0.6, 1.05);
        colour *= 0.90 + 0.20 * value(Vec3::new(u, v, f32::from(side)) * 11.0, self.seed ^ 0x0a);
        // Wallpaper: stripes and small blossoms.
        colour *= 1.0 - 0.10 * step(0.35, 0.5, (u * 9.0).rem_euclid(1.0)) * step(0.95, 0.8, (u * 9.0).rem_euclid(1.0));
        let (d, which) = spots_on_plane(u * 8.5, v * 8.5, self.seed ^ 0x0b ^ u32::from(side));
        let blossom = self.random_colour((which * 900.0) as i32, 0.65, 1.0);
        colour = colour.lerp(blossom, 0.85 * step(0.20 + 0.16 * which, 0.12 + 0.16 * which, d));
        colour.lerp(srgb(250, 244, 220), 0.8 * step(0.08, 0.05, d))
    }

    fn floor_or_ceiling(self, p: Vec3) -> Vec3 {
        if p.y > 0.0 {
            return srgb(222, 218, 208) * (0.9 + 0.1 * value(p * 6.0, self.seed ^ 0x0c));
        }
        let plank = (p.x * 8.0).floor();
        srgb(142, 100, 66) * (0.6 + 0.4 * cell([plank as i32, (p.z * 1.5 + plank * 0.37) as i32, 0], self.seed))
    }

    fn picture(self, pattern: u32, u: f32, v: f32, id: i32) -> Vec3 {
        let tone = |k: i32| self.random_colour(id * 31 + k, 0.8, 1.15);
        match pattern {
            0 => {
                let (a, b) = ((u * 4.0).floor() as i32, (v * 4.0).floor() as i32);
                if (a + b).rem_euclid(2) == 0 { tone(a * 7 + b) } else { srgb(238, 232, 214) }
            }
            1 => {
                let ring = ((u - 0.15).hypot(v + 0.1) * 5.0).floor() as i32;
                tone(ring)
            }
            2 => {
                let hills = v + 0.35 * (u * 3.0 + id as f32).sin() * value(Vec3::new(u * 2.0, 0.0, 0.0), self.seed);
                tone((hills * 4.0).floor() as i32)
                    .lerp(tone(50), 0.4 * value(Vec3::new(u * 9.0, v * 9.0, 1.0), self.seed))
            }
            3 => {
                let (d, which) = spots_on_plane(u * 3.0, v * 3.0, self.seed ^ id as u32);
                tone((which * 40.0) as i32) * step(0.55, 0.45, d) + srgb(40, 44, 60) * step(0.45, 0.55, d)
            }
            _ => {
                let slant = ((u + v) * 4.0).floor() as i32;
                tone(slant).lerp(srgb(244, 240, 230), if slant.rem_euclid(3) == 0 { 0.9 } else { 0.0 })
            }
        }
    }

    fn furniture(self, piece: &Furniture, p: Vec3) -> Vec3 {
        let q = p - piece.centre;
        let wood =
            |tint: Vec3| tint * (0.72 + 0.42 * fractal(Vec3::new(q.x * 9.0, q.y * 70.0, q.z * 9.0), self.seed ^ 0x0d));
        let front = q.z > piece.half.z - 1e-4;
        let shade = if front { 1.0 } else { 0.62 };
        match piece.kind {
            Kind::Shelf if front => {
                let row = ((q.y + piece.half.y) / 0.26).floor();
                let height = (q.y + piece.half.y) - row * 0.26;
                if height < 0.022 || q.x.abs() > piece.half.x - 0.02 {
                    return wood(srgb(150, 108, 72));
                }
                // Books of a few widths; some lean on nothing and leave a gap.
                let slot = (q.x * 26.0 + row * 3.3).floor();
                let across = (q.x * 26.0 + row * 3.3).rem_euclid(1.0);
                let dice = |k| cell([slot as i32, row as i32, k], self.seed);
                let top = 0.15 + 0.08 * dice(1);
                if height - 0.022 > top || dice(2) < 0.08 {
                    return srgb(58, 40, 30);
                }
                let back = self.random_colour((slot * 17.0 + row * 5.0) as i32, 0.75, 0.95);
                let label = step(0.5 * top, 0.5 * top + 0.004, height) * step(0.72 * top + 0.004, 0.72 * top, height);
                let round = 0.62 + 0.38 * (std::f32::consts::PI * across).sin();
                back.lerp(srgb(240, 226, 180), 0.75 * label * if dice(3) > 0.45 { 1.0 } else { 0.0 }) * round
            }
            Kind::Chest if front => {
                let drawer = ((q.y + piece.half.y) / 0.23).rem_euclid(1.0);
                let edge = step(0.05, 0.03, drawer.min(1.0 - drawer));
                let knob = step(0.022, 0.018, (q.x.abs() - 0.16).hypot((drawer - 0.5) * 0.23));
                wood(srgb(178, 150, 112)).lerp(srgb(60, 44, 30), edge).lerp(srgb(226, 190, 96), knob)
            }
            _ => wood(srgb(150, 112, 78)) * shade,
        }
    }

    fn lamp(self, n: Vec3) -> Vec3 {
        let stripes = (n.y * 6.0).floor() as i32 + (n.x.atan2(n.z) * 3.0).floor() as i32 * 3;
        let glow = 0.55 + 0.45 * n.z.max(0.0);
        srgb(250, 214, 140).lerp(self.random_colour(stripes, 0.6, 1.2), 0.35) * glow
    }
}
