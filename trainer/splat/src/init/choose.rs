//! Which frames the plane sweep looks at: reference views by farthest-point sampling, neighbours at useful baselines in
//! spread directions.

use glam::{DVec2, DVec3};
use risorius_formats::Isometry;

/// Baselines of neighbours, in distances of the camera from the face.
const BASELINES: [f64; 2] = [0.053, 0.28];
/// The baseline that is preferred, likewise.
const BEST_BASELINE: f64 = 0.14;
/// Cosine of the largest angle between the optical axes of neighbours.
const ALIGNED: f64 = 0.8;

/// The indices of the `share` of frames with the smallest sums, at least `least`; frames without a sum come last.
pub(crate) fn smallest(sums: &[Option<f32>], share: f64, least: usize) -> Vec<usize> {
    let mut order: Vec<usize> = (0..sums.len()).collect();
    let key = |i: usize| sums[i].filter(|s| s.is_finite()).unwrap_or(f32::INFINITY);
    order.sort_by(|&a, &b| key(a).total_cmp(&key(b)).then(a.cmp(&b)));
    order.truncate(((sums.len() as f64 * share).ceil() as usize).max(least));
    order.sort_unstable();
    order
}

/// How far two views are from each other: camera centres, and directions at the distance of the face.
fn distance(a: &Isometry, b: &Isometry, face_distance: f64) -> f64 {
    let turned = (a.rotation.row(2) - b.rotation.row(2)).length();
    (a.camera_center() - b.camera_center()).length() + 0.5 * face_distance * turned
}

/// `count` of the `pool`, each as far as can be from those before it; the first is the nearest to the mean.
pub(crate) fn spread(pool: &[usize], poses: &[Isometry], face_distance: f64, count: usize) -> Vec<usize> {
    let middle = pool.iter().map(|&i| poses[i].camera_center()).sum::<DVec3>() / pool.len().max(1) as f64;
    let from_middle = |i: usize| (poses[i].camera_center() - middle).length();
    let first = pool.iter().copied().min_by(|&a, &b| from_middle(a).total_cmp(&from_middle(b)).then(a.cmp(&b)));
    let Some(first) = first else { return Vec::new() };
    let mut chosen = vec![first];
    let mut nearest: Vec<f64> = pool.iter().map(|&i| distance(&poses[i], &poses[first], face_distance)).collect();
    while chosen.len() < count.min(pool.len()) {
        let farthest = (0..pool.len()).max_by(|&a, &b| nearest[a].total_cmp(&nearest[b]).then(b.cmp(&a)));
        let Some(next) = farthest.filter(|&i| nearest[i] > 0.0) else { break };
        chosen.push(pool[next]);
        for (n, &i) in nearest.iter_mut().zip(pool) {
            *n = n.min(distance(&poses[i], &poses[pool[next]], face_distance));
        }
    }
    chosen
}

/// At most `count` of the `pool` beside `reference`, best first.
pub(crate) fn neighbours(reference: usize, pool: &[usize], poses: &[Isometry], count: usize) -> Vec<usize> {
    let from = &poses[reference];
    let face_distance = from.camera_center().length().max(1e-6);
    let of = |&i: &usize| {
        let to = &poses[i];
        let baseline = from.rotation * (to.camera_center() - from.camera_center());
        let ratio = baseline.length() / face_distance;
        let aligned = from.rotation.row(2).dot(to.rotation.row(2)) > ALIGNED;
        // Along the optical axis there is little parallax.
        let across = baseline.truncate().length() / baseline.length().max(1e-12);
        let useful = (BASELINES[0]..=BASELINES[1]).contains(&ratio) && aligned && across > 0.5;
        let worth = across / (1.0 + (ratio / BEST_BASELINE).ln().abs());
        (i != reference && useful).then(|| (i, baseline.truncate().normalize_or_zero(), worth))
    };
    let mut candidates: Vec<(usize, DVec2, f64)> = pool.iter().filter_map(of).collect();
    let mut chosen: Vec<(usize, DVec2)> = Vec::with_capacity(count);
    while chosen.len() < count {
        let score = |&(_, direction, worth): &(usize, DVec2, f64)| {
            let crowd: f64 = chosen.iter().map(|(_, d)| direction.dot(*d).max(0.0).powi(4)).sum();
            worth / (1.0 + 2.0 * crowd)
        };
        let best = (0..candidates.len())
            .max_by(|&a, &b| score(&candidates[a]).total_cmp(&score(&candidates[b])).then(b.cmp(&a)));
        let Some(best) = best else { break };
        let (i, direction, _) = candidates.remove(best);
        chosen.push((i, direction));
    }
    chosen.into_iter().map(|(i, _)| i).collect()
}
