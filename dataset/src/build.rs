//! `dataset build`: from tracked and posed takes to a balanced, packaged dataset.
//!
//! ```text
//! valid frames → smoothed intensities → ranges (eq. 1), neutral values → candidates: posed, not repeated
//!              → balanced choice → pictures, masks, cameras, annotations, report
//! ```

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use risorius_formats::atomic::{self, AtomicDir};
use risorius_formats::intensities::Intensities;
use risorius_formats::pose_report::write_json;
use risorius_formats::similarity::umeyama;
use risorius_formats::{ActionUnit, AttributeSpec, AttributeTable, Camera, RegionTable, Reporter, Similarity, Warning};

use crate::align::TakeInput;
use crate::balance::{self, BalanceOptions};
use crate::describe::{describe, head_hull};
use crate::error::{DatasetError, Result};
use crate::neutral;
use crate::options::{BuildOptions, Sampling};
use crate::package::{self, Job};
use crate::regions::{self, RegionStyle, Rejection, Shape};
use crate::scale;
use crate::sheet;
use crate::signals::{self, Signals};
use crate::stats::{self, Report};

/// Frame numbers of the second take start here, those of the third at twice this, and so on.
pub const TAKE_OFFSET: u32 = 1_000_000;
/// Every so many chosen frames one is held out.
pub const VAL_INTERVAL: usize = 20;
/// Which of each [`VAL_INTERVAL`] frames it is: one in the middle, so that it has neighbours on both sides.
pub const VAL_FIRST: usize = 10;
/// The file that shows a folder to be a dataset.
pub(crate) const DATASET_FILE: &str = "dataset.json";
/// Above this remainder, in head radii, the faces of two takes do not agree.
const MAX_WORLD_MISFIT: f64 = 0.1;

/// A frame that may be chosen.
pub(crate) struct Candidate {
    pub(crate) take: usize,
    pub(crate) frame: u32,
    pub(crate) intensities: Vec<f32>,
    pub(crate) camera: Camera,
    /// See [`risorius_formats::Landmarks68::asymmetry`]; infinite without landmarks.
    pub(crate) asymmetry: f32,
    pub(crate) polygons: Result<risorius_formats::nerfies::Polygons, Rejection>,
}

/// Builds a dataset in the folder `out` and returns what `report/stats.json` says.
pub fn build(takes: &[PathBuf], out: &Path, options: &BuildOptions, reporter: &dyn Reporter) -> Result<Report> {
    options.check()?;
    if takes.is_empty() {
        return Err(DatasetError::Option {
            message: "no takes to build from".to_owned(),
            hint: "name the folder of a take".to_owned(),
        });
    }
    atomic::check_replaceable(out, "a dataset", &[DATASET_FILE])?;
    reporter.stage("read tracks and poses", Some(takes.len() as u64));
    let mut inputs = Vec::with_capacity(takes.len());
    for dir in takes {
        inputs.push(TakeInput::open(dir, reporter)?);
        reporter.advance(1);
    }
    let size = common_size(&inputs)?;
    let worlds = common_world(&inputs, reporter)?;

    reporter.stage("smooth and choose", None);
    let units = common_units(&inputs, options, reporter)?;
    let signals = smooth(&inputs, &units, options, reporter)?;
    let (table, dropped) = attribute_table(&units, &signals, options);
    for name in dropped {
        reporter.note(&format!("the region `{name}` has no AU in the tracks and is left out"));
    }
    warn_inactive(&table, reporter);
    let styles = region_styles(&table);
    let mut candidates = candidates(&inputs, &signals, &worlds, &styles, reporter)?;
    let chosen = choose(&candidates, &table, options, reporter);

    let staging = AtomicDir::create(out)?;
    let dir = staging.path();
    let report = stats::collect(&stats::Material {
        inputs: &inputs,
        signals: &signals,
        table: &table,
        options,
        levels: &candidates.iter().map(|c| levels_of(c, options)).collect::<Vec<_>>(),
        rejections: &candidates.iter().map(|c| c.polygons.as_ref().err().copied()).collect::<Vec<_>>(),
        chosen: &chosen,
    });
    let dataset = describe(&inputs, &worlds, &candidates, &chosen, &table, options, size);
    let mut jobs = Vec::with_capacity(chosen.len());
    let on_sheet: BTreeSet<usize> = balance::spread(chosen.len(), sheet::FRAMES).into_iter().collect();
    let hulls: Vec<_> = inputs.iter().zip(&worlds).map(|(i, w)| head_hull(i, w).map(Arc::new)).collect();
    for (place, &index) in chosen.iter().enumerate() {
        let candidate = &mut candidates[index];
        let id = dataset.ids[place].clone();
        jobs.push(Job {
            take: candidate.take,
            frame: candidate.frame,
            camera: dataset.cameras[&id],
            polygons: std::mem::replace(&mut candidate.polygons, Err(Rejection::NoLandmarks)).ok(),
            hull: hulls[candidate.take].clone(),
            on_sheet: on_sheet.contains(&place),
            intensities: std::mem::take(&mut candidate.intensities),
            id,
        });
    }
    let thumbnails = package::write_pictures(dir, &inputs, &jobs, &styles, &options.scales, reporter)?;

    reporter.stage("write cameras and annotations", None);
    dataset.write(dir)?;
    table.write(dir.join("attributes.toml"))?;
    let units = table.attributes.iter().map(|a| a.unit).collect();
    let rows = jobs.into_iter().map(|j| (j.id, j.intensities)).collect();
    Intensities { units, rows }.write(dir)?;
    let report_dir = dir.join("report");
    write_json(report_dir.join("stats.json"), &report)?;
    let settings = toml::to_string(options).map_err(|e| DatasetError::encode(report_dir.join("settings.toml"), &e))?;
    atomic::write_file(report_dir.join("settings.toml"), settings.as_bytes())?;
    crate::plot::write_svg(&report_dir.join("distribution.svg"), &report)?;
    sheet::write_png(&report_dir.join("contact_sheet.png"), &thumbnails, &table)?;
    if reporter.cancelled() {
        return Err(DatasetError::Cancelled);
    }
    staging.commit()?;
    Ok(report)
}

/// The trimmed size, which all takes must share.
fn common_size(inputs: &[TakeInput]) -> Result<(u32, u32)> {
    let size = |i: &TakeInput| (i.take.manifest.width, i.take.manifest.height);
    let expected = size(&inputs[0]);
    if let Some(other) = inputs.iter().find(|i| size(i) != expected) {
        return Err(DatasetError::Size {
            path: other.take.dir.clone(),
            what: "the first take has",
            expected,
            found: size(other),
        });
    }
    scale::trimmed_size(expected.0, expected.1).ok_or_else(|| DatasetError::Option {
        message: format!("{} × {} pixels are too few", expected.0, expected.1),
        hint: "both sides need at least 8 pixels".to_owned(),
    })
}

/// For each take the way into the first one's world, by the triangulated face.
fn common_world(inputs: &[TakeInput], reporter: &dyn Reporter) -> Result<Vec<Similarity>> {
    let mut worlds = vec![Similarity::IDENTITY];
    for input in &inputs[1..] {
        let first = &inputs[0].report;
        let (faces, own) = (&first.landmarks_in_world, &input.report.landmarks_in_world);
        let pairs: Vec<_> = faces.iter().copied().zip(own.iter().copied()).collect();
        let fit = umeyama(&pairs, true).filter(|fit| faces.len() == own.len() && !fit.on_a_line);
        let fit = fit.ok_or_else(|| DatasetError::Option {
            message: format!("{}: has no face in common with the first take", input.take.pose_report_path().display()),
            hint: "find the poses of all takes anew with `tracker poses TAKE`".to_owned(),
        })?;
        let misfit = fit.rms;
        if misfit > MAX_WORLD_MISFIT * first.head_radius {
            let message = format!(
                "the face of take `{}` fits the first one's to {misfit:.4} of a head radius of {:.4} only",
                input.name, first.head_radius
            );
            reporter.warn(Warning::new("world-misfit", message));
        }
        worlds.push(fit.a_from_b);
    }
    Ok(worlds)
}

/// The units of the table that every track has.
fn common_units(inputs: &[TakeInput], options: &BuildOptions, reporter: &dyn Reporter) -> Result<Vec<ActionUnit>> {
    let wanted = options.regions.units();
    let mut units = wanted.clone();
    for input in inputs {
        units = signals::present_units(&input.track, &units);
    }
    for missing in wanted.iter().filter(|u| !units.contains(u)) {
        reporter.warn(Warning::new(
            "missing-au",
            format!("{missing} ({}) is not in every track and is left out", missing.facs_name()),
        ));
    }
    if units.is_empty() {
        return Err(DatasetError::Option {
            message: format!("{}: has none of the AUs of the regions", inputs[0].take.openface_path().display()),
            hint: "the table needs columns such as `AU12_r`".to_owned(),
        });
    }
    Ok(units)
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

/// Valid frames with a camera that do not repeat the frame before, take after take in the order of frames.
fn candidates(
    inputs: &[TakeInput],
    signals: &[Signals],
    worlds: &[Similarity],
    styles: &[RegionStyle],
    reporter: &dyn Reporter,
) -> Result<Vec<Candidate>> {
    let mut all = Vec::new();
    for (take, (input, signals)) in inputs.iter().zip(signals).enumerate() {
        let before = all.len();
        let manifest = &input.take.manifest;
        for valid in &signals.frames {
            let Some(camera) = input.cameras.get(&valid.frame) else { continue };
            if input.take.frames[valid.frame as usize].repeated {
                continue;
            }
            let landmarks = input.track.rows[valid.row].landmarks.as_deref();
            all.push(Candidate {
                take,
                frame: valid.frame,
                intensities: valid.intensities.clone(),
                camera: Camera { camera_from_world: worlds[take].transform_pose(&camera.camera_from_world), ..*camera },
                asymmetry: landmarks.map_or(f32::INFINITY, risorius_formats::Landmarks68::asymmetry),
                polygons: regions::polygons(landmarks, styles, manifest.width, manifest.height),
            });
        }
        if all.len() == before {
            let (cameras, valid) = (input.cameras.len(), signals.frames.len());
            return Err(DatasetError::NoCandidates { path: input.take.sparse_dir(), cameras, valid });
        }
        if inputs.len() > 1 && manifest.frame_count > TAKE_OFFSET {
            return Err(DatasetError::Option {
                message: format!(
                    "take `{}` has {} frames; with several takes at most {TAKE_OFFSET} can be numbered",
                    input.name, manifest.frame_count
                ),
                hint: "build from this take alone".to_owned(),
            });
        }
    }
    let rejected = all.iter().filter(|c: &&Candidate| c.polygons.is_err()).count();
    if rejected > 0 {
        let message = format!(
            "{rejected} of {} frames have no usable region masks (turned too far, or outside the picture)",
            all.len()
        );
        reporter.warn(Warning::new("rejected-masks", message));
    }
    Ok(all)
}

fn levels_of(candidate: &Candidate, options: &BuildOptions) -> Vec<usize> {
    candidate.intensities.iter().map(|&v| balance::level_of(v, options.levels)).collect()
}

/// The chosen candidates, ascending: those with masks first; the others, which still show the head from its sides,
/// only fill up what is missing.
fn choose(
    candidates: &[Candidate],
    table: &AttributeTable,
    options: &BuildOptions,
    reporter: &dyn Reporter,
) -> Vec<usize> {
    if candidates.len() < options.frames {
        let message =
            format!("{} frames were asked for, and {} can be used: all are taken", options.frames, candidates.len());
        reporter.warn(Warning::new("few-candidates", message));
    }
    let (good, poor): (Vec<usize>, Vec<usize>) = (0..candidates.len()).partition(|&c| candidates[c].polygons.is_ok());
    let active: Vec<bool> = table.attributes.iter().map(|a| a.active).collect();
    let picked = match options.sampling {
        Sampling::Balanced => {
            let levels: Vec<_> = good.iter().map(|&c| levels_of(&candidates[c], options)).collect();
            let how = BalanceOptions { levels: options.levels, count_existing: options.count_existing };
            balance::select_balanced(&levels, &active, options.frames, how)
        }
        Sampling::Uniform => balance::select_uniform(good.len(), options.frames),
    };
    let mut chosen: Vec<usize> = picked.into_iter().map(|i| good[i]).collect();
    let missing = options.frames - chosen.len();
    chosen.extend(balance::spread(poor.len(), missing).into_iter().map(|i| poor[i]));
    chosen.sort_unstable();
    chosen
}
