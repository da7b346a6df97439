//! `RUN/model.safetensors` and `RUN/model.json`: the avatar as others can read it, and everything needed to render it.

use std::collections::BTreeMap;
use std::path::Path;

use burn::module::{Module as _, ModuleMapper, ModuleVisitor, Param};
use burn::tensor::{Device, Tensor, TensorData};
use glam::DVec3;
use risorius_formats::pose_report::{json_error, write_json};
use risorius_formats::views::ViewCamera;
use risorius_formats::{AttributeTable, Camera, FormatError, atomic};
use safetensors::tensor::{Dtype, SafeTensors, TensorView};
use serde::{Deserialize, Serialize};

use crate::bounds;
use crate::confies::ConfiesField;
use crate::config::{FitSettings, MaskRendering, ModelConfig, Spacing};
use crate::data::TrainData;
use crate::error::{Result, TrainerError};
use crate::field::Field;
use crate::model::{ConfiesModel, region_groups};
use crate::path;
use crate::space::NetSpace;
use crate::splat::{SavedSplat, SplatField};

/// `RUN/model.json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SavedModel {
    /// Version of the layout.
    pub version: u32,
    /// What the field needs besides its weights.
    #[serde(flatten)]
    pub field: SavedField,
    /// The attributes with their ranges.
    pub table: AttributeTable,
    /// The middle of the head, world units.
    pub center_in_world: DVec3,
    /// The training frame that is closest to a neutral face.
    pub neutral_frame: usize,
    /// Where that frame was seen from, at the size that was fitted.
    pub default_camera: ViewCamera,
    /// Half angles of the cone that the training cameras span around the head: sideways and up-down, radians.
    pub orbit_rad: [f64; 2],
    /// Image scale that was fitted.
    pub image_scale: u32,
    /// Corners of the head's hull, where only the head was fitted.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub head_hull_in_world: Option<Vec<DVec3>>,
}

/// What only one of the fields has.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "field", rename_all = "kebab-case")]
pub enum SavedField {
    /// The paper's networks.
    Confies(SavedConfies),
    /// Gaussians.
    Splat(SavedSplat),
}

/// The name of the field of avatars that are no longer read.
const REMOVED: &str = "brick";

/// Refuses a run of a field that is no longer there.
pub(crate) fn check_field(field: &str, run: &Path) -> Result<()> {
    if field != REMOVED {
        return Ok(());
    }
    Err(TrainerError::Run {
        path: run.to_owned(),
        message: "was made by the brick field of an earlier version".to_owned(),
        hint: "fit the dataset again".to_owned(),
    })
}

/// What `model.json` says first.
#[derive(Deserialize)]
struct Named {
    #[serde(default)]
    field: String,
}

/// The paper's networks without their weights.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SavedConfies {
    /// Network sizes.
    pub model: ModelConfig,
    /// Training frames, which the latent table has rows for.
    pub frames: usize,
    /// Coarse samples per ray.
    pub coarse_samples: usize,
    /// Importance samples per ray.
    pub fine_samples: usize,
    /// Spacing of the coarse samples.
    pub spacing: Spacing,
    /// What of the masks was rendered.
    #[serde(default)]
    pub mask_rendering: MaskRendering,
    /// The space the networks see.
    pub space: NetSpace,
}

impl SavedModel {
    /// What both fields save of a fit; `center_in_world` is the middle of the head.
    pub fn describe(data: &TrainData, field: SavedField, center_in_world: DVec3) -> Self {
        let neutral_frame = data.neutral_frame();
        let camera = &data.frames[neutral_frame].camera;
        let cameras: Vec<Camera> = data.frames.iter().map(|f| f.camera).collect();
        Self {
            version: 3,
            field,
            table: data.table.clone(),
            center_in_world,
            neutral_frame,
            default_camera: ViewCamera::from(camera),
            orbit_rad: path::spread(camera, &cameras, center_in_world),
            image_scale: data.scale,
            head_hull_in_world: data.extras().and_then(|e| e.head_hull_in_world.clone()),
        }
    }

    /// What is to be saved of a fit of the paper's networks.
    pub fn describe_confies(data: &TrainData, settings: &FitSettings, space: &NetSpace) -> Self {
        let confies = SavedConfies {
            model: settings.model,
            frames: data.frames.len(),
            coarse_samples: settings.coarse_samples,
            fine_samples: settings.fine_samples,
            spacing: settings.spacing,
            mask_rendering: settings.mask_rendering,
            space: *space,
        };
        Self::describe(data, SavedField::Confies(confies), space.center_in_world)
    }

    /// Writes both files, each whole or not at all.
    pub fn write(&self, run: &Path, model: &ConfiesModel) -> Result<()> {
        let mut collected = Collected::default();
        model.visit(&mut collected);
        let path = run.join("model.safetensors");
        let views: Vec<(&str, TensorView<'_>)> = collected
            .tensors
            .iter()
            .map(|(name, (shape, bytes))| Ok((name.as_str(), TensorView::new(Dtype::F32, shape.clone(), bytes)?)))
            .collect::<std::result::Result<_, safetensors::SafeTensorError>>()
            .map_err(|e| damaged(&path, &e))?;
        let bytes = safetensors::serialize(views, None).map_err(|e| damaged(&path, &e))?;
        atomic::write_file(&path, &bytes)?;
        write_json(run.join("model.json"), self)?;
        Ok(())
    }

    /// Reads `model.json`.
    pub fn read(run: &Path) -> Result<Self> {
        let path = run.join("model.json");
        let bytes = std::fs::read(&path).map_err(|e| {
            FormatError::io(&path, "read", &e)
                .with_hint("this folder holds no fitted avatar; make one with `trainer fit DATASET --out RUN`")
        })?;
        let broken = |e: serde_json::Error| json_error(&e).in_file(&path);
        let named: Named = serde_json::from_slice(&bytes).map_err(broken)?;
        check_field(&named.field, run)?;
        let saved: Self = serde_json::from_slice(&bytes).map_err(broken)?;
        bounds::of_model(&saved).map_err(|problem| damaged(&path, &problem))?;
        Ok(saved)
    }

    /// Opens the field that the run holds.
    pub fn open_field(&self, run: &Path, device: &Device) -> Result<Box<dyn Field>> {
        Ok(match &self.field {
            SavedField::Confies(confies) => Box::new(ConfiesField::open(self, confies, run, device)?),
            SavedField::Splat(splat) => Box::new(SplatField::open(self, splat, run)?),
        })
    }

    /// Builds the model and fills in the weights of `model.safetensors`.
    pub fn load_confies(&self, confies: &SavedConfies, run: &Path, device: &Device) -> Result<ConfiesModel> {
        let path = run.join("model.safetensors");
        let bytes = std::fs::read(&path).map_err(|e| FormatError::io(&path, "read", &e))?;
        let tensors = SafeTensors::deserialize(&bytes).map_err(|e| damaged(&path, &e))?;
        bounds::of_confies(confies, bytes.len()).map_err(|problem| damaged(&run.join("model.json"), &problem))?;
        let groups = region_groups(&self.table);
        let model = ConfiesModel::new(&confies.model, &groups, confies.frames, 0, device);
        let mut filler = Filler { tensors: &tensors, path: Vec::new(), problem: None };
        let model = model.map(&mut filler);
        match filler.problem {
            Some(problem) => Err(damaged(&path, &problem)),
            None => Ok(model),
        }
    }
}

pub(crate) fn damaged(path: &Path, error: &dyn std::fmt::Display) -> TrainerError {
    TrainerError::Run {
        path: path.to_owned(),
        message: error.to_string(),
        hint: "fit the avatar again, or resume its last checkpoint".to_owned(),
    }
}

/// Gathers every parameter by its path, as little-endian bytes.
#[derive(Default)]
struct Collected {
    path: Vec<String>,
    tensors: BTreeMap<String, (Vec<usize>, Vec<u8>)>,
}

impl ModuleVisitor for Collected {
    fn enter_module(&mut self, name: &str, _: &str) {
        self.path.push(name.to_owned());
    }

    fn exit_module(&mut self, _: &str, _: &str) {
        self.path.pop();
    }

    fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
        let tensor = param.val();
        let shape = tensor.dims().to_vec();
        let bytes = crate::fit::host(tensor.detach()).iter().flat_map(|v| v.to_le_bytes()).collect();
        self.tensors.insert(self.path.join("."), (shape, bytes));
    }
}

/// Replaces every parameter by the stored tensor of its path.
struct Filler<'a> {
    tensors: &'a SafeTensors<'a>,
    path: Vec<String>,
    problem: Option<String>,
}

impl ModuleMapper for Filler<'_> {
    fn enter_module(&mut self, name: &str, _: &str) {
        self.path.push(name.to_owned());
    }

    fn exit_module(&mut self, _: &str, _: &str) {
        self.path.pop();
    }

    fn map_float<const D: usize>(&mut self, param: Param<Tensor<D>>) -> Param<Tensor<D>> {
        let name = self.path.join(".");
        let stored = match self.tensors.tensor(&name) {
            Ok(t) => t,
            Err(e) => {
                self.problem.get_or_insert(format!("`{name}`: {e}"));
                return param;
            }
        };
        let shape = param.val().dims();
        if stored.shape() != shape || stored.dtype() != Dtype::F32 {
            self.problem.get_or_insert(format!("`{name}` has shape {:?}, expected {shape:?} of f32", stored.shape()));
            return param;
        }
        let values: Vec<f32> =
            stored.data().chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect();
        if let Some(bad) = values.iter().find(|v| !v.is_finite()) {
            self.problem.get_or_insert(format!("`{name}` holds {bad}"));
        }
        let device = param.val().device();
        param.map(|_| Tensor::from_data(TensorData::new(values, shape), &device))
    }
}

#[cfg(test)]
mod tests {
    use risorius_formats::Hint as _;

    use super::*;

    #[test]
    fn an_avatar_of_the_field_that_is_gone_says_so() {
        let run = tempfile::tempdir().unwrap();
        std::fs::write(run.path().join("model.json"), r#"{"version":2,"field":"brick","layout":{}}"#).unwrap();
        let error = SavedModel::read(run.path()).unwrap_err();
        assert!(error.to_string().ends_with("was made by the brick field of an earlier version"), "{error}");
        assert_eq!(error.hint().as_deref(), Some("fit the dataset again"));
    }
}
