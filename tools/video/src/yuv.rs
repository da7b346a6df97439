//! RGB of 8 bits to BT.709 YUV 4:2:0, limited range: what is written.
//!
//! Equations: ITU-R BT.709-6, 3.5. A chroma sample is the mean of two rows and of three columns with weights 1, 2, 1, since
//! H.264's chroma lies on the first of two luma columns.
#![allow(clippy::inline_always, reason = "the vectorised build of a caller has to take in all that it calls")]

use ffmpeg::frame;
use image::RgbImage;

/// Luma of red, green and blue of 0 to 255, in levels of 219.
const LUMA: [f32; 3] = [0.2126 * 219.0 / 255.0, 0.7152 * 219.0 / 255.0, 0.0722 * 219.0 / 255.0];
/// Half the span of chroma in levels, over 255 and the span of B − Y and R − Y.
const CB: f32 = 112.0 / 255.0 / (1.0 - 0.0722);
const CR: f32 = 112.0 / 255.0 / (1.0 - 0.2126);

/// Fills a 4:2:0 picture; it may be larger than the image, whose last column and row are repeated then.
pub(crate) fn fill(picture: &mut frame::Video, image: &RgbImage) {
    pulp::Arch::new().dispatch(|| planes(picture, image));
}

#[inline(always)]
fn planes(picture: &mut frame::Video, image: &RgbImage) {
    let (width, height) = (picture.width() as usize, picture.height() as usize);
    let row = |y: usize| {
        let stride = 3 * image.width() as usize;
        &image.as_raw()[y.min(image.height() as usize - 1) * stride..][..stride]
    };
    let stride = picture.stride(0);
    for (y, out) in picture.data_mut(0).chunks_mut(stride).take(height).enumerate() {
        let source = row(y);
        for (value, pixel) in out.iter_mut().zip(source.chunks_exact(3)) {
            let [r, g, b] = [f32::from(pixel[0]), f32::from(pixel[1]), f32::from(pixel[2])];
            *value = (16.5 + LUMA[0] * r + LUMA[1] * g + LUMA[2] * b) as u8;
        }
        if width > image.width() as usize {
            out[width - 1] = out[width - 2];
        }
    }
    // Two rows added up, with a column repeated at each end.
    let mut sums = vec![[0.0f32; 3]; width + 2];
    let (strides, half) = ([picture.stride(1), picture.stride(2)], width / 2);
    for y in 0..height / 2 {
        let (above, below) = (row(2 * y), row(2 * y + 1));
        for ((sum, a), b) in sums[1..].iter_mut().zip(above.chunks_exact(3)).zip(below.chunks_exact(3)) {
            *sum = [0, 1, 2].map(|c| f32::from(a[c]) + f32::from(b[c]));
        }
        sums[0] = sums[1];
        let last = image.width() as usize;
        let end = sums[last];
        sums[last + 1..].fill(end);
        for (plane, stride) in [1, 2].into_iter().zip(strides) {
            let out = &mut picture.data_mut(plane)[y * stride..][..half];
            for (x, value) in out.iter_mut().enumerate() {
                let [r, g, b] =
                    [0, 1, 2].map(|c| (sums[2 * x][c] + 2.0 * sums[2 * x + 1][c] + sums[2 * x + 2][c]) / 8.0);
                let luma = 0.2126 * r + 0.7152 * g + 0.0722 * b;
                let chroma = if plane == 1 { CB * (b - luma) } else { CR * (r - luma) };
                *value = (128.5 + chroma) as u8;
            }
        }
    }
}
