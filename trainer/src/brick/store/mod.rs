//! The brick field on disk. An avatar is a safetensors file that any tool reads, a checkpoint holds records of Burn. What is
//! not finite is neither written nor read.

pub mod avatar;
pub mod checkpoint;
mod settle;

use std::io::Read;
use std::path::Path;

use risorius_brick::expression::{CHANNELS, MASKS};
use risorius_brick::field::FEATURES;
use risorius_brick::model::{LATENT, Part};
use risorius_brick::table::Table;
use risorius_brick::{Brick, Layout};
use serde::{Deserialize, Serialize};

use self::settle::settle;
use super::plate::Plate;
use crate::bounds;
use crate::error::Result;
use crate::saved::damaged;

/// The brick field without its numbers.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SavedBrick {
    /// Box, background, regions.
    pub layout: Layout,
    /// Samples along the head box's edge.
    pub divisions: usize,
    /// Planes of the background.
    pub planes: usize,
    /// Live levels of head and background.
    pub live: [usize; 2],
    /// The image whose latent code stands for a neutral face.
    pub neutral_image: usize,
    /// Whether attributes rise above 1 for the strongest intensities (eq. 1 without its cap).
    #[serde(default)]
    pub uncapped: bool,
    /// Size of the picture behind everything, if it is known.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub plate: Option<[u32; 2]>,
}

impl SavedBrick {
    /// Describes a model.
    pub fn of(model: &Brick, plate: Option<&Plate>, uncapped: bool) -> Self {
        Self {
            layout: model.layout.clone(),
            divisions: model.divisions,
            planes: model.planes,
            live: [model.head.field.live, model.background.as_ref().map_or(0, |p| p.field.live)],
            neutral_image: model.neutral_image,
            uncapped,
            plate: plate.map(|p| [p.width, p.height]),
        }
    }
}

/// Whether what only a fit needs is stored as well.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Content {
    /// What rendering needs.
    Avatar,
    /// All that resuming needs.
    Checkpoint,
}

/// What an array of a model is to a fit.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Role {
    /// Learned.
    Value,
    /// Adam's first moment.
    First,
    /// Adam's second moment.
    Second,
    /// Updates of each block.
    Steps,
    /// Where something is.
    Space,
}

enum Numbers<'m> {
    Floats(&'m mut Vec<f32>),
    Counts(&'m mut Vec<u32>),
    Bytes(&'m mut Vec<u8>),
}

/// An array of a model.
struct Array<'m> {
    /// Its name in an avatar's file.
    name: String,
    /// Its path in a record: that of the parameter in [`super::tensors::BrickParameters`], for moments and counts too.
    path: String,
    role: Role,
    /// Numbers of a row; 0 for arrays of one dimension.
    width: usize,
    numbers: Numbers<'m>,
}

/// Gathers arrays with their names.
struct Gather<'m> {
    content: Content,
    arrays: Vec<Array<'m>>,
}

impl<'m> Gather<'m> {
    fn add(&mut self, name: String, path: String, role: Role, width: usize, numbers: Numbers<'m>) {
        self.arrays.push(Array { name, path, role, width, numbers });
    }

    fn space(&mut self, name: &str, numbers: Numbers<'m>) {
        self.add(name.to_owned(), name.to_owned(), Role::Space, 0, numbers);
    }

    fn table(&mut self, name: &str, path: &str, width: usize, table: &'m mut Table) {
        let whole = self.content == Content::Checkpoint;
        let mut add = |what: &str, role, width, numbers| {
            self.add(format!("{name}.{what}"), path.to_owned(), role, width, numbers);
        };
        add("values", Role::Value, width, Numbers::Floats(&mut table.values));
        add("steps", Role::Steps, 0, Numbers::Counts(&mut table.steps));
        if whole {
            add("first", Role::First, width, Numbers::Floats(&mut table.first));
            add("second", Role::Second, width, Numbers::Floats(&mut table.second));
        }
    }

    fn part(&mut self, name: &str, part: &'m mut Part) {
        for (l, (lattice, table)) in part.field.levels.iter_mut().zip(&mut part.field.features).enumerate() {
            self.space(&format!("{name}.level{l}.slot"), Numbers::Counts(&mut lattice.slot));
            self.table(&format!("{name}.level{l}"), &format!("{name}.levels.{l}"), FEATURES, table);
        }
        let net = format!("{name}.net");
        self.table(&net, &net, 0, &mut part.field.net);
        self.space(&format!("{name}.occupied"), Numbers::Bytes(&mut part.occupancy.bits));
        if self.content == Content::Checkpoint {
            self.space(&format!("{name}.density"), Numbers::Floats(&mut part.occupancy.density));
            self.space(&format!("{name}.weight"), Numbers::Floats(&mut part.occupancy.weight));
        }
    }
}

/// All arrays of a model that belong to `content`.
fn arrays(model: &mut Brick, content: Content) -> Vec<Array<'_>> {
    let mut all = Gather { content, arrays: Vec::new() };
    let units = model.layout.region_of.len();
    all.part("head", &mut model.head);
    if let Some(part) = &mut model.background {
        all.part("background", part);
    }
    let e = &mut model.expression;
    all.space("expression.slot", Numbers::Counts(&mut e.lattice.slot));
    all.space("expression.allowed", Numbers::Bytes(&mut e.allowed));
    for (n, slots) in e.slots_of.iter_mut().enumerate() {
        all.space(&format!("expression.region{n}"), Numbers::Counts(slots));
    }
    for (k, table) in e.residuals.iter_mut().enumerate() {
        all.table(&format!("expression.au{k}"), &format!("residuals.{k}"), CHANNELS, table);
    }
    all.table("expression.masks", "masks", MASKS, &mut e.masks);
    for (j, table) in model.latent_bases.iter_mut().enumerate() {
        all.table(&format!("latent{j}"), &format!("latent_bases.{j}"), 4, table);
    }
    all.table("codes", "codes", LATENT, &mut model.codes);
    if content == Content::Checkpoint {
        all.table("alphas", "alphas", units, &mut model.alphas);
        all.table("log_betas", "log_betas", units, &mut model.log_betas);
        all.table("motions", "motions", 6, &mut model.motions);
    }
    all.arrays
}

/// A fit that went wrong must not take the place of what was written before it.
fn check_finite(path: &Path, arrays: &[Array<'_>]) -> Result<()> {
    for Array { name, numbers, .. } in arrays {
        if let Numbers::Floats(values) = numbers
            && let Some(bad) = values.iter().find(|v| !v.is_finite())
        {
            return Err(damaged(path, &format!("`{name}` holds {bad}: nothing is written")));
        }
    }
    Ok(())
}

/// Little-endian numbers, read to where they stay: a copy of the file beside them would double what opening takes.
fn read_numbers<T: bytemuck::Pod>(count: usize, from: &mut impl Read) -> std::io::Result<Vec<T>> {
    let mut values = vec![T::zeroed(); count];
    let bytes: &mut [u8] = bytemuck::cast_slice_mut(&mut values);
    from.read_exact(bytes)?;
    if cfg!(target_endian = "big") {
        bytes.chunks_exact_mut(size_of::<T>()).for_each(<[u8]>::reverse);
    }
    Ok(values)
}

/// Fills `array` with the next `bytes` bytes of `from`; says what is wrong with them.
fn fill(array: &mut Array<'_>, bytes: usize, from: &mut impl Read) -> std::result::Result<(), String> {
    let broken = |e: std::io::Error| format!("`{}`: {e}", array.name);
    match &mut array.numbers {
        Numbers::Floats(values) => {
            **values = read_numbers(bytes / 4, from).map_err(broken)?;
            if let Some(bad) = values.iter().find(|v| !v.is_finite()) {
                return Err(format!("`{}` holds {bad}", array.name));
            }
        }
        Numbers::Counts(values) => **values = read_numbers(bytes / 4, from).map_err(broken)?,
        Numbers::Bytes(values) => **values = read_numbers(bytes, from).map_err(broken)?,
    }
    Ok(())
}

/// A model of the layout that `saved` tells, to be filled.
fn unfilled(saved: &SavedBrick, file_bytes: usize) -> std::result::Result<Brick, String> {
    bounds::of_brick(saved, file_bytes)?;
    Ok(Brick::empty(saved.layout.clone()))
}

/// A model whose arrays were filled, made ready.
fn ready(mut model: Brick, saved: &SavedBrick, content: Content) -> std::result::Result<Brick, String> {
    model.neutral_image = saved.neutral_image.min(saved.layout.images.saturating_sub(1));
    model.divisions = saved.divisions.max(1);
    model.planes = saved.planes.max(1);
    model.head.field.live = saved.live[0].min(model.head.field.levels.len());
    if let Some(part) = &mut model.background {
        part.field.live = saved.live[1].min(part.field.levels.len());
    }
    settle(&mut model, content)?;
    Ok(model)
}
