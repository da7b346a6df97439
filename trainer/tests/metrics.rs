//! Metrics against other implementations: `golden/metrics.py` writes what they say.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

use image::{Rgb, RgbImage};
use risorius_trainer::eval::icc::icc;
use risorius_trainer::eval::{Lpips, LpipsNetwork, lpips, ms_ssim, mse, psnr_from_mse, ssim_map};
use serde_json::Value;

fn golden() -> Value {
    serde_json::from_str(include_str!("golden/metrics.json")).unwrap()
}

/// The pictures of `golden/metrics.py`, by the same formula.
fn pictures(case: &Value) -> (RgbImage, RgbImage) {
    let number = |name: &str| case[name].as_i64().unwrap();
    let (width, height, seed) = (number("width"), number("height"), number("seed"));
    let truth = |x: i64, y: i64, c: i64| (x * x / 37 + y * y / 23 + x * y / 41 + c * 40 + seed * 17) % 211 + 20;
    let render = |x: i64, y: i64, c: i64| {
        let noise = (x * 31 + y * 17 + c * 7 + seed * 5) % 23 - 11;
        let noise = (noise * (1 + (x / 32 + y / 32) % 3)).div_euclid(2);
        ((truth(x, y, c) * 15 + 128) / 16 + noise).clamp(0, 255)
    };
    let paint = |of: &dyn Fn(i64, i64, i64) -> i64| {
        RgbImage::from_fn(width as u32, height as u32, |x, y| {
            Rgb([0, 1, 2].map(|c| of(i64::from(x), i64::from(y), c) as u8))
        })
    };
    (paint(&truth), paint(&render))
}

#[test]
fn picture_metrics_agree_with_scikit_image_and_tensorflow() {
    for case in golden()["pictures"].as_array().unwrap() {
        let (truth, render) = pictures(case);
        let expected = |name: &str| case[name].as_f64().unwrap();
        let psnr = psnr_from_mse(mse(&truth, &render).unwrap());
        assert!((psnr - expected("psnr_db")).abs() < 1e-9, "{psnr} {case}");
        let map = ssim_map(&truth, &render).unwrap();
        let ssim = map.mean_inside(|_| true).unwrap();
        assert!((ssim - expected("ssim")).abs() < 1e-6, "{ssim} {case}");
        let multi = ms_ssim(&truth, &render).unwrap();
        // TensorFlow computes in 32 bits, as differences of squares.
        assert!((multi.value - expected("ms_ssim")).abs() < 1e-5, "{} {case}", multi.value);
        assert_eq!(multi.scales, 5);
    }
}

#[test]
fn icc_agrees_with_pingouin() {
    for case in golden()["icc"].as_array().unwrap() {
        let ratings: Vec<Vec<f64>> = serde_json::from_value(case["ratings"].clone()).unwrap();
        let expected: [f64; 3] = serde_json::from_value(case["icc_1_1_2_1_3_1"].clone()).unwrap();
        let got = icc(&ratings).unwrap();
        for (got, expected) in [got.icc_1_1, got.icc_2_1, got.icc_3_1].into_iter().zip(expected) {
            assert!((got - expected).abs() < 1e-6, "{got} {expected}");
        }
    }
}

#[test]
fn lpips_agrees_with_another_implementation() {
    let dir = lpips::default_dir();
    for (network, name) in [(LpipsNetwork::Alex, "lpips_alex"), (LpipsNetwork::Vgg, "lpips_vgg")] {
        if !Lpips::is_in(&dir, network) {
            eprintln!("SKIPPED: {name} is not in {}; `tools/models --metrics` fetches it", dir.display());
            continue;
        }
        let mut lpips = Lpips::open(&dir, network).unwrap();
        for case in golden()["pictures"].as_array().unwrap() {
            let (truth, render) = pictures(case);
            let score = lpips.compare(&truth, &render).unwrap().unwrap();
            let expected = case[name].as_f64().unwrap();
            assert!((score.value - expected).abs() < 1e-5 + 1e-3 * expected, "{name}: {} {expected}", score.value);
            let whole = score.inside(|_, _| true).unwrap();
            assert!((whole - score.value).abs() < 1e-6);
            assert_eq!(lpips.compare(&truth, &truth).unwrap().unwrap().value, 0.0);
        }
        assert!(lpips.compare(&RgbImage::new(32, 32), &RgbImage::new(32, 32)).unwrap().is_none(), "too small");
    }
}
