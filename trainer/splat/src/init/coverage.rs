//! How much of the face seeds show, and the head's shape where they show too little.

use std::collections::BTreeMap;

use glam::{DVec2, DVec3};

use super::Seed;
use super::face::Axes;

/// Share of the face that must be shown.
pub(crate) const ENOUGH: f64 = 0.7;
/// Below this share, and where seeds contradict the landmarks, the head's seeds are given up.
const USELESS: f64 = 0.35;
/// Side of the cells that are counted, radii of the face.
const CELL: f64 = 0.1;
/// Radius that is counted, radii of the face.
const FACE: f64 = 0.75;
/// The largest median distance in depth between seeds and landmarks, radii of the face.
const CONTRADICTION: f64 = 0.2;
/// Seeds of the shape keep this distance from other seeds, radii of the face.
const CLEAR: f64 = 0.08;

/// Share of the face, as cells of its plane, in which a seed of the head lies; 0 where seeds contradict the landmarks.
pub(crate) fn of(seeds: &[Seed], axes: &Axes, rest: Option<&[[f64; 3]; 68]>) -> f64 {
    let side = (FACE / CELL).ceil() as i64;
    // The nearest seed of each cell.
    let mut nearest: BTreeMap<(i64, i64), f64> = BTreeMap::new();
    for p in seeds.iter().filter(|s| s.head_weight > 0.5).map(|s| in_radii(axes, s)) {
        if p.z < 0.8 {
            let depth = nearest.entry(cell(p.truncate())).or_insert(f64::INFINITY);
            *depth = depth.min(p.z);
        }
    }
    let all = (-side..side).flat_map(|y| (-side..side).map(move |x| (x, y)));
    let inside = |c: &(i64, i64)| DVec2::new(c.0 as f64 + 0.5, c.1 as f64 + 0.5).length() * CELL < FACE;
    let (mut shown, mut count) = (0, 0);
    for c in all.filter(inside) {
        count += 1;
        shown += usize::from(nearest.contains_key(&c));
    }
    if let Some(rest) = rest {
        let places = rest[27..48].iter().map(|&p| axes.in_radii(DVec3::from(p)));
        let mut gaps: Vec<f64> =
            places.filter_map(|p| nearest.get(&cell(p.truncate())).map(|z| (z - p.z).abs())).collect();
        gaps.sort_by(f64::total_cmp);
        if gaps.get(gaps.len() / 2).is_none_or(|&gap| gap > CONTRADICTION) {
            return 0.0;
        }
    }
    f64::from(shown as u32) / f64::from(count.max(1))
}

/// Adds those seeds of the shape that lie where there are none, `cover` being the share of the face that is shown.
pub(crate) fn complete(seeds: &mut Vec<Seed>, shape: Vec<Seed>, axes: &Axes, cover: f64) {
    if cover < USELESS {
        seeds.retain(|s| s.head_weight <= 0.5);
    }
    let key = |p: DVec3| (p / CLEAR).floor().as_i64vec3().to_array();
    let mut taken: Vec<[i64; 3]> = seeds.iter().map(|s| key(in_radii(axes, s))).collect();
    taken.sort_unstable();
    taken.dedup();
    let free = |s: &Seed| {
        let [x, y, z] = key(in_radii(axes, s));
        let near = (0..27).map(|i| [x + i % 3 - 1, y + i / 3 % 3 - 1, z + i / 9 - 1]);
        near.into_iter().all(|k| taken.binary_search(&k).is_err())
    };
    seeds.extend(shape.into_iter().filter(free));
}

fn in_radii(axes: &Axes, seed: &Seed) -> DVec3 {
    axes.in_radii(DVec3::from(seed.mean.map(f64::from)))
}

fn cell(p: DVec2) -> (i64, i64) {
    let c = (p / CELL).floor();
    (c.x as i64, c.y as i64)
}
