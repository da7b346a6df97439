//! Parquet and pictures: a row per frame, the dataset's tables, and a card that says what it is.

use std::collections::BTreeSet;
use std::path::Path;

use risorius_formats::nerfies::Dataset;
use risorius_formats::{Attribute, AttributeTable, Reporter, atomic};

use super::{attributes_of, card, copy, copy_images, image_name, make};
use crate::TAKE_OFFSET;
use crate::error::Result;
use crate::provenance::Provenance;
use crate::tables::{self, TABLES, camera_columns, column, write_table};

/// The file that makes a folder of this layout.
pub const FRAMES_FILE: &str = "frames.parquet";

/// Writes the layout into `out`.
pub(super) fn write(dataset: &Dataset, dir: &Path, out: &Path, reporter: &dyn Reporter) -> Result<()> {
    let scale = copy_images(dataset, dir, out, reporter)?;
    frames_table(dataset, dir, scale, &out.join(FRAMES_FILE))?;
    let provenance = Provenance::read(dir)?;
    copy_tables(dir, out, &provenance)?;
    let card = card::markdown(dataset, &provenance, scale);
    Ok(atomic::write_file(out.join("README.md"), card.as_bytes())?)
}

/// Copies the tables of the takes, as far as they are there.
pub(crate) fn copy_tables(dir: &Path, out: &Path, provenance: &Provenance) -> Result<()> {
    for table in TABLES {
        for take in &provenance.takes {
            let (from, to) =
                (tables::existing_table(dir, table, &take.name), tables::table_path(out, table, &take.name));
            if from == tables::table_path(dir, table, &take.name) && from.is_file() {
                to.parent().map_or(Ok(()), make)?;
                copy(&from, &to)?;
            } else if from.is_file() {
                tables::copy_table(&from, &to, &[("take", &take.name)])?;
            }
        }
    }
    Ok(())
}

/// A row per frame. `AUxx_attribute` is −1..1; `AUxx_intensity` is its inverse by eq. 1, 0–5, which tops out at 0.8 of
/// the capture's largest value; null where the AU is inactive or the folder has no `attributes.toml`.
fn frames_table(dataset: &Dataset, dir: &Path, scale: u32, path: &Path) -> Result<()> {
    let table = if dir.join("attributes.toml").exists() {
        Some(AttributeTable::read(dir.join("attributes.toml"))?)
    } else {
        None
    };
    let values = attributes_of(dataset);
    let ids = &dataset.ids;
    let val: BTreeSet<_> = dataset.val_ids.iter().collect();
    let train: BTreeSet<_> = dataset.train_ids.iter().collect();
    let split = |id: &String| {
        if val.contains(id) {
            "val"
        } else if train.contains(id) {
            "train"
        } else {
            "none"
        }
    };
    let takes = dataset.extras.as_ref().map(|e| e.takes.clone()).unwrap_or_default();
    let number = |id: &String| dataset.source_frame(id);
    let take_of = |id: &String| -> Option<String> {
        let index = if takes.len() > 1 { number(id)? / TAKE_OFFSET } else { 0 };
        takes.get(index as usize).cloned()
    };
    let frame_of = |id: &String| number(id).map(|n| if takes.len() > 1 { n % TAKE_OFFSET } else { n });
    let mut columns = vec![
        column("id", ids.clone()),
        column("take", ids.iter().map(take_of).collect::<Vec<_>>()),
        column("frame", ids.iter().map(frame_of).collect::<Vec<_>>()),
        column("split", ids.iter().map(split).collect::<Vec<_>>()),
    ];
    let without: BTreeSet<_> = dataset.extras.iter().flat_map(|e| &e.ids_without_masks).collect();
    columns.push(column("has_masks", ids.iter().map(|id| !without.contains(id)).collect::<Vec<_>>()));
    for (class, name) in dataset.mapping.iter().enumerate() {
        let value =
            |id: &String| id.parse().ok().and_then(|n: u32| values.get(&n)).and_then(|v| v.get(&class)).copied();
        let spec = table.as_ref().and_then(|t| t.attributes.get(class)).filter(|s| s.active);
        columns.push(column(&format!("{name}_attribute"), ids.iter().map(value).collect::<Vec<_>>()));
        let intensity = |id| Some(spec?.scale().intensity(Attribute(value(id)?)).0);
        columns.push(column(&format!("{name}_intensity"), ids.iter().map(intensity).collect::<Vec<_>>()));
    }
    columns.push(column("image", ids.iter().map(|id| image_name(id)).collect::<Vec<_>>()));
    columns.push(column("image_scale", vec![scale; ids.len()]));
    columns.extend(camera_columns(&ids.iter().map(|id| &dataset.cameras[id]).collect::<Vec<_>>()));
    write_table(path, columns)
}
