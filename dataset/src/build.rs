//! `dataset build`: from tracked and posed takes to a balanced, packaged dataset.
//!
//! ```text
//! valid frames → smoothed intensities → ranges (eq. 1), neutral values → candidates: posed, not repeated
//!              → balanced choice → pictures, masks, cameras, annotations, tables, report
//! ```

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

use risorius_formats::atomic::{self, AtomicDir};
use risorius_formats::landmark_table::LandmarkTable;
use risorius_formats::{ActionUnit, AttributeSpec, AttributeTable, RegionTable, Reporter, Warning};

use crate::align::TakeInput;
use crate::candidates::{self, Sight};
use crate::choose::{self, Chosen};
use crate::describe::describe;
use crate::error::{DatasetError, Result};
use crate::neutral;
use crate::options::BuildOptions;
use crate::package::{self, Job};
use crate::provenance::Provenance;
use crate::regions::{RegionStyle, Rejection, Shape};
use crate::report;
use crate::rows::Rows;
use crate::sheet;
use crate::signals::{self, Signals};
use crate::split::Role;
use crate::stats::{self, Report};
use crate::{balance, tables, takes};

/// Frame numbers of the second take start here, those of the third at twice this, and so on.
pub const TAKE_OFFSET: u32 = 1_000_000;
/// The file that shows a folder to be a dataset.
pub(crate) const DATASET_FILE: &str = "dataset.json";

/// What a build made, and how long its parts took.
#[derive(Clone, Debug)]
pub struct Built {
    /// What `report/stats.json` says.
    pub report: Report,
    /// Reading tracks and poses.
    pub read: Duration,
    /// Attributes, region outlines and the choice, from tracks in memory.
    pub choice: Duration,
    /// Pictures and their masks.
    pub pictures: Duration,
    /// Cameras, annotations, tables and report.
    pub documents: Duration,
}

/// Builds a dataset in the folder `out` and returns what `report/stats.json` says.
pub fn build(takes: &[PathBuf], out: &Path, options: &BuildOptions, reporter: &dyn Reporter) -> Result<Report> {
    build_timed(takes, out, options, reporter).map(|built| built.report)
}

/// The same as [`build`], with the time that each part took.
pub fn build_timed(takes: &[PathBuf], out: &Path, options: &BuildOptions, reporter: &dyn Reporter) -> Result<Built> {
    options.check()?;
    if takes.is_empty() {
        return Err(DatasetError::Option {
            message: "no takes to build from".to_owned(),
            hint: "name the folder of a take".to_owned(),
        });
    }
    atomic::check_replaceable(out, "a dataset", &[DATASET_FILE])?;
    let started = Instant::now();
    reporter.stage("read tracks and poses", Some(takes.len() as u64));
    let inputs = open(takes, reporter)?;
    takes::one_subject(&inputs, options, reporter)?;
    let size = takes::common_size(&inputs)?;
    let worlds = takes::common_world(&inputs, options, reporter)?;
    let units = takes::common_units(&inputs, options, reporter)?;
    takes::common_scale(&inputs, &units, reporter)?;
    let read = started.elapsed();

    let started = Instant::now();
    reporter.stage("smooth and choose", None);
    let signals = smooth(&inputs, &units, options, reporter)?;
    let (table, dropped) = attribute_table(&units, &signals, options);
    for name in dropped {
        reporter.note(&format!("the region `{name}` has no AU in the tracks and is left out"));
    }
    warn_inactive(&table, reporter);
    let styles = region_styles(&table);
    let (mut rows, mut sights) = candidates::collect(&inputs, &signals, &worlds, &table, &styles, reporter)?;
    let chosen = choose::choose(&rows, options, reporter);
    let choice = started.elapsed();

    let hulls: Vec<_> = (0..inputs.len())
        .map(|k| candidates::head_hull(&inputs[k], &rows.takes[k], &signals[k], &worlds[k]).map(Arc::new))
        .collect();
    let dataset = describe(&inputs, &worlds, &rows, &sights, &chosen, options, size, &hulls);
    mark(&mut rows, &chosen, &dataset.ids);
    let staging = AtomicDir::create(out)?;
    let dir = staging.path();
    let started = Instant::now();
    let jobs = jobs(&inputs, &rows, &mut sights, &chosen, &dataset, &hulls, options);
    let thumbnails = package::write_pictures(dir, &inputs, &jobs, &styles, &options.scales, reporter)?;
    let pictures = started.elapsed();

    let started = Instant::now();
    reporter.stage("write cameras, tables and report", None);
    dataset.write(dir)?;
    table.write(dir.join("attributes.toml"))?;
    Provenance::of(&inputs).write(dir)?;
    tables::write(dir, &rows)?;
    tables::intensities_of(&rows).write(dir)?;
    landmarks_of(&inputs, &rows, &signals).write(dir)?;
    let about: Vec<_> = inputs.iter().zip(&signals).map(|(i, s)| stats::about_take(i, s)).collect();
    let report = stats::collect(&rows, about, options);
    report::write(dir, &rows, &report, options, &thumbnails)?;
    if reporter.cancelled() {
        return Err(DatasetError::Cancelled);
    }
    staging.commit()?;
    Ok(Built { report, read, choice, pictures, documents: started.elapsed() })
}

/// Opens the takes; names that stand there twice get a number, because tables are filed under them.
fn open(takes: &[PathBuf], reporter: &dyn Reporter) -> Result<Vec<TakeInput>> {
    let mut inputs: Vec<TakeInput> = Vec::with_capacity(takes.len());
    let mut folders = BTreeSet::new();
    for dir in takes {
        let mut input = TakeInput::open(dir, reporter)?;
        if !folders.insert(dir.canonicalize().unwrap_or_else(|_| dir.clone())) {
            return Err(DatasetError::Option {
                message: format!("{}: the take is named twice", dir.display()),
                hint: "name each take once".to_owned(),
            });
        }
        let name = input.name.clone();
        let mut number = 2;
        while inputs.iter().any(|i| i.name == input.name) {
            input.name = format!("{name}-{number}");
            number += 1;
        }
        inputs.push(input);
        reporter.advance(1);
    }
    Ok(inputs)
}

fn smooth(
    inputs: &[TakeInput],
    units: &[ActionUnit],
    options: &BuildOptions,
    reporter: &dyn Reporter,
) -> Result<Vec<Signals>> {
    let mut all = Vec::with_capacity(inputs.len());
    for input in inputs {
        let signals =
            signals::smooth_track(&input.track, &input.take.frames, units, input.take.fps(), options.min_confidence);
        let c = signals.counts;
        if c.valid == 0 {
            return Err(DatasetError::NoValidFrames {
                path: input.take.openface_path(),
                frames: c.frames,
                lost: c.lost,
                low_confidence: c.low_confidence,
                incomplete: c.incomplete,
            });
        }
        if c.lost + c.low_confidence + c.incomplete > 0 {
            let message = format!(
                "take `{}`: {} frames lost, {} unsure, {} incomplete of {}; they are left out",
                input.name, c.lost, c.low_confidence, c.incomplete, c.frames
            );
            reporter.warn(Warning::new("untrusted-frames", message));
        }
        if c.surplus_rows > 0 {
            reporter.warn(Warning::new(
                "surplus-rows",
                format!("take `{}`: {} rows belong to no frame or to one that has a row", input.name, c.surplus_rows),
            ));
        }
        all.push(signals);
    }
    Ok(all)
}

/// The attributes with their ranges over all valid frames of all takes, and the names of regions without AUs.
fn attribute_table(units: &[ActionUnit], signals: &[Signals], options: &BuildOptions) -> (AttributeTable, Vec<String>) {
    let mut regions = options.regions.restricted_to(units).regions;
    let dropped = regions.iter().filter(|r| r.units.is_empty()).map(|r| r.name.clone()).collect();
    regions.retain(|r| !r.units.is_empty());
    let regions = RegionTable { regions };
    let rows: Vec<Vec<f32>> = signals.iter().flat_map(|s| s.frames.iter().map(|f| f.intensities.clone())).collect();
    let spec = |(k, &unit): (usize, &ActionUnit)| {
        let range = rows.iter().fold((f32::MAX, f32::MIN), |(lo, hi), row| (lo.min(row[k]), hi.max(row[k])));
        AttributeSpec::from_range(unit, regions.region_of(unit).unwrap_or(0), range.0, range.1, 0.0)
    };
    // `units` stand region after region, because they come from the region table.
    let mut attributes: Vec<_> = units.iter().enumerate().map(spec).collect();
    let neutral = neutral::neutral_intensities(&rows, &attributes);
    for (attribute, value) in attributes.iter_mut().zip(neutral) {
        attribute.neutral = value;
    }
    (AttributeTable { regions: regions.regions.into_iter().map(|r| r.name).collect(), attributes }, dropped)
}

fn warn_inactive(table: &AttributeTable, reporter: &dyn Reporter) {
    for a in table.attributes.iter().filter(|a| !a.active) {
        let message = format!(
            "{} ({}) stays between {:.2} and {:.2}: it moves too little to be learned",
            a.unit,
            a.unit.facs_name(),
            a.au_min,
            a.au_max
        );
        reporter.warn(Warning::new("inactive-au", message));
    }
}

fn region_styles(table: &AttributeTable) -> Vec<RegionStyle> {
    let style = |(index, name): (usize, &String)| {
        let first = table.attributes.iter().find(|a| a.region == index)?;
        Some(RegionStyle {
            shape: Shape::from_name(name)?,
            polygon_label: first.unit.to_string(),
            label: index as u8 + 1,
        })
    };
    table.regions.iter().enumerate().filter_map(style).collect()
}

/// Writes into the rows which frames were chosen and what for.
fn mark(rows: &mut Rows, chosen: &[Chosen], ids: &[String]) {
    let places: Vec<(usize, u32)> = {
        let usable = rows.usable();
        chosen.iter().map(|&(c, _)| (usable[c].take, usable[c].row.frame)).collect()
    };
    for ((&(_, role), (take, frame)), id) in chosen.iter().zip(places).zip(ids) {
        let row = &mut rows.takes[take].frames[frame as usize];
        row.id = Some(id.clone());
        row.split = Some(match role {
            Role::Train => "train",
            Role::Val => "val",
            Role::Neither => "none",
        });
    }
}

/// The tracked landmarks of the chosen frames.
fn landmarks_of(inputs: &[TakeInput], rows: &Rows, signals: &[Signals]) -> LandmarkTable {
    let mut table = LandmarkTable::default();
    for ((input, take), signals) in inputs.iter().zip(&rows.takes).zip(signals) {
        for valid in &signals.frames {
            let id = take.frames[valid.frame as usize].id.clone();
            let landmarks = input.track.rows[valid.row].landmarks.as_deref().cloned();
            table.rows.extend(id.zip(landmarks));
        }
    }
    table
}

/// What is to be written of each chosen frame, take after take.
fn jobs(
    inputs: &[TakeInput],
    rows: &Rows,
    sights: &mut [Sight],
    chosen: &[Chosen],
    dataset: &risorius_formats::nerfies::Dataset,
    hulls: &[Option<Arc<Vec<glam::DVec3>>>],
    options: &BuildOptions,
) -> Vec<Job> {
    let usable = rows.usable();
    let on_sheet: BTreeSet<usize> = balance::spread(chosen.len(), sheet::FRAMES).into_iter().collect();
    let job = |(place, &(index, _)): (usize, &Chosen)| {
        let take = usable[index].take;
        let id = dataset.ids[place].clone();
        let rigid = inputs[take].report.method == risorius_formats::pose_report::PoseMethod::Head;
        Job {
            take,
            frame: usable[index].row.frame,
            camera: dataset.cameras[&id],
            polygons: std::mem::replace(&mut sights[index].polygons, Err(Rejection::NoLandmarks)).ok(),
            hull: hulls[take].clone().filter(|_| rigid),
            head: hulls[take].clone().filter(|_| options.head_masks),
            on_sheet: on_sheet.contains(&place),
            intensities: usable[index].intensities.to_vec(),
            id,
        }
    };
    chosen.iter().enumerate().map(job).collect()
}
