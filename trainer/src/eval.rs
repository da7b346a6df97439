//! How good renders are.

use std::path::{Path, PathBuf};

use image::RgbImage;
use serde::Serialize;

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
}

/// Scores of a list of views.
#[derive(Clone, Debug, Serialize)]
pub struct Evaluation {
    /// View by view.
    pub views: Vec<ViewScore>,
    /// Mean of the views' PSNR, dB.
    pub mean_psnr_db: f64,
    /// The same per sort of view.
    pub mean_psnr_db_by_kind: std::collections::BTreeMap<String, f64>,
}

impl Evaluation {
    /// Sums up; `None` without views.
    pub fn new(views: Vec<ViewScore>) -> Option<Self> {
        if views.is_empty() {
            return None;
        }
        let mean = |v: &[f64]| v.iter().sum::<f64>() / v.len().max(1) as f64;
        let all: Vec<f64> = views.iter().map(|v| v.psnr_db).collect();
        let mut kinds: std::collections::BTreeMap<String, Vec<f64>> = std::collections::BTreeMap::new();
        for v in &views {
            if let Some(kind) = &v.kind {
                kinds.entry(kind.clone()).or_default().push(v.psnr_db);
            }
        }
        let mean_psnr_db_by_kind = kinds.iter().map(|(k, v)| (k.clone(), mean(v))).collect();
        Some(Self { mean_psnr_db: mean(&all), mean_psnr_db_by_kind, views })
    }
}

/// PSNR of a render against the image file `truth`.
pub fn score(render: &RgbImage, truth: &Path) -> Result<f64> {
    let image = crate::data::read_rgb(truth)?;
    let mse = mse(render, &image).ok_or_else(|| TrainerError::Image {
        path: PathBuf::from(truth),
        message: format!(
            "is {}×{}, but the render is {}×{}",
            image.width(),
            image.height(),
            render.width(),
            render.height()
        ),
    })?;
    Ok(psnr_from_mse(mse))
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
}
