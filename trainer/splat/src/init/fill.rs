//! Holes of the face closed: smooth skin has no texture that a sweep could match.
//!
//! Seeds of the head's front, and the landmarks, make a map of depths over the face's plane. Cells without one that lie
//! between others, in their row and in their column, take the mean of their neighbours (∇²z = 0) and become seeds.

use glam::{DVec2, DVec3};
use rayon::prelude::*;
use risorius_formats::Isometry;

use super::face::Axes;
use super::{Seed, shape};
use crate::scene::Scene;

/// Half axes of the face's outline, radii of the face.
const FACE: DVec2 = DVec2::new(0.9, 1.1);
/// What is farther back is not the front, radii of the face.
const BACK: f64 = 0.8;
/// The last landmark of the jaw.
const JAW: usize = 16;
/// Parts of the line between two landmarks.
const STEPS: usize = 24;
/// Rounds of averaging.
const ROUNDS: usize = 200;

struct Map {
    side: f64,
    columns: usize,
    rows: usize,
    /// Depth per cell, row by row, radii of the face.
    depths: Vec<Option<f64>>,
}

impl Map {
    fn new(seeds: &[Seed], axes: &Axes, side: f64) -> Self {
        let columns = (2.0 * FACE.x / side).ceil() as usize;
        let rows = (2.0 * FACE.y / side).ceil() as usize;
        let mut map = Self { side, columns, rows, depths: vec![None; columns * rows] };
        for seed in seeds.iter().filter(|s| s.head_weight > 0.5) {
            map.add(axes.in_radii(DVec3::from(seed.mean.map(f64::from))), true);
        }
        map
    }

    /// Takes the depth of a point, the nearest if `replace`, else only where there is none.
    fn add(&mut self, p: DVec3, replace: bool) {
        let cell = ((p.truncate() + FACE) / self.side).floor();
        let inside = cell.cmpge(DVec2::ZERO).all() && cell.x < self.columns as f64 && cell.y < self.rows as f64;
        if inside && p.z < BACK {
            let depth = &mut self.depths[cell.y as usize * self.columns + cell.x as usize];
            *depth = match *depth {
                Some(z) if replace => Some(z.min(p.z)),
                Some(z) => Some(z),
                None => Some(p.z),
            };
        }
    }

    /// Cells without a depth between cells with one.
    fn holes(&self) -> Vec<usize> {
        let known = |x: usize, y: usize| self.depths[y * self.columns + x].is_some();
        let between = |line: &dyn Fn(usize) -> bool, at: usize, end: usize| (0..at).any(line) && (at..end).any(line);
        let is_hole = |i: &usize| {
            let (x, y) = (i % self.columns, i / self.columns);
            let inside = (self.place(*i) / FACE).length() < 1.0;
            inside
                && !known(x, y)
                && between(&|x| known(x, y), x, self.columns)
                && between(&|y| known(x, y), y, self.rows)
        };
        (0..self.depths.len()).filter(is_hole).collect()
    }

    fn place(&self, cell: usize) -> DVec2 {
        DVec2::new((cell % self.columns) as f64 + 0.5, (cell / self.columns) as f64 + 0.5) * self.side - FACE
    }

    fn neighbours(&self, cell: usize) -> impl Iterator<Item = usize> {
        let (x, y, columns, rows) = (cell % self.columns, cell / self.columns, self.columns, self.rows);
        let left = (x > 0).then(|| cell - 1);
        let right = (x + 1 < columns).then(|| cell + 1);
        let above = (y > 0).then(|| cell - columns);
        let below = (y + 1 < rows).then(|| cell + columns);
        [left, right, above, below].into_iter().flatten()
    }

    /// Gives the holes depths.
    fn close(&mut self, holes: &[usize]) {
        for _ in 0..ROUNDS {
            let of = |&cell: &usize| {
                let (sum, count) = self
                    .neighbours(cell)
                    .filter_map(|n| self.depths[n])
                    .fold((0.0, 0u32), |(sum, count), z| (sum + z, count + 1));
                (count > 0).then(|| sum / f64::from(count))
            };
            let next: Vec<Option<f64>> = holes.iter().map(of).collect();
            for (&cell, depth) in holes.iter().zip(next) {
                self.depths[cell] = depth;
            }
        }
    }

    fn slope(&self, cell: usize, step: usize, at: usize, end: usize) -> f64 {
        let (low, high) = (if at > 0 { cell - step } else { cell }, if at + 1 < end { cell + step } else { cell });
        match (self.depths[low], self.depths[high]) {
            (Some(a), Some(b)) if high > low => (b - a) / (self.side * ((high - low) / step) as f64),
            _ => 0.0,
        }
    }
}

/// Seeds that close the face's holes, about `spacing` metres apart.
pub(crate) fn seeds(
    scene: &Scene<'_>,
    head_poses: &[Isometry],
    axes: &Axes,
    seeds: &[Seed],
    rest: Option<&[[f64; 3]; 68]>,
    spacing: f64,
) -> Vec<Seed> {
    let r = axes.radius;
    let mut map = Map::new(seeds, axes, (1.3 * spacing / r).clamp(0.01, 1.0));
    if let Some(rest) = rest {
        let place = |l: usize| axes.in_radii(DVec3::from(rest[l]));
        (0..68).for_each(|l| map.add(place(l), false));
        // The line of the jaw encloses what seeds miss of cheeks and chin.
        for l in 0..JAW {
            (1..STEPS).for_each(|k| map.add(place(l).lerp(place(l + 1), k as f64 / STEPS as f64), false));
        }
    }
    let holes = map.holes();
    map.close(&holes);
    let views = shape::views(scene, head_poses);
    let to_head = axes.rotation.transpose();
    let seed = |&cell: &usize| {
        let (x, y) = (cell % map.columns, cell / map.columns);
        let at = to_head * (map.place(cell).extend(map.depths[cell]?) * r);
        let slopes = (map.slope(cell, 1, x, map.columns), map.slope(cell, map.columns, y, map.rows));
        let normal = to_head * DVec3::new(slopes.0, slopes.1, -1.0).normalize();
        let narrow = |v: DVec3| v.to_array().map(|v| v as f32);
        Some(Seed {
            mean: narrow(at),
            normal: narrow(normal),
            color: shape::color(scene, &views, at, normal)?,
            sigma: (0.6 * map.side * r) as f32,
            thickness: (0.2 * map.side * r) as f32,
            opacity: super::OPACITY,
            regions: [0.0; crate::model::REGIONS],
            head_weight: axes.head_weight(at),
            deformable: false,
        })
    };
    holes.par_iter().filter_map(seed).collect()
}
