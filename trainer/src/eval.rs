//! How good renders are.

use std::collections::BTreeMap;
use std::path::Path;

use image::RgbImage;
use serde::Serialize;

use crate::avatar::Render;
use crate::error::{Result, TrainerError};

/// PSNR is capped here, also for identical images, so that it stays a number.
pub const MAX_PSNR_DB: f64 = 100.0;

/// `−10 log10(mse)`, dB, for values in 0–1.
pub fn psnr_from_mse(mse: f64) -> f64 {
    if mse <= 0.0 { MAX_PSNR_DB } else { (-10.0 * mse.log10()).min(MAX_PSNR_DB) }
}

/// Mean squared error over all pixels and channels, values in 0–1.
pub fn mse(a: &RgbImage, b: &RgbImage) -> Option<f64> {
    if a.dimensions() != b.dimensions() || a.as_raw().is_empty() {
        return None;
    }
    let sum: f64 = a.as_raw().iter().zip(b.as_raw()).map(|(a, b)| (f64::from(*a) - f64::from(*b)).powi(2)).sum();
    Some(sum / (a.as_raw().len() as f64 * 255.0 * 255.0))
}

/// The score of one view.
#[derive(Clone, Debug, Serialize)]
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
        let means = |m: &BTreeMap<String, Vec<f64>>| m.iter().map(|(k, v)| (k.clone(), mean(v))).collect();
        Some(Self {
            mean_psnr_db: mean(&all),
            mean_psnr_db_by_kind: means(&kinds),
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
fn psnr_inside(a: &RgbImage, b: &RgbImage, inside: impl Fn(usize) -> bool) -> Option<f64> {
    let (mut sum, mut count) = (0.0, 0usize);
    let (a, b) = (a.as_raw().as_chunks::<3>().0, b.as_raw().as_chunks::<3>().0);
    for (_, (a, b)) in a.iter().zip(b).enumerate().filter(|(i, _)| inside(*i)) {
        sum += (0..3).map(|c| (f64::from(a[c]) - f64::from(b[c])).powi(2)).sum::<f64>();
        count += 1;
    }
    (count >= 16).then(|| psnr_from_mse(sum / (3 * count) as f64 / (255.0 * 255.0)))
}

/// PSNR of parts of a picture; `maps` is the render behind it, of the same or a smaller size.
pub fn score_parts(picture: &RgbImage, truth: &RgbImage, maps: &Render, regions: &[String]) -> BTreeMap<String, f64> {
    let (width, small) = (picture.width() as usize, maps.rgb.width() as usize);
    if picture.dimensions() != truth.dimensions() || small == 0 || maps.rgb.height() == 0 {
        return BTreeMap::new();
    }
    let (height, small_height) = (picture.height() as usize, maps.rgb.height() as usize);
    let at = |i: usize| (i / width * small_height / height) * small + i % width * small / width;
    let head = |i: usize| maps.depth[at(i)] > 0.0;
    let region = |i: usize, n: usize| maps.masks[n][at(i)] >= 0.5;
    let mut parts: Vec<(String, Option<f64>)> = vec![
        ("head".to_owned(), psnr_inside(picture, truth, head)),
        ("background".to_owned(), psnr_inside(picture, truth, |i| !head(i))),
        ("AU regions".to_owned(), psnr_inside(picture, truth, |i| (0..maps.masks.len()).any(|n| region(i, n)))),
    ];
    for (n, name) in regions.iter().enumerate().take(maps.masks.len()) {
        parts.push((name.clone(), psnr_inside(picture, truth, |i| region(i, n))));
    }
    parts.into_iter().filter_map(|(name, psnr)| Some((name, psnr?))).collect()
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
