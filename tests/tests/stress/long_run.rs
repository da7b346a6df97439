//! A long fit of a tiny scene: no drift, no number that is none, no growth of memory.

use glam::{DMat3, DQuat, DVec3};
use risorius_formats::Isometry;
use risorius_splat::{Fitter, Scene, Settings};

use crate::support::Ball;

const VIEWS: usize = 8;

/// What a tenth of a fit measured.
struct Tenth {
    color: f64,
    bytes: usize,
    gaussians: usize,
}

/// Fits for `steps`, and measures each tenth.
fn fit(steps: u64, gaussians: usize) -> Vec<Tenth> {
    let ball = Ball::new(VIEWS);
    let scene = ball.scene();
    let settings = Settings { gaussians, ..Settings::default() };
    let mut fit = Fitter::new(&scene, settings, &|_| {});
    let mut tenths = Vec::new();
    for _ in 0..10 {
        let (mut sum, mut count) = (0.0, 0);
        for i in 0..steps / 10 {
            // The learning rate of the middle of a fit throughout: it must hold, not fade out.
            let n = fit.step(&scene, 0.5);
            let step = fit.progress.step;
            assert!(n.color.is_finite() && n.mask.is_finite() && n.attribute.is_finite(), "step {step} gives {n:?}");
            if i >= steps / 20 {
                (sum, count) = (sum + n.color, count + 1);
            }
        }
        for (name, values) in fit.arrays() {
            assert!(values.iter().all(|v| v.is_finite()), "`{name}` after step {}", fit.progress.step);
        }
        let (color, bytes) = (sum / f64::from(count.max(1)), crate::MEMORY.current_usage());
        tenths.push(Tenth { color, bytes, gaussians: fit.model.count() });
    }
    tenths
}

fn judge(tenths: &[Tenth], most: usize) {
    for (i, Tenth { color, bytes, gaussians }) in tenths.iter().enumerate() {
        let (psnr, mib) = (-10.0 * color.log10(), bytes >> 20);
        eprintln!("tenth {}: colour error {color:.3e} ({psnr:.1} dB), {mib} MiB, {gaussians} Gaussians", i + 1);
    }
    let (early, last) = (&tenths[3], &tenths[9]);
    assert!(last.color <= 1.5 * early.color, "the error grew from {:.3e} to {:.3e}", early.color, last.color);
    assert!(last.gaussians <= most, "{} Gaussians, {most} were allowed", last.gaussians);
    // Growth takes memory, and may; from its end on, nothing more does.
    let whole = tenths.iter().position(|t| t.gaussians == last.gaussians).unwrap_or(9);
    assert!(whole <= 6, "the fit grows until tenth {}: too late to tell", whole + 1);
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
    judge(&fit(1_000, 4_000), 4_000);
}

#[test]
#[ignore = "minutes: the long part"]
fn two_hundred_thousand_steps_neither_drift_nor_grow() {
    let steps = std::env::var("RISORIUS_STEPS").ok().and_then(|v| v.parse().ok()).unwrap_or(200_000);
    judge(&fit(steps, 1_000), 1_000);
}

/// What is changed of the scene.
type Lack = fn(&mut Scene<'_>);

#[test]
fn scenes_that_lack_something_are_fitted() {
    let cases: [(&str, Lack); 6] = [
        ("no annotations", |s| s.frames.iter_mut().for_each(|f| f.activations = None)),
        ("no masks", |s| s.frames.iter_mut().for_each(|f| f.labels = None)),
        ("some annotations", |s| s.frames.iter_mut().skip(1).step_by(3).for_each(|f| f.activations = None)),
        ("one frame", |s| {
            s.frames.truncate(1);
            s.neutral_frame = 0;
        }),
        ("one view", |s| {
            let first = s.frames[0].camera;
            s.frames.iter_mut().for_each(|f| f.camera = first);
        }),
        ("no AUs", |s| {
            s.region_of.clear();
            s.frames.iter_mut().for_each(|f| f.activations = Some(Vec::new()));
        }),
    ];
    let ball = Ball::new(VIEWS);
    for (name, change) in cases {
        let mut scene = ball.scene();
        change(&mut scene);
        let mut fit = Fitter::new(&scene, Settings { gaussians: 1_000, ..Settings::default() }, &|_| {});
        for i in 0..30u16 {
            let n = fit.step(&scene, f32::from(i) / 30.0);
            assert!(n.color.is_finite() && n.mask.is_finite() && n.attribute.is_finite(), "{name}: {n:?}");
        }
        for (array, values) in fit.arrays() {
            assert!(values.iter().all(|v| v.is_finite()), "{name}: `{array}`");
        }
    }
}

/// What two pictures of the same expression differ in is learned by the images' codes. Codes and their deltas that both
/// begin at zero have no gradient: they would stay there, and nobody would see it.
#[test]
fn latent_codes_learn_what_no_au_tells() {
    let ball = Ball::new(VIEWS);
    let mut scene = ball.scene();
    // The same annotation for two different faces.
    scene.frames.iter_mut().for_each(|f| f.activations = Some(vec![0.0]));
    let error = |latent: bool| {
        let settings = Settings { gaussians: 1_000, latent, code_share: 1.0, ..Settings::default() };
        let mut fit = Fitter::new(&scene, settings, &|_| {});
        let errors: Vec<f64> = (0..240u16).map(|i| fit.step(&scene, f32::from(i) / 240.0).color).collect();
        errors[200..].iter().sum::<f64>() / 40.0
    };
    let (with, without) = (error(true), error(false));
    assert!(with < 0.7 * without, "mean squared error {with} with codes, {without} without");
}

/// Steps of the fits below, and how many of the last ones their error is the mean of.
const STEPS: u16 = 1500;
const LAST: usize = 100;

/// The fit of a scene, and its mean squared error at the end.
fn fitted(scene: &Scene<'_>, change: impl Fn(&mut Settings)) -> (Fitter, f64) {
    let mut settings = Settings { gaussians: 1_000, latent: false, ..Settings::default() };
    change(&mut settings);
    let mut fit = Fitter::new(scene, settings, &|_| {});
    let errors: Vec<f64> = (0..STEPS).map(|i| fit.step(scene, f32::from(i) / f32::from(STEPS)).color).collect();
    let last = &errors[errors.len() - LAST..];
    (fit, last.iter().sum::<f64>() / LAST as f64)
}

/// Changes of light between images go into their gains, not into the Gaussians.
#[test]
fn gains_follow_the_light_of_every_image() {
    let mut ball = Ball::new(VIEWS);
    let (_, undisturbed) = fitted(&ball.scene(), |_| {});
    let gain = |image: usize, c: usize| 1.0 + 0.04 * ((5 * image + 3 * c) % 7) as f64 - 0.12;
    for (image, picture) in ball.pictures.iter_mut().enumerate() {
        for (i, v) in picture.iter_mut().enumerate() {
            *v = (f64::from(*v) * gain(image, i % 3)).round().min(255.0) as u8;
        }
    }
    let (fit, with) = fitted(&ball.scene(), |_| {});
    let (_, without) = fitted(&ball.scene(), |s| s.refine_light = false);
    assert!(
        with - undisturbed < 0.3 * (without - undisturbed),
        "mean squared error {with} with gains, {without} without, {undisturbed} in even light"
    );
    for c in 0..3 {
        let mean = (0..VIEWS).map(|i| gain(i, c).ln()).sum::<f64>() / VIEWS as f64;
        for i in 0..VIEWS {
            let (found, wanted) = (f64::from(fit.images.gain(i)[c]).ln(), gain(i, c).ln() - mean);
            assert!((found - wanted).abs() < 0.03, "image {i}, channel {c}: {found}, wanted {wanted}");
        }
    }
}

/// The poses of a head that sways come from landmarks and are a little wrong.
#[test]
fn poses_that_came_from_landmarks_are_corrected() {
    let ball = Ball::new(VIEWS);
    let (_, undisturbed) = fitted(&ball.scene(), |_| {});
    let off = |i: usize| {
        let turn = DVec3::new(0.012 * ((i * 3 % 5) as f64 - 2.0), 0.01 * ((i * 2 % 5) as f64 - 2.0), 0.0) * 0.5;
        Isometry::new(DMat3::from_quat(DQuat::from_scaled_axis(turn)), DVec3::ZERO)
    };
    let mut scene = ball.scene();
    for (i, frame) in scene.frames.iter_mut().enumerate() {
        frame.room_from_head = off(i);
    }
    let (_, with) = fitted(&scene, |_| {});
    let (_, without) = fitted(&scene, |s| s.refine_poses = false);
    assert!(
        with - undisturbed < 0.5 * (without - undisturbed),
        "mean squared error {with} with corrections, {without} without, {undisturbed} with true poses"
    );
}
