//! Masks and depth as colours.

use image::RgbImage;

use crate::field::Render;

/// Colours of the first three regions, told apart by people who see red and green alike.
const REGION_COLORS: [[f32; 3]; 3] = [[230.0, 159.0, 0.0], [86.0, 180.0, 233.0], [204.0, 121.0, 167.0]];

/// The picture with each region's mask laid over it.
pub(crate) fn masks(render: &Render) -> RgbImage {
    let mut picture = render.rgb.clone();
    for (i, pixel) in picture.as_mut().as_chunks_mut::<3>().0.iter_mut().enumerate() {
        for (mask, color) in render.masks.iter().zip(REGION_COLORS) {
            let share = 0.6 * mask[i].clamp(0.0, 1.0);
            for (byte, color) in pixel.iter_mut().zip(color) {
                *byte = (f32::from(*byte) * (1.0 - share) + color * share).round() as u8;
            }
        }
    }
    picture
}

/// Depth between the nearest and the farthest hundredth of the head; what has none stays dark.
pub(crate) fn depth(render: &Render) -> RgbImage {
    let mut known: Vec<f32> = render.depth.iter().copied().filter(|d| *d > 0.0).collect();
    known.sort_by(f32::total_cmp);
    let at = |share: f64| known.get((share * known.len().saturating_sub(1) as f64) as usize).copied().unwrap_or(0.0);
    let (near, far) = (at(0.01), at(0.99));
    let mut picture = RgbImage::new(render.rgb.width(), render.rgb.height());
    for (pixel, &d) in picture.as_mut().as_chunks_mut::<3>().0.iter_mut().zip(&render.depth) {
        *pixel = if d > 0.0 { ramp(1.0 - (d - near) / (far - near).max(1e-6)) } else { [18, 18, 24] };
    }
    picture
}

/// Dark blue over red to light yellow, rising in lightness all the way; `t` is 0–1.
pub(crate) fn ramp(t: f32) -> [u8; 3] {
    const STOPS: [[f32; 3]; 5] =
        [[13.0, 8.0, 70.0], [106.0, 14.0, 130.0], [190.0, 55.0, 84.0], [245.0, 140.0, 40.0], [250.0, 250.0, 160.0]];
    let at = if t.is_finite() { t.clamp(0.0, 1.0) * 4.0 } else { 0.0 };
    let first = (at as usize).min(3);
    let share = at - first as f32;
    std::array::from_fn(|c| (STOPS[first][c] * (1.0 - share) + STOPS[first + 1][c] * share).round() as u8)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_ramp_grows_lighter() {
        let light = |[r, g, b]: [u8; 3]| 0.2126 * f64::from(r) + 0.7152 * f64::from(g) + 0.0722 * f64::from(b);
        for i in 0..100 {
            assert!(light(ramp(i as f32 / 100.0)) <= light(ramp((i + 1) as f32 / 100.0)) + 1.0, "{i}");
        }
        assert_eq!(ramp(f32::NAN), ramp(0.0));
    }

    #[test]
    fn masks_tint_and_depth_without_a_head_is_dark() {
        let render = Render {
            rgb: RgbImage::from_pixel(2, 1, image::Rgb([100, 100, 100])),
            masks: vec![vec![0.0, 1.0]],
            head: Vec::new(),
            depth: vec![0.0, 0.5],
        };
        let tinted = masks(&render);
        assert_eq!(tinted.get_pixel(0, 0).0, [100; 3]);
        assert_eq!(tinted.get_pixel(1, 0).0, [178, 135, 40]);
        assert_eq!(depth(&render).get_pixel(0, 0).0, [18, 18, 24]);
    }
}
