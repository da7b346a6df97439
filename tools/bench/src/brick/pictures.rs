//! Pictures of one avatar: whole frames and edits, direct and baked, with and without each skip.

use std::path::Path;
use std::time::Instant;

use burn::tensor::Device;
use risorius_brick::Skips;
use risorius_console::Failure;
use risorius_formats::views::ViewList;
use risorius_formats::{Camera, Silent};
use risorius_trainer::Avatar;
use risorius_trainer::avatar::Render;
use risorius_trainer::studio::{Look, Studio};
use serde::Serialize;

/// Times of pictures, medians over the views, milliseconds on the wall; differences to direct pictures.
#[derive(Clone, Debug, Serialize)]
pub(super) struct Pictures {
    /// Pixels of a picture.
    width: u32,
    height: u32,
    /// A whole picture.
    direct_ms: f64,
    /// One AU changed, the camera still; per region.
    edit_ms: Vec<(String, f64)>,
    /// Baking an expression.
    bake_ms: f64,
    /// A whole picture of the baked avatar.
    baked_ms: f64,
    /// One AU changed on the baked avatar.
    baked_edit_ms: Vec<(String, f64)>,
    /// PSNR of baked pictures against direct ones, dB.
    baked_psnr_db: f64,
    /// Without one skip: milliseconds, and the largest difference of a pixel in 1/255.
    without: Vec<(String, f64, u8)>,
}

pub(super) fn measure(run: &Path, views: &Path, every: usize) -> Result<Pictures, Failure> {
    let avatar = Avatar::open(run, &Device::flex())?;
    let views = ViewList::read(views)?;
    let scenes: Vec<(Camera, Vec<f32>)> = views
        .views
        .iter()
        .step_by(every.max(1))
        .map(|v| (Camera::from(&v.camera), avatar.attributes_from_intensities(&v.aus).0))
        .map(|(camera, attributes)| (camera.reduced(avatar.spare_resolution(&camera)), attributes))
        .collect();
    let regions = &avatar.saved.table.regions;
    let baked = Look { baked: true, ..Look::default() };
    let mut times = Times::default();
    let mut squares = (0.0, 0usize);
    let mut without: Vec<(String, Vec<f64>, u8)> = Vec::new();
    for (camera, attributes) in &scenes {
        let mut studio = Studio::new(&avatar, Look::default());
        // The first picture of a studio also fetches its memory; the second, of another camera, is what a path costs.
        let mut beside = *camera;
        beside.camera_from_world.translation.x += 1e-4;
        taken(&mut studio, &beside, attributes)?;
        let (direct, ms) = taken(&mut studio, camera, attributes)?;
        times.direct.push(ms);
        times.edits.resize(regions.len(), Vec::new());
        times.baked_edits.resize(regions.len(), Vec::new());
        edits(&avatar, &mut studio, camera, attributes, &mut times.edits)?;

        let mut studio = Studio::new(&avatar, baked);
        // Here the first picture bakes.
        let (picture, first) = taken(&mut studio, camera, attributes)?;
        let (_, second) = taken(&mut studio, &beside, attributes)?;
        times.bake.push(first - second);
        times.baked.push(second);
        squares.0 += risorius_trainer::eval::mse(&picture.rgb, &direct.rgb).unwrap_or(0.0);
        squares.1 += 1;
        taken(&mut studio, camera, attributes)?;
        edits(&avatar, &mut studio, camera, attributes, &mut times.baked_edits)?;

        for (i, name) in ["empty-space", "hidden"].iter().enumerate() {
            let mut skips = Skips::default();
            skips.switch_off(name);
            let mut studio = Studio::new(&avatar, Look { skips, ..Look::default() });
            let (whole, ms) = taken(&mut studio, camera, attributes)?;
            let apart = whole.rgb.as_raw().iter().zip(direct.rgb.as_raw()).map(|(a, b)| a.abs_diff(*b)).max();
            if without.len() <= i {
                without.push(((*name).to_owned(), Vec::new(), 0));
            }
            without[i].1.push(ms);
            without[i].2 = without[i].2.max(apart.unwrap_or(0));
        }
    }
    let (width, height) =
        scenes.first().map_or((0, 0), |(camera, _)| (camera.intrinsics.width, camera.intrinsics.height));
    let named = |edits: Vec<Vec<f64>>| regions.iter().cloned().zip(edits.into_iter().map(median)).collect();
    Ok(Pictures {
        width,
        height,
        direct_ms: median(times.direct),
        edit_ms: named(times.edits),
        bake_ms: median(times.bake),
        baked_ms: median(times.baked),
        baked_edit_ms: named(times.baked_edits),
        baked_psnr_db: risorius_trainer::eval::psnr_from_mse(squares.0 / f64::from(squares.1.max(1) as u32)),
        without: without.into_iter().map(|(name, ms, apart)| (name, median(ms), apart)).collect(),
    })
}

#[derive(Default)]
struct Times {
    direct: Vec<f64>,
    edits: Vec<Vec<f64>>,
    bake: Vec<f64>,
    baked: Vec<f64>,
    baked_edits: Vec<Vec<f64>>,
}

fn taken(studio: &mut Studio<'_>, camera: &Camera, attributes: &[f32]) -> Result<(Render, f64), Failure> {
    let started = Instant::now();
    let picture = studio.render(camera, attributes, &Silent)?;
    Ok((picture, started.elapsed().as_secs_f64() * 1e3))
}

/// Changes one AU of each region and back.
fn edits(
    avatar: &Avatar,
    studio: &mut Studio<'_>,
    camera: &Camera,
    attributes: &[f32],
    times: &mut [Vec<f64>],
) -> Result<(), Failure> {
    for (region, times) in times.iter_mut().enumerate() {
        for (k, spec) in avatar.saved.table.attributes.iter().enumerate() {
            if spec.region != region || !spec.active {
                continue;
            }
            let mut edited = attributes.to_vec();
            edited[k] = if edited[k] > 0.0 { -0.5 } else { 0.7 };
            times.push(taken(studio, camera, &edited)?.1);
            taken(studio, camera, attributes)?;
        }
    }
    Ok(())
}

pub(super) fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or(f64::NAN)
}

impl Pictures {
    pub(super) fn table(&self) -> String {
        let mut lines = vec![
            format!("| picture of {}×{} | ms | per second | against direct |", self.width, self.height),
            "|---|---|---|---|".to_owned(),
        ];
        let mut row = |name: &str, ms: f64, error: &str| {
            lines.push(format!("| {name} | {ms:.1} | {:.1} | {error} |", 1e3 / ms));
        };
        row("whole, direct", self.direct_ms, "–");
        for (region, ms) in &self.edit_ms {
            row(&format!("one AU of `{region}` edited"), *ms, "the same to the bit");
        }
        row("baking an expression", self.bake_ms, "–");
        let baked = format!("{:.1} dB", self.baked_psnr_db);
        row("whole, baked", self.baked_ms, &baked);
        for (region, ms) in &self.baked_edit_ms {
            row(&format!("one AU of `{region}` edited, baked"), *ms, &baked);
        }
        for (skip, ms, apart) in &self.without {
            row(&format!("whole, without the skip `{skip}`"), *ms, &format!("at most {apart}/255 in a pixel"));
        }
        lines.join("\n")
    }
}
