use super::*;

/// A face with edges in all directions, colours and a black outside.
fn face() -> AlignedFace {
    let mut levels = vec![0.0f32; 3 * PLANE];
    for (i, level) in levels.iter_mut().enumerate() {
        let (c, y, x) = (i / PLANE, (i % PLANE / SIDE) as f64, (i % SIDE) as f64);
        let wave = (0.021 * x * y + c as f64).sin() + (0.3 * x - 0.11 * y * (1.0 + c as f64)).cos();
        if (x - 55.5).hypot(y - 55.5) < 48.0 {
            *level = (128.0 + 60.0 * wave).round() as f32;
        }
    }
    AlignedFace { levels }
}

/// The definition, pixel by pixel and in double precision.
fn plain(face: &AlignedFace) -> Vec<f64> {
    let level = |c: usize, y: usize, x: usize| f64::from(face.levels[c * PLANE + y * SIDE + x]);
    let mut histograms = vec![[[0.0f64; 18]; 16]; 16];
    for y in 1..SIDE - 1 {
        for x in 1..SIDE - 1 {
            let gradient = |c| [level(c, y, x + 1) - level(c, y, x - 1), level(c, y + 1, x) - level(c, y - 1, x)];
            let length = |g: [f64; 2]| g[0].hypot(g[1]);
            let [gx, gy] = (1..3).map(gradient).fold(gradient(0), |a, b| if length(b) > length(a) { b } else { a });
            let along = |o: usize| {
                let (sin, cos) = (o as f64 * std::f64::consts::PI / 9.0).sin_cos();
                cos * gx + sin * gy
            };
            // The first of equals, unsigned orientations in their order.
            let mut orientation = 0;
            for o in 0..9 {
                for candidate in [o, o + 9] {
                    if along(candidate) > along(orientation) + 1e-9 {
                        orientation = candidate;
                    }
                }
            }
            let at = |i: usize| (i as f64 + 0.5) / 8.0 + 0.5;
            for (row, wy) in [(at(y).floor(), 1.0 - at(y).fract()), (at(y).floor() + 1.0, at(y).fract())] {
                for (column, wx) in [(at(x).floor(), 1.0 - at(x).fract()), (at(x).floor() + 1.0, at(x).fract())] {
                    histograms[row as usize][column as usize][orientation] += wx * wy * length([gx, gy]);
                }
            }
        }
    }
    let energy = |y: usize, x: usize| -> f64 {
        let h = &histograms[y][x];
        (0..9).map(|o| (h[o] + h[o + 9]).powi(2)).sum()
    };
    let mut out = Vec::new();
    for (y, x) in (2..14).flat_map(|y| (2..14).map(move |x| (y, x))) {
        let h = &histograms[y][x];
        let norms = [(y - 1, x - 1), (y - 1, x), (y, x - 1), (y, x)]
            .map(|(y, x)| (energy(y, x) + energy(y, x + 1) + energy(y + 1, x) + energy(y + 1, x + 1) + 1e-4).sqrt());
        let share = |v: f64, n: f64| (v / n).min(0.2);
        out.extend((0..18).map(|o| norms.iter().map(|n| 0.5 * share(h[o], *n)).sum::<f64>()));
        out.extend((0..9).map(|o| norms.iter().map(|n| 0.5 * share(h[o] + h[o + 9], *n)).sum::<f64>()));
        out.extend(norms.map(|n| 0.2357 * h.iter().map(|v| share(*v, n)).sum::<f64>()));
    }
    out
}

#[test]
fn the_fast_one_is_the_definition() {
    let face = face();
    let (fast, plain) = (fhog(&face), plain(&face));
    assert_eq!((fast.len(), plain.len()), (FHOG_NUMBERS, FHOG_NUMBERS));
    for (i, (a, b)) in fast.iter().zip(&plain).enumerate() {
        assert!((f64::from(*a) - b).abs() < 2e-4, "{i}: {a} {b}");
    }
}

#[test]
fn light_and_contrast_do_not_matter() {
    let dark = face();
    let bright = AlignedFace { levels: dark.levels.iter().map(|v| 0.4 * v).collect() };
    for (a, b) in fhog(&dark).iter().zip(fhog(&bright)) {
        assert!((a - b).abs() < 1e-3, "{a} {b}");
    }
    assert!(fhog(&AlignedFace { levels: vec![90.0; 3 * PLANE] }).iter().all(|v| *v == 0.0));
}
