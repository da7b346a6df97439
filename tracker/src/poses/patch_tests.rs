use super::*;
use image::{Rgb, RgbImage};

/// A smooth random pattern, known at every place.
fn pattern(x: f64, y: f64) -> f64 {
    let waves = [(0.31, 0.12, 0.4), (-0.17, 0.35, 1.9), (0.45, -0.28, 2.2), (0.11, 0.52, 5.1), (0.6, 0.4, 3.0)];
    128.0 + waves.iter().map(|(a, b, c)| 20.0 * (a * x + b * y + c).sin()).sum::<f64>()
}

/// The pattern seen through `pattern_from_pixel` = M p + t, with a gain and an offset.
fn picture(m: DMat2, t: DVec2, gain: f64) -> Picture {
    Picture::new(&RgbImage::from_fn(160, 120, |x, y| {
        let p = m * DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5) + t;
        Rgb([((pattern(p.x, p.y) - 128.0) * gain + 120.0).round() as u8; 3])
    }))
}

#[test]
fn a_shift_is_found_to_a_thirtieth_of_a_pixel_in_spite_of_exposure() {
    let a = picture(DMat2::IDENTITY, DVec2::ZERO, 1.0);
    for (shift, gain) in [(DVec2::new(1.37, -0.82), 1.0), (DVec2::new(-2.5, 1.9), 0.7)] {
        let b = picture(DMat2::IDENTITY, -shift, gain);
        for centre in [DVec2::new(80.0, 60.0), DVec2::new(50.3, 71.8)] {
            let template = Template::cut(&a, 0, centre, false).unwrap();
            let found = template.find(&b, centre, DMat2::IDENTITY).unwrap();
            let error = (found.centre - centre - shift).length();
            assert!(error < 0.03 && found.similarity > 0.995, "{error} {found:?}");
        }
    }
}

#[test]
fn a_turned_and_grown_patch_needs_the_right_warp_or_the_affine_search() {
    let (a, turn) = (picture(DMat2::IDENTITY, DVec2::ZERO, 1.0), DMat2::from_angle(0.12) * 1.1);
    let middle = DVec2::new(80.0, 60.0);
    // pattern_from_pixel of the second picture, about the middle, is the inverse of the warp.
    let (m, shift) = (turn.inverse(), DVec2::new(0.6, -0.4));
    let b = picture(m, middle - m * (middle + shift), 1.0);
    let template = Template::cut(&a, 0, middle, true).unwrap();
    let known = template.find(&b, middle, turn).unwrap();
    assert!((known.centre - middle - shift).length() < 0.08, "{known:?}");
    let found = template.find_affine(&b, middle, DMat2::IDENTITY).unwrap();
    assert!((found.centre - middle - shift).length() < 0.08 && found.similarity > 0.99, "{found:?}");
    let unwarped = template.find(&b, middle, DMat2::IDENTITY);
    assert!(unwarped.is_none_or(|u| u.similarity < found.similarity - 0.001));
}

#[test]
fn flat_pictures_and_borders_give_no_patch() {
    let flat = Picture::new(&RgbImage::from_pixel(100, 100, Rgb([90; 3])));
    assert!(Template::cut(&flat, 0, DVec2::splat(50.0), false).is_none());
    let edge = Picture::new(&RgbImage::from_fn(100, 100, |x, _| Rgb([if x < 50 { 40 } else { 200 }; 3])));
    assert!(Template::cut(&edge, 0, DVec2::splat(50.0), false).is_none(), "an edge slides along itself");
    let a = picture(DMat2::IDENTITY, DVec2::ZERO, 1.0);
    assert!(Template::cut(&a, 0, DVec2::new(5.0, 50.0), false).is_none());
    let template = Template::cut(&a, 0, DVec2::new(40.0, 50.0), false).unwrap();
    assert!(template.find(&a, DVec2::new(3.0, 50.0), DMat2::IDENTITY).is_none());
    assert!(template.find(&a, DVec2::NAN, DMat2::IDENTITY).is_none());
    // Elsewhere in the picture it is not found, or seen to be another.
    let other = template.find(&a, DVec2::new(120.0, 80.0), DMat2::IDENTITY);
    assert!(other.is_none_or(|o| o.similarity < 0.9));
}
