//! The head cut out of its background.
//!
//! A ray's opacity is what the head takes of its light: 1 − Π (1 − a_i) over the head's samples, with the colours that
//! these show. Both are kept multiplied together (premultiplied) while pixels are averaged or enlarged, since only such
//! numbers may be mixed; PNG's colours are straight, so [`straight`] divides at the end.

use image::{ImageBuffer, Rgba, RgbaImage, imageops};

/// A pixel whose opacity differs by more than this from a neighbour's lies on the head's edge.
const EDGE: f32 = 0.05;
/// Opacities below half a level of 255 are written as 0, and have no colour.
const CLEAR: f32 = 0.5 / 255.0;

/// Where on a pixel of the edge rays are sent, pixels from its middle.
pub const ON_EDGES: [[f64; 2]; 4] = [[-0.25, -0.25], [0.25, -0.25], [-0.25, 0.25], [0.25, 0.25]];

/// Pixels on the edge of a premultiplied picture: one ray through the middle says too little of them.
pub fn edges(head: &[[f32; 4]], width: usize) -> Vec<usize> {
    let mut on_edge = vec![false; head.len()];
    for i in 0..head.len() {
        let right = (i % width + 1 < width).then_some(i + 1);
        let below = (i + width < head.len()).then_some(i + width);
        for j in [right, below].into_iter().flatten() {
            if (head[i][3] - head[j][3]).abs() > EDGE {
                on_edge[i] = true;
                on_edge[j] = true;
            }
        }
    }
    (0..head.len()).filter(|&i| on_edge[i]).collect()
}

/// The mean of premultiplied colours.
pub fn mean(of: &[[f32; 4]]) -> [f32; 4] {
    std::array::from_fn(|c| of.iter().map(|v| v[c]).sum::<f32>() / of.len().max(1) as f32)
}

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

    #[test]
    fn edges_are_both_sides_of_a_step_and_nothing_else() {
        let head: Vec<[f32; 4]> = (0..24).map(|i| [0.0, 0.0, 0.0, if i % 6 < 3 { 1.0 } else { 0.0 }]).collect();
        assert_eq!(edges(&head, 6), [2, 3, 8, 9, 14, 15, 20, 21]);
        assert_eq!(mean(&[[1.0, 0.0, 0.0, 1.0], [0.0; 4]]), [0.5, 0.0, 0.0, 0.5]);
    }
}
