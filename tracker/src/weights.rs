//! The project's own fitted numbers: the canonical mesh, the model of resting faces, the AU regressor.
//!
//! They are made by `tools/train-aus` from rendered faces and lie in the repository (`tracker/models`), so that every
//! build of one version gives the same numbers.

use std::sync::LazyLock;

use glam::DVec3;
use safetensors::{Dtype, SafeTensors};

use crate::aus::readout::{Part, Readout};
use crate::head_pose::shape::ShapeModel;

static FILE: &[u8] = include_bytes!("../models/face_v2.safetensors");
static WEIGHTS: LazyLock<Weights> =
    LazyLock::new(|| Weights::parse(FILE).expect("the embedded file is whole: a test reads it"));

/// All fitted numbers of one version.
#[derive(Clone, Debug)]
pub struct Weights {
    /// Name and version.
    pub name: String,
    /// The mean mesh: outer eye corners 1 apart, x right, y down, z away from the camera.
    pub canonical: Vec<[f32; 3]>,
    /// From a point of the mesh to the landmark it stands for, in the frame of the canonical mesh.
    pub point_offsets: Vec<[f32; 3]>,
    /// Resting faces.
    pub shape: ShapeModel,
    /// AU readouts, those that need more first.
    pub readouts: Vec<Readout>,
}

impl Weights {
    /// The embedded weights.
    pub fn get() -> &'static Self {
        &WEIGHTS
    }

    fn parse(bytes: &[u8]) -> Result<Self, String> {
        let text = |e: safetensors::SafeTensorError| e.to_string();
        let (_, header) = SafeTensors::read_metadata(bytes).map_err(text)?;
        let name = header.metadata().as_ref().and_then(|m| m.get("name")).ok_or("no name")?.clone();
        let file = File { tensors: SafeTensors::deserialize(bytes).map_err(text)? };
        let points =
            |name: &str| Ok::<_, String>(file.floats(name)?.chunks_exact(3).map(|p| [p[0], p[1], p[2]]).collect());
        let solid = |p: &[f32; 3]| DVec3::from(p.map(f64::from));
        let mean: Vec<[f32; 3]> = points("shape_mean")?;
        let modes: Vec<[f32; 3]> = points("shape_modes")?;
        let shape = ShapeModel {
            modes: modes.chunks_exact(mean.len()).map(|m| m.iter().map(solid).collect()).collect(),
            mean: mean.iter().map(solid).collect(),
        };
        let readouts = ["full", "plain", "bare"].iter().map(|name| file.readout(name)).collect::<Result<_, _>>()?;
        Ok(Self { name, canonical: points("canonical")?, point_offsets: points("point_offsets")?, shape, readouts })
    }
}

struct File<'a> {
    tensors: SafeTensors<'a>,
}

impl File<'_> {
    fn floats(&self, name: &str) -> Result<Vec<f32>, String> {
        let tensor = self.tensors.tensor(name).map_err(|e| format!("{name}: {e}"))?;
        if tensor.dtype() != Dtype::F32 {
            return Err(format!("{name}: is not of 32-bit floats"));
        }
        Ok(tensor.data().chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect())
    }

    /// Rows of one input; none where the readout does without it.
    fn part(&self, name: &str) -> Result<Part, String> {
        let Ok(tensor) = self.tensors.tensor(name) else { return Ok(Part::default()) };
        if tensor.dtype() != Dtype::I8 {
            return Err(format!("{name}: is not of 8-bit integers"));
        }
        let weights = tensor.data().iter().map(|b| i8::from_le_bytes([*b])).collect();
        Ok(Part { weights, scales: self.floats(&format!("{name}.scale"))? })
    }

    fn readout(&self, name: &str) -> Result<Readout, String> {
        let part = |kind: &str| self.part(&format!("{name}.{kind}"));
        let numbers = |what: &str| self.floats(&format!("{name}.{what}"));
        Ok(Readout {
            // The same in all readouts.
            skin: self.part("fhog")?,
            points: [part("mesh")?, part("blendshapes")?, part("inner16")?],
            share: numbers("share")?,
            gain: numbers("gain")?,
            presence: numbers("presence")?,
            reliability: numbers("reliability")?,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::aus::UNITS;
    use crate::aus::fhog::FHOG_NUMBERS;
    use crate::aus::readout::MESH_NUMBERS;
    use crate::run::mesh::{LEFT_EYE, MESH_POINTS, RIGHT_EYE};

    #[test]
    fn the_embedded_weights_are_whole() {
        let w = Weights::parse(FILE).unwrap();
        assert_eq!((w.canonical.len(), w.point_offsets.len(), w.shape.mean.len()), (MESH_POINTS, 68, 68));
        let (a, b) = (w.canonical[LEFT_EYE], w.canonical[RIGHT_EYE]);
        assert!(((0..3).map(|i| (a[i] - b[i]).powi(2)).sum::<f32>() - 1.0).abs() < 1e-4);
        assert!(w.shape.modes.len() >= 10 && w.shape.modes.iter().all(|m| m.len() == 68));
        let columns = |p: &Part| p.weights.len() / UNITS;
        let points = w.readouts.iter().map(|r| r.points.each_ref().map(columns)).collect::<Vec<_>>();
        let maps = 11 * 12 * 128;
        assert_eq!(points, [[MESH_NUMBERS, 52, maps], [MESH_NUMBERS, 52, 0], [MESH_NUMBERS, 0, 0]]);
        for r in &w.readouts {
            assert_eq!(r.skin.weights.len(), UNITS * FHOG_NUMBERS);
            for part in r.points.iter().chain([&r.skin]).filter(|p| !p.weights.is_empty()) {
                assert_eq!(part.scales.len(), UNITS);
            }
            for numbers in [&r.share, &r.gain, &r.presence, &r.reliability] {
                assert!(numbers.len() == UNITS && numbers.iter().all(|v| v.is_finite() && *v >= 0.0));
            }
            assert!(r.share.iter().chain(&r.reliability).all(|v| *v <= 1.0));
        }
    }
}
