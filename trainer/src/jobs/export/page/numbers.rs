//! The numbers of an avatar for the page: a safetensors file (n Gaussians, of which the first m carry deltas, padded to
//! blocks of 16; a AUs that move).
//!
//! | array | type, shape | |
//! |---|---|---|
//! | `mean` | f32 `[n, 3]` | metres |
//! | `log_scale`, `opacity` | f16 `[n, 3]`, `[n]` | logarithms; logit |
//! | `quaternion` | i16 `[n, 4]` | unit, w first, times 32,767 |
//! | `color`, `sh1` | f16 `[n, 3]`, `[n, 9]` | 0–1; y, z, x, each red, green, blue |
//! | `head` | u8 `[n]` | how much of the head's motion it follows, times 255 |
//! | `deltas` | i8 `[a, m/16, 6, 16]` | gate times delta: mean, colour; times its scale |
//! | `delta_scales` | f32 `[a, m/16, 2]` | of the mean's three channels, of the colour's |

use risorius_splat::model::{DELTAS, EMPTY, LANES, REGIONS, channel};
use safetensors::SafeTensorError;
use safetensors::tensor::{Dtype, TensorView};

use super::super::cloud::{self, Row};
use crate::avatar::Avatar;
use crate::splat::SplatField;
use crate::splat::quantise::{from_bytes, to_bytes, to_half};

/// The page's numbers, and how far they are from the avatar's.
#[derive(Debug)]
pub(super) struct Numbers {
    rows: Vec<Row>,
    bytes: Vec<u8>,
    scales: Vec<f32>,
    pub gaussians: usize,
    pub deformable: usize,
    /// AUs with deltas.
    pub moving: Vec<usize>,
    pub most_mm: f64,
    pub most_levels: f64,
}

impl Numbers {
    /// Quantises the avatar of `field`.
    pub(super) fn new(avatar: &Avatar, field: &SplatField) -> Self {
        let model = &field.model;
        let table = &avatar.saved.table.attributes;
        let slots = cloud::slots(model);
        let rows: Vec<Row> = slots.iter().map(|&slot| cloud::row(model, slot, &[])).collect();
        let deformable = slots.iter().take_while(|&&slot| slot / LANES < model.deformable).count();
        let moving: Vec<usize> = (0..table.len()).filter(|&k| table[k].active).collect();
        let blocks = deformable.div_ceil(LANES);
        let bases = model.layout.bases();
        let mut deltas = vec![0.0f32; moving.len() * blocks * DELTAS * LANES];
        for (at, &k) in moving.iter().enumerate() {
            let reach = model.layout.reach(k);
            for (i, &slot) in slots[..deformable].iter().enumerate() {
                let (g, lane) = (slot / LANES, slot % LANES);
                let of_region = |r: usize| model.gates[(g * REGIONS + r) * LANES + lane];
                let gate = (0..REGIONS).filter(|r| reach >> r & 1 != 0).map(of_region).fold(0.0, f32::max);
                for c in 0..DELTAS {
                    let to = ((at * blocks + i / LANES) * DELTAS + c) * LANES + i % LANES;
                    deltas[to] = gate * model.deltas[((g * bases + k) * DELTAS + c) * LANES + lane];
                }
            }
        }
        let (bytes, scales) = to_bytes(&deltas);
        let back = from_bytes(&bytes, &scales);
        let (mut most_mm, mut most_levels) = (0.0f64, 0.0f64);
        let neutral = avatar.neutral();
        for (at, &k) in moving.iter().enumerate() {
            let strongest = field.activations(&neutral.with(k, table[k].scale().most()));
            let activation = f64::from(strongest.get(k).copied().unwrap_or(0.0));
            let part = at * blocks * DELTAS * LANES..(at + 1) * blocks * DELTAS * LANES;
            for (i, (was, is)) in deltas[part.clone()].iter().zip(&back[part]).enumerate() {
                let error = f64::from((was - is).abs()) * activation;
                if i / LANES % DELTAS < 3 {
                    most_mm = most_mm.max(error * 1e3);
                } else {
                    most_levels = most_levels.max(error * 255.0);
                }
            }
        }
        Self { gaussians: rows.len(), rows, bytes, scales, deformable, moving, most_mm, most_levels }
    }

    /// The file.
    pub(super) fn to_safetensors(&self) -> Result<Vec<u8>, SafeTensorError> {
        let rows = &self.rows;
        let (n, a, blocks) = (rows.len(), self.moving.len(), self.deformable.div_ceil(LANES));
        let floats = |values: &mut dyn Iterator<Item = f32>| values.flat_map(f32::to_le_bytes).collect::<Vec<u8>>();
        let arrays: [(&str, Dtype, Vec<usize>, Vec<u8>); 9] = [
            ("mean", Dtype::F32, vec![n, 3], floats(&mut rows.iter().flat_map(|r| r.mean))),
            ("delta_scales", Dtype::F32, vec![a, blocks, 2], floats(&mut self.scales.iter().copied())),
            ("log_scale", Dtype::F16, vec![n, 3], to_half(rows.iter().flat_map(|r| r.log_scale))),
            ("opacity", Dtype::F16, vec![n], to_half(rows.iter().map(|r| r.logit.max(EMPTY)))),
            ("color", Dtype::F16, vec![n, 3], to_half(rows.iter().flat_map(|r| r.color))),
            (
                "sh1",
                Dtype::F16,
                vec![n, channel::COUNT - channel::SH1],
                to_half(rows.iter().flat_map(|r| r.sh1).flatten()),
            ),
            ("quaternion", Dtype::I16, vec![n, 4], rows.iter().flat_map(|r| r.quaternion).flat_map(short).collect()),
            (
                "head",
                Dtype::U8,
                vec![n],
                rows.iter().map(|r| (r.head * 255.0).round().clamp(0.0, 255.0) as u8).collect(),
            ),
            ("deltas", Dtype::I8, vec![a, blocks, DELTAS, LANES], self.bytes.clone()),
        ];
        let views: Vec<(&str, TensorView<'_>)> = arrays
            .iter()
            .map(|(name, dtype, shape, bytes)| Ok((*name, TensorView::new(*dtype, shape.clone(), bytes)?)))
            .collect::<Result<_, SafeTensorError>>()?;
        safetensors::serialize(views, None)
    }
}

fn short(v: f32) -> [u8; 2] {
    ((v * 32_767.0).round().clamp(-32_767.0, 32_767.0) as i16).to_le_bytes()
}
