//! Compares pictures with the true images of a list of views.

use std::collections::BTreeMap;
use std::path::Path;

use image::RgbImage;
use risorius_formats::views::{View, ViewList};
use risorius_formats::{Camera, ErrorKind, FormatError, Reporter};

use super::render::{shots_of_views, write_png};
use crate::avatar::Avatar;
use crate::error::{Result, TrainerError};
use crate::eval::scores::{Parts, psnr_inside, score};
use crate::eval::{Evaluation, Lpips, LpipsNetwork, ViewScore, depth, ms_ssim, ssim_map};
use crate::field::{Between, Look, Outputs, Render};
use crate::studio::Studio;

/// Where the pictures to be judged come from.
#[derive(Clone, Copy)]
pub enum Judged<'a> {
    /// PNGs that were rendered before.
    Folder(&'a Path),
    /// The avatar, rendered now; its pictures are kept in the folder.
    Avatar(&'a Avatar, Look, &'a Path),
    /// The same with codes between those of training frames, by the view's id.
    Between(&'a Avatar, &'a BTreeMap<String, Between>, &'a Path),
}

/// What tells the parts of a picture apart.
const MAPS: Outputs = Outputs { depth: true, masks: true, head: false };

/// A picture with the render behind it, if it was rendered now.
struct Picture {
    rgb: RgbImage,
    render: Option<(Render, Camera)>,
}

/// Compares pictures with the true images that the list names. Parts of images are judged where the avatar tells them
/// apart, depth where the list names its truth; `networks` add LPIPS.
pub fn evaluate(
    views: &ViewList,
    list_path: &Path,
    judged: Judged<'_>,
    networks: &mut [(LpipsNetwork, Lpips)],
    reporter: &dyn Reporter,
) -> Result<Evaluation> {
    let base = list_path.parent().unwrap_or(Path::new("."));
    let with_truth = ViewList { views: views.views.iter().filter(|v| v.image.is_some()).cloned().collect() };
    let mut studio = match judged {
        Judged::Avatar(avatar, look, folder) => Some((
            avatar,
            Studio::new(avatar, Look { outputs: MAPS, ..look }),
            shots_of_views(avatar, &with_truth, reporter),
            folder,
        )),
        Judged::Folder(_) | Judged::Between(..) => None,
    };
    let mut scores = Vec::new();
    reporter.stage("evaluate", Some(with_truth.views.len() as u64));
    for (i, view) in with_truth.views.iter().enumerate() {
        if reporter.cancelled() {
            return Err(TrainerError::Interrupted { done: format!("{i} of {} views", with_truth.views.len()) });
        }
        let name = format!("{}.png", view.id);
        let (picture, regions) = match (&mut studio, judged) {
            (Some((avatar, studio, shots, folder)), _) => {
                let shot = &shots[i];
                let (rgb, render) = studio.picture_and_maps(&shot.camera, &shot.expression, reporter)?;
                write_png(&folder.join(name), &rgb)?;
                let reduce = (shot.camera.intrinsics.width / render.rgb.width().max(1)).max(1);
                let camera = shot.camera.reduced(reduce);
                (Picture { rgb, render: Some((render, camera)) }, avatar.saved.table.regions.as_slice())
            }
            (None, Judged::Between(avatar, places, folder)) => {
                let render = render_between(avatar, view, places, list_path, reporter)?;
                write_png(&folder.join(name), &render.rgb)?;
                let picture = Picture { rgb: render.rgb.clone(), render: Some((render, Camera::from(&view.camera))) };
                (picture, avatar.saved.table.regions.as_slice())
            }
            (None, Judged::Folder(folder) | Judged::Avatar(_, _, folder)) => {
                (Picture { rgb: crate::data::read_rgb(&folder.join(name))?, render: None }, &[][..])
            }
        };
        scores.push(judge(view, base, &picture, regions, networks)?);
        reporter.advance(1);
    }
    Evaluation::new(scores).ok_or_else(|| {
        FormatError::new(ErrorKind::Missing, "names no true image to compare with")
            .in_file(list_path)
            .with_hint("a view's `image` names the true picture, relative to the list")
            .into()
    })
}

fn render_between(
    avatar: &Avatar,
    view: &View,
    places: &BTreeMap<String, Between>,
    list_path: &Path,
    reporter: &dyn Reporter,
) -> Result<Render> {
    let fail = |message: String| FormatError::new(ErrorKind::Inconsistent, message).in_file(list_path);
    let place = places.get(&view.id).ok_or_else(|| fail(format!("`{}` is no held-out frame of the run", view.id)))?;
    let render = avatar.field.render_between(&Camera::from(&view.camera), *place, MAPS, reporter)?;
    Ok(render.ok_or_else(|| fail("this field has no codes to interpolate".to_owned()))?)
}

fn judge(
    view: &View,
    base: &Path,
    picture: &Picture,
    regions: &[String],
    networks: &mut [(LpipsNetwork, Lpips)],
) -> Result<ViewScore> {
    let path = base.join(view.image.as_deref().unwrap_or(Path::new("")));
    let truth = crate::data::read_rgb(&path)?;
    let rgb = &picture.rgb;
    let mut result = ViewScore {
        id: view.id.clone(),
        kind: view.kind.clone(),
        psnr_db: score(rgb, &truth, &path)?,
        ms_ssim: ms_ssim(rgb, &truth),
        ..ViewScore::default()
    };
    let mut lpips = BTreeMap::new();
    for (network, lpips_network) in networks.iter_mut() {
        if let Some(score) = lpips_network.compare(rgb, &truth)? {
            result.lpips.insert(*network, score.value);
            lpips.insert(*network, score);
        }
    }
    let Some((render, camera)) = &picture.render else { return Ok(result) };
    if let Some(parts) = Parts::new(rgb.dimensions(), render, regions) {
        result.parts_psnr_db = parts.each(|part| psnr_inside(rgb, &truth, |i| parts.has_pixel(part, i)));
        if let Some(map) = ssim_map(rgb, &truth) {
            result.parts_ssim = parts.each(|part| map.mean_inside(|i| parts.has_pixel(part, i)));
        }
        for (network, score) in &lpips {
            let by_part = parts.each(|part| score.inside(|x, y| parts.has(part, x, y)));
            result.parts_lpips.insert(*network, by_part);
        }
    }
    if let Some(file) = &view.depth {
        result.depth = depth::compare(render, camera, &depth::read(&base.join(file))?);
    }
    Ok(result)
}
