//! Head poses from the landmarks that stay with the skull: their places and one rigid correction per frame together.
//!
//! Bundle adjustment with known cameras. The 6 unknowns of each frame are eliminated (Schur complement), which leaves
//! 3 per landmark: S = A_xx − Σ_f A_xf A_ff⁻¹ A_fx.

use glam::{DVec2, DVec3};
use nalgebra::{DMatrix, DVector, Matrix2x3, Matrix2x6, Matrix6, Vector2, Vector6};
use risorius_formats::Isometry;

use super::motion::Track;
use super::sway::{EXPECTED, Twist, isometry, twist_of};

/// Landmarks that stay with the skull: ears' side of the jaw, nose, corners of the eyes.
pub(crate) const SKULL: [usize; 17] = [0, 1, 15, 16, 27, 28, 29, 30, 31, 32, 33, 34, 35, 36, 39, 42, 45];
/// Gauss–Newton steps.
const STEPS: usize = 12;
/// Residuals beyond this many standard deviations count less and less.
const OUTLIER: f64 = 2.0;

/// The skull landmark's residual, pixels, with its derivatives by the correction and by the place.
fn linearised(
    track: &Track,
    camera: &Isometry,
    correction: &Isometry,
    landmark: usize,
    place: DVec3,
) -> Option<(Vector2<f64>, Matrix2x6<f64>, Matrix2x3<f64>)> {
    let in_head = correction.transform_point(place);
    let (r, by_place) = residual(track, landmark, camera.transform_point(in_head))?;
    let (mut by_twist, mut by_rest) = (Matrix2x6::zeros(), Matrix2x3::zeros());
    for (i, by_place) in by_place.into_iter().enumerate() {
        let g = camera.rotation.transpose() * by_place;
        let turn = in_head.cross(g);
        let rest = correction.rotation.transpose() * g;
        for k in 0..3 {
            by_twist[(i, k)] = turn[k];
            by_twist[(i, k + 3)] = g[k];
            by_rest[(i, k)] = rest[k];
        }
    }
    Some((Vector2::new(r.x, r.y), by_twist, by_rest))
}

/// One frame's residual of a landmark, pixels, and the derivatives of its coordinates by the place in camera space.
pub(crate) fn residual(track: &Track, landmark: usize, at: DVec3) -> Option<(DVec2, [DVec3; 2])> {
    let found = track.points[landmark].filter(|_| at.z > 0.01)?;
    let (x, y, scale) = (at.x / at.z, at.y / at.z, track.focal / at.z);
    let r = track.focal * (DVec2::new(x, y) - found);
    Some((r, [scale * DVec3::new(1.0, 0.0, -x), scale * DVec3::new(0.0, 1.0, -y)]))
}

/// The corrections of all frames, with landmarks that begin at `rest`; `cameras` are `camera_from_head` before them.
pub(crate) fn corrections(tracks: &[Track], cameras: &[Isometry], rest: &[[f64; 3]; 68]) -> Option<Vec<Twist>> {
    let mut places: Vec<DVec3> = SKULL.iter().map(|&l| DVec3::from(rest[l])).collect();
    let mut poses = vec![Isometry::IDENTITY; tracks.len()];
    let mut sigmas = vec![4.0f64; SKULL.len()];
    let n = 3 * SKULL.len();
    for _ in 0..STEPS {
        let mut system = DMatrix::<f64>::zeros(n, n);
        let mut right = DVector::<f64>::zeros(n);
        let mut sizes: Vec<Vec<f64>> = vec![Vec::new(); SKULL.len()];
        let mut frames = Vec::with_capacity(tracks.len());
        for ((track, camera), pose) in tracks.iter().zip(cameras).zip(&poses) {
            let (mut left, mut own) = (Matrix6::<f64>::zeros(), Vector6::<f64>::zeros());
            let mut coupling = DMatrix::<f64>::zeros(6, n);
            for (s, &l) in SKULL.iter().enumerate() {
                let Some((r, by_twist, by_rest)) = linearised(track, camera, pose, l, places[s]) else { continue };
                sizes[s].push(r.norm());
                let w = sigmas[s].powi(-2) / (1.0 + r.norm_squared() / (2.0 * (OUTLIER * sigmas[s]).powi(2)));
                left += w * by_twist.transpose() * by_twist;
                own -= w * by_twist.transpose() * r;
                let shared = w * by_twist.transpose() * by_rest;
                coupling.view_mut((0, 3 * s), (6, 3)).copy_from(&shared);
                let rest_block = w * by_rest.transpose() * by_rest;
                let mut block = system.view_mut((3 * s, 3 * s), (3, 3));
                block += rest_block;
                let mut part = right.rows_mut(3 * s, 3);
                part -= w * by_rest.transpose() * r;
            }
            // Corrections are small: this holds the room that the landmarks share with them.
            let so_far = twist_of(pose);
            for k in 0..6 {
                let prior = EXPECTED[usize::from(k > 2)].powi(-2);
                left[(k, k)] += prior;
                own[k] -= prior * so_far[k];
            }
            let inverse = left.try_inverse()?;
            let eliminated = inverse * &coupling;
            system.gemm_tr(-1.0, &coupling, &eliminated, 1.0);
            right.gemv_tr(-1.0, &eliminated, &own, 1.0);
            frames.push((inverse * own, eliminated));
        }
        (0..n).for_each(|i| system[(i, i)] += 1.0);
        let moved = system.cholesky()?.solve(&right);
        if !moved.iter().all(|v| v.is_finite()) {
            return None;
        }
        for (s, place) in places.iter_mut().enumerate() {
            *place += DVec3::new(moved[3 * s], moved[3 * s + 1], moved[3 * s + 2]);
        }
        for (pose, (own, eliminated)) in poses.iter_mut().zip(frames) {
            let step: Vector6<f64> = own - eliminated * &moved;
            *pose = isometry(&step.into()).compose(pose);
        }
        for (sigma, sizes) in sigmas.iter_mut().zip(&mut sizes) {
            sizes.sort_by(f64::total_cmp);
            *sigma = sizes.get(sizes.len() / 2).map_or(*sigma, |m| (m / 1.177).max(0.1));
        }
    }
    Some(poses.iter().map(twist_of).collect())
}
