//! Whole fits of tiny scenes: they learn, repeat themselves to the bit, and stay finite whatever they are given.

use rand::Rng;
use rand_chacha::ChaCha8Rng;

use super::*;
use crate::model::{BackgroundFrame, HeadBox, Layout};
use crate::render::Face;
use crate::skips::Skips;

/// A ball whose colour follows one AU in front of a wall, seen by cameras on an arc.
struct Ball {
    views: usize,
    attributes: fn(usize) -> Option<Vec<f32>>,
    color: fn(usize, bool) -> [f32; 3],
    label: bool,
    /// Where the cameras stand.
    distance: f32,
}

impl Default for Ball {
    fn default() -> Self {
        Self {
            views: 12,
            attributes: |view| Some(vec![if view.is_multiple_of(2) { 1.0 } else { -1.0 }]),
            color: |view, ball| match (ball, view.is_multiple_of(2)) {
                (true, true) => [0.9, 0.2, 0.1],
                (true, false) => [0.1, 0.3, 0.8],
                (false, _) => [0.4, 0.5, 0.3],
            },
            label: true,
            distance: 2.0,
        }
    }
}

impl Ball {
    fn angle(&self, view: usize) -> f32 {
        (view as f32 / self.views as f32 - 0.5) * 0.8
    }
}

impl Views for Ball {
    fn count(&self) -> usize {
        self.views
    }

    fn origin(&self, view: usize) -> [f32; 3] {
        let (sin, cos) = self.angle(view).sin_cos();
        [self.distance * sin, 0.0, -self.distance * cos]
    }

    fn attributes(&self, view: usize) -> Option<&[f32]> {
        let values = (self.attributes)(view)?;
        // Test data only: a handful of short-lived rows.
        Some(Vec::leak(values))
    }

    fn draw(&self, view: usize, rng: &mut ChaCha8Rng, rays: usize, out: &mut Vec<Pixel>) {
        let (sin, cos) = self.angle(view).sin_cos();
        for _ in 0..rays {
            let (u, v) = (rng.random::<f32>() - 0.5, rng.random::<f32>() - 0.5);
            let d = [u * cos - sin, v, u * sin + cos];
            let n = crate::math::dot(d, d).sqrt();
            let direction = d.map(|x| x / n);
            let o = self.origin(view);
            let along = -crate::math::dot(o, direction);
            let nearest: [f32; 3] = std::array::from_fn(|a| o[a] + along * direction[a]);
            let ball = crate::math::dot(nearest, nearest) < 0.3 * 0.3;
            out.push(Pixel {
                direction,
                color: (self.color)(view, ball),
                backdrop: None,
                label: self.label.then_some(u8::from(ball)),
            });
        }
    }
}

fn fitter(views: &Ball, settings: Settings) -> Fitter {
    let layout = Layout {
        head_box: HeadBox { center: [0.0; 3], half: 0.6 },
        background: Some(BackgroundFrame {
            position: [0.0, 0.0, -views.distance],
            axes: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
            near: views.distance.max(0.1) + 0.6,
            far: views.distance.max(0.1) * 3.0 + 1.0,
            middle: [0.0; 2],
            extent: [1.0; 2],
        }),
        region_of: vec![0],
        regions: 1,
        images: views.views,
        expression_vertices: 16,
        finest: 128,
    };
    let model = Brick::new(layout, 0, |p| u8::from(crate::math::dot(p, p) < 0.2));
    Fitter::new(model, settings, Progress::default())
}

fn small() -> Settings {
    Settings { samples: 6_000, images: 4, ..Settings::default() }
}

fn is_finite(model: &mut Brick) -> bool {
    let fields = [Some(&model.head), model.background.as_ref()];
    let mut tables: Vec<&Table> = vec![&model.expression.masks, &model.codes, &model.alphas, &model.log_betas];
    for part in fields.into_iter().flatten() {
        tables.extend(&part.field.features);
        tables.push(&part.field.net);
    }
    tables.extend(model.expression.residuals.iter().chain(&model.latent_bases));
    tables.iter().all(|t| t.values.iter().chain(&t.first).chain(&t.second).all(|v| v.is_finite()))
}

#[test]
fn a_ball_and_its_colours_are_learned_and_only_its_region_changes() {
    let views = Ball::default();
    let mut fit = fitter(&views, small());
    let numbers: Vec<StepNumbers> = (0..400).map(|i| fit.step(&views, i as f32 / 400.0)).collect();
    let mean = |part: &[StepNumbers]| part.iter().map(|n| n.color).sum::<f64>() / part.len() as f64;
    let (first, last) = (mean(&numbers[..10]), mean(&numbers[360..]));
    assert!(last < 0.15 * first, "{first} → {last}");
    let model = &fit.model;
    let origin = views.origin(6);
    let middle = [-origin[0] / 2.0, 0.0, -origin[2] / 2.0];
    let show = |alpha: f32| Face::new(model, &[alpha]).render(origin, &[middle, [0.45, 0.45, 0.77]]);
    let (on, off) = (show(1.0), show(-1.0));
    assert!(on[0].color[0] > on[0].color[2] + 0.2, "{on:?}");
    assert!(off[0].color[2] > off[0].color[0] + 0.2, "{off:?}");
    assert_eq!(on[1], off[1], "a ray past the region does not know the AU");
    assert!(on[0].masks[0] > 0.5, "{on:?}");
}

#[test]
fn a_fit_repeats_itself_to_the_bit() {
    let views = Ball::default();
    let run = || {
        let mut fit = fitter(&views, small());
        (0..120).for_each(|i| {
            fit.step(&views, i as f32 / 120.0);
        });
        (fit.model.head.field.net.values.clone(), fit.model.expression.masks.values.clone())
    };
    assert!(run() == run());
}

/// What a capture may hold at worst: nothing of it may bring a number that is none.
#[test]
fn nothing_that_a_capture_holds_makes_a_fit_lose_its_footing() {
    let cases: [(&str, Ball); 8] = [
        ("all black", Ball { color: |_, _| [0.0; 3], ..Ball::default() }),
        ("all white", Ball { color: |_, _| [1.0; 3], ..Ball::default() }),
        ("one view", Ball { views: 1, ..Ball::default() }),
        ("no annotations", Ball { attributes: |_| None, ..Ball::default() }),
        ("no masks", Ball { label: false, ..Ball::default() }),
        ("AUs all at rest", Ball { attributes: |_| Some(vec![-1.0]), ..Ball::default() }),
        ("AUs far beyond their range", Ball { attributes: |v| Some(vec![v as f32 * 3.0]), ..Ball::default() }),
        ("a camera inside the head", Ball { distance: 0.05, ..Ball::default() }),
    ];
    for (name, views) in cases {
        let settings = Settings { refine_cameras: true, grid_rate: 5e-2, ..small() };
        let mut fit = fitter(&views, settings);
        // In the middle of a fit: everything is learned at once, and cells are culled.
        fit.progress = Progress { step: 150, stage: 2, ..fit.progress };
        for i in 0..50 {
            let n = fit.step(&views, i as f32 / 50.0);
            assert!(
                n.color.is_finite() && n.mask.is_finite() && n.attribute.is_finite(),
                "{name}: step {i} gives {n:?}"
            );
        }
        assert!(is_finite(&mut fit.model), "{name}: the model holds a number that is none");
        assert!(fit.model.head.occupancy.bits.len() == crate::occupancy::COUNT);
    }
}

/// Culling starts only when something has grown, and never empties what pixels see.
#[test]
fn culling_keeps_what_is_seen() {
    let views = Ball::default();
    // One stage throughout: which one a fit is in depends on how many samples culling leaves.
    let settings = |empty_space| Settings {
        finest: [64, 64],
        skips: Skips { empty_space, coarse_first: false, ..Skips::default() },
        ..small()
    };
    let mut kept = fitter(&views, settings(true));
    let mut whole = fitter(&views, settings(false));
    let mut sums = [0.0; 2];
    let mut samples = [0; 2];
    for i in 0..400 {
        for (k, fit) in [&mut kept, &mut whole].into_iter().enumerate() {
            let n = fit.step(&views, i as f32 / 400.0);
            if i >= 360 {
                sums[k] += n.color;
                samples[k] += (n.samples[0] + n.samples[1]) / n.rays;
            }
        }
    }
    let occupied = kept.model.head.occupancy.occupied();
    assert!(occupied > 100 && occupied < crate::occupancy::COUNT / 2, "{occupied} cells are left");
    assert!(samples[0] * 4 < samples[1] * 3, "culling saves samples: {samples:?}");
    // In decibels: what culling costs at the same number of steps. `bench-brick --skip-steps` measures it, and what it
    // saves, on a real capture.
    let lost = 10.0 * (sums[0] / sums[1]).log10();
    assert!(lost < 1.0, "culling costs {lost} dB");
    let origin = views.origin(6);
    let middle = [-origin[0] / 2.0, 0.0, -origin[2] / 2.0];
    let shown = Face::new(&kept.model, &[1.0]).render(origin, &[middle]);
    assert!(shown[0].depth > 1.2, "the ball is gone: {shown:?}");
}

#[test]
fn the_background_has_fewer_planes_once_it_is_settled() {
    let views = Ball::default();
    let planes = |stage: usize, settled_planes: usize| {
        let mut fit = fitter(&views, Settings { finest: [40, 40], settled_planes, ..small() });
        fit.progress.stage = stage;
        assert!(fit.step(&views, 0.5).color.is_finite());
        (fit.model.divisions, fit.model.planes)
    };
    assert_eq!(planes(LAST_STAGE - 1, 20), (24, 24));
    assert_eq!(planes(LAST_STAGE, 20), (40, 20));
    assert_eq!(planes(LAST_STAGE, 64), (40, 40), "never more than before");
}

#[test]
fn every_skip_of_a_fit_can_be_switched_off() {
    let views = Ball::default();
    for name in Skips::NAMES {
        let mut settings = small();
        assert!(settings.skips.switch_off(name));
        assert_ne!(settings.skips, Skips::default());
        let mut fit = fitter(&views, settings);
        let last = (0..30).map(|i| fit.step(&views, i as f32 / 30.0).color).last();
        assert!(last.is_some_and(f64::is_finite), "{name}");
    }
    assert!(!Skips::default().switch_off("everything"));
}
