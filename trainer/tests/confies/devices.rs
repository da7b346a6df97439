//! What other numbers and other devices make of the same fit.

use std::path::Path;

use burn::tensor::Device;
use risorius_formats::Silent;
use risorius_trainer::config::FitSettings;
use risorius_trainer::devices;
use risorius_trainer::fit::confies::{ConfiesNumbers, Limits, fit};
use risorius_trainer::fit::metrics::Line;
use risorius_trainer::kernel::Products;

use crate::scene::{scene, settings};

fn short() -> FitSettings {
    settings().with_steps(60)
}

fn fitted(settings: &FitSettings, run: &Path, device: &Device) -> Vec<Line<ConfiesNumbers>> {
    fit(&scene(&[2]), settings, Limits::default(), run, false, device, &Silent).unwrap();
    let text = std::fs::read_to_string(run.join("metrics.jsonl")).unwrap();
    text.lines().map(|l| serde_json::from_str(l).unwrap()).collect()
}

/// Both begin with the same errors and gradients to `first`, and get as far to `last`.
fn assert_alike(found: &[Line<ConfiesNumbers>], expected: &[Line<ConfiesNumbers>], first: f64, last: f64) {
    let near = |name: &str, a: f64, b: f64, share: f64| {
        assert!((a - b).abs() <= share * b.abs().max(1e-6), "{name}: {a} instead of {b}");
    };
    let (a, b) = (&found[0].numbers, &expected[0].numbers);
    near("reconstruction", a.reconstruction, b.reconstruction, first);
    near("mask", a.mask, b.mask, first);
    near("attribute", a.attribute, b.attribute, first);
    for (part, &norm) in &b.gradient_norms {
        near(part, a.gradient_norms[part], norm, 10.0 * first);
    }
    let end =
        |lines: &[Line<ConfiesNumbers>]| lines[lines.len() - 3..].iter().map(|l| l.numbers.reconstruction).sum::<f64>();
    near("the last reconstructions", end(found), end(expected), last);
    assert!(end(found) < 3.0 * found[0].numbers.reconstruction, "it learns");
}

#[test]
fn products_in_bf16_learn_what_those_in_f32_learn() {
    let dir = tempfile::tempdir().unwrap();
    let plain = short();
    let mut half = plain.clone();
    half.model.products = Products::Bf16;
    let expected = fitted(&plain, &dir.path().join("f32"), &Device::flex());
    let found = fitted(&half, &dir.path().join("bf16"), &Device::flex());
    assert_ne!(
        found[0].numbers.reconstruction.to_bits(),
        expected[0].numbers.reconstruction.to_bits(),
        "nothing was rounded"
    );
    assert_alike(&found, &expected, 0.01, 0.1);
}

/// Builds with `--features wgpu` or `cuda`, where such a device is here; a Vulkan driver that computes on the CPU will do.
#[test]
#[allow(clippy::print_stderr, reason = "a test that is skipped has to say so")]
fn every_device_fits_as_the_cpu_does() {
    let others: Vec<_> =
        devices::list().into_iter().filter(|k| k.name != "cpu" && k.compiled_in && !k.present.is_empty()).collect();
    if others.is_empty() {
        eprintln!("SKIPPED: this build or machine has no device but the CPU");
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    let settings = short();
    let expected = fitted(&settings, &dir.path().join("cpu"), &Device::flex());
    for kind in others {
        let device = devices::open(kind.name).unwrap();
        let found = fitted(&settings, &dir.path().join(kind.name), &device);
        assert_alike(&found, &expected, 1e-4, 0.05);
    }
}
