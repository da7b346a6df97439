//! What the description of a stored model may ask for. It comes from a file that somebody else may have written, and is
//! checked before anything is allocated or drawn by it.

use glam::DVec3;
use risorius_formats::{Camera, Isometry};
use risorius_splat::Layout;
use risorius_splat::fit::Progress;
use risorius_splat::model::{LANES, LATENT, REGIONS};

use crate::config::{ModelConfig, NetSize};
use crate::saved::{SavedConfies, SavedModel};
use crate::splat::{SavedSplat, SplatSettings};

/// No picture side or number of samples along a ray is larger.
const MOST_ALONG: usize = 4096;
/// No fit grows to more Gaussians.
const MOST_GAUSSIANS: usize = 1 << 23;
/// Sizes of worlds in 32-bit floats whose inverses are numbers as well.
const SIZES: std::ops::RangeInclusive<f32> = 1e-12..=1e12;

type Checked = Result<(), String>;

fn within(name: &str, value: usize, range: std::ops::RangeInclusive<usize>) -> Checked {
    if range.contains(&value) {
        return Ok(());
    }
    Err(format!("`{name}` is {value}, expected {} to {}", range.start(), range.end()))
}

fn bounded(name: &str, values: &[f32]) -> Checked {
    match values.iter().find(|v| !(0.0..=*SIZES.end()).contains(&v.abs())) {
        Some(bad) => Err(format!("`{name}` holds {bad}")),
        None => Ok(()),
    }
}

fn positive(name: &str, value: f32) -> Checked {
    if SIZES.contains(&value) { Ok(()) } else { Err(format!("`{name}` is {value}")) }
}

/// What all fields describe.
pub(crate) fn of_model(saved: &SavedModel) -> Checked {
    within("table", saved.table.attributes.len(), 0..=256)?;
    let regions = saved.table.regions.len();
    for spec in &saved.table.attributes {
        if spec.region >= regions {
            return Err(format!("`{}` is of region {} of {regions}", spec.unit, spec.region));
        }
    }
    let camera = Camera::from(&saved.default_camera);
    let i = camera.intrinsics;
    within("default_camera.width", i.width as usize, 1..=4 * MOST_ALONG)?;
    within("default_camera.height", i.height as usize, 1..=4 * MOST_ALONG)?;
    positive("default_camera.fx", i.fx as f32)?;
    positive("default_camera.fy", i.fy as f32)?;
    let error = camera.camera_from_world.orthonormality_error();
    // Written so that a NaN is refused.
    if !(0.0..1e-3).contains(&error) {
        return Err(format!("`default_camera` is turned by no rotation: it deviates by {error}"));
    }
    bounded("default_camera.camera_from_world", &camera.camera_from_world.translation.as_vec3().to_array())?;
    bounded("center_in_world", &saved.center_in_world.as_vec3().to_array())?;
    bounded("orbit_rad", &saved.orbit_rad.map(|v| v as f32))
}

/// The settings of a fit of the Gaussian field: from the command line, or from the file of a run that is resumed.
pub(crate) fn of_settings(settings: &SplatSettings) -> Checked {
    let s = &settings.splat;
    within("splat.gaussians", s.gaussians, 1..=MOST_GAUSSIANS)?;
    within("splat.densifications", s.densifications as usize, 0..=1000)?;
    for (name, mm) in ["splat.voxel_mm: head", "splat.voxel_mm: background"].into_iter().zip(s.voxel_mm) {
        if !(0.1..=1000.0).contains(&mm) {
            return Err(format!("`{name}` is {mm}, expected 0.1 to 1000"));
        }
    }
    let [first, last] = s.densify_between;
    let shares = [
        ("seed_share", s.seed_share),
        ("coarse_share", s.coarse_share),
        ("mean_final", s.mean_final),
        ("final_rate", s.final_rate),
        ("densify_between", first),
        ("densify_between", last),
        ("prune_opacity", s.prune_opacity),
        ("code_share", s.code_share),
    ];
    if let Some((name, share)) = shares.into_iter().find(|(_, share)| !(0.0..=1.0).contains(share)) {
        return Err(format!("`splat.{name}` is {share}, expected 0 to 1"));
    }
    let rates = [s.mean_px, s.depth_factor, s.delta_factor, s.log_scale_rate, s.quaternion_rate, s.opacity_rate];
    let more = [s.color_rate, s.sh_rate, s.latent_weight, s.code_rate, s.image_rate, s.mask_rate];
    let all = rates.into_iter().chain(more).chain(s.attribute_weight);
    if let Some(bad) = all.into_iter().find(|v| !(0.0..=1e6).contains(v)) {
        return Err(format!("a rate or weight is {bad}, expected a number from 0"));
    }
    if !(settings.budget_secs.is_finite() && settings.budget_secs > 0.0) {
        return Err(format!("`budget_secs` is {}, expected a time", settings.budget_secs));
    }
    Ok(())
}

/// How far a fit that is resumed says it is.
pub(crate) fn of_progress(progress: &Progress) -> Checked {
    // A step that wraps around would start over.
    within("progress.step", progress.step as usize, 0..=1 << 48)?;
    within("progress.basis_steps", progress.basis_steps.len(), 0..=256 + LATENT)
}

/// Sizes of the Gaussian field, whose arrays take `bytes`.
pub(crate) fn of_layout(layout: &Layout, bytes: usize) -> Checked {
    within("layout.regions", layout.regions, 0..=REGIONS)?;
    within("layout.region_of", layout.region_of.len(), 0..=256)?;
    for &region in &layout.region_of {
        within("layout.region_of", region, 0..=layout.regions.saturating_sub(1))?;
    }
    within("layout.also_in", layout.also_in.len(), 0..=layout.region_of.len())?;
    for &bits in &layout.also_in {
        within("layout.also_in", bits.into(), 0..=(1 << layout.regions) - 1)?;
    }
    within("layout.latent", layout.latent, 0..=LATENT)?;
    within("layout.images", layout.images, 0..=bytes.max(1 << 24))
}

/// The Gaussian field, whose arrays are a file of `file_bytes`.
pub(crate) fn of_splat(saved: &SavedSplat, file_bytes: usize) -> Checked {
    of_layout(&saved.layout, file_bytes)?;
    // A group's means alone take this much of the file.
    within("groups", saved.groups, 0..=file_bytes / (3 * 4 * LANES))?;
    within("deformable", saved.deformable, 0..=saved.groups)?;
    for side in saved.plate.iter().flatten() {
        within("plate", *side as usize, 1..=4 * MOST_ALONG)?;
    }
    positive("space.metres_per_unit", saved.space.metres_per_unit as f32)?;
    let turned = Isometry::new(saved.space.metric_from_world, DVec3::ZERO).orthonormality_error();
    // Written so that a NaN is refused.
    if !(0.0..1e-3).contains(&turned) {
        return Err(format!("`space.metric_from_world` is no rotation: it deviates by {turned}"));
    }
    bounded("space.origin_in_world", &saved.space.origin_in_world.as_vec3().to_array())
}

/// The paper's networks, whose weights are a file of `file_bytes`.
pub(crate) fn of_confies(saved: &SavedConfies, file_bytes: usize) -> Checked {
    let m: &ModelConfig = &saved.model;
    within("frames", saved.frames, 1..=file_bytes / 4)?;
    within("coarse_samples", saved.coarse_samples, 4..=MOST_ALONG)?;
    within("fine_samples", saved.fine_samples, 1..=MOST_ALONG)?;
    within("model.latent_dims", m.latent_dims, 1..=1024)?;
    within("model.latent_dims", m.latent_dims, 1..=(file_bytes / 4 / saved.frames.max(1)).max(1))?;
    within("model.hyper_dims", m.hyper_dims, 1..=256)?;
    let nets = [
        ("attribute", m.attribute),
        ("warp", m.warp),
        ("sheet", m.sheet),
        ("template", m.template),
        ("template_coarse", m.template_coarse),
        ("mask", m.mask.trunk),
        ("uncertainty", m.uncertainty.trunk),
    ];
    for (name, NetSize { depth, width }) in nets {
        within(&format!("model.{name}.depth"), depth, 1..=64)?;
        within(&format!("model.{name}.width"), width, 1..=MOST_ALONG)?;
        // A square layer takes this much of the file.
        within(&format!("model.{name}.width"), width, 1..=((file_bytes / 4) as f64).sqrt() as usize + 1)?;
    }
    within("model.mask.branch", m.mask.branch, 0..=MOST_ALONG)?;
    within("model.uncertainty.branch", m.uncertainty.branch, 0..=MOST_ALONG)?;
    within("model.color_width", m.color_width, 1..=MOST_ALONG)?;
    let bands = [m.warp_bands, m.sheet_bands, m.hyper_bands, m.template_bands, m.view_bands];
    bands.iter().try_for_each(|&b| within("model: bands", b, 0..=32))?;
    let space = &saved.space;
    bounded("space.center_in_world", &space.center_in_world.as_vec3().to_array())?;
    [("scale", space.scale), ("near", space.near), ("far", space.far)]
        .iter()
        .try_for_each(|&(name, v)| positive(&format!("space.{name}"), v as f32))
}
