//! The points of one face in one picture, by a landmark network.

use std::sync::Arc;

use image::RgbImage;

use super::crop::{Crop, Sampling};
use super::mesh::{self, MESH_POINTS, Mesh};
use crate::aus::face::{AlignedFace, NetworkInput};
use crate::aus::fhog::fhog;
use crate::aus::openface::OpenFaceModels;
use crate::aus::readout::{self, Inputs, Readout};
use crate::aus::{FEATURES, SCORES};
use crate::error::{Result, TrackerError};
use crate::gaze::{self, EYE_NUMBERS};
use crate::models::ModelFolder;
use crate::models::manifest::{AuModel, LandmarkModel, Layout, PointSet};
use crate::models::runtime::{Network, Runtime};
use crate::weights::Weights;
use risorius_formats::Similarity;

/// Coefficients of the blendshape network.
pub const BLENDSHAPES: usize = 52;

/// What the networks say about a face in one picture.
#[derive(Clone, Debug, PartialEq)]
pub struct Found {
    /// The 68 points, pixels of the picture, the centre of the first pixel at (0.5, 0.5).
    pub points_px: [[f32; 2]; 68],
    /// All points of the mesh, where the network gives one.
    pub mesh: Option<Box<Mesh>>,
    /// The part of the network's 16×16×128 feature map that sees the face.
    inner16: Option<Vec<f32>>,
    /// The masked, aligned face, where there is a readout for it.
    face: Option<AlignedFace>,
    /// What the AUs are made of: [`readout::features`], where the network gives a mesh; or the intensities of an AU
    /// network; or yaw and pitch behind zeros, then what OpenFace's models read.
    pub features: Vec<f32>,
    /// Numbers of the eyes, where the network gives a mesh.
    pub eyes: Option<Box<[f32; EYE_NUMBERS]>>,
    /// Probability that this is a face, 0–1.
    pub presence: f32,
    /// Where to look next.
    pub crop: Crop,
}

/// The landmark networks on one thread.
#[derive(Debug)]
pub struct Landmarker {
    network: Network,
    blendshapes: Option<Network>,
    readout: Option<&'static Readout>,
    aus: Option<(Network, AuModel)>,
    openface: Option<Arc<OpenFaceModels>>,
    model: LandmarkModel,
    input: Vec<f32>,
}

impl Landmarker {
    /// Loads the networks of a folder of models; with `openface` AUs come from these models alone.
    pub fn open(runtime: &Runtime, models: &ModelFolder, openface: Option<Arc<OpenFaceModels>>) -> Result<Self> {
        let model = models.manifest.landmarks.clone();
        let size = model.width as usize;
        let shape = if model.layout == Layout::Nhwc { [1, size, size, 3] } else { [1, 3, size, size] };
        let mut outputs = vec![model.points.as_str()];
        outputs.extend(model.presence.as_deref());
        outputs.extend(model.inner16.as_deref());
        let network = Network::open(runtime, &models.dir.join(&model.file), &shape, &outputs)?;
        let blendshapes = match &models.manifest.blendshapes {
            Some(m) => {
                Some(Network::open(runtime, &models.dir.join(&m.file), &[1, mesh::BLENDSHAPE_POINTS.len(), 2], &[])?)
            }
            None => None,
        };
        let aus = match models.manifest.aus.as_ref().filter(|_| openface.is_none()) {
            Some(m) => {
                let size = m.width as usize;
                let shape = if m.layout == Layout::Nhwc { [1, size, size, 3] } else { [1, 3, size, size] };
                let network = Network::open(runtime, &models.dir.join(&m.file), &shape, &[&m.intensities])?;
                Some((network, m.clone()))
            }
            None => None,
        };
        // Those that need more come first.
        let readouts = &Weights::get().readouts;
        let readout = match (model.kind, blendshapes.is_some(), model.inner16.is_some()) {
            _ if aus.is_some() || openface.is_some() => None,
            (PointSet::Points68, ..) => None,
            (_, true, true) => readouts.first(),
            (_, true, false) => readouts.get(1),
            (_, false, _) => readouts.get(2),
        };
        Ok(Self { network, blendshapes, readout, aus, openface, model, input: Vec::new() })
    }

    /// The readout that fits these networks.
    pub fn readout(&self) -> Option<&'static Readout> {
        self.readout
    }

    /// The AU network of the manifest.
    pub fn au_model(&self) -> Option<&AuModel> {
        self.aus.as_ref().map(|(_, model)| model)
    }

    /// Side of a first crop over the side of a detector's box, and of the next crop over the points'.
    pub fn margin(&self) -> f32 {
        self.model.margin
    }

    /// Looks for a face in `crop`; `None` where there is none.
    pub fn find(&mut self, picture: &RgbImage, crop: &Crop) -> Result<Option<Found>> {
        let model = &self.model;
        let matrix = crop.picture_from_crop(model.width);
        let sampling = Sampling {
            width: model.width,
            height: model.height,
            layout: model.layout,
            mean: model.mean,
            scale: model.scale,
        };
        sampling.sample(picture, &matrix, &mut self.input);
        let depth_scale = crop.side / model.width as f32;
        let has_readout = self.readout.is_some();
        let picture_of_input = NetworkInput {
            numbers: &self.input,
            width: model.width as usize,
            height: model.height as usize,
            layout: model.layout,
            mean: model.mean,
            scale: model.scale,
        };
        let decoded = self.network.run(&self.input, |outputs| {
            let mut outputs = outputs.iter();
            let values = *outputs.next().unwrap_or(&&[][..]);
            let presence = match model.presence.as_ref().and_then(|_| outputs.next()) {
                Some(logit) => logit.first().map_or(f32::NAN, |l| 1.0 / (1.0 + (-l).exp())),
                None => 1.0,
            };
            let inner16 = model.inner16.as_ref().and_then(|_| outputs.next()).map(|map| window_of(map)).transpose()?;
            let expected = match model.kind {
                PointSet::Mesh478 => 3 * MESH_POINTS,
                PointSet::Points68 => 2 * 68,
            };
            if values.len() != expected {
                return Err(format!("has {} numbers, expected {expected}", values.len()));
            }
            if !presence.is_finite() || values.iter().any(|v| !v.is_finite()) {
                return Err("holds numbers that are not finite".to_owned());
            }
            Ok(match model.kind {
                PointSet::Mesh478 => {
                    let at = |i: usize| [values[3 * i], values[3 * i + 1]];
                    let mesh: Box<Mesh> = Box::new(std::array::from_fn(|i| {
                        let [x, y] = matrix.apply(at(i));
                        [x, y, values[3 * i + 2] * depth_scale]
                    }));
                    let face = has_readout.then(|| AlignedFace::sample(&picture_of_input, &std::array::from_fn(at)));
                    (presence, None, Some(mesh), inner16, face.flatten())
                }
                PointSet::Points68 => {
                    let at = |i: usize| matrix.apply([values[2 * i], values[2 * i + 1]]);
                    (presence, Some(std::array::from_fn(at)), None, None, None)
                }
            })
        })?;
        let (presence, points, mesh, inner16, face) = decoded.map_err(|problem| TrackerError::NetworkOutput {
            path: self.network.path().to_owned(),
            output: model.points.clone(),
            problem,
        })?;
        if presence < model.threshold {
            return Ok(None);
        }
        let next = match (&mesh, &points) {
            (Some(mesh), _) => Crop::around(
                mesh.iter().map(|p| [p[0], p[1]]),
                mesh::flat(mesh, mesh::LEFT_EYE),
                mesh::flat(mesh, mesh::RIGHT_EYE),
                model.margin,
            ),
            (None, Some(points)) => Crop::around(points.iter().copied(), points[36], points[45], model.margin),
            (None, None) => None,
        };
        let Some(next) = next else { return Ok(None) };
        let points_px = match (&mesh, points) {
            (_, Some(points)) => points,
            (Some(mesh), None) => mesh::landmarks68(mesh),
            (None, None) => return Ok(None),
        };
        Ok(Some(Found { points_px, mesh, inner16, face, features: Vec::new(), eyes: None, presence, crop: next }))
    }

    /// Adds features and eyes, as far as there are networks for them.
    pub fn express(&mut self, picture: &RgbImage, found: &mut Found) -> Result<()> {
        let aligned = found.mesh.as_ref().and_then(|m| Some((m, mesh::alignment(m, Weights::get())?)));
        found.eyes = aligned.as_ref().map(|(mesh, alignment)| Box::new(gaze::numbers(mesh, alignment)));
        if self.aus.is_some() {
            return self.express_by_network(picture, found);
        }
        if let Some(models) = &self.openface {
            if let Some(numbers) = models.describe(picture, &found.points_px) {
                let unscored = [0.0; SCORES];
                let turned = |(_, alignment): &(_, Similarity)| readout::features(&unscored, alignment);
                found.features = aligned.as_ref().map_or([0.0; FEATURES], turned).to_vec();
                found.features.extend(numbers);
            }
            return Ok(());
        }
        let (Some(readout), Some((mesh, canonical_from_picture))) = (self.readout, aligned) else { return Ok(()) };
        let Some(face) = found.face.take() else { return Ok(()) };
        let coefficients = self.blendshapes(mesh)?;
        let inputs = Inputs {
            fhog: &fhog(&face),
            mesh: &readout::aligned(mesh, &canonical_from_picture),
            blendshapes: coefficients.as_ref().map(<[f32; BLENDSHAPES]>::as_slice).unwrap_or_default(),
            inner16: found.inner16.as_deref().unwrap_or_default(),
        };
        if let Some(scores) = readout.scores(&inputs) {
            found.features = readout::features(&scores, &canonical_from_picture).to_vec();
        }
        // It is large, and done with.
        found.inner16 = None;
        Ok(())
    }

    /// The intensities of the manifest's AU network.
    fn express_by_network(&mut self, picture: &RgbImage, found: &mut Found) -> Result<()> {
        let Some((network, model)) = &mut self.aus else { return Ok(()) };
        // The next crop is the one around the points.
        let crop = Crop { side: found.crop.side * model.margin / self.model.margin, ..found.crop };
        let AuModel { width, height, layout, mean, scale, .. } = *model;
        let sampling = Sampling { width, height, layout, mean, scale };
        sampling.sample(picture, &crop.picture_from_crop(width), &mut self.input);
        let values = network.run(&self.input, |outputs| outputs.first().map(|v| v.to_vec()).unwrap_or_default())?;
        let problem = if values.len() != model.units.len() {
            Some(format!("has {} numbers, but `units` names {} AUs", values.len(), model.units.len()))
        } else if values.iter().any(|v| !v.is_finite()) {
            Some("holds numbers that are not finite".to_owned())
        } else {
            None
        };
        if let Some(problem) = problem {
            let (path, output) = (network.path().to_owned(), model.intensities.clone());
            return Err(TrackerError::NetworkOutput { path, output, problem });
        }
        found.features = values.iter().map(|v| (v * model.factor).clamp(0.0, 5.0)).collect();
        Ok(())
    }

    /// Coefficients 0–1 of the blendshape network, if there is one.
    fn blendshapes(&mut self, mesh: &Mesh) -> Result<Option<[f32; BLENDSHAPES]>> {
        let Some(network) = &mut self.blendshapes else { return Ok(None) };
        self.input.clear();
        self.input.extend(mesh::BLENDSHAPE_POINTS.iter().flat_map(|&i| mesh::flat(mesh, usize::from(i))));
        let values = network.run(&self.input, |outputs| <[f32; BLENDSHAPES]>::try_from(*outputs.first()?).ok())?;
        match values.filter(|v| v.iter().all(|x| x.is_finite())) {
            Some(values) => Ok(Some(values)),
            None => Err(TrackerError::NetworkOutput {
                path: network.path().to_owned(),
                output: "coefficients".to_owned(),
                problem: format!("is not {BLENDSHAPES} finite numbers"),
            }),
        }
    }
}

/// Channels of the inner map.
const CHANNELS: usize = 128;
/// Rows and columns of the 16×16 map that see the face.
const WINDOW: [std::ops::Range<usize>; 2] = [3..14, 2..14];

/// The 16×16 map as the readout wants it: the cells that see the face, channel by channel, row by row.
fn window_of(map: &[f32]) -> Result<Vec<f32>, String> {
    if map.len() != CHANNELS * 16 * 16 {
        return Err(format!("has an inner map of {} numbers, expected 16×16×128", map.len()));
    }
    let [rows, columns] = &WINDOW;
    let mut window = Vec::with_capacity(CHANNELS * rows.len() * columns.len());
    for channel in map.chunks_exact(16 * 16) {
        for row in channel.chunks_exact(16).take(rows.end).skip(rows.start) {
            window.extend_from_slice(&row[columns.clone()]);
        }
    }
    Ok(window)
}
