//! What the description of a stored model may ask for. It comes from a file that somebody else may have written, and is
//! checked before anything is allocated or marched by it.

use risorius_brick::expression::REST;
use risorius_brick::model::LATENT;
use risorius_brick::{BackgroundFrame, HeadBox, Progress};
use risorius_formats::Camera;

use crate::brick::fit::BrickSettings;
use crate::brick::store::SavedBrick;
use crate::config::{ModelConfig, NetSize};
use crate::saved::{SavedConfies, SavedModel};

/// No lattice, picture side or number of samples along a ray is larger.
const MOST_ALONG: usize = 4096;
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

/// What both fields describe.
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

/// The settings of a fit of the brick field: from the command line, or from the file of a run that is resumed.
pub(crate) fn of_settings(settings: &BrickSettings) -> Checked {
    let s = &settings.step;
    within("step.images", s.images, 1..=4096)?;
    within("step.samples", s.samples, 1..=1 << 28)?;
    within("expression_vertices", settings.expression_vertices, 8..=256)?;
    if !settings.expression_vertices.is_multiple_of(8) {
        return Err(format!("`expression_vertices` is {}, expected a multiple of 8", settings.expression_vertices));
    }
    within("finest_level", settings.finest_level, 0..=2048)?;
    s.finest.iter().try_for_each(|&n| within("step.finest", n, 1..=MOST_ALONG))?;
    within("step.settled_planes", s.settled_planes, 1..=MOST_ALONG)?;
    for (name, share) in [("region_share", settings.region_share), ("step.code_share", s.code_share)] {
        if !(0.0..=1.0).contains(&share) {
            return Err(format!("`{name}` is {share}, expected 0 to 1"));
        }
    }
    let rates = [s.grid_rate, s.residual_rate, s.warp_rate, s.net_rate, s.image_rate, s.final_rate];
    let weights = [s.mask_weight, s.latent_weight, s.faint];
    let pairs = [s.haze, s.spread, s.smooth, s.attribute_weight];
    let all = rates.iter().chain(&weights).chain(pairs.as_flattened());
    match all.copied().find(|v| !(0.0..=1e6).contains(v)) {
        Some(bad) => Err(format!("a rate or weight is {bad}, expected a number from 0")),
        None => Ok(()),
    }
}

/// How far a fit that is resumed says it is.
pub(crate) fn of_progress(progress: &Progress) -> Checked {
    within("progress.stage", progress.stage, 0..=risorius_brick::fit::LAST_STAGE)?;
    // A step that wraps around would start over.
    within("progress.step", progress.step as usize, 0..=1 << 48)?;
    within("progress.stage_steps", progress.stage_steps as usize, 0..=1 << 48)?;
    if progress.samples_per_ray.is_finite() {
        Ok(())
    } else {
        Err("`progress.samples_per_ray` is no number".to_owned())
    }
}

/// The brick field, whose arrays are a file of `file_bytes`.
pub(crate) fn of_brick(saved: &SavedBrick, file_bytes: usize) -> Checked {
    let layout = &saved.layout;
    within("layout.regions", layout.regions, 0..=REST)?;
    within("layout.region_of", layout.region_of.len(), 0..=256)?;
    for &region in &layout.region_of {
        within("layout.region_of", region, 0..=layout.regions.saturating_sub(1))?;
    }
    within("layout.images", layout.images, 1..=file_bytes / (4 * LATENT))?;
    within("layout.expression_vertices", layout.expression_vertices, 8..=256)?;
    if !layout.expression_vertices.is_multiple_of(8) {
        return Err(format!("`layout.expression_vertices` is {}, no multiple of 8", layout.expression_vertices));
    }
    within("layout.finest", layout.finest, 0..=2048)?;
    within("divisions", saved.divisions, 0..=MOST_ALONG)?;
    within("planes", saved.planes, 0..=MOST_ALONG)?;
    for side in saved.plate.iter().flatten() {
        within("plate", *side as usize, 1..=4 * MOST_ALONG)?;
    }
    let HeadBox { center, half } = layout.head_box;
    bounded("layout.head_box.center", &center)?;
    positive("layout.head_box.half", half)?;
    let Some(BackgroundFrame { position, axes, near, far, middle, extent }) = layout.background else { return Ok(()) };
    bounded("layout.background.position", &position)?;
    bounded("layout.background.axes", axes.as_flattened())?;
    bounded("layout.background.middle", &middle)?;
    positive("layout.background.near", near)?;
    positive("layout.background.far", far)?;
    extent.iter().try_for_each(|&e| positive("layout.background.extent", e))
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
