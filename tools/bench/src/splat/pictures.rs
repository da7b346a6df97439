//! Pictures of one avatar at two sizes: another AU every picture from another view, edits before a still camera, and what
//! each skip is worth.

use std::path::Path;
use std::time::Instant;

use burn::tensor::Device;
use risorius_console::Failure;
use risorius_formats::views::ViewList;
use risorius_formats::{Camera, Intensity, Intrinsics, Silent};
use risorius_splat::Skips;
use risorius_trainer::Avatar;
use risorius_trainer::expression::Expression;
use risorius_trainer::field::{Look, Render};
use risorius_trainer::studio::Studio;
use serde::Serialize;

/// How often the list of pictures is drawn for its time; the first round also fetches memory, and does not count.
const ROUNDS: usize = 3;

/// Times of pictures of one size, milliseconds on the wall.
#[derive(Clone, Debug, Serialize)]
pub(super) struct Pictures {
    /// Pixels of a picture.
    width: u32,
    height: u32,
    /// A whole picture with another view and another AU than the one before: median.
    whole_ms: f64,
    /// The same, as a rate over all of them.
    whole_per_sec: f64,
    /// One AU changed, the camera still: median per region.
    edit_ms: Vec<(String, f64)>,
    /// The same over all AUs, as a rate.
    edits_per_sec: f64,
    /// Without one skip: median of pictures and of edits, and the largest difference of a pixel in 1/255.
    without: Vec<(String, [f64; 2], u8)>,
}

/// What is drawn.
struct Shot {
    camera: Camera,
    expression: Expression,
}

pub(super) fn measure(run: &Path, views: &Path, every: usize) -> Result<Vec<Pictures>, Failure> {
    let avatar = Avatar::open(run, &Device::flex())?;
    let views = ViewList::read(views)?;
    let width = avatar.saved.default_camera.width;
    [1, 2].iter().map(|times| of_size(&avatar, &views, every, width * times)).collect()
}

/// The view with `width` pixels across.
fn resized(camera: &Camera, width: u32) -> Camera {
    let i = &camera.intrinsics;
    let share = f64::from(width) / f64::from(i.width.max(1));
    let intrinsics = Intrinsics {
        width,
        height: (f64::from(i.height) * share).round() as u32,
        fx: i.fx * share,
        fy: i.fy * share,
        cx: i.cx * share,
        cy: i.cy * share,
        skew: i.skew * share,
        ..*i
    };
    Camera { intrinsics, ..*camera }
}

/// Each view with its own AUs, and one more that changes from view to view.
fn shots_of(avatar: &Avatar, views: &ViewList, every: usize, width: u32) -> Vec<Shot> {
    let table = &avatar.saved.table.attributes;
    let active: Vec<usize> = (0..table.len()).filter(|&k| table[k].active).collect();
    let shot = |(i, view): (usize, &risorius_formats::views::View)| {
        let expression = avatar.expression(&view.aus);
        let raised = active.get(i % active.len().max(1)).map(|&k| expression.with(k, table[k].scale().most()));
        Shot { camera: resized(&Camera::from(&view.camera), width), expression: raised.unwrap_or(expression) }
    };
    views.views.iter().step_by(every.max(1)).enumerate().map(shot).collect()
}

fn of_size(avatar: &Avatar, views: &ViewList, every: usize, width: u32) -> Result<Pictures, Failure> {
    let shots = shots_of(avatar, views, every, width);
    let regions = &avatar.saved.table.regions;
    let whole = times_of(avatar, &shots, Skips::default())?;
    let mut without = Vec::new();
    for name in Skips::NAMES {
        let mut skips = Skips::default();
        skips.switch_off(name);
        let times = times_of(avatar, &shots, skips)?;
        let pairs = whole.renders.iter().zip(&times.renders);
        let apart = pairs.map(|(a, b)| difference(a, b)).max().unwrap_or(0);
        without.push((name.to_owned(), [median(times.pictures), median(times.edits.concat())], apart));
    }
    let (width, height) = shots.first().map_or((0, 0), |s| (s.camera.intrinsics.width, s.camera.intrinsics.height));
    let rate = |ms: &[f64]| 1e3 * ms.len() as f64 / ms.iter().sum::<f64>().max(1e-9);
    Ok(Pictures {
        width,
        height,
        whole_per_sec: rate(&whole.pictures),
        whole_ms: median(whole.pictures),
        edits_per_sec: rate(&whole.edits.concat()),
        edit_ms: regions.iter().cloned().zip(whole.edits.into_iter().map(median)).collect(),
        without,
    })
}

/// The largest difference of a pixel.
fn difference(a: &Render, b: &Render) -> u8 {
    a.rgb.as_raw().iter().zip(b.rgb.as_raw()).map(|(a, b)| a.abs_diff(*b)).max().unwrap_or(0)
}

#[derive(Default)]
struct Times {
    pictures: Vec<f64>,
    /// Per region.
    edits: Vec<Vec<f64>>,
    /// One of each shot.
    renders: Vec<Render>,
}

fn times_of(avatar: &Avatar, shots: &[Shot], skips: Skips) -> Result<Times, Failure> {
    let mut times = Times { edits: vec![Vec::new(); avatar.saved.table.regions.len()], ..Times::default() };
    let mut studio = Studio::new(avatar, Look { skips, ..Look::default() });
    for round in 0..=ROUNDS {
        for shot in shots {
            let (render, ms) = taken(&mut studio, shot)?;
            if round == 0 {
                times.renders.push(render);
            } else {
                times.pictures.push(ms);
            }
        }
    }
    for shot in shots {
        taken(&mut studio, shot)?;
        edit(avatar, &mut studio, shot, &mut times.edits)?;
    }
    Ok(times)
}

fn taken(studio: &mut Studio<'_>, shot: &Shot) -> Result<(Render, f64), Failure> {
    let started = Instant::now();
    let picture = studio.render(&shot.camera, &shot.expression, &Silent)?;
    Ok((picture, started.elapsed().as_secs_f64() * 1e3))
}

/// Changes one AU of each region and back.
fn edit(avatar: &Avatar, studio: &mut Studio<'_>, shot: &Shot, times: &mut [Vec<f64>]) -> Result<(), Failure> {
    for (k, spec) in avatar.saved.table.attributes.iter().enumerate().filter(|(_, a)| a.active) {
        let half = Intensity(f32::midpoint(spec.au_min, spec.au_max));
        let other = if shot.expression.0[k] > half { Intensity(spec.au_min) } else { Intensity(spec.au_max) };
        let edited = Shot { camera: shot.camera, expression: shot.expression.with(k, other) };
        for shot in [&edited, shot] {
            times[spec.region].push(taken(studio, shot)?.1);
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
            format!("| {}×{} | ms | per second | difference |", self.width, self.height),
            "|---|---|---|---|".to_owned(),
        ];
        let mut row = |name: &str, ms: f64, per_sec: f64, apart: &str| {
            lines.push(format!("| {name} | {ms:.2} | {per_sec:.0} | {apart} |"));
        };
        row("another view and another AU", self.whole_ms, self.whole_per_sec, "–");
        row("one AU edited, camera still", 1e3 / self.edits_per_sec, self.edits_per_sec, "–");
        for (region, ms) in &self.edit_ms {
            row(&format!("… of `{region}`"), *ms, 1e3 / ms, "–");
        }
        for (skip, [picture, edit], apart) in &self.without {
            let apart = format!("at most {apart}/255 in a pixel");
            row(&format!("picture without the skip `{skip}`"), *picture, 1e3 / picture, &apart);
            row(&format!("edit without the skip `{skip}`"), *edit, 1e3 / edit, &apart);
        }
        lines.join("\n")
    }
}
