//! Poison values, and a ledger of what was tried with them.

use std::panic::{AssertUnwindSafe, catch_unwind};

use risorius_brick::{BackgroundFrame, Brick, HeadBox, Layout, math};
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

/// An untrained avatar of a ball before a wall, whose one region is the ball's middle.
pub(crate) fn ball(aus: usize, images: usize, seed: u64) -> Brick {
    ball_with_finest(aus, images, seed, 128)
}

/// The same with grids of up to `finest` vertices along an edge.
pub(crate) fn ball_with_finest(aus: usize, images: usize, seed: u64, finest: usize) -> Brick {
    let layout = Layout {
        head_box: HeadBox { center: [0.0; 3], half: 0.6 },
        background: Some(BackgroundFrame {
            position: [0.0, 0.0, -2.0],
            axes: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
            near: 2.6,
            far: 7.0,
            middle: [0.0; 2],
            extent: [1.0; 2],
        }),
        region_of: vec![0; aus],
        regions: 1,
        images,
        expression_vertices: 16,
        finest,
    };
    Brick::new(layout, seed, |p| u8::from(math::dot(p, p) < 0.2))
}
