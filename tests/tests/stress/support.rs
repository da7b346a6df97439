//! Poison values, and a ledger of what was tried with them.

use std::panic::{AssertUnwindSafe, catch_unwind};

use glam::{DMat3, DVec2, DVec3};
use risorius_formats::{Camera, Intrinsics, Isometry};
use risorius_splat::{Frame, Gaussians, Layout, Scene};
use risorius_tests::run;
pub(crate) use risorius_tests::{text, tiny};

/// Values that arithmetic trips over, by name.
pub(crate) const POISON: [(&str, f64); 18] = [
    ("NaN", f64::NAN),
    ("+inf", f64::INFINITY),
    ("-inf", f64::NEG_INFINITY),
    ("0", 0.0),
    ("-0", -0.0),
    ("least denormal", 5e-324),
    ("denormal", -1e-310),
    ("least normal", f64::MIN_POSITIVE),
    ("f32 denormal", 1e-42),
    ("tiny", 1e-30),
    ("-tiny", -1e-30),
    ("huge", 1e30),
    ("-huge", -1e30),
    ("beyond f32", 1e39),
    ("largest", f64::MAX),
    ("-largest", f64::MIN),
    ("1e154", 1e154),
    ("epsilon", f64::EPSILON),
];

/// The same for 32 bits.
pub(crate) const POISON_32: [(&str, f32); 14] = [
    ("NaN", f32::NAN),
    ("+inf", f32::INFINITY),
    ("-inf", f32::NEG_INFINITY),
    ("0", 0.0),
    ("-0", -0.0),
    ("least denormal", 1e-45),
    ("denormal", -1e-42),
    ("least normal", f32::MIN_POSITIVE),
    ("tiny", 1e-20),
    ("huge", 1e20),
    ("-huge", -1e20),
    ("largest", f32::MAX),
    ("-largest", f32::MIN),
    ("epsilon", f32::EPSILON),
];

/// What an entry answered to poison: fine, or what is wrong with it.
pub(crate) type Verdict = Result<(), String>;

/// Fails unless all numbers are finite.
pub(crate) fn finite(values: impl IntoIterator<Item = f64>) -> Verdict {
    let values: Vec<f64> = values.into_iter().collect();
    if values.iter().all(|v| v.is_finite()) { Ok(()) } else { Err(format!("{values:?}")) }
}

/// Fails unless all numbers are finite.
pub(crate) fn finite_32(values: impl IntoIterator<Item = f32>) -> Verdict {
    finite(values.into_iter().map(f64::from))
}

/// Fails with `message` unless `good`.
pub(crate) fn check(good: bool, message: impl FnOnce() -> String) -> Verdict {
    if good { Ok(()) } else { Err(message()) }
}

/// Counts what was tried and gathers what went wrong, so that one run names everything.
#[derive(Default)]
pub(crate) struct Ledger {
    entries: usize,
    tried: usize,
    wrong: Vec<String>,
}

impl Ledger {
    /// One try.
    pub(crate) fn one(&mut self, entry: &str, with: &str, test: impl FnOnce() -> Verdict) {
        self.tried += 1;
        let wrong = match catch_unwind(AssertUnwindSafe(test)) {
            Ok(Ok(())) => return,
            Ok(Err(message)) => message,
            Err(panic) => {
                let text = panic.downcast_ref::<String>().map(String::as_str);
                let text = text.or_else(|| panic.downcast_ref::<&str>().copied()).unwrap_or("?");
                format!("PANIC {text}")
            }
        };
        self.wrong.push(format!("{entry} [{with}]: {wrong}"));
    }

    /// Every poison in every place of `base`, and `base` itself.
    pub(crate) fn poke<const N: usize>(&mut self, entry: &str, base: [f64; N], test: impl Fn([f64; N]) -> Verdict) {
        self.entries += 1;
        self.one(entry, "sound", || test(base));
        for place in 0..N {
            for (name, value) in POISON {
                let mut args = base;
                args[place] = value;
                self.one(entry, &format!("argument {place} = {name}"), || test(args));
            }
        }
    }

    /// The same in 32 bits.
    pub(crate) fn poke_32<const N: usize>(&mut self, entry: &str, base: [f32; N], test: impl Fn([f32; N]) -> Verdict) {
        self.entries += 1;
        self.one(entry, "sound", || test(base));
        for place in 0..N {
            for (name, value) in POISON_32 {
                let mut args = base;
                args[place] = value;
                self.one(entry, &format!("argument {place} = {name}"), || test(args));
            }
        }
    }

    /// Says what was tried and fails if anything went wrong.
    pub(crate) fn close(self, title: &str) {
        eprintln!("{title}: {} entries, {} tries, {} wrong", self.entries, self.tried, self.wrong.len());
        assert!(self.wrong.is_empty(), "{title}:\n{}", self.wrong.join("\n"));
    }
}

/// Runs a command that may succeed or be refused, but must not crash: gives its status and what it said.
pub(crate) fn survives(name: &str, args: &[&str]) -> Result<(bool, String), String> {
    let output = run(name, args);
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    match output.status.code() {
        Some(status @ (0 | 1)) if !said.contains("panicked") => Ok((status == 0, said)),
        status => Err(format!("{name} {args:?} ended with {status:?}: {said}")),
    }
}

/// Pixels along a side of the ball's pictures.
const SIDE: u32 = 48;
/// The ball's radius, and where the wall behind it is, metres.
const RADIUS: f64 = 0.08;
const WALL: f64 = 0.3;

/// Pictures of a ball that changes its colour with one AU, before a wall; the ball's middle is the AU's region.
pub(crate) struct Ball {
    cameras: Vec<Camera>,
    pub pictures: Vec<Vec<u8>>,
    labels: Vec<Vec<u8>>,
}

impl Ball {
    /// So many views; the AU is raised in every other one.
    pub(crate) fn new(views: usize) -> Self {
        let camera = |view: usize| {
            let turn = (view as f64 / views.max(1) as f64 - 0.5) * 0.8;
            let camera_from_world = Isometry::new(DMat3::from_rotation_y(turn), DVec3::new(0.0, 0.0, 0.6));
            Camera { intrinsics: Intrinsics::pinhole(SIDE, SIDE, 70.0), camera_from_world }
        };
        let cameras: Vec<Camera> = (0..views).map(camera).collect();
        let seen = cameras.iter().enumerate().map(|(view, camera)| picture(camera, view.is_multiple_of(2)));
        let (pictures, labels) = seen.unzip();
        Self { cameras, pictures, labels }
    }

    /// What a fit is given.
    pub(crate) fn scene(&self) -> Scene<'_> {
        let frame = |view: usize| Frame {
            camera: self.cameras[view],
            room_from_head: Isometry::IDENTITY,
            rgb: &self.pictures[view],
            valid: None,
            labels: Some(&self.labels[view]),
            activations: Some(vec![f32::from(u8::from(view.is_multiple_of(2)))]),
            landmarks_px: None,
        };
        Scene {
            frames: (0..self.cameras.len()).map(frame).collect(),
            region_of: vec![0],
            also_in: Vec::new(),
            regions: 1,
            face_radius_m: RADIUS as f32,
            head_hull: None,
            plate: None,
            neutral_frame: 1.min(self.cameras.len().saturating_sub(1)),
        }
    }
}

/// Colours and labels of the ball.
fn picture(camera: &Camera, raised: bool) -> (Vec<u8>, Vec<u8>) {
    let eye = camera.center();
    let pixel = |i: u32| {
        let d = camera.ray_direction(DVec2::new(f64::from(i % SIDE) + 0.5, f64::from(i / SIDE) + 0.5)).unwrap();
        let nearest = eye - d * eye.dot(d);
        let texture = |p: DVec3| ((p.x * 90.0).sin() * (p.y * 70.0).cos() * 40.0) as i32;
        let inside = RADIUS * RADIUS - nearest.length_squared();
        let (color, at) = match (inside > 0.0, raised) {
            (true, true) => ([200, 60, 30], eye + d * (-eye.dot(d) - inside.sqrt())),
            (true, false) => ([40, 70, 190], eye + d * (-eye.dot(d) - inside.sqrt())),
            (false, _) => ([110, 130, 80], eye + d * ((WALL - eye.z) / d.z)),
        };
        let label = u8::from(nearest.length() < 0.6 * RADIUS);
        (color.map(|c: i32| (c + texture(at)).clamp(0, 255) as u8), label)
    };
    let pixels: Vec<([u8; 3], u8)> = (0..SIDE * SIDE).map(pixel).collect();
    (pixels.iter().flat_map(|p| p.0).collect(), pixels.iter().map(|p| p.1).collect())
}

/// A model of 64 Gaussians in a block, of which the first half carries deltas of two AUs.
pub(crate) fn block() -> Gaussians {
    use risorius_splat::model::{DELTAS, LANES, REGIONS, channel};
    let layout = Layout { region_of: vec![0, 1], also_in: Vec::new(), regions: 2, latent: 0, images: 1 };
    let (groups, deformable) = (4, 2);
    let mut base = vec![0.0; groups * channel::COUNT * LANES];
    for i in 0..groups * LANES {
        let mut set = |c: usize, v: f32| base[(i / LANES * channel::COUNT + c) * LANES + i % LANES] = v;
        for axis in 0..3 {
            set(channel::MEAN + axis, 0.03 * ((i >> (2 * axis)) % 4) as f32 - 0.045);
            set(channel::LOG_SCALE + axis, -4.5);
            set(channel::COLOR + axis, ((i * (axis + 3)) % 7) as f32 / 7.0);
        }
        set(channel::QUATERNION, 1.0);
        set(channel::OPACITY, 1.5);
    }
    let deltas = (0..deformable * 2 * DELTAS * LANES).map(|i| ((i * 37 % 19) as f32 - 9.0) * 1e-3).collect();
    Gaussians {
        layout,
        deformable,
        base,
        deltas,
        gates: vec![1.0; deformable * REGIONS * LANES],
        membership: (0..groups * REGIONS * LANES).map(|i| (i % 5) as f32 - 2.0).collect(),
        head_weight: vec![1.0; groups * LANES],
    }
}
