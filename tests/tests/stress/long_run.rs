//! A long fit of a tiny scene: no drift, no number that is none, no growth of memory.

use rand::Rng as _;
use rand_chacha::ChaCha8Rng;
use risorius_brick::{Fitter, Pixel, Progress, Settings, Views, math};

use crate::support::ball_with_finest;

/// A ball that changes its colour with one AU, in front of a wall.
struct Ball;

const VIEWS: usize = 8;

fn stands(view: usize) -> [f32; 3] {
    let (sin, cos) = ((view as f32 / VIEWS as f32 - 0.5) * 0.8).sin_cos();
    [2.0 * sin, 0.0, -2.0 * cos]
}

impl Views for Ball {
    fn count(&self) -> usize {
        VIEWS
    }

    fn origin(&self, view: usize) -> [f32; 3] {
        stands(view)
    }

    fn attributes(&self, view: usize) -> Option<&[f32]> {
        Some(if view.is_multiple_of(2) { &[1.0] } else { &[-1.0] })
    }

    fn draw(&self, view: usize, rng: &mut ChaCha8Rng, rays: usize, out: &mut Vec<Pixel>) {
        let origin = stands(view);
        let (sin, cos) = (origin[0] / 2.0, -origin[2] / 2.0);
        for _ in 0..rays {
            let (u, v) = (rng.random::<f32>() - 0.5, rng.random::<f32>() - 0.5);
            let d = [u * cos - sin, v, u * sin + cos];
            let length = math::dot(d, d).sqrt();
            let direction = d.map(|x| x / length);
            let along = -math::dot(origin, direction);
            let nearest: [f32; 3] = std::array::from_fn(|a| origin[a] + along * direction[a]);
            let ball = math::dot(nearest, nearest) < 0.09;
            let color = match (ball, view.is_multiple_of(2)) {
                (true, true) => [0.9, 0.2, 0.1],
                (true, false) => [0.1, 0.3, 0.8],
                (false, _) => [0.4, 0.5, 0.3],
            };
            out.push(Pixel { direction, color, backdrop: None, label: Some(u8::from(ball)) });
        }
    }
}

/// How large the scene is: the longer the fit, the smaller.
#[derive(Clone, Copy)]
struct Size {
    images: usize,
    finest: usize,
}

const QUICK: Size = Size { images: 2, finest: 128 };
const LONG: Size = Size { images: 1, finest: 16 };

fn fitter(size: Size) -> Fitter {
    let model = ball_with_finest(1, VIEWS, 0, size.finest);
    let finest = [size.finest.min(48); 2];
    let settings =
        Settings { samples: 1_500, images: size.images, finest, refine_cameras: true, ..Settings::default() };
    Fitter::new(model, settings, Progress::default())
}

/// What a tenth of a fit measured.
struct Tenth {
    color: f64,
    bytes: usize,
    /// Levels of the head that are fitted.
    levels: usize,
}

/// Fits for `steps`, and measures each tenth.
fn fit(steps: u64, size: Size) -> Vec<Tenth> {
    let mut fit = fitter(size);
    let mut tenths = Vec::new();
    for _ in 0..10 {
        let (mut sum, mut count) = (0.0, 0);
        for i in 0..steps / 10 {
            // The learning rate of the middle of a fit throughout: it must hold, not fade out.
            let n = fit.step(&Ball, 0.5);
            let step = fit.progress.step;
            assert!(n.color.is_finite() && n.mask.is_finite() && n.attribute.is_finite(), "step {step} gives {n:?}");
            if i >= steps / 20 {
                (sum, count) = (sum + n.color, count + 1);
            }
        }
        let (color, bytes) = (sum / f64::from(count.max(1)), crate::MEMORY.current_usage());
        tenths.push(Tenth { color, bytes, levels: fit.model.head.field.live });
        let parts = [Some(&fit.model.head), fit.model.background.as_ref()];
        let tables = parts.into_iter().flatten().flat_map(|p| p.field.features.iter().chain([&p.field.net]));
        for table in tables.chain([&fit.model.expression.masks, &fit.model.codes, &fit.model.motions]) {
            assert!(
                table.values.iter().chain(&table.first).chain(&table.second).all(|v| v.is_finite()),
                "step {}",
                fit.progress.step
            );
        }
    }
    tenths
}

fn judge(tenths: &[Tenth]) {
    for (i, Tenth { color, bytes, levels }) in tenths.iter().enumerate() {
        let (psnr, mib) = (-10.0 * color.log10(), bytes >> 20);
        eprintln!("tenth {}: colour error {color:.3e} ({psnr:.1} dB), {mib} MiB, {levels} levels", i + 1);
    }
    let (early, last) = (&tenths[3], &tenths[9]);
    assert!(last.color <= 1.5 * early.color, "the error grew from {:.3e} to {:.3e}", early.color, last.color);
    // A level that comes into use takes memory, and may; from the last one's on, nothing more does.
    let whole = tenths.iter().position(|t| t.levels == last.levels).unwrap_or(9);
    assert!(whole <= 6, "the last level comes in tenth {}: too late to tell", whole + 1);
    let early = &tenths[whole.max(3)];
    assert!(
        last.bytes <= early.bytes + early.bytes / 20 + (4 << 20),
        "memory grew from {} to {} bytes",
        early.bytes,
        last.bytes
    );
}

#[test]
fn a_thousand_steps_neither_drift_nor_grow() {
    judge(&fit(1_000, QUICK));
}

#[test]
#[ignore = "minutes: the long part"]
fn two_hundred_thousand_steps_neither_drift_nor_grow() {
    let steps = std::env::var("RISORIUS_STEPS").ok().and_then(|v| v.parse().ok()).unwrap_or(200_000);
    judge(&fit(steps, LONG));
}
