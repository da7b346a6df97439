//! Where along a ray the field is asked (fact sheet §2.3). On the host, in f32, without gradients.

use rand::Rng;

use crate::config::Spacing;

/// Maps `t` in 0..1 to a depth between `near` and `far`.
fn depth(spacing: Spacing, near: f32, far: f32, t: f32) -> f32 {
    match spacing {
        Spacing::Depth => near * (1.0 - t) + far * t,
        Spacing::Disparity => 1.0 / ((1.0 - t) / near + t / far),
    }
}

/// `samples` depths from near to far into `out`: bin middles, or with an `rng` one random place in each bin.
///
/// Bins lie between the middles of `samples` evenly spaced knots; the first starts at near, the last ends at far.
pub fn stratified(
    out: &mut Vec<f32>,
    samples: usize,
    near: f32,
    far: f32,
    spacing: Spacing,
    rng: Option<&mut impl Rng>,
) {
    let knot = |k: usize| k as f32 / (samples - 1).max(1) as f32;
    let mut rng = rng;
    for k in 0..samples {
        let t = match &mut rng {
            None => knot(k),
            Some(rng) => {
                let low = if k == 0 { 0.0 } else { 0.5 * (knot(k - 1) + knot(k)) };
                let high = if k + 1 == samples { 1.0 } else { 0.5 * (knot(k) + knot(k + 1)) };
                low + (high - low) * rng.random::<f32>()
            }
        };
        out.push(depth(spacing, near, far, t));
    }
}

/// Draws `count` depths from the piecewise constant density that `weights` give to `bins`, appended to `out`.
///
/// `bins.len() == weights.len() + 1`. 1e-5 is added to every weight, so an empty ray is sampled evenly per bin
/// (fact sheet §8.8); without an `rng` the quantiles are evenly spaced.
pub fn importance(out: &mut Vec<f32>, bins: &[f32], weights: &[f32], count: usize, mut rng: Option<&mut impl Rng>) {
    debug_assert_eq!(bins.len(), weights.len() + 1, "one more edge than bins");
    // What is no weight counts as none: a single NaN or infinity would take the whole ray with it.
    let weight = |w: &f32| if w.is_finite() { w.clamp(0.0, 1e30) + 1e-5 } else { 1e-5 };
    let total: f32 = weights.iter().map(weight).sum();
    let mut cdf = Vec::with_capacity(bins.len());
    cdf.push(0.0);
    let mut sum = 0.0;
    for w in weights {
        sum += weight(w) / total;
        cdf.push(sum.min(1.0));
    }
    if let Some(last) = cdf.last_mut() {
        *last = 1.0;
    }
    for i in 0..count {
        let u = match &mut rng {
            Some(rng) => rng.random::<f32>(),
            None if count > 1 => i as f32 / (count - 1) as f32,
            None => 0.5,
        };
        // u exactly at a knot belongs to the interval above it; u = 1 lands on the last edge.
        let above = cdf.partition_point(|&c| c <= u).min(cdf.len() - 1);
        let below = above - 1;
        let width = cdf[above] - cdf[below];
        let t = if width < 1e-5 { 0.0 } else { ((u - cdf[below]) / width).clamp(0.0, 1.0) };
        let t = if u >= 1.0 { 1.0 } else { t };
        out.push(bins[below] + t * (bins[above] - bins[below]));
    }
}

/// The coarse depths of one ray and `count` importance samples from its coarse weights, sorted together into `out`.
///
/// Density over the interior weights, bins between the middles of the coarse depths. Weights that are not numbers are
/// the caller's bug; they are taken as 0 here so that sorting stays defined.
pub fn union(out: &mut Vec<f32>, coarse: &[f32], weights: &[f32], count: usize, rng: Option<&mut impl Rng>) {
    let start = out.len();
    let middles: Vec<f32> = coarse.windows(2).map(|z| 0.5 * (z[0] + z[1])).collect();
    importance(out, &middles, &weights[1..weights.len() - 1], count, rng);
    out.extend_from_slice(coarse);
    out[start..].sort_unstable_by(f32::total_cmp);
}

#[cfg(test)]
mod tests {
    use rand_chacha::ChaCha8Rng;

    use super::*;

    fn at(bins: &[f32], weights: &[f32], u: f32) -> f32 {
        /// Always draws the same number.
        struct Fixed(f32);
        impl rand::RngCore for Fixed {
            fn next_u32(&mut self) -> u32 {
                // rand's f32 takes the upper 24 bits.
                (f64::from(self.0) * f64::from(1u32 << 24)) as u32 * 256
            }
            fn next_u64(&mut self) -> u64 {
                u64::from(self.next_u32()) << 32
            }
            fn fill_bytes(&mut self, _: &mut [u8]) {}
        }
        let mut out = Vec::new();
        importance(&mut out, bins, weights, 1, Some(&mut Fixed(u)));
        out[0]
    }

    #[test]
    fn empty_rays_are_sampled_per_bin() {
        let mut out = Vec::new();
        importance(&mut out, &[0.0, 1.0, 2.0, 4.0], &[0.0; 3], 5, None::<&mut ChaCha8Rng>);
        for (got, want) in out.iter().zip([0.0, 0.75, 1.5, 2.5, 4.0]) {
            assert!((got - want).abs() < 1e-5, "{out:?}");
        }
    }

    #[test]
    fn the_inverse_cdf_matches_the_check_values() {
        let (bins, weights) = ([0.0, 1.0, 2.0, 4.0], [0.1, 0.7, 0.2]);
        for (u, want) in [(0.05, 0.499_965), (0.1, 0.999_93), (0.5, 1.571_427_6), (0.95, 3.500_01)] {
            let got = at(&bins, &weights, u);
            assert!((got - want).abs() < 2e-5, "u {u}: {got}");
        }
    }

    #[test]
    fn depths_stay_in_their_bins_and_sorted() {
        use rand::SeedableRng;
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        for spacing in [Spacing::Depth, Spacing::Disparity] {
            let mut z = Vec::new();
            stratified(&mut z, 16, 0.5, 4.0, spacing, Some(&mut rng));
            assert!(z.windows(2).all(|w| w[0] <= w[1]) && z[0] >= 0.5 && z[15] <= 4.0, "{z:?}");
            let mut middle = Vec::new();
            stratified(&mut middle, 16, 0.5, 4.0, spacing, None::<&mut ChaCha8Rng>);
            assert!((middle[0] - 0.5).abs() < 1e-6 && (middle[15] - 4.0).abs() < 1e-5);
            let mut both = Vec::new();
            union(&mut both, &middle, &[1.0; 16], 16, Some(&mut rng));
            assert_eq!(both.len(), 32);
            assert!(both.windows(2).all(|w| w[0] <= w[1]));
        }
    }
}
