//! The pixels that a hull covers, and tints over pictures.

use glam::{DVec2, DVec3};
use image::RgbImage;
use risorius_formats::Camera;
use risorius_formats::mask::LabelImage;
use risorius_formats::nerfies::fill_polygon;
use risorius_formats::polygon::projected_hull;

/// The pixels that see the convex hull of `corners_in_world`: 255 inside, 0 outside.
pub fn hull_mask(corners_in_world: &[DVec3], camera: &Camera) -> LabelImage {
    let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
    let outline: Vec<_> = projected_hull(corners_in_world, camera).iter().map(DVec2::to_array).collect();
    let mut mask = LabelImage::new(width, height);
    fill_polygon(&outline, width, height, |row, columns| {
        let start = row as usize * width as usize;
        mask.labels[start + columns.start as usize..start + columns.end as usize].fill(255);
    });
    mask
}

/// Darkens what a mask leaves out. Sizes must agree; else nothing happens.
pub fn dim_outside(image: &mut RgbImage, mask: &LabelImage) {
    if (image.width(), image.height()) != (mask.width, mask.height) {
        return;
    }
    for (pixel, _) in image.pixels_mut().zip(&mask.labels).filter(|(_, label)| **label == 0) {
        pixel.0 = pixel.0.map(|v| v / 3);
    }
}

/// The colours of regions 1, 2, 3, … in pictures for people; they repeat.
pub const REGION_COLOURS: [[u8; 3]; 6] =
    [[230, 159, 0], [86, 180, 233], [0, 158, 115], [204, 121, 167], [213, 94, 0], [240, 228, 66]];

/// The colour of a label above 0.
pub fn region_colour(label: u8) -> [u8; 3] {
    REGION_COLOURS[usize::from(label.saturating_sub(1)) % REGION_COLOURS.len()]
}

/// Tints each labelled pixel with its region's colour, `strength` in 256ths. Sizes must agree; else nothing happens.
pub fn tint(image: &mut RgbImage, labels: &LabelImage, strength: u16) {
    if (image.width(), image.height()) != (labels.width, labels.height) {
        return;
    }
    for (pixel, &label) in image.pixels_mut().zip(&labels.labels) {
        if label > 0 {
            for (v, c) in pixel.0.iter_mut().zip(region_colour(label)) {
                *v = ((u16::from(*v) * (256 - strength.min(256)) + u16::from(c) * strength.min(256)) >> 8) as u8;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use risorius_formats::{Intrinsics, Isometry};

    #[test]
    fn a_ball_projects_to_a_disc() {
        let camera = Camera {
            intrinsics: Intrinsics::pinhole(200, 100, 100.0),
            camera_from_world: Isometry::new(glam::DMat3::IDENTITY, DVec3::new(0.0, 0.0, 5.0)),
        };
        let points: Vec<_> = (0..400)
            .map(|i| {
                let (z, a) = (1.0 - (2 * i + 1) as f64 / 400.0, i as f64 * 2.399_963);
                DVec3::new((1.0 - z * z).sqrt() * a.cos(), (1.0 - z * z).sqrt() * a.sin(), z)
            })
            .collect();
        let mask = hull_mask(&points, &camera);
        // The silhouette of a unit ball at distance 5: tan = 1/√24, radius 20.41 pixels.
        let area = mask.share(255) * 200.0 * 100.0;
        let expected = std::f64::consts::PI * 100.0 * 100.0 / 24.0;
        assert!((area / expected - 1.0).abs() < 0.04, "{area} of {expected}");
        assert_eq!((mask.get(100, 50), mask.get(125, 50)), (255, 0));
    }

    #[test]
    fn tinting_leaves_label_0_alone() {
        let mut image = RgbImage::from_pixel(2, 1, image::Rgb([100, 100, 100]));
        let labels = LabelImage { width: 2, height: 1, labels: vec![0, 1] };
        tint(&mut image, &labels, 128);
        assert_eq!((image.get_pixel(0, 0).0, image.get_pixel(1, 0).0), ([100; 3], [165, 129, 50]));
    }
}
