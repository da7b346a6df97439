use super::*;

/// The canonical mesh seen from the front in a picture: turned by `roll`, `eyes_px` between the outer eye corners.
fn points(roll: f32, eyes_px: f32) -> [[f32; 2]; MESH_POINTS] {
    let (sin, cos) = roll.sin_cos();
    std::array::from_fn(|i| {
        let [x, y, _] = Weights::get().canonical[i].map(|v| v * eyes_px);
        [cos * x - sin * y + 128.0, sin * x + cos * y + 128.0]
    })
}

/// A ramp of levels: red along x, green along y, blue 50.
fn ramp(layout: Layout) -> Vec<f32> {
    let pixels = (0..256 * 256).map(|i| [(i % 256) as f32 + 0.5, (i / 256) as f32 + 0.5, 50.0].map(|v| v / 255.0));
    let pixels: Vec<[f32; 3]> = pixels.collect();
    match layout {
        Layout::Nhwc => pixels.into_iter().flatten().collect(),
        Layout::Nchw => (0..3).flat_map(|c| pixels.iter().map(move |p| p[c])).collect(),
    }
}

#[test]
fn the_face_lies_upright_in_its_place_whatever_the_layout() {
    let mut both = Vec::new();
    for layout in [Layout::Nhwc, Layout::Nchw] {
        let numbers = ramp(layout);
        let input = NetworkInput { numbers: &numbers, width: 256, height: 256, layout, mean: 0.0, scale: 1.0 / 255.0 };
        let points = points(0.2, 80.0);
        let face = AlignedFace::sample(&input, &points).unwrap();
        // The ramps tell which pixel of the input each pixel shows.
        let back = alignment(&points).unwrap();
        for (row, column) in [(56, 56), (30, 70), (80, 40)] {
            let at = row * SIDE + column;
            let [x, y] = back.apply([face.levels[at], face.levels[PLANE + at]]);
            assert!((x - column as f32 - 0.5).abs() < 1e-2 && (y - row as f32 - 0.5).abs() < 1e-2, "{x} {y}");
            assert!((face.levels[2 * PLANE + at] - 50.0).abs() < 1e-3);
        }
        assert!(face.levels[..SIDE].iter().all(|v| *v == 0.0), "the corner is outside the oval");
        both.push(face);
    }
    for (a, b) in both[0].levels.iter().zip(&both[1].levels) {
        assert!((a - b).abs() < 1e-3);
    }
}

#[test]
fn outer_eye_corners_are_50_px_apart() {
    let points = points(-0.5, 123.0);
    let [left, right] = [33, 263].map(|i| alignment(&points).unwrap().apply(points[i]));
    assert!((right[0] - left[0] - 50.0).abs() < 1e-2 && (right[1] - left[1]).abs() < 1e-2, "{left:?} {right:?}");
}

#[test]
fn runs_lie_inside_the_polygon() {
    let diamond = [[56.0, 10.0], [100.0, 56.0], [56.0, 100.0], [10.0, 56.0]];
    assert_eq!(inside(&diamond, 5.5), Vec::<[usize; 2]>::new());
    assert_eq!(inside(&diamond, 56.5), vec![[11, 99]]);
    assert!(alignment(&[[3.0; 2]; MESH_POINTS]).is_none());
}
