//! The brick field on disk: named tensors in safetensors, and what describes them. What is not finite is neither written
//! nor read.

use std::borrow::Cow;
use std::path::Path;

use risorius_brick::field::LAYERS;
use risorius_brick::lattice::{BRICK, Lattice};
use risorius_brick::model::Part;
use risorius_brick::table::Table;
use risorius_brick::{Brick, Layout};
use risorius_formats::{FormatError, atomic};
use safetensors::tensor::{Dtype, SafeTensors};
use serde::{Deserialize, Serialize};

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

/// Visits every array of a model with its name.
trait Visitor<'m> {
    fn floats(&mut self, name: String, values: &'m mut Vec<f32>);
    fn counts(&mut self, name: String, values: &'m mut Vec<u32>);
    fn bytes(&mut self, name: String, values: &'m mut Vec<u8>);
}

fn visit_table<'m>(name: &str, table: &'m mut Table, content: Content, v: &mut impl Visitor<'m>) {
    v.floats(format!("{name}.values"), &mut table.values);
    v.counts(format!("{name}.steps"), &mut table.steps);
    if content == Content::Checkpoint {
        v.floats(format!("{name}.first"), &mut table.first);
        v.floats(format!("{name}.second"), &mut table.second);
    }
}

fn visit_part<'m>(name: &str, part: &'m mut Part, content: Content, v: &mut impl Visitor<'m>) {
    for (l, (lattice, table)) in part.field.levels.iter_mut().zip(&mut part.field.features).enumerate() {
        v.counts(format!("{name}.level{l}.slot"), &mut lattice.slot);
        visit_table(&format!("{name}.level{l}"), table, content, v);
    }
    visit_table(&format!("{name}.net"), &mut part.field.net, content, v);
    v.bytes(format!("{name}.occupied"), &mut part.occupancy.bits);
    if content == Content::Checkpoint {
        v.floats(format!("{name}.density"), &mut part.occupancy.density);
        v.floats(format!("{name}.weight"), &mut part.occupancy.weight);
    }
}

fn visit<'m>(model: &'m mut Brick, content: Content, v: &mut impl Visitor<'m>) {
    visit_part("head", &mut model.head, content, v);
    if let Some(part) = &mut model.background {
        visit_part("background", part, content, v);
    }
    let e = &mut model.expression;
    v.counts("expression.slot".to_owned(), &mut e.lattice.slot);
    v.bytes("expression.allowed".to_owned(), &mut e.allowed);
    for (n, slots) in e.slots_of.iter_mut().enumerate() {
        v.counts(format!("expression.region{n}"), slots);
    }
    for (k, table) in e.residuals.iter_mut().enumerate() {
        visit_table(&format!("expression.au{k}"), table, content, v);
    }
    visit_table("expression.masks", &mut e.masks, content, v);
    for (j, table) in model.latent_bases.iter_mut().enumerate() {
        visit_table(&format!("latent{j}"), table, content, v);
    }
    visit_table("codes", &mut model.codes, content, v);
    if content == Content::Checkpoint {
        visit_table("alphas", &mut model.alphas, content, v);
        visit_table("log_betas", &mut model.log_betas, content, v);
        visit_table("motions", &mut model.motions, content, v);
    }
}

/// An array on its way to a file.
enum Array<'m> {
    Floats(&'m [f32], [usize; 1]),
    Counts(&'m [u32], [usize; 1]),
    Bytes(&'m [u8], [usize; 1]),
}

impl safetensors::View for Array<'_> {
    fn dtype(&self) -> Dtype {
        match self {
            Self::Floats(..) => Dtype::F32,
            Self::Counts(..) => Dtype::U32,
            Self::Bytes(..) => Dtype::U8,
        }
    }

    fn shape(&self) -> &[usize] {
        let (Self::Floats(_, shape) | Self::Counts(_, shape) | Self::Bytes(_, shape)) = self;
        shape
    }

    fn data(&self) -> Cow<'_, [u8]> {
        match self {
            // The file is little-endian: there, what lies in memory is what goes to the disk, without a copy.
            Self::Floats(values, _) if cfg!(target_endian = "little") => Cow::Borrowed(bytemuck::cast_slice(values)),
            Self::Counts(values, _) if cfg!(target_endian = "little") => Cow::Borrowed(bytemuck::cast_slice(values)),
            Self::Floats(values, _) => values.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>().into(),
            Self::Counts(values, _) => values.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>().into(),
            Self::Bytes(values, _) => Cow::Borrowed(values),
        }
    }

    fn data_len(&self) -> usize {
        self.shape()[0] * if matches!(self, Self::Bytes(..)) { 1 } else { 4 }
    }
}

/// Gathers all arrays where they are.
#[derive(Default)]
struct Gather<'m>(Vec<(String, Array<'m>)>);

impl<'m> Visitor<'m> for Gather<'m> {
    fn floats(&mut self, name: String, values: &'m mut Vec<f32>) {
        self.0.push((name, Array::Floats(values, [values.len()])));
    }
    fn counts(&mut self, name: String, values: &'m mut Vec<u32>) {
        self.0.push((name, Array::Counts(values, [values.len()])));
    }
    fn bytes(&mut self, name: String, values: &'m mut Vec<u8>) {
        self.0.push((name, Array::Bytes(values, [values.len()])));
    }
}

/// Fills arrays from a file; the first problem is kept.
struct Fill<'a> {
    tensors: SafeTensors<'a>,
    problem: Option<String>,
}

impl Fill<'_> {
    fn take<T>(&mut self, name: &str, dtype: Dtype, convert: impl Fn(&[u8]) -> Vec<T>) -> Option<Vec<T>> {
        match self.tensors.tensor(name) {
            Ok(t) if t.dtype() == dtype => Some(convert(t.data())),
            Ok(t) => {
                self.problem.get_or_insert(format!("`{name}` holds {:?}, expected {dtype:?}", t.dtype()));
                None
            }
            Err(e) => {
                self.problem.get_or_insert(format!("`{name}`: {e}"));
                None
            }
        }
    }
}

impl<'m> Visitor<'m> for Fill<'_> {
    fn floats(&mut self, name: String, values: &'m mut Vec<f32>) {
        let convert = |b: &[u8]| b.as_chunks::<4>().0.iter().map(|c| f32::from_le_bytes(*c)).collect::<Vec<_>>();
        if let Some(read) = self.take(&name, Dtype::F32, convert) {
            if let Some(bad) = read.iter().find(|v| !v.is_finite()) {
                self.problem.get_or_insert(format!("`{name}` holds {bad}"));
            }
            *values = read;
        }
    }
    fn counts(&mut self, name: String, values: &'m mut Vec<u32>) {
        let convert = |b: &[u8]| b.as_chunks::<4>().0.iter().map(|c| u32::from_le_bytes(*c)).collect();
        if let Some(read) = self.take(&name, Dtype::U32, convert) {
            *values = read;
        }
    }
    fn bytes(&mut self, name: String, values: &'m mut Vec<u8>) {
        if let Some(read) = self.take(&name, Dtype::U8, <[u8]>::to_vec) {
            *values = read;
        }
    }
}

/// Writes a model's arrays, with the plate and other floats of the fit if there are some; one array after the other, so
/// that no copy of the whole is made. The model is only read.
pub fn write(
    path: &Path,
    model: &mut Brick,
    content: Content,
    plate: Option<&Plate>,
    more: &[(&str, &[f32])],
) -> Result<()> {
    let mut gather = Gather::default();
    visit(model, content, &mut gather);
    let Gather(mut arrays) = gather;
    // A fit that went wrong must not take the place of the checkpoint before it.
    for (name, array) in &arrays {
        if let Array::Floats(values, _) = array
            && let Some(bad) = values.iter().find(|v| !v.is_finite())
        {
            return Err(damaged(path, &format!("`{name}` holds {bad}: nothing is written")));
        }
    }
    if let Some(plate) = plate {
        arrays.push(("plate".to_owned(), Array::Bytes(&plate.rgb, [plate.rgb.len()])));
    }
    arrays.extend(more.iter().map(|(name, values)| ((*name).to_owned(), Array::Floats(values, [values.len()]))));
    let io = |e: std::io::Error| FormatError::io(path, "write", &e);
    // The crate writes a private file of its own beside ours first, which would stay behind a killed process.
    atomic::write_file_by(path, |staged| {
        safetensors::serialize_to_file(arrays, None, staged).map_err(|e| match e {
            safetensors::SafeTensorError::IoError(e) => io(e).into(),
            other => damaged(path, &other),
        })?;
        #[cfg(unix)]
        {
            use std::os::unix::fs::PermissionsExt as _;
            std::fs::set_permissions(staged, std::fs::Permissions::from_mode(0o644)).map_err(io)?;
        }
        Ok(())
    })
}

/// A model read back, with its plate and the other floats that were asked for.
pub struct Read {
    /// The model.
    pub model: Brick,
    /// The picture behind everything.
    pub plate: Option<Plate>,
    /// The other floats, in the order they were asked for.
    pub more: Vec<Vec<f32>>,
}

/// Reads what [`write()`] wrote.
pub fn read(path: &Path, saved: &SavedBrick, content: Content, more: &[&str]) -> Result<Read> {
    let bytes = std::fs::read(path).map_err(|e| FormatError::io(path, "read", &e))?;
    let tensors = SafeTensors::deserialize(&bytes).map_err(|e| damaged(path, &e))?;
    bounds::of_brick(saved, bytes.len()).map_err(|problem| damaged(path, &problem))?;
    let mut model = Brick::new(saved.layout.clone(), 0, |_| 0);
    let mut fill = Fill { tensors, problem: None };
    visit(&mut model, content, &mut fill);
    let plate = saved.plate.and_then(|[width, height]| {
        let mut rgb = Vec::new();
        fill.bytes("plate".to_owned(), &mut rgb);
        (rgb.len() == width as usize * height as usize * 3).then_some(Plate { width, height, rgb })
    });
    let more = more
        .iter()
        .map(|name| {
            let mut values = Vec::new();
            fill.floats((*name).to_owned(), &mut values);
            values
        })
        .collect();
    if let Some(problem) = fill.problem {
        return Err(damaged(path, &problem));
    }
    model.neutral_image = saved.neutral_image.min(saved.layout.images.saturating_sub(1));
    model.divisions = saved.divisions.max(1);
    model.planes = saved.planes.max(1);
    model.head.field.live = saved.live[0].min(model.head.field.levels.len());
    if let Some(part) = &mut model.background {
        part.field.live = saved.live[1].min(part.field.levels.len());
    }
    if let Err(problem) = settle(&mut model, content) {
        return Err(damaged(path, &problem));
    }
    Ok(Read { model, plate, more })
}

/// Makes lengths and counts agree with what was read, or says what does not: look-ups trust them.
fn settle(model: &mut Brick, content: Content) -> std::result::Result<(), String> {
    let fresh = content == Content::Avatar;
    let lattice = |name: &str, lattice: &mut Lattice, expected: usize| {
        if lattice.slot.len() != expected {
            return Err(format!("`{name}` has {} bricks, expected {expected}", lattice.slot.len()));
        }
        lattice.slots = lattice.slot.iter().max().map_or(0, |&m| m as usize + 1);
        if lattice.slots > expected + 1 {
            return Err(format!("`{name}` names brick {} of {expected}", lattice.slots - 1));
        }
        Ok(())
    };
    let table = |name: &str, table: &mut Table, blocks: usize| {
        let n = blocks * table.block;
        // Before anything is made at the size that a damaged lattice asks for.
        if table.values.len() != n {
            return Err(format!("`{name}` has {} numbers, expected {n}", table.values.len()));
        }
        if fresh {
            table.first = vec![0.0; n];
            table.second = vec![0.0; n];
            // An avatar is read whatever blocks it was fitted with.
            table.steps.resize(blocks, 1);
        }
        let lengths = [table.values.len(), table.first.len(), table.second.len()];
        if lengths != [n; 3] {
            return Err(format!("`{name}` has {} numbers, expected {n}", table.values.len()));
        }
        if table.steps.len() != blocks {
            return Err(format!(
                "`{name}` has {} blocks, expected {blocks}: another version wrote it",
                table.steps.len()
            ));
        }
        Ok(())
    };
    for (name, part) in [("head", Some(&mut model.head)), ("background", model.background.as_mut())] {
        let Some(part) = part else { continue };
        for (l, (level, features)) in part.field.levels.iter_mut().zip(&mut part.field.features).enumerate() {
            let expected = level.bricks().iter().product();
            lattice(&format!("{name}.level{l}.slot"), level, expected)?;
            table(&format!("{name}.level{l}"), features, level.slots * LAYERS)?;
        }
        table(&format!("{name}.net"), &mut part.field.net, 1)?;
        let cells = risorius_brick::occupancy::COUNT;
        let o = &mut part.occupancy;
        if o.bits.len() != cells || o.density.len() != cells || o.weight.len() != 8 * cells {
            return Err(format!("`{name}.occupied` has {} cells, expected {cells}", o.bits.len()));
        }
        o.refresh();
    }
    let e = &mut model.expression;
    let expected = e.lattice.bricks().iter().product();
    lattice("expression.slot", &mut e.lattice, expected)?;
    e.lattice.slots = e.lattice.slots.max(1);
    if e.allowed.len() != e.lattice.slots * BRICK {
        return Err(format!("`expression.allowed` has {} vertices", e.allowed.len()));
    }
    if e.slots_of.iter().flatten().any(|&s| s as usize >= e.lattice.slots) {
        return Err("a region names a brick that is not there".to_owned());
    }
    if e.slots_of.iter().any(|slots| !slots.is_sorted_by(|a, b| a < b)) {
        return Err("the bricks of a region are not in order".to_owned());
    }
    e.list_vertices();
    for (k, residual) in e.residuals.iter_mut().enumerate() {
        table(&format!("expression.au{k}"), residual, e.slots_of[e.region_of[k]].len())?;
    }
    let slots = e.lattice.slots;
    table("expression.masks", &mut e.masks, slots)?;
    for (j, basis) in model.latent_bases.iter_mut().enumerate() {
        table(&format!("latent{j}"), basis, model.latent_lattice.slots)?;
    }
    table("codes", &mut model.codes, model.layout.images)?;
    if !fresh {
        table("alphas", &mut model.alphas, model.layout.images)?;
        table("log_betas", &mut model.log_betas, model.layout.images)?;
        table("motions", &mut model.motions, model.layout.images)?;
    }
    Ok(())
}
