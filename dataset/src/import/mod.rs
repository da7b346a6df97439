//! `dataset import`: datasets of other programs, and our own exports, as a dataset.
//!
//! An export of ours has a folder `risorius/` with what its layout cannot express; imported again it is the dataset that
//! it was made from. Where somebody moved a camera in the layout's own files, theirs counts. A folder of CoNeRF or
//! CoNFies has attributes that people annotated: its class names become AUs, by their names or by `--au`. Other folders
//! have no attributes, and there is nothing to steer: they are refused.

mod foreign;
mod layout;
mod transforms;

use std::collections::BTreeMap;
use std::path::Path;

use glam::DVec3;
use risorius_formats::atomic::{self, AtomicDir};
use risorius_formats::head_hull::world_from_head;
use risorius_formats::intensities;
use risorius_formats::nerfies::{self, Dataset};
use risorius_formats::pose_report::PoseMethod;
use risorius_formats::{ActionUnit, Attribute, AttributeTable, ErrorKind, FormatError, Isometry, Reporter, package};

use crate::build::DATASET_FILE;
use crate::error::{DatasetError, Result};
use crate::export::{SIDECAR_DIR, copy, copy_tables, is_within, make};
use crate::options::{BuildOptions, Sampling};
use crate::provenance::{Provenance, TakeEntry};
use crate::rows::{FrameRow, FrameState, Rows, TakeRows};
use crate::signals::TrackCounts;
use crate::split::SplitKind;
use crate::stats::{self, Report, TakeReport};
use crate::verify::verify;
use crate::{TAKE_OFFSET, redact, report, sheet, tables, views};

pub use layout::{Layout, layout_of};
pub(crate) use layout::{cameras as layout_cameras, id_of};
pub(crate) use transforms::{Transforms, read_transforms};

/// How to import.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct ImportOptions {
    /// Which AU a class of the folder stands for, where its name does not say so.
    pub units: BTreeMap<String, ActionUnit>,
    /// Whether the folder `risorius/` is passed by, as another program would.
    pub ignore_sidecar: bool,
}

/// What an import brings together before anything is written.
pub(crate) struct Imported {
    pub(crate) dataset: Dataset,
    pub(crate) table: AttributeTable,
    pub(crate) provenance: Provenance,
    /// Outlines by id, with AUs for labels.
    pub(crate) polygons: BTreeMap<String, nerfies::Polygons>,
    /// All recorded frames, where the folder has tables, and the folder: the tables can be copied as they are.
    pub(crate) rows: Option<(Rows, std::path::PathBuf)>,
    /// What it was built with, where the folder tells.
    pub(crate) options: Option<BuildOptions>,
    /// Camera files that can be copied as they are.
    pub(crate) cameras: BTreeMap<String, std::path::PathBuf>,
    /// The folder with masks that can be copied as they are.
    pub(crate) masks: Option<std::path::PathBuf>,
}

/// Imports the folder `from` as a dataset in the folder `out`, whole or not at all.
pub fn import(from: &Path, out: &Path, options: &ImportOptions, reporter: &dyn Reporter) -> Result<Report> {
    let layout = layout_of(from)?;
    if is_within(out, from) {
        return Err(DatasetError::Option {
            message: format!("{}: lies in the folder that is imported, or is it", out.display()),
            hint: "import to a folder of its own".to_owned(),
        });
    }
    atomic::check_replaceable(out, "a dataset", &[DATASET_FILE])?;
    reporter.stage("read the folder", None);
    let sidecar = Some(from.join(SIDECAR_DIR)).filter(|d| !options.ignore_sidecar && d.join(DATASET_FILE).is_file());
    let imported = match &sidecar {
        Some(sidecar) => own(from, layout, sidecar)?,
        None => foreign::read(from, layout, options, reporter)?,
    };
    let pictures = layout::pictures(from, layout, &imported.dataset)?;
    check_files(from, &imported, &pictures)?;
    let staging = AtomicDir::create(out)?;
    let report = write(&imported, &pictures, staging.path(), reporter)?;
    if reporter.cancelled() {
        return Err(DatasetError::Cancelled);
    }
    check_result(from, staging.path(), reporter)?;
    staging.commit()?;
    Ok(report)
}

/// Fails where what was written is no dataset that a fit could open.
fn check_result(from: &Path, staging: &Path, reporter: &dyn Reporter) -> Result<()> {
    let verdict = verify(staging, reporter);
    let Some(first) = verdict.problems.first() else { return Ok(()) };
    let path = first.path.strip_prefix(staging).unwrap_or(&first.path).display();
    Err(DatasetError::Unverified {
        folder: from.to_owned(),
        problems: verdict.problems.len(),
        first: format!("{path}: {}", first.message),
    })
}

/// Fails where a file that would be copied leads out of the folder: what it links to was never given.
fn check_files(from: &Path, imported: &Imported, pictures: &[Picture]) -> Result<()> {
    for (path, scale, id) in pictures {
        package::check_file(from, path)?;
        if let Some(masks) = &imported.masks {
            for path in [nerfies::region_path, nerfies::valid_path, nerfies::head_path] {
                package::check_file(from, path(masks, *scale, id))?;
            }
        }
    }
    imported.cameras.values().try_for_each(|path| package::check_file(from, path))?;
    Ok(())
}

/// An export of ours.
fn own(from: &Path, layout: Layout, sidecar: &Path) -> Result<Imported> {
    let mut dataset = Dataset::read(sidecar)?;
    let table = AttributeTable::read(sidecar.join("attributes.toml"))?;
    let before = dataset.cameras.clone();
    layout::take_cameras(from, layout, &mut dataset)?;
    let folder = if layout == Layout::Nerfies { from } else { sidecar };
    let kept = |id: &&String| layout == Layout::Nerfies || dataset.cameras[*id] == before[*id];
    let cameras = dataset.ids.iter().filter(kept).map(|id| (id.clone(), nerfies::camera_path(folder, id))).collect();
    let mut polygons = BTreeMap::new();
    for id in &dataset.ids {
        let path = nerfies::polygons_path(sidecar, id);
        if path.is_file() {
            polygons.insert(id.clone(), nerfies::Polygons::read(&path)?);
        }
    }
    let provenance = Provenance::read(sidecar)?;
    let rows = own_rows(from, &dataset, &table, &provenance)?.map(|rows| (rows, from.to_owned()));
    let has_settings = sidecar.join("report").join("settings.toml").is_file();
    let options = if has_settings { Some(redact::settings(sidecar)?) } else { None };
    Ok(Imported { dataset, table, provenance, polygons, rows, options, cameras, masks: Some(sidecar.to_owned()) })
}

/// The tables of an export, as far as they are those of the dataset.
fn own_rows(from: &Path, dataset: &Dataset, table: &AttributeTable, provenance: &Provenance) -> Result<Option<Rows>> {
    let names: Vec<String> = provenance.takes.iter().map(|t| t.name.clone()).collect();
    if names.is_empty() || !tables::existing_table(from, "frames", &names[0]).is_file() {
        return Ok(None);
    }
    let rows = tables::read_takes(from, table, names)?;
    let mut ids: Vec<&String> = rows.takes.iter().flat_map(|t| &t.frames).filter_map(|f| f.id.as_ref()).collect();
    ids.sort_unstable();
    Ok(ids.into_iter().eq(&dataset.ids).then_some(rows))
}

/// A picture to copy: from where, its scale, its id.
pub(crate) type Picture = (std::path::PathBuf, u32, String);

fn write(imported: &Imported, pictures: &[Picture], dir: &Path, reporter: &dyn Reporter) -> Result<Report> {
    let Imported { dataset, table, provenance, polygons, cameras, masks, .. } = imported;
    reporter.stage("copy pictures", Some(pictures.len() as u64));
    let styles = foreign::paint_order(table, polygons);
    for (from, scale, id) in pictures {
        let to = nerfies::rgb_path(dir, *scale, id);
        to.parent().map_or(Ok(()), make)?;
        copy(from, &to)?;
        let mut has_regions = false;
        if let Some(masks) = masks {
            for path in [nerfies::region_path, nerfies::valid_path, nerfies::head_path] {
                let (from, to) = (path(masks.as_path(), *scale, id), path(dir, *scale, id));
                if from.is_file() {
                    to.parent().map_or(Ok(()), make)?;
                    copy(&from, &to)?;
                    has_regions |= to == nerfies::region_path(dir, *scale, id);
                }
            }
        }
        if let Some(outlines) = polygons.get(id).filter(|_| !has_regions) {
            let size = dataset.cameras[id].reduced(*scale).intrinsics;
            let paint: Vec<(&str, u8)> = styles.iter().map(|(l, v)| (l.as_str(), *v)).collect();
            outlines
                .label_image(&paint, *scale, size.width, size.height)
                .write_png(nerfies::region_path(dir, *scale, id))?;
        }
        reporter.advance(1);
    }
    for (id, outlines) in polygons {
        outlines.write(nerfies::polygons_path(dir, id))?;
    }
    dataset.write(dir)?;
    for (id, path) in cameras {
        copy(path, &nerfies::camera_path(dir, id))?;
    }
    table.write(dir.join("attributes.toml"))?;
    if let Some(from) = masks.as_ref().map(intensities::path).filter(|p| p.is_file()) {
        copy(&from, &intensities::path(dir))?;
    }
    let provenance = if provenance.takes.is_empty() { unnamed(dataset) } else { provenance.clone() };
    provenance.write(dir)?;
    let rows = if let Some((rows, folder)) = &imported.rows {
        copy_tables(folder, dir, &provenance)?;
        rows.clone()
    } else {
        let rows = rows_of(dataset, table, &provenance, polygons);
        tables::write(dir, &rows)?;
        rows
    };
    let scale = dataset.extras.as_ref().map_or(4, |e| e.default_scale);
    let scales: Vec<u32> = crate::export::scales_in(dir);
    let unknown = BuildOptions {
        sampling: Sampling::Uniform,
        frames: dataset.ids.len(),
        scale,
        scales: scales.clone(),
        split: SplitKind::Periodic,
        no_val: dataset.val_ids.is_empty(),
        regions: table.region_table(),
        ..BuildOptions::default()
    };
    let options = imported.options.clone().map_or(unknown, |options| BuildOptions { scales, ..options });
    let about = provenance.takes.iter().zip(&rows.takes).map(|(entry, rows)| about(entry, rows, dataset)).collect();
    let report = stats::collect(&rows, about, &options);
    report::write(dir, &rows, &report, &options, &sheet::thumbnails(dir, dataset, &rows)?)?;
    Ok(report)
}

/// A dataset without word of its takes is one take.
fn unnamed(dataset: &Dataset) -> Provenance {
    let names = dataset.extras.as_ref().map(|e| e.takes.clone()).filter(|t| !t.is_empty());
    let entry = |(number, name): (usize, String)| TakeEntry { name, number, ..TakeEntry::default() };
    Provenance {
        takes: names.unwrap_or_else(|| vec!["imported".to_owned()]).into_iter().enumerate().map(entry).collect(),
    }
}

fn about(entry: &TakeEntry, rows: &TakeRows, dataset: &Dataset) -> TakeReport {
    let count = |state: FrameState| rows.frames.iter().filter(|f| f.state == state).count() as u32;
    TakeReport {
        name: entry.name.clone(),
        fps: entry.fps,
        counts: TrackCounts {
            frames: rows.frames.len() as u32,
            valid: rows.frames.iter().filter(|f| f.intensities.is_some()).count() as u32,
            lost: count(FrameState::Lost),
            low_confidence: count(FrameState::Unsure),
            incomplete: count(FrameState::Incomplete),
            ..TrackCounts::default()
        },
        smoothing_window: 0,
        posed: rows.frames.iter().filter(|f| f.camera.is_some()).count(),
        pose_method: dataset.extras.as_ref().map_or(PoseMethod::ColmapModel, |e| e.method),
        reprojection_error_px: None,
    }
}

/// The take and the frame of an id: ids of several takes are numbered through.
pub(crate) fn take_and_frame(dataset: &Dataset, id: &str) -> (usize, u32) {
    let number = dataset.source_frame(id).unwrap_or(0);
    let takes = dataset.extras.as_ref().map_or(1, |e| e.takes.len());
    if takes > 1 { ((number / TAKE_OFFSET) as usize, number % TAKE_OFFSET) } else { (0, number) }
}

/// The frames of a dataset as rows; frames that were not chosen are unknown.
fn rows_of(
    dataset: &Dataset,
    table: &AttributeTable,
    provenance: &Provenance,
    polygons: &BTreeMap<String, nerfies::Polygons>,
) -> Rows {
    let values = crate::export::attributes_of(dataset);
    let axes = head_axes(dataset);
    let take_rows = |entry: &TakeEntry| {
        let mut frames: Vec<FrameRow> = Vec::new();
        let own =
            dataset.ids.iter().map(|id| (id, take_and_frame(dataset, id))).filter(|(_, (t, _))| *t == entry.number);
        for (id, (_, frame)) in own {
            let number: Option<u32> = id.parse().ok();
            let given = number.and_then(|n| values.get(&n));
            // A class that is not listed for an annotated frame counts as its resting value, as in the original.
            let intensity = |(k, spec): (usize, &risorius_formats::AttributeSpec)| {
                let value = given.and_then(|g| g.get(&k)).copied();
                value.map_or(spec.neutral, |v| spec.scale().intensity(Attribute(v)).0)
            };
            let intensities = given.map(|_| table.attributes.iter().enumerate().map(intensity).collect());
            let split = if dataset.val_ids.contains(id) {
                "val"
            } else if dataset.train_ids.contains(id) {
                "train"
            } else {
                "none"
            };
            let camera = dataset.cameras.get(id).copied();
            frames.push(FrameRow {
                frame,
                timestamp_nanos: if entry.fps > 0.0 {
                    (f64::from(frame) / entry.fps * 1e9) as i64
                } else {
                    i64::from(frame) * 1_000_000_000
                },
                state: if given.is_some() { FrameState::Usable } else { FrameState::Incomplete },
                confidence: None,
                sharpness: None,
                luma_mean: None,
                clipped_share: None,
                id: Some(id.clone()),
                split: Some(split),
                masks: Some(if polygons.contains_key(id) { "ok" } else { "no-landmarks" }.to_owned()),
                intensities,
                camera,
                view: camera.as_ref().and_then(|c| views::direction(c, &axes)).map(views::yaw_pitch_deg),
                interpolated: false,
            });
        }
        frames.sort_by_key(|f| f.frame);
        frames.dedup_by_key(|f| f.frame);
        TakeRows { name: entry.name.clone(), frames }
    };
    Rows { table: table.clone(), takes: provenance.takes.iter().map(take_rows).collect() }
}

/// The head's axes as far as a package tells: those of the mean camera.
fn head_axes(dataset: &Dataset) -> Isometry {
    let center = dataset.extras.as_ref().map_or(dataset.scene.center_in_world, |e| e.head_center);
    if let Some(axes) = dataset.extras.as_ref().and_then(|e| e.head_hull_in_world.as_ref()).and_then(|h| {
        // The head route's hull begins with the face.
        h.get(..68).and_then(world_from_head)
    }) {
        return axes;
    }
    let mut sums = [DVec3::ZERO; 2];
    for camera in dataset.cameras.values() {
        let r = camera.camera_from_world.rotation;
        sums[0] += r.row(0);
        sums[1] += r.row(1);
    }
    let x = sums[0].normalize_or(DVec3::X);
    let y = (sums[1] - x * sums[1].dot(x)).normalize_or(x.any_orthonormal_vector());
    Isometry::new(glam::DMat3::from_cols(x, y, x.cross(y)), center)
}

/// An error about a folder that cannot be imported.
pub(crate) fn refused(path: &Path, message: impl Into<String>, hint: impl Into<String>) -> DatasetError {
    FormatError::new(ErrorKind::Unsupported, message).in_file(path).with_hint(hint).into()
}
