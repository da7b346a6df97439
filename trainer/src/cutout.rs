//! The head cut out of its background.
//!
//! A pixel's opacity is what the head takes of the light behind it, 1 − Π (1 − a_i), with the colours that it shows. Both
//! are kept multiplied together (premultiplied) while pixels are averaged or enlarged, since only such
//! numbers may be mixed; PNG's colours are straight, so [`straight`] divides at the end.

use image::{ImageBuffer, Rgba, RgbaImage, imageops};

/// Opacities below half a level of 255 are written as 0, and have no colour.
const CLEAR: f32 = 0.5 / 255.0;

/// A premultiplied picture of `width` × `height` as straight 8-bit RGBA of `size`.
pub fn straight(head: &[[f32; 4]], (width, height): (u32, u32), size: (u32, u32)) -> RgbaImage {
    let numbers: Vec<f32> = head.iter().flatten().copied().collect();
    let picture: ImageBuffer<Rgba<f32>, Vec<f32>> =
        ImageBuffer::from_raw(width, height, numbers).unwrap_or_else(|| ImageBuffer::new(width, height));
    let picture = if (width, height) == size {
        picture
    } else {
        imageops::resize(&picture, size.0, size.1, imageops::FilterType::CatmullRom)
    };
    let byte = |v: f32| (v.clamp(0.0, 1.0) * 255.0).round() as u8;
    let mut out = RgbaImage::new(size.0, size.1);
    for (to, Rgba([r, g, b, opacity])) in out.pixels_mut().zip(picture.pixels()) {
        if *opacity >= CLEAR {
            *to = Rgba([byte(r / opacity), byte(g / opacity), byte(b / opacity), byte(*opacity)]);
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    /// What a straight picture shows over a colour, as any program composites PNG.
    fn over(pixel: [u8; 4], behind: f32) -> [f32; 3] {
        let opacity = f32::from(pixel[3]) / 255.0;
        std::array::from_fn(|c| f32::from(pixel[c]) / 255.0 * opacity + behind * (1.0 - opacity))
    }

    #[test]
    fn straight_pictures_composite_to_what_the_ray_showed() {
        let head = [[0.2, 0.1, 0.05, 0.4], [0.9, 0.5, 0.1, 1.0], [0.0; 4], [0.001, 0.001, 0.0, 0.0015]];
        let picture = straight(&head, (4, 1), (4, 1));
        for (pixel, head) in picture.pixels().zip(head) {
            for behind in [0.0, 0.3, 1.0] {
                let shown = over(pixel.0, behind);
                for c in 0..3 {
                    let expected = head[c] + behind * (1.0 - head[3]);
                    assert!((shown[c] - expected).abs() < 1.5 / 255.0, "{pixel:?} over {behind}: {shown:?}");
                }
            }
        }
        assert_eq!(picture.get_pixel(0, 0).0, [128, 64, 32, 102]);
        assert_eq!(picture.get_pixel(2, 0).0, [0; 4]);
    }

    #[test]
    fn enlarging_darkens_no_edge() {
        // Red beside nothing: what is half transparent in between stays red.
        let head: Vec<[f32; 4]> = (0..64).map(|i| if i % 8 < 4 { [1.0, 0.0, 0.0, 1.0] } else { [0.0; 4] }).collect();
        let large = straight(&head, (8, 8), (32, 32));
        let soft: Vec<_> = large.pixels().filter(|p| (30..226).contains(&p.0[3])).collect();
        assert!(!soft.is_empty() && soft.iter().all(|p| p.0[0] == 255 && p.0[1] == 0), "{soft:?}");
    }
}
