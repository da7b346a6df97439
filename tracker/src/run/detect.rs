//! Faces in whole pictures.

use image::RgbImage;

use super::crop::{Affine, Crop, Sampling};
use crate::error::{Result, TrackerError};
use crate::models::ModelFolder;
use crate::models::manifest::{DetectorKind, DetectorModel, Layout};
use crate::models::runtime::{Network, Runtime};

/// A face that a detector found.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Face {
    /// Left, top, right, bottom, pixels of the picture.
    pub bounds_px: [f32; 4],
    /// The image-left and image-right eye, where the detector tells.
    pub eyes_px: Option<[[f32; 2]; 2]>,
    /// How sure the detector is, 0–1.
    pub score: f32,
}

impl Face {
    /// Width × height, square pixels.
    pub fn area(&self) -> f32 {
        let [l, t, r, b] = self.bounds_px;
        (r - l).max(0.0) * (b - t).max(0.0)
    }

    /// The first crop for the landmark network; the next one comes from its points.
    pub fn crop(&self, margin: f32) -> Option<Crop> {
        let [l, t, r, b] = self.bounds_px;
        let angle = self.eyes_px.map_or(0.0, |[a, b]| (b[1] - a[1]).atan2(b[0] - a[0]));
        let crop = Crop { center: [0.5 * (l + r), 0.5 * (t + b)], side: margin * (r - l).max(b - t), angle };
        crop.is_sane().then_some(crop)
    }
}

/// Intersection over union of two boxes.
fn overlap(a: &[f32; 4], b: &[f32; 4]) -> f32 {
    let both = (a[2].min(b[2]) - a[0].max(b[0])).max(0.0) * (a[3].min(b[3]) - a[1].max(b[1])).max(0.0);
    let area = |r: &[f32; 4]| (r[2] - r[0]).max(0.0) * (r[3] - r[1]).max(0.0);
    let either = area(a) + area(b) - both;
    if either > 0.0 { both / either } else { 0.0 }
}

/// Boxes that share more than this are one face.
const SAME_FACE: f32 = 0.3;
/// How closely a picture can be looked at, see [`Detector::detect`].
pub const LEVELS: usize = 3;
/// Tiles share this much of their side with their neighbours.
const TILE_OVERLAP: f32 = 0.5;

/// A detector on one thread.
#[derive(Debug)]
pub struct Detector {
    network: Network,
    model: DetectorModel,
    input: Vec<f32>,
}

impl Detector {
    /// Loads the detector of a folder of models.
    pub fn open(runtime: &Runtime, models: &ModelFolder) -> Result<Self> {
        let model = models.manifest.detector.clone();
        let (w, h) = (model.width as usize, model.height as usize);
        let shape = if model.layout == Layout::Nhwc { [1, h, w, 3] } else { [1, 3, h, w] };
        let path = models.dir.join(&model.file);
        let network = Network::open(runtime, &path, &shape, &[&model.boxes, &model.scores])?;
        Ok(Self { network, model, input: Vec::new() })
    }

    /// All faces, surest first, at one of [`LEVELS`]: 0 looks at the whole picture, the others at smaller and smaller
    /// tiles of it, because a detector that sees 128 pixels misses small faces.
    pub fn detect(&mut self, picture: &RgbImage, level: usize) -> Result<Vec<Face>> {
        let (width, height) = (picture.width() as f32, picture.height() as f32);
        let parts = match (level, self.model.kind) {
            (0, _) => vec![[0.0, 0.0, width, height]],
            (_, DetectorKind::BlazeFace) => tiles(width, height, width.min(height) / level as f32),
            (_, DetectorKind::Boxes) => vec![],
        };
        let mut faces = Vec::new();
        for part in parts {
            faces.extend(self.detect_in(picture, part)?);
        }
        Ok(without_doubles(faces))
    }

    /// Faces in a part (left, top, right, bottom) of the picture.
    fn detect_in(&mut self, picture: &RgbImage, part: [f32; 4]) -> Result<Vec<Face>> {
        let model = &self.model;
        let (width, height) = (model.width as f32, model.height as f32);
        let k = ((part[2] - part[0]) / width).max((part[3] - part[1]) / height);
        // The part fills the input along one side and is centred along the other.
        let shift = [0.5 * (part[0] + part[2] - k * width), 0.5 * (part[1] + part[3] - k * height)];
        let matrix = Affine { linear: [[k, 0.0], [0.0, k]], shift };
        let sampling = Sampling {
            width: model.width,
            height: model.height,
            layout: model.layout,
            mean: model.mean,
            scale: model.scale,
        };
        sampling.sample(picture, &matrix, &mut self.input);
        let found = self.network.run(&self.input, |outputs| match model.kind {
            DetectorKind::BlazeFace => blaze_faces(outputs[0], outputs[1], model),
            DetectorKind::Boxes => boxes(outputs[0], outputs[1], model),
        })?;
        let faces = found.map_err(|problem| TrackerError::NetworkOutput {
            path: self.network.path().to_owned(),
            output: format!("{}`, `{}", model.boxes, model.scores),
            problem,
        })?;
        let to_picture = |face: Face| {
            let [l, t, r, b] = face.bounds_px;
            let ([l, t], [r, b]) = (matrix.apply([l, t]), matrix.apply([r, b]));
            let eyes_px = face.eyes_px.map(|eyes| eyes.map(|p| matrix.apply(p)));
            Face { bounds_px: [l, t, r, b], eyes_px, ..face }
        };
        Ok(without_doubles(faces.into_iter().map(to_picture).collect()))
    }
}

/// Squares of `side` pixels that cover the picture and overlap by half.
fn tiles(width: f32, height: f32, side: f32) -> Vec<[f32; 4]> {
    let starts = |length: f32| {
        let count = ((length - side) / (side * TILE_OVERLAP)).ceil().clamp(0.0, 16.0) as u32;
        (0..=count).map(move |i| (length - side) * i as f32 / count.max(1) as f32)
    };
    starts(height).flat_map(|top| starts(width).map(move |left| [left, top, left + side, top + side])).collect()
}

/// Surest first; of boxes that overlap, the surest stays, moved to the mean of all, weighted by their scores.
fn without_doubles(mut faces: Vec<Face>) -> Vec<Face> {
    faces.retain(|f| f.bounds_px.iter().all(|v| v.is_finite()) && f.area() > 0.0);
    faces.sort_by(|a, b| b.score.total_cmp(&a.score));
    let mut kept: Vec<Face> = Vec::new();
    while let Some(best) = faces.first().copied() {
        let (same, others): (Vec<Face>, Vec<Face>) =
            faces.into_iter().partition(|f| *f == best || overlap(&f.bounds_px, &best.bounds_px) > SAME_FACE);
        faces = others;
        let total: f32 = same.iter().map(|f| f.score).sum();
        let mean = |value: &dyn Fn(&Face) -> f32| same.iter().map(|f| f.score * value(f)).sum::<f32>() / total;
        let bounds_px = [0, 1, 2, 3].map(|i| mean(&|f| f.bounds_px[i]));
        let eyes_px = best
            .eyes_px
            .map(|own| [0, 1].map(|e| [0, 1].map(|axis| mean(&|f: &Face| f.eyes_px.unwrap_or(own)[e][axis]))));
        kept.push(Face { bounds_px, eyes_px, score: best.score });
    }
    kept
}

fn sigmoid(x: f32) -> f32 {
    1.0 / (1.0 + (-x).exp())
}

/// Centres of BlazeFace's anchors as shares of the input: a 16×16 grid with 2 each, then 8×8 with 6 each.
fn blaze_anchors() -> impl Iterator<Item = [f32; 2]> {
    [(16u32, 2usize), (8, 6)].into_iter().flat_map(|(grid, each)| {
        let at = move |i: u32| (i as f32 + 0.5) / grid as f32;
        (0..grid * grid).flat_map(move |i| std::iter::repeat_n([at(i % grid), at(i / grid)], each))
    })
}

/// Pixels of the input; a row of `regressors` holds centre, size and six points, relative to the anchor.
fn blaze_faces(regressors: &[f32], logits: &[f32], model: &DetectorModel) -> Result<Vec<Face>, String> {
    let count = blaze_anchors().count();
    if logits.len() != count || regressors.len() != 16 * count {
        return Err(format!(
            "have {} and {} numbers, expected {} and {count}",
            regressors.len(),
            logits.len(),
            16 * count
        ));
    }
    let (w, h) = (model.width as f32, model.height as f32);
    let rows = blaze_anchors().zip(regressors.chunks_exact(16)).zip(logits);
    Ok(rows
        .filter(|(_, logit)| sigmoid(**logit) >= model.threshold)
        .map(|(([x, y], r), logit)| {
            let point = |i: usize| [r[i] + x * w, r[i + 1] + y * h];
            let [cx, cy] = point(0);
            let (half_w, half_h) = (0.5 * r[2], 0.5 * r[3]);
            Face {
                bounds_px: [cx - half_w, cy - half_h, cx + half_w, cy + half_h],
                eyes_px: Some([point(4), point(6)]),
                score: sigmoid(*logit),
            }
        })
        .collect())
}

/// Pixels of the input, from corners in shares of it.
fn boxes(corners: &[f32], scores: &[f32], model: &DetectorModel) -> Result<Vec<Face>, String> {
    let count = corners.len() / 4;
    if corners.len() != 4 * count || scores.len() != 2 * count {
        return Err(format!("have {} and {} numbers, expected 4 and 2 for each box", corners.len(), scores.len()));
    }
    let (w, h) = (model.width as f32, model.height as f32);
    let rows = corners.chunks_exact(4).zip(scores.chunks_exact(2));
    Ok(rows
        .filter(|(_, score)| score[1] >= model.threshold)
        .map(|(c, score)| Face { bounds_px: [c[0] * w, c[1] * h, c[2] * w, c[3] * h], eyes_px: None, score: score[1] })
        .collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn model(kind: DetectorKind) -> DetectorModel {
        let text = include_str!("../../../tools/model-fetch/models.toml");
        let mut model = crate::models::manifest::Manifest::parse(text).unwrap().detector;
        model.kind = kind;
        model
    }

    #[test]
    fn an_anchor_says_where_its_face_is() {
        let (mut regressors, mut logits) = (vec![0.0; 896 * 16], vec![-9.0; 896]);
        // The last anchor of the coarse grid sits at (7.5, 7.5) / 8 of the input.
        logits[895] = 3.0;
        regressors[895 * 16..895 * 16 + 8].copy_from_slice(&[-20.0, -30.0, 40.0, 50.0, -30.0, -40.0, -10.0, -36.0]);
        let faces = blaze_faces(&regressors, &logits, &model(DetectorKind::BlazeFace)).unwrap();
        assert_eq!(faces.len(), 1);
        assert_eq!(faces[0].bounds_px, [80.0, 65.0, 120.0, 115.0]);
        let crop = faces[0].crop(1.5).unwrap();
        assert_eq!((crop.center, crop.side), ([100.0, 90.0], 75.0));
        assert!((crop.angle - 0.2f32.atan2(1.0)).abs() < 1e-3);
        assert!(blaze_faces(&regressors, &logits[1..], &model(DetectorKind::BlazeFace)).is_err());
    }

    #[test]
    fn decoded_boxes_are_shares_of_the_input() {
        let faces =
            boxes(&[0.25, 0.5, 0.5, 1.0, 0.0, 0.0, 1.0, 1.0], &[0.1, 0.9, 0.8, 0.2], &model(DetectorKind::Boxes));
        assert_eq!(faces.unwrap().iter().map(|f| f.bounds_px).collect::<Vec<_>>(), [[32.0, 64.0, 64.0, 128.0]]);
    }

    #[test]
    fn doubles_are_one_face_and_the_surest_comes_first() {
        let face = |x: f32, score: f32| Face { bounds_px: [x, 0.0, x + 10.0, 10.0], eyes_px: None, score };
        let kept = without_doubles(vec![face(50.0, 0.6), face(1.0, 0.3), face(0.0, 0.9), face(f32::NAN, 1.0)]);
        assert_eq!(kept.len(), 2);
        assert!((kept[0].bounds_px[0] - 0.25).abs() < 1e-5 && kept[1].bounds_px[0] == 50.0);
    }

    #[test]
    fn tiles_cover_the_picture() {
        for (w, h) in [(540.0, 960.0), (1920.0, 1080.0), (300.0, 300.0)] {
            for side in [300.0f32, 150.0] {
                let all = tiles(w, h, side);
                assert!(all.iter().any(|t| t[0] == 0.0 && t[1] == 0.0));
                assert!(all.iter().any(|t| (t[2] - w).abs() < 0.01 && (t[3] - h).abs() < 0.01), "{all:?}");
            }
        }
    }
}
