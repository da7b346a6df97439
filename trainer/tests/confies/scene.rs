//! A scene in memory: six frames of a few pixels, four AUs in two regions.

use std::collections::BTreeMap;

use burn::module::{Module as _, ModuleVisitor, Param};
use burn::optim::GradientsParams;
use burn::tensor::Tensor;
use glam::DVec3;
use risorius_formats::nerfies::Dataset;
use risorius_formats::{
    ActionUnit, Attribute, AttributeSpec, AttributeTable, Camera, Intrinsics, Isometry, SceneBounds,
};
use risorius_trainer::config::FitSettings;
use risorius_trainer::data::{PixelLists, TrainData, TrainFrame};
use risorius_trainer::model::ConfiesModel;
use risorius_trainer::space::NetSpace;

pub(crate) const SIDE: u32 = 8;
pub(crate) const FRAMES: usize = 6;

/// The scene; frames without annotation are those whose index `unannotated` names.
pub(crate) fn scene(unannotated: &[usize]) -> TrainData {
    let spec = |unit: u8, region: usize| AttributeSpec::from_range(ActionUnit(unit), region, 0.0, 4.0, 0.0);
    let table = AttributeTable {
        regions: vec!["brow".to_owned(), "mouth".to_owned()],
        attributes: vec![spec(1, 0), spec(4, 0), spec(12, 1), spec(25, 1)],
    };
    let count = (SIDE * SIDE) as usize;
    let frame = |i: usize| {
        let given = !unannotated.contains(&i);
        let label = |p: usize| if p < count / 4 { 1 } else { u8::from(p >= count / 2) * 2 };
        let labels: Vec<u8> = (0..count).map(label).collect();
        let center = DVec3::new(0.05 * i as f64 - 0.1, 0.02 * i as f64, 0.0);
        let mut camera_from_world = Isometry::IDENTITY;
        camera_from_world.translation = -center;
        TrainFrame {
            id: format!("{i:06}"),
            camera: Camera { intrinsics: Intrinsics::pinhole(SIDE, SIDE, 10.0), camera_from_world },
            pixels: (0..count * 3).map(|p| ((p * 37 + i * 11) % 256) as u8).collect(),
            labels: given.then_some(labels),
            valid: None,
            attributes: given.then(|| (0..4).map(|k| Attribute(((i * 3 + k * 5) % 9) as f32 / 4.0 - 1.0)).collect()),
            intensities: None,
            landmarks_px: None,
            lists: PixelLists::default(),
        }
    };
    let frames: Vec<TrainFrame> = (0..FRAMES).map(frame).collect();
    let ids: Vec<String> = frames.iter().map(|f| f.id.clone()).collect();
    TrainData {
        dir: "nowhere".into(),
        sha256: "0".repeat(64),
        dataset: Dataset {
            train_ids: ids.clone(),
            val_ids: Vec::new(),
            ids,
            metadata: BTreeMap::new(),
            scene: SceneBounds { center_in_world: DVec3::new(0.0, 0.0, 1.0), scale: 1.0, near: 0.5, far: 2.0 },
            cameras: BTreeMap::new(),
            mapping: Vec::new(),
            annotations: Vec::new(),
            extras: None,
        },
        frames,
        table,
        scale: 1,
    }
}

/// Settings for it: networks of a few units, with every structure of the paper's.
pub(crate) fn settings() -> FitSettings {
    let mut s = FitSettings::tiny();
    s.rays = 24;
    s.coarse_samples = 6;
    s.fine_samples = 5;
    s.region_share = 0.0;
    s.attribute_cut = 1e-6;
    s.model.mask.branch = 5;
    s.model.mask.branch_skip = true;
    s.model.uncertainty.branch = 4;
    s.model.warp.depth = 5;
    s
}

pub(crate) fn space(data: &TrainData, settings: &FitSettings) -> NetSpace {
    NetSpace::new(&data.dataset.scene, data.extras(), settings.model.head_radius)
}

/// Every parameter's gradient by its path; `None` where there is none.
pub(crate) fn by_path(model: &ConfiesModel, gradients: &GradientsParams) -> BTreeMap<String, Option<Vec<f32>>> {
    struct Read<'a> {
        gradients: &'a GradientsParams,
        path: Vec<String>,
        found: BTreeMap<String, Option<Vec<f32>>>,
    }
    impl ModuleVisitor for Read<'_> {
        fn enter_module(&mut self, name: &str, _: &str) {
            self.path.push(name.to_owned());
        }
        fn exit_module(&mut self, _: &str, _: &str) {
            self.path.pop();
        }
        fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
            let gradient = self.gradients.get::<D>(param.id).map(numbers);
            self.found.insert(self.path.join("."), gradient);
        }
    }
    let mut read = Read { gradients, path: Vec::new(), found: BTreeMap::new() };
    model.visit(&mut read);
    read.found
}

pub(crate) fn numbers<const D: usize>(t: Tensor<D>) -> Vec<f32> {
    t.into_data().try_to_vec::<f32>().unwrap()
}

/// The largest gradient of the parameters whose path begins so; 0 where none has one.
pub(crate) fn peak(gradients: &BTreeMap<String, Option<Vec<f32>>>, prefix: &str) -> f32 {
    let of = gradients.iter().filter(|(path, _)| path.starts_with(prefix)).filter_map(|(_, g)| g.as_ref());
    of.flatten().fold(0.0, |m, v| m.max(v.abs()))
}
