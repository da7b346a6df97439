//! `tables/`: every frame, AU and pose of a dataset as Parquet, a folder per take, so that polars, DuckDB or pandas read
//! one dataset or a whole collection without this program:
//!
//! ```text
//! DIR/tables/frames/take_dir=take-NAME/frames.parquet    all frames: state, quality, id and split where chosen
//! DIR/tables/aus/take_dir=take-NAME/aus.parquet          trusted frames: AUxx_intensity (0–5, smoothed), AUxx_attribute
//! DIR/tables/poses/take_dir=take-NAME/poses.parquet      posed frames: lens, camera_from_world, yaw and pitch
//! ```
//!
//! The column `take` in every file is the take's name, as text. The folders are Hive partitions whose values no reader takes
//! for numbers or dates: of `take=001` polars and pandas make the number 1. Names are percent-encoded.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use polars::prelude::{Column, DataFrame, NamedFrom, ParquetCompression, ParquetWriter, Series};
use risorius_formats::intensities::Intensities;
use risorius_formats::{AttributeTable, Camera, ErrorKind, FormatError, Intensity, atomic};

use crate::error::{DatasetError, Result};
use crate::provenance::Provenance;
use crate::rows::{FrameRow, FrameState, Rows, TakeRows};
use crate::table_file::TableFile;

/// The three tables.
pub const TABLES: [&str; 3] = ["frames", "aus", "poses"];

/// The file of `table` for a take of the dataset in `dir`.
pub fn table_path(dir: &Path, table: &str, take: &str) -> PathBuf {
    dir.join("tables").join(table).join(partition("take", take)).join(format!("{table}.parquet"))
}

/// The file of `table` to read: datasets of version 0.1 have it in `take=NAME`.
pub(crate) fn existing_table(dir: &Path, table: &str, take: &str) -> PathBuf {
    let path = table_path(dir, table, take);
    let older = dir.join("tables").join(table).join(format!("take={}", encoded(take))).join(format!("{table}.parquet"));
    if !path.is_file() && older.is_file() { older } else { path }
}

/// The folder of a Hive partition that holds what belongs to one `kind` (take, subject), `name`.
pub(crate) fn partition(kind: &str, name: &str) -> String {
    format!("{kind}_dir={kind}-{}", encoded(name))
}

/// Writes the table in `from` to `to`, with the columns `names` of one text each in front.
pub(crate) fn copy_table(from: &Path, to: &Path, names: &[(&str, &str)]) -> Result<()> {
    write_table(to, TableFile::open(from)?.with_texts(names))
}

/// A name as a folder of a Hive partition: everything but letters, digits, `.`, `_` and `-` as `%XX`.
pub(crate) fn encoded(name: &str) -> String {
    let plain = |b: u8| b.is_ascii_alphanumeric() || matches!(b, b'.' | b'_' | b'-');
    name.bytes().map(|b| if plain(b) { char::from(b).to_string() } else { format!("%{b:02X}") }).collect()
}

/// Writes the tables of all takes into the dataset's folder `dir`.
pub fn write(dir: &Path, rows: &Rows) -> Result<()> {
    for take in &rows.takes {
        write_table(&table_path(dir, "frames", &take.name), frames_table(take))?;
        write_table(&table_path(dir, "aus", &take.name), aus_table(take, &rows.table))?;
        write_table(&table_path(dir, "poses", &take.name), poses_table(take))?;
    }
    Ok(())
}

/// The smoothed intensities of the chosen frames.
pub(crate) fn intensities_of(rows: &Rows) -> Intensities {
    let chosen = rows.takes.iter().flat_map(|t| &t.frames);
    Intensities {
        units: rows.table.attributes.iter().map(|a| a.unit).collect(),
        rows: chosen.filter_map(|f| Some((f.id.clone()?, f.intensities.clone()?))).collect(),
    }
}

/// Writes `columns`, whole or not at all.
pub(crate) fn write_table(path: &Path, columns: Vec<Column>) -> Result<()> {
    let encode = |e: polars::error::PolarsError| DatasetError::encode(path, &e);
    let mut frame = DataFrame::new_infer_height(columns).map_err(encode)?;
    let mut bytes = Vec::new();
    let writer = ParquetWriter::new(&mut bytes).with_compression(ParquetCompression::Snappy);
    writer.finish(&mut frame).map_err(encode)?;
    Ok(atomic::write_file(path, &bytes)?)
}

/// A named column.
pub(crate) fn column<T, P: ?Sized>(name: &str, values: T) -> Column
where
    Series: NamedFrom<T, P>,
{
    let series: Series = NamedFrom::new(name.into(), values);
    series.into()
}

/// The take's name in every row.
fn take_column(take: &TakeRows, rows: usize) -> Column {
    column("take", vec![take.name.as_str(); rows])
}

fn frames_table(take: &TakeRows) -> Vec<Column> {
    let f = &take.frames;
    vec![
        take_column(take, f.len()),
        column("frame", f.iter().map(|r| r.frame).collect::<Vec<_>>()),
        column("timestamp_nanos", f.iter().map(|r| r.timestamp_nanos).collect::<Vec<_>>()),
        column("state", f.iter().map(|r| r.state.name()).collect::<Vec<_>>()),
        column("confidence", f.iter().map(|r| r.confidence).collect::<Vec<_>>()),
        column("sharpness", f.iter().map(|r| r.sharpness).collect::<Vec<_>>()),
        column("luma_mean", f.iter().map(|r| r.luma_mean).collect::<Vec<_>>()),
        column("clipped_share", f.iter().map(|r| r.clipped_share).collect::<Vec<_>>()),
        column("id", f.iter().map(|r| r.id.clone()).collect::<Vec<_>>()),
        column("split", f.iter().map(|r| r.split).collect::<Vec<_>>()),
        column("masks", f.iter().map(|r| r.masks.clone()).collect::<Vec<_>>()),
    ]
}

fn aus_table(take: &TakeRows, table: &AttributeTable) -> Vec<Column> {
    let trusted: Vec<(&FrameRow, &[f32])> =
        take.frames.iter().filter_map(|f| Some((f, f.intensities.as_deref()?))).collect();
    let mut columns = vec![
        take_column(take, trusted.len()),
        column("frame", trusted.iter().map(|t| t.0.frame).collect::<Vec<_>>()),
        column("id", trusted.iter().map(|t| t.0.id.clone()).collect::<Vec<_>>()),
    ];
    for (k, spec) in table.attributes.iter().enumerate() {
        let intensities: Vec<f32> = trusted.iter().map(|t| t.1[k]).collect();
        let attributes: Vec<f32> = intensities.iter().map(|&v| spec.scale().attribute(Intensity(v)).0).collect();
        columns.push(column(&format!("{}_intensity", spec.unit), intensities));
        columns.push(column(&format!("{}_attribute", spec.unit), attributes));
    }
    columns
}

/// A number of a camera.
type OfCamera = fn(&Camera) -> f64;

/// The numbers of a camera in the tables: lens in pixels of the full-size picture, then `camera_from_world`.
pub(crate) const CAMERA_COLUMNS: [(&str, OfCamera); 17] = [
    ("fx", |c| c.intrinsics.fx),
    ("fy", |c| c.intrinsics.fy),
    ("cx", |c| c.intrinsics.cx),
    ("cy", |c| c.intrinsics.cy),
    ("skew", |c| c.intrinsics.skew),
    ("k1", |c| c.intrinsics.distortion.radial[0]),
    ("k2", |c| c.intrinsics.distortion.radial[1]),
    ("k3", |c| c.intrinsics.distortion.radial[2]),
    ("p1", |c| c.intrinsics.distortion.tangential[0]),
    ("p2", |c| c.intrinsics.distortion.tangential[1]),
    ("camera_from_world_qw", |c| c.camera_from_world.to_wxyz()[0]),
    ("camera_from_world_qx", |c| c.camera_from_world.to_wxyz()[1]),
    ("camera_from_world_qy", |c| c.camera_from_world.to_wxyz()[2]),
    ("camera_from_world_qz", |c| c.camera_from_world.to_wxyz()[3]),
    ("camera_from_world_tx", |c| c.camera_from_world.translation.x),
    ("camera_from_world_ty", |c| c.camera_from_world.translation.y),
    ("camera_from_world_tz", |c| c.camera_from_world.translation.z),
];

/// The columns of `cameras`.
pub(crate) fn camera_columns(cameras: &[&Camera]) -> Vec<Column> {
    let mut columns = vec![
        column("width", cameras.iter().map(|c| c.intrinsics.width).collect::<Vec<_>>()),
        column("height", cameras.iter().map(|c| c.intrinsics.height).collect::<Vec<_>>()),
    ];
    for (name, number) in CAMERA_COLUMNS {
        columns.push(column(name, cameras.iter().map(|c| number(c)).collect::<Vec<_>>()));
    }
    let center = |axis: usize| cameras.iter().map(|c| c.center().to_array()[axis]).collect::<Vec<f64>>();
    columns
        .extend(["x", "y", "z"].into_iter().zip(0..).map(|(n, k)| column(&format!("center_in_world_{n}"), center(k))));
    columns
}

fn poses_table(take: &TakeRows) -> Vec<Column> {
    let posed: Vec<(&FrameRow, &Camera)> = take.frames.iter().filter_map(|f| Some((f, f.camera.as_ref()?))).collect();
    let angle = |axis: usize| posed.iter().map(|p| p.0.view.map(|v| v[axis])).collect::<Vec<Option<f64>>>();
    let mut columns = vec![
        take_column(take, posed.len()),
        column("frame", posed.iter().map(|p| p.0.frame).collect::<Vec<_>>()),
        column("id", posed.iter().map(|p| p.0.id.clone()).collect::<Vec<_>>()),
        column("yaw_deg", angle(0)),
        column("pitch_deg", angle(1)),
        column("interpolated", posed.iter().map(|p| p.0.interpolated).collect::<Vec<_>>()),
    ];
    columns.extend(camera_columns(&posed.iter().map(|p| p.1).collect::<Vec<_>>()));
    columns
}

/// Reads the tables of the dataset in `dir`, whose takes `takes.toml` names.
pub fn read(dir: &Path) -> Result<Rows> {
    let table = AttributeTable::read(dir.join("attributes.toml"))?;
    let names: Vec<String> = Provenance::read(dir)?.takes.into_iter().map(|t| t.name).collect();
    if names.is_empty() {
        return Err(FormatError::new(ErrorKind::Missing, "names no takes")
            .in_file(dir.join(crate::provenance::TAKES_FILE))
            .with_hint("the dataset is older than its tables; build it again with `dataset build`")
            .into());
    }
    read_takes(dir, &table, names)
}

/// Reads the tables below `dir` of the takes `names`.
pub(crate) fn read_takes(dir: &Path, table: &AttributeTable, names: Vec<String>) -> Result<Rows> {
    let takes = names.into_iter().map(|name| read_take(dir, name, table)).collect::<Result<_>>()?;
    Ok(Rows { table: table.clone(), takes })
}

fn read_take(dir: &Path, name: String, table: &AttributeTable) -> Result<TakeRows> {
    let file = TableFile::open(&existing_table(dir, "frames", &name))?;
    let frames = file.u32s("frame")?;
    let times = file.i64s("timestamp_nanos")?;
    let (states, ids, splits, masks) =
        (file.texts("state")?, file.texts("id")?, file.texts("split")?, file.texts("masks")?);
    let confidences = file.f32s("confidence")?;
    let (sharpness, luma, clipped) = (file.f32s("sharpness")?, file.f32s("luma_mean")?, file.f32s("clipped_share")?);
    let mut rows = Vec::with_capacity(frames.len());
    let mut place_of = BTreeMap::new();
    for i in 0..file.height() {
        let state = states[i].as_deref().and_then(FrameState::from_name);
        let (Some(frame), Some(timestamp_nanos), Some(state)) = (frames[i], times[i], state) else {
            return Err(file.bad(format!("row {}: `frame`, `timestamp_nanos` or `state` makes no sense", i + 1)));
        };
        if place_of.insert(frame, i).is_some() {
            return Err(file.bad(format!("row {}: frame {frame} stands there twice", i + 1)));
        }
        rows.push(FrameRow {
            frame,
            timestamp_nanos,
            state,
            confidence: confidences[i],
            sharpness: sharpness[i],
            luma_mean: luma[i],
            clipped_share: clipped[i],
            id: ids[i].clone(),
            split: splits[i].as_deref().map(known_split),
            masks: masks[i].clone(),
            intensities: None,
            camera: None,
            view: None,
            interpolated: false,
        });
    }
    let place = |file: &TableFile, frame: Option<u32>| {
        frame
            .and_then(|f| place_of.get(&f).copied())
            .ok_or_else(|| file.bad("has a frame that the table of frames lacks"))
    };

    let file = TableFile::open(&existing_table(dir, "aus", &name))?;
    let columns: Vec<Vec<Option<f32>>> =
        table.attributes.iter().map(|a| file.f32s(&format!("{}_intensity", a.unit))).collect::<Result<_>>()?;
    for (i, frame) in file.u32s("frame")?.into_iter().enumerate() {
        let row = place(&file, frame)?;
        let values: Option<Vec<f32>> = columns.iter().map(|c| c[i].filter(|v| v.is_finite())).collect();
        rows[row].intensities = Some(values.ok_or_else(|| file.bad(format!("row {}: an AU is no number", i + 1)))?);
    }

    let file = TableFile::open(&existing_table(dir, "poses", &name))?;
    let (yaws, pitches, interpolated) = (file.f64s("yaw_deg")?, file.f64s("pitch_deg")?, file.bools("interpolated")?);
    let cameras = file.cameras()?;
    for (i, frame) in file.u32s("frame")?.into_iter().enumerate() {
        let row = place(&file, frame)?;
        rows[row].camera = Some(cameras[i]);
        rows[row].view = yaws[i].zip(pitches[i]).map(|(y, p)| [y, p]);
        rows[row].interpolated = interpolated[i].unwrap_or(false);
    }
    let bad = rows.iter().find(|r| r.state == FrameState::Usable && (r.intensities.is_none() || r.camera.is_none()));
    if let Some(row) = bad {
        return Err(file.bad(format!("frame {} is usable, but its AUs or its camera are missing", row.frame)));
    }
    Ok(TakeRows { name, frames: rows })
}

fn known_split(name: &str) -> &'static str {
    ["train", "val"].into_iter().find(|s| *s == name).unwrap_or("none")
}

#[cfg(test)]
mod tests {
    use glam::DVec3;
    use risorius_formats::{ActionUnit, AttributeSpec, Intrinsics, Isometry};

    use super::*;

    #[test]
    fn rows_come_back_as_written() {
        let dir = tempfile::tempdir().unwrap();
        let table = AttributeTable {
            regions: vec!["mouth".to_owned()],
            attributes: vec![AttributeSpec::from_range(ActionUnit(12), 0, 0.0, 4.0, 0.2)],
        };
        let row = |frame: u32, state| FrameRow {
            frame,
            timestamp_nanos: i64::from(frame) * 8_333_333,
            state,
            confidence: Some(0.9),
            sharpness: None,
            luma_mean: Some(120.0),
            clipped_share: None,
            id: None,
            split: None,
            masks: None,
            intensities: None,
            camera: None,
            view: None,
            interpolated: false,
        };
        let mut usable = row(1, FrameState::Usable);
        usable.id = Some("000001".to_owned());
        usable.split = Some("val");
        usable.masks = Some("ok".to_owned());
        usable.intensities = Some(vec![1.25]);
        let pose = Isometry::from_wxyz([0.9, 0.1, -0.3, 0.2], DVec3::new(0.3, -0.2, 4.0));
        usable.camera = Some(Camera { intrinsics: Intrinsics::pinhole(64, 48, 50.0), camera_from_world: pose });
        usable.view = Some([12.5, -3.0]);
        let takes = vec![TakeRows { name: "a take=1".to_owned(), frames: vec![row(0, FrameState::Lost), usable] }];
        let rows = Rows { table: table.clone(), takes };
        write(dir.path(), &rows).unwrap();
        table.write(dir.path().join("attributes.toml")).unwrap();
        let entry = crate::provenance::TakeEntry { name: "a take=1".to_owned(), ..Default::default() };
        Provenance { takes: vec![entry] }.write(dir.path()).unwrap();
        assert!(dir.path().join("tables/aus/take_dir=take-a%20take%3D1/aus.parquet").is_file());

        let names = TableFile::open(&table_path(dir.path(), "frames", "a take=1")).unwrap().texts("take").unwrap();
        assert_eq!(names, vec![Some("a take=1".to_owned()); 2]);

        let mut back = read(dir.path()).unwrap();
        let camera = back.takes[0].frames[1].camera.unwrap();
        let original = rows.takes[0].frames[1].camera.unwrap();
        assert_eq!(camera.intrinsics, original.intrinsics);
        assert!((camera.center() - original.center()).length() < 1e-12);
        back.takes[0].frames[1].camera = Some(original);
        assert_eq!(back, rows);

        // Datasets of version 0.1 are read as well.
        for table in TABLES {
            let folder = dir.path().join("tables").join(table);
            std::fs::rename(folder.join("take_dir=take-a%20take%3D1"), folder.join("take=a%20take%3D1")).unwrap();
        }
        assert_eq!(read(dir.path()).unwrap().takes[0].frames.len(), 2);

        std::fs::create_dir_all(table_path(dir.path(), "aus", "a take=1").parent().unwrap()).unwrap();
        std::fs::write(table_path(dir.path(), "aus", "a take=1"), b"PAR1").unwrap();
        let error = read(dir.path()).unwrap_err().to_string();
        assert!(error.contains("aus.parquet: is not a Parquet table"), "{error}");
    }
}
