use proptest::prelude::*;

use super::*;

/// The readable twin of [`Sampling::sample`] for one tap: every pixel of the crop asks for its place in the picture.
fn sample_slowly(sampling: &Sampling, picture: &RgbImage, picture_from_input: &Affine) -> Vec<f64> {
    let level = |x: i64, y: i64, c: usize| {
        let inside = x >= 0 && y >= 0 && x < i64::from(picture.width()) && y < i64::from(picture.height());
        if inside { f64::from(picture.get_pixel(x as u32, y as u32).0[c]) } else { 0.0 }
    };
    let mut out = vec![0.0; sampling.len()];
    for v in 0..sampling.height {
        for u in 0..sampling.width {
            let [x, y] = picture_from_input.apply([u as f32 + 0.5, v as f32 + 0.5]);
            let (x, y) = (f64::from(x) - 0.5, f64::from(y) - 0.5);
            let (left, top) = (x.floor(), y.floor());
            for c in 0..3 {
                let mut value = 0.0;
                for (dx, dy) in [(0, 0), (1, 0), (0, 1), (1, 1)] {
                    let wx = if dx == 1 { x - left } else { 1.0 - (x - left) };
                    let wy = if dy == 1 { y - top } else { 1.0 - (y - top) };
                    value += wx * wy * level(left as i64 + dx, top as i64 + dy, c);
                }
                let at = (v * sampling.width + u) as usize;
                let plane = (sampling.width * sampling.height) as usize;
                let place = if sampling.layout == Layout::Nhwc { 3 * at + c } else { c * plane + at };
                out[place] = (value - f64::from(sampling.mean)) * f64::from(sampling.scale);
            }
        }
    }
    out
}

fn picture(width: u32, height: u32) -> RgbImage {
    RgbImage::from_fn(width, height, |x, y| {
        let wave = |k: f32| (127.0 + 120.0 * (k * x as f32 * 0.3 + 0.2 * y as f32).sin()) as u8;
        image::Rgb([wave(1.0), wave(0.7), (x * 7 + y * 13) as u8])
    })
}

fn sampling(layout: Layout) -> Sampling {
    Sampling { width: 24, height: 24, layout, mean: 100.0, scale: 0.01 }
}

proptest! {
    #[test]
    fn the_sampler_agrees_with_its_readable_twin(x in -10f32..50.0, y in -10f32..40.0, side in 5f32..38.0,
                                                 angle in -3.2f32..3.2, nchw in prop::bool::ANY) {
        let sampling = sampling(if nchw { Layout::Nchw } else { Layout::Nhwc });
        let picture = picture(40, 30);
        let matrix = Crop { center: [x, y], side, angle }.picture_from_crop(24);
        let mut fast = Vec::new();
        sampling.sample(&picture, &matrix, &mut fast);
        for (a, b) in fast.iter().zip(sample_slowly(&sampling, &picture, &matrix)) {
            prop_assert!((f64::from(*a) - b).abs() < 2e-3, "{a} {b}");
        }
    }

    #[test]
    fn a_crop_comes_back_from_the_corners_of_its_own_square(x in 0f32..500.0, y in 0f32..500.0, side in 20f32..400.0,
                                                            angle in -3.1f32..3.1) {
        let crop = Crop { center: [x, y], side, angle };
        let matrix = crop.picture_from_crop(100);
        let corners = [[0.0, 0.0], [100.0, 0.0], [100.0, 100.0], [0.0, 100.0]].map(|p| matrix.apply(p));
        let back = Crop::around(corners.into_iter(), corners[0], corners[1], 1.0).unwrap();
        prop_assert!(crop.distance(&back) < 1e-3, "{crop:?} {back:?}");
    }
}

#[test]
fn a_crop_made_smaller_is_averaged() {
    // Noise: single samples would be 58 levels from its mean on average in the square.
    let noise = |x: u32, y: u32| ((x * 7919 + y * 104_729).wrapping_mul(2_654_435_761) >> 24) as u8;
    let noisy = RgbImage::from_fn(400, 400, |x, y| image::Rgb([(u32::from(noise(x, y)) * 200 / 255) as u8; 3]));
    let sampling = Sampling { width: 20, height: 20, layout: Layout::Nhwc, mean: 0.0, scale: 1.0 };
    let crop = Crop { center: [200.0, 200.0], side: 300.0, angle: 0.0 };
    let mut out = Vec::new();
    sampling.sample(&noisy, &crop.picture_from_crop(20), &mut out);
    let mean = out.iter().sum::<f32>() / out.len() as f32;
    let deviation = (out.iter().map(|v| (v - mean).powi(2)).sum::<f32>() / out.len() as f32).sqrt();
    assert!((mean - 100.0).abs() < 5.0 && deviation < 15.0, "{mean} {deviation}");
}

#[test]
fn points_without_extent_have_no_crop() {
    assert_eq!(Crop::around([[3.0, 3.0]; 4].into_iter(), [3.0, 3.0], [3.0, 3.0], 1.5), None);
    assert_eq!(Crop::around([[f32::NAN, 3.0], [9.0, 9.0]].into_iter(), [f32::NAN, 0.0], [1.0, 0.0], 1.5), None);
}

#[test]
fn motion_goes_on() {
    let before = Crop { center: [10.0, 20.0], side: 100.0, angle: 3.1 };
    let now = Crop { center: [12.0, 19.0], side: 110.0, angle: -3.1 };
    let next = now.extrapolated(&before, 1.0);
    assert!((next.center[0] - 14.0).abs() < 1e-4 && (next.center[1] - 18.0).abs() < 1e-4);
    assert!((next.side - 121.0).abs() < 1e-3 && (turn(now.angle, next.angle) - 0.083_185).abs() < 1e-4);
}
