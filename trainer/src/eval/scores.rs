//! The scores of views, and their means.

use std::collections::BTreeMap;
use std::path::Path;

use image::RgbImage;
use serde::Serialize;

use super::LpipsNetwork;
use crate::error::{Result, TrainerError};
use crate::field::Render;

/// PSNR is capped here, also for identical images, so that it stays a number.
pub const MAX_PSNR_DB: f64 = 100.0;

/// `−10 log10(mse)`, dB, for values in 0–1; a NaN stays one.
pub fn psnr_from_mse(mse: f64) -> f64 {
    // `min` alone would take a NaN for the best there is.
    if mse.is_nan() {
        f64::NAN
    } else if mse <= 0.0 {
        MAX_PSNR_DB
    } else {
        (-10.0 * mse.log10()).min(MAX_PSNR_DB)
    }
}

/// Mean squared error over all pixels and channels, values in 0–1.
pub fn mse(a: &RgbImage, b: &RgbImage) -> Option<f64> {
    if a.dimensions() != b.dimensions() || a.as_raw().is_empty() {
        return None;
    }
    let sum: f64 = a.as_raw().iter().zip(b.as_raw()).map(|(a, b)| (f64::from(*a) - f64::from(*b)).powi(2)).sum();
    Some(sum / (a.as_raw().len() as f64 * 255.0 * 255.0))
}

/// Names of the parts of a picture that are told apart besides the regions.
const HEAD: &str = "head";
const BACKGROUND: &str = "background";
const AU_REGIONS: &str = "AU regions";

/// The score of one view.
#[derive(Clone, Debug, Default, Serialize)]
pub struct ViewScore {
    /// The view's id.
    pub id: String,
    /// Of which sort it is.
    pub kind: Option<String>,
    /// PSNR over the whole image, dB.
    pub psnr_db: f64,
    /// PSNR of parts of the image, dB: `head` and `background` by the avatar's own depth, each region by its own mask (at
    /// least one half), `AU regions` all of them together. Parts of fewer than 16 pixels are left out.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub parts_psnr_db: BTreeMap<String, f64>,
    /// MS-SSIM over the whole image; `None` for images smaller than a window.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub ms_ssim: Option<super::MsSsim>,
    /// LPIPS over the whole image, per network.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub lpips: BTreeMap<LpipsNetwork, f64>,
    /// Mean SSIM of parts (window by window, by the window's middle).
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub parts_ssim: BTreeMap<String, f64>,
    /// LPIPS of parts, per network.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub parts_lpips: BTreeMap<LpipsNetwork, BTreeMap<String, f64>>,
    /// Error of depth, where its truth is known.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub depth: Option<super::depth::DepthError>,
}

impl ViewScore {
    /// The whole image's numbers by name, in the order of tables.
    pub fn numbers(&self) -> Vec<(String, f64)> {
        let mut all = vec![("psnr_db".to_owned(), self.psnr_db)];
        all.extend(self.ms_ssim.map(|s| ("ms_ssim".to_owned(), s.value)));
        all.extend(self.lpips.iter().map(|(n, v)| (format!("lpips_{}", n.name()), *v)));
        if let Some(depth) = &self.depth {
            all.push(("depth_median_mm".to_owned(), depth.median_mm));
            all.push(("depth_mean_mm".to_owned(), depth.mean_mm));
        }
        all
    }
}

/// Scores of a list of views.
#[derive(Clone, Debug, Serialize)]
pub struct Evaluation {
    /// View by view.
    pub views: Vec<ViewScore>,
    /// Mean of the views' PSNR, dB.
    pub mean_psnr_db: f64,
    /// The same per sort of view.
    pub mean_psnr_db_by_kind: BTreeMap<String, f64>,
    /// Mean of the parts' PSNR per sort of view and over `all` views, dB.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub mean_parts_psnr_db: BTreeMap<String, BTreeMap<String, f64>>,
    /// Means of every number of the whole image per sort of view and over `all`.
    pub means: BTreeMap<String, BTreeMap<String, f64>>,
    /// Means over all views of every number of a part: `[part][number]`.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub mean_parts: BTreeMap<String, BTreeMap<String, f64>>,
}

impl Evaluation {
    /// Sums up; `None` without views.
    pub fn new(views: Vec<ViewScore>) -> Option<Self> {
        if views.is_empty() {
            return None;
        }
        let mean = |v: &[f64]| v.iter().sum::<f64>() / v.len().max(1) as f64;
        let all: Vec<f64> = views.iter().map(|v| v.psnr_db).collect();
        let mut kinds: BTreeMap<String, Vec<f64>> = BTreeMap::new();
        let mut parts: BTreeMap<String, BTreeMap<String, Vec<f64>>> = BTreeMap::new();
        for v in &views {
            if let Some(kind) = &v.kind {
                kinds.entry(kind.clone()).or_default().push(v.psnr_db);
            }
            for (part, &psnr) in &v.parts_psnr_db {
                for kind in v.kind.iter().map(String::as_str).chain(["all"]) {
                    parts.entry(kind.to_owned()).or_default().entry(part.clone()).or_default().push(psnr);
                }
            }
        }
        let mut numbers: BTreeMap<String, BTreeMap<String, Vec<f64>>> = BTreeMap::new();
        let mut part_numbers: BTreeMap<String, BTreeMap<String, Vec<f64>>> = BTreeMap::new();
        for v in &views {
            for (name, value) in v.numbers() {
                for kind in v.kind.iter().map(String::as_str).chain(["all"]) {
                    numbers.entry(kind.to_owned()).or_default().entry(name.clone()).or_default().push(value);
                }
            }
            let mut add = |name: &str, parts: &BTreeMap<String, f64>| {
                for (part, value) in parts {
                    part_numbers.entry(part.clone()).or_default().entry(name.to_owned()).or_default().push(*value);
                }
            };
            add("psnr_db", &v.parts_psnr_db);
            add("ssim", &v.parts_ssim);
            for (network, parts) in &v.parts_lpips {
                add(&format!("lpips_{}", network.name()), parts);
            }
        }
        let means = |m: &BTreeMap<String, Vec<f64>>| m.iter().map(|(k, v)| (k.clone(), mean(v))).collect();
        Some(Self {
            mean_psnr_db: mean(&all),
            mean_psnr_db_by_kind: means(&kinds),
            means: numbers.iter().map(|(kind, m)| (kind.clone(), means(m))).collect(),
            mean_parts: part_numbers.iter().map(|(part, m)| (part.clone(), means(m))).collect(),
            mean_parts_psnr_db: parts.iter().map(|(kind, m)| (kind.clone(), means(m))).collect(),
            views,
        })
    }
}

/// PSNR of a render against the image `truth`, which was read from `path`.
pub fn score(render: &RgbImage, truth: &RgbImage, path: &Path) -> Result<f64> {
    let mse = mse(render, truth).ok_or_else(|| TrainerError::Image {
        path: path.to_owned(),
        message: format!(
            "is {}×{}, but the render is {}×{}",
            truth.width(),
            truth.height(),
            render.width(),
            render.height()
        ),
    })?;
    Ok(psnr_from_mse(mse))
}

/// PSNR over the pixels for which `inside` holds; `None` below 16 of them.
pub fn psnr_inside(a: &RgbImage, b: &RgbImage, inside: impl Fn(usize) -> bool) -> Option<f64> {
    let (mut sum, mut count) = (0.0, 0usize);
    let (a, b) = (a.as_raw().as_chunks::<3>().0, b.as_raw().as_chunks::<3>().0);
    for (_, (a, b)) in a.iter().zip(b).enumerate().filter(|(i, _)| inside(*i)) {
        sum += (0..3).map(|c| (f64::from(a[c]) - f64::from(b[c])).powi(2)).sum::<f64>();
        count += 1;
    }
    (count >= 16).then(|| psnr_from_mse(sum / (3 * count) as f64 / (255.0 * 255.0)))
}

/// Which part of a picture a pixel belongs to, told by the render behind it, which may be smaller.
pub struct Parts<'a> {
    maps: &'a Render,
    regions: &'a [String],
    size: (usize, usize),
}

impl<'a> Parts<'a> {
    /// The parts of a picture of `size` pixels; `None` for empty ones.
    pub fn new(size: (u32, u32), maps: &'a Render, regions: &'a [String]) -> Option<Self> {
        let size = (size.0 as usize, size.1 as usize);
        (size.0 * size.1 > 0 && maps.rgb.width() * maps.rgb.height() > 0).then_some(Self { maps, regions, size })
    }

    /// Their names, `head` and `background` first.
    pub fn names(&self) -> Vec<String> {
        let fixed = [HEAD, BACKGROUND, AU_REGIONS].map(str::to_owned);
        fixed.into_iter().chain(self.regions.iter().take(self.maps.masks.len()).cloned()).collect()
    }

    /// Whether the pixel that lies at `x`, `y` (0–1 across the picture) is in the part of a number, in the order of
    /// [`Self::names`].
    pub fn has(&self, part: usize, x: f64, y: f64) -> bool {
        let (width, height) = (self.maps.rgb.width() as usize, self.maps.rgb.height() as usize);
        let column = ((x * width as f64) as usize).min(width - 1);
        let row = ((y * height as f64) as usize).min(height - 1);
        let at = row * width + column;
        let region = |n: usize| self.maps.masks[n][at] >= 0.5;
        match part {
            0 => self.maps.depth[at] > 0.0,
            1 => self.maps.depth[at] <= 0.0,
            2 => (0..self.maps.masks.len()).any(region),
            n => region(n - 3),
        }
    }

    /// The same for a pixel by its number.
    pub fn has_pixel(&self, part: usize, pixel: usize) -> bool {
        let (width, height) = self.size;
        let (x, y) = ((pixel % width) as f64 + 0.5, (pixel / width) as f64 + 0.5);
        self.has(part, x / width as f64, y / height as f64)
    }

    /// A number for every part that has one.
    pub fn each(&self, of: impl Fn(usize) -> Option<f64>) -> BTreeMap<String, f64> {
        self.names().into_iter().enumerate().filter_map(|(part, name)| Some((name, of(part)?))).collect()
    }
}

/// PSNR of parts of a picture; `maps` is the render behind it, of the same or a smaller size.
pub fn score_parts(picture: &RgbImage, truth: &RgbImage, maps: &Render, regions: &[String]) -> BTreeMap<String, f64> {
    if picture.dimensions() != truth.dimensions() {
        return BTreeMap::new();
    }
    let Some(parts) = Parts::new(picture.dimensions(), maps, regions) else { return BTreeMap::new() };
    parts.each(|part| psnr_inside(picture, truth, |i| parts.has_pixel(part, i)))
}

#[cfg(test)]
pub(crate) mod testing {
    use image::RgbImage;

    /// A picture with structure at several scales.
    pub(crate) fn pattern(width: u32, height: u32, shift: u32) -> RgbImage {
        RgbImage::from_fn(width, height, |x, y| {
            let (x, y) = (f64::from(x + shift), f64::from(y));
            let wave = |a: f64, b: f64| (127.5 + 60.0 * (a * x).sin() + 60.0 * (b * y).cos()).clamp(0.0, 255.0) as u8;
            image::Rgb([wave(0.11, 0.23), wave(0.37, 0.05), wave(0.9, 0.7)])
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn psnr_of_a_known_difference() {
        let a = RgbImage::from_pixel(4, 4, image::Rgb([100, 100, 100]));
        let b = RgbImage::from_pixel(4, 4, image::Rgb([110, 90, 110]));
        let psnr = psnr_from_mse(mse(&a, &b).unwrap());
        assert!((psnr - 20.0 * (255.0f64 / 10.0).log10()).abs() < 1e-9);
        assert_eq!(psnr_from_mse(mse(&a, &a).unwrap()), MAX_PSNR_DB);
        assert!(mse(&a, &RgbImage::new(2, 2)).is_none());
    }

    #[test]
    fn parts_are_told_apart_by_depth_and_masks() {
        let truth = RgbImage::from_pixel(8, 8, image::Rgb([100, 100, 100]));
        let mut picture = truth.clone();
        // The upper half is the head; its upper quarter wears the first region's mask and is wrong by 10.
        let maps = Render {
            rgb: RgbImage::new(8, 8),
            masks: vec![(0..64).map(|i| if i < 16 { 1.0 } else { 0.0 }).collect(), vec![0.0; 64]],
            head: Vec::new(),
            depth: (0..64).map(|i| if i < 32 { 0.4 } else { 0.0 }).collect(),
        };
        for i in 0..16 {
            picture.put_pixel(i % 8, i / 8, image::Rgb([110, 110, 110]));
        }
        let parts = score_parts(&picture, &truth, &maps, &["brows".to_owned(), "eyes".to_owned()]);
        let wrong = 20.0 * (255.0f64 / 10.0).log10();
        for (part, expected) in
            [("brows", wrong), ("AU regions", wrong), ("head", wrong + 10.0 * 2f64.log10()), ("background", 100.0)]
        {
            assert!((parts[part] - expected).abs() < 1e-9, "{part}: {}", parts[part]);
        }
        assert!(!parts.contains_key("eyes"), "no pixel wears the second mask");
    }
}
