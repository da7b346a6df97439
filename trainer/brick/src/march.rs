//! The march of rays through what is occupied: one at a time, as it reads, and sixteen side by side.

use crate::occupancy::{CELLS, Occupancy, PARTS, cell_and_bit, part_position};
use crate::simd::Simd;
use crate::sixteen::Each;

/// Edge of a part.
const EDGE: f32 = 2.0 / PARTS as f32;

/// Where a ray enters and leaves [−1, 1]³; entry ≥ exit when it misses, goes nowhere or is no ray.
pub fn crossing(origin: [f32; 3], direction: [f32; 3]) -> (f32, f32) {
    let (mut enter, mut exit) = (0.0f32, f32::MAX);
    // A march whose way has no end, or no number for one, would never be through.
    if !origin.iter().chain(&direction).all(|v| v.is_finite()) {
        return (1.0, 0.0);
    }
    for a in 0..3 {
        if direction[a].abs() < 1e-12 {
            // Parallel to these planes: inside for good, or never (1/0 would give NaN on the border).
            if origin[a].abs() > 1.0 {
                return (1.0, 0.0);
            }
            continue;
        }
        let inverse = 1.0 / direction[a];
        let (t0, t1) = ((-1.0 - origin[a]) * inverse, (1.0 - origin[a]) * inverse);
        enter = enter.max(t0.min(t1));
        exit = exit.min(t0.max(t1));
    }
    if exit == f32::MAX { (1.0, 0.0) } else { (enter, exit) }
}

/// A ray on its way.
#[derive(Clone, Copy, Debug)]
pub struct March {
    /// Origin, box units.
    pub origin: [f32; 3],
    /// Direction; its length is box units per `t`.
    pub direction: [f32; 3],
    /// 1 / direction; 0 along axes that the ray does not move along …
    inverse: [f32; 3],
    /// … and there, how far it is to the next wall: for ever. 0 along the others.
    never: [f32; 3],
    /// Where the first sample lies.
    first: f32,
    /// The next sample's number: places are the same however a march came to them.
    index: f32,
    /// Where it leaves the box.
    pub exit: f32,
    /// Distance of samples in `t`.
    pub step: f32,
    /// 1 / step
    per_step: f32,
}

impl March {
    /// A ray whose first sample lies at `t`.
    pub fn new(origin: [f32; 3], direction: [f32; 3], first: f32, exit: f32, step: f32) -> Self {
        let inverse = direction.map(|d| if d.abs() > 1e-12 { 1.0 / d } else { 0.0 });
        let never = inverse.map(|i| if i == 0.0 { f32::MAX } else { 0.0 });
        Self { origin, direction, inverse, never, first, index: 0.0, exit, step, per_step: 1.0 / step }
    }

    /// Where the next sample lies.
    #[inline(always)]
    pub fn t(&self) -> f32 {
        self.first + self.index * self.step
    }

    #[inline(always)]
    fn point(&self, t: f32) -> [f32; 3] {
        std::array::from_fn(|a| self.origin[a] + t * self.direction[a])
    }

    /// The next sample and its `t`, whatever is there.
    #[inline(always)]
    pub fn next_anywhere(&mut self) -> Option<([f32; 3], f32)> {
        let t = self.t();
        (t < self.exit).then(|| {
            self.index += 1.0;
            (self.point(t), t)
        })
    }
}

/// Sixteen rays on their way.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct SixteenMarches {
    origin: [Each<f32>; 3],
    direction: [Each<f32>; 3],
    inverse: [Each<f32>; 3],
    never: [Each<f32>; 3],
    first: Each<f32>,
    exit: Each<f32>,
    step: Each<f32>,
    per_step: Each<f32>,
    index: Each<f32>,
}

/// The next samples of sixteen rays: which have one, where, and their `t`.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Found {
    pub(crate) rays: u16,
    pub(crate) points: [Each<f32>; 3],
    pub(crate) t: Each<f32>,
}

impl SixteenMarches {
    /// Puts `march` in one of the places.
    #[inline(always)]
    pub(crate) fn put(&mut self, place: usize, march: &March) {
        for a in 0..3 {
            self.origin[a][place] = march.origin[a];
            self.direction[a][place] = march.direction[a];
            self.inverse[a][place] = march.inverse[a];
            self.never[a][place] = march.never[a];
        }
        self.first[place] = march.first;
        self.exit[place] = march.exit;
        self.step[place] = march.step;
        self.per_step[place] = march.per_step;
        self.index[place] = march.index;
    }

    /// How far the march in a place has come.
    #[inline(always)]
    pub(crate) fn take(&self, place: usize, march: &mut March) {
        march.index = self.index[place];
    }
}

impl Occupancy {
    /// The next sample of `march` in an occupied part, and its `t`; `None` when the ray is through.
    #[inline(always)]
    pub fn next(&self, march: &mut March) -> Option<([f32; 3], f32)> {
        loop {
            let t = march.t();
            if t >= march.exit {
                return None;
            }
            let p = march.point(t);
            let position = part_position(p);
            let (cell, bit) = cell_and_bit(position);
            let ahead = self.ahead[cell];
            if ahead >> bit & 1 == 1 {
                march.index += 1.0;
                return Some((p, t));
            }
            // The empty cube around the point, in parts: the part, or the cells on all sides short of the nearest occupied.
            let [low, high] = if ahead & 0xff != 0 {
                [position.map(|v| v as i32), position.map(|v| v as i32 + 1)]
            } else {
                let reach = 2 * i32::from(ahead >> 8);
                let first = position.map(|v| v as i32 & !1);
                [first.map(|v| v + 2 - reach), first.map(|v| v + reach)]
            };
            let mut leave = f32::MAX;
            for a in 0..3 {
                let wall = if march.inverse[a] > 0.0 { high[a] } else { low[a] };
                leave = leave.min((wall as f32 * EDGE - 1.0 - march.origin[a]) * march.inverse[a] + march.never[a]);
            }
            // Whole steps, so that samples stay where they would be without the skip; a hair less than to the wall, for
            // a sample on it may belong to what is behind.
            #[allow(
                clippy::manual_clamp,
                reason = "a number that is none has to become a step, or the march would not end"
            )]
            let steps = ((leave - t) * march.per_step - 1e-3).ceil().max(1.0).min(1e6);
            march.index += steps;
        }
    }

    /// The next sample of those of sixteen marches that `wanted` names, as [`Self::next`] finds it for each.
    #[allow(unsafe_code, reason = "positions are clamped to the grid, as in the scalar march")]
    #[inline(always)]
    pub(crate) fn next_of_sixteen<S: Simd>(&self, m: &mut SixteenMarches, wanted: u16, found: &mut Found) {
        assert!(self.ahead.len() > CELLS.pow(3), "one more than there are cells");
        // SAFETY: all arrays hold 16 numbers; a cell's number is below CELLS³ as positions are clamped.
        unsafe {
            let zero = S::splat(0.0);
            let (mut origin, mut direction, mut inverse, mut never) = ([zero; 3], [zero; 3], [zero; 3], [zero; 3]);
            let mut forward = [S::m_from(0); 3];
            // Loops, not closures: a closure is compiled without the instruction set, and called.
            for a in 0..3 {
                origin[a] = S::load(m.origin[a].as_ptr());
                direction[a] = S::load(m.direction[a].as_ptr());
                inverse[a] = S::load(m.inverse[a].as_ptr());
                never[a] = S::load(m.never[a].as_ptr());
                forward[a] = S::lt(zero, inverse[a]);
            }
            let (first, exit) = (S::load(m.first.as_ptr()), S::load(m.exit.as_ptr()));
            let (step, per_step) = (S::load(m.step.as_ptr()), S::load(m.per_step.as_ptr()));
            let mut index = S::load(m.index.as_ptr());
            let (mut searching, mut hits) = (wanted, 0u16);
            let (mut at, mut points) = (zero, [zero; 3]);
            while searching != 0 {
                let t = S::add(first, S::mul(index, step));
                searching &= S::m_bits(S::lt(t, exit));
                let one = S::i_splat(1);
                let (mut p, mut position) = ([zero; 3], [one; 3]);
                for a in 0..3 {
                    p[a] = S::add(origin[a], S::mul(t, direction[a]));
                    let q = S::mul(S::add(p[a], S::splat(1.0)), S::splat(PARTS as f32 * 0.5));
                    position[a] = S::i_from(S::min(S::max(q, zero), S::splat((PARTS - 1) as f32)));
                }
                let [x, y, z] =
                    [S::i_right(position[0], one), S::i_right(position[1], one), S::i_right(position[2], one)];
                let cell = S::i_add(
                    x,
                    S::i_add(S::i_mul(y, S::i_splat(CELLS as i32)), S::i_mul(z, S::i_splat((CELLS * CELLS) as i32))),
                );
                let [x, y, z] = [S::i_and(position[0], one), S::i_and(position[1], one), S::i_and(position[2], one)];
                let bit = S::i_add(x, S::i_add(S::i_add(y, y), S::i_mul(z, S::i_splat(4))));
                let ahead = S::i_gather_pairs(self.ahead.as_ptr(), cell);
                let hit = searching & S::m_bits(S::i_some(S::i_and(S::i_right(ahead, bit), one)));
                let fresh = S::m_from(hit);
                at = S::select(fresh, t, at);
                for a in 0..3 {
                    points[a] = S::select(fresh, p[a], points[a]);
                }
                hits |= hit;
                let goes_on = searching & !hit;
                let partly = S::i_some(S::i_and(ahead, S::i_splat(0xff)));
                let reach = S::i_and(S::i_right(ahead, S::i_splat(7)), S::i_splat(0x1fe));
                let high = S::i_select(partly, one, reach);
                let low = S::i_select(partly, S::i_splat(0), S::i_add(S::i_splat(2), S::i_mul(reach, S::i_splat(-1))));
                let base = S::i_select(partly, S::i_splat(-1), S::i_splat(!1));
                let mut leave = S::splat(f32::MAX);
                for a in 0..3 {
                    let wall = S::i_add(S::i_and(position[a], base), S::i_select(forward[a], high, low));
                    let wall = S::sub(S::sub(S::mul(S::i_to(wall), S::splat(EDGE)), S::splat(1.0)), origin[a]);
                    leave = S::min(leave, S::add(S::mul(wall, inverse[a]), never[a]));
                }
                let stride = S::ceil(S::sub(S::mul(S::sub(leave, t), per_step), S::splat(1e-3)));
                let stride = S::min(S::max(stride, S::splat(1.0)), S::splat(1e6));
                // A ray that has found its sample has passed it; one that is through stays where it is.
                let stride = S::select(fresh, S::splat(1.0), stride);
                index = S::select(S::m_from(searching), S::add(index, stride), index);
                searching = goes_on;
            }
            S::store(m.index.as_mut_ptr(), index);
            S::store(found.t.as_mut_ptr(), at);
            (0..3).for_each(|a| S::store(found.points[a].as_mut_ptr(), points[a]));
            found.rays = hits;
        }
    }
}

#[cfg(test)]
mod tests {
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;
    use crate::occupancy::{COUNT, cell_position};
    use crate::simd::{Level, Task, run_at};
    use crate::sixteen::POINTS;

    fn grid(fill: impl Fn([usize; 3]) -> bool) -> Occupancy {
        let mut o = Occupancy::default();
        for cell in 0..COUNT {
            let [x, y, z] = cell_position(cell).map(|v| 2 * v);
            o.bits[cell] = (0..8)
                .filter(|&bit| fill([x + (bit & 1), y + (bit >> 1 & 1), z + (bit >> 2)]))
                .fold(0, |bits, bit| bits | 1 << bit);
        }
        o.refresh();
        o
    }

    /// The march with skips meets the very samples that the march without them finds in occupied parts.
    #[test]
    fn skipping_loses_no_sample_and_invents_none() {
        let o = grid(|[x, y, z]| (x / 9 + y / 5 + z / 7) % 6 == 0);
        let diagonal = 1.0 / 3f32.sqrt();
        for (origin, direction) in [
            ([0.013, -0.021, -1.5], [0.0, 0.0, 1.0]),
            ([-1.5, 0.037, 0.011], [1.0, 0.0, 0.0]),
            ([0.3, 1.4, -0.2], [0.0, -1.0, 0.0]),
            ([-1.2, -1.1, -1.3], [diagonal; 3]),
            ([0.1, 0.2, 0.3], [-0.48, 0.6, 0.64]),
        ] {
            let (enter, exit) = crossing(origin, direction);
            let step = 2.0 / 160.0;
            let start = March::new(origin, direction, enter + 0.37 * step, exit, step);
            let (mut slow, mut fast) = (start, start);
            let mut expected = Vec::new();
            while let Some((p, t)) = slow.next_anywhere() {
                if o.holds(p) {
                    expected.push(t);
                }
            }
            let mut found = Vec::new();
            while let Some((_, t)) = o.next(&mut fast) {
                found.push(t);
            }
            assert!(!expected.is_empty(), "the ray from {origin:?} meets nothing");
            // Rounding may put a sample on a border to either side: one in a hundred may differ.
            let apart = expected.iter().filter(|e| !found.iter().any(|f| (*f - **e).abs() < 1e-4)).count();
            assert!(apart * 100 <= expected.len(), "{apart} of {} samples are lost", expected.len());
            assert!(found.len().abs_diff(expected.len()) * 100 <= expected.len());
        }
    }

    #[test]
    fn rays_along_an_axis_or_past_the_box_end() {
        assert!(crossing([0.0, 2.0, -3.0], [0.0, 0.0, 1.0]).0 >= crossing([0.0, 2.0, -3.0], [0.0, 0.0, 1.0]).1);
        let o = Occupancy::default();
        let (enter, exit) = crossing([1.0, 1.0, -3.0], [0.0, 0.0, 1.0]);
        let mut march = March::new([1.0, 1.0, -3.0], [0.0, 0.0, 1.0], enter, exit, 0.1);
        let mut count = 0;
        while o.next(&mut march).is_some() {
            count += 1;
        }
        assert!((19..=21).contains(&count), "{count}");
    }

    struct Together<'a> {
        occupancy: &'a Occupancy,
        marches: &'a mut SixteenMarches,
        wanted: u16,
    }

    impl Task for Together<'_> {
        type Output = Found;

        #[inline(always)]
        fn run<S: Simd>(self) -> Found {
            let mut found = Found::default();
            self.occupancy.next_of_sixteen::<S>(self.marches, self.wanted, &mut found);
            found
        }
    }

    #[test]
    fn sixteen_rays_find_what_each_finds() {
        let o = grid(|[x, y, z]| (x / 9 + y / 5 + z / 7) % 6 == 0 || (x > 60 && z == 40));
        let empty = grid(|_| false);
        let mut rng = ChaCha8Rng::seed_from_u64(8);
        for level in [Level::Scalar, Level::Avx2, Level::Avx512] {
            for (o, round) in (0..40).map(|round| (if round == 0 { &empty } else { &o }, round)) {
                let mut each: Vec<March> = (0..POINTS)
                    .map(|i| {
                        let origin = [rng.random::<f32>() - 0.5, rng.random::<f32>() - 0.5, -1.6];
                        let mut d = [rng.random::<f32>() - 0.5, rng.random::<f32>() - 0.5, 1.0];
                        if i % 5 == 0 {
                            d[0] = 0.0;
                        }
                        let n = crate::math::dot(d, d).sqrt();
                        let d = d.map(|v| v / n);
                        let (enter, exit) = crossing(origin, d);
                        March::new(origin, d, enter + rng.random::<f32>() * 0.01, exit, 0.0125)
                    })
                    .collect();
                let mut marches = SixteenMarches::default();
                each.iter().enumerate().for_each(|(i, m)| marches.put(i, m));
                let mut wanted = if round % 2 == 0 { u16::MAX } else { 0x5a3c };
                for _ in 0..50 {
                    let found = run_at(level, Together { occupancy: o, marches: &mut marches, wanted });
                    for (i, march) in each.iter_mut().enumerate().filter(|(i, _)| wanted >> i & 1 == 1) {
                        let expected = o.next(march);
                        assert_eq!(found.rays >> i & 1 == 1, expected.is_some(), "ray {i}");
                        if let Some((p, t)) = expected {
                            assert_eq!((found.t[i], [0, 1, 2].map(|a| found.points[a][i])), (t, p), "ray {i}");
                        }
                        let mut copy = *march;
                        marches.take(i, &mut copy);
                        assert!(expected.is_none() || copy.index == march.index, "ray {i}");
                    }
                    wanted &= found.rays;
                }
            }
        }
    }
}
