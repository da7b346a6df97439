//! Which of the two a take is: a camera that moves around a head, or a head that moves before a still camera.
//!
//! Textured places beside the head are looked for where they were, in key frames half a second and more apart. Before a
//! still camera they are still there.

use std::collections::BTreeMap;

use glam::{DMat2, DVec2};
use rayon::prelude::*;
use risorius_formats::polygon::hull_contains;

use super::mask::{GRID_PX, STRONG};
use super::patch::{SAME, Template};
use super::picture::Picture;
use super::triangulate::median;

/// A place is where it was within this share of the longer side.
const STILL_SHARE: f64 = 0.004;
/// A still camera leaves at least this share of the places where they were.
const STILL: f64 = 0.6;
/// Places needed in a pair of pictures, and pairs needed.
const LEAST_PLACES: usize = 15;
const LEAST_PAIRS: usize = 3;
/// Head and hair reach this far from the face, in face sizes to the side and upwards …
const HEAD_REACH: [f64; 2] = [0.35, 0.5];
/// … and below the chin the body so far to each side.
const BODY_REACH: f64 = 1.3;
/// Where only the person has texture, a share like this stays in place before a still camera: bodies sway.
const STILL_BODY: f64 = 0.12;
/// … and COLMAP needs so many textured places beside the face.
const LEAST_BODY_PLACES: usize = 80;

/// What the cameras follow from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Choice {
    Colmap,
    Head,
}

/// The method for the take, and why.
pub(crate) fn decide(pictures: &BTreeMap<u32, Picture>, outlines: &BTreeMap<u32, Vec<DVec2>>) -> (Choice, String) {
    let seen: Vec<(&Picture, &Vec<DVec2>)> = pictures.iter().filter_map(|(f, p)| Some((p, outlines.get(f)?))).collect();
    if seen.len() < LEAST_PAIRS + 1 {
        return (
            Choice::Colmap,
            "chose COLMAP: too few key frames with landmarks to tell whether the camera moves".into(),
        );
    }
    let next = (1..seen.len()).map(|i| (i - 1, i));
    let first = (2..seen.len()).map(|i| (0, i));
    let pairs: Vec<(usize, usize)> = next.chain(first).collect();
    let share_of = |with_body: bool| {
        let mut shares: Vec<f64> =
            pairs.par_iter().filter_map(|&(a, b)| still_share(seen[a], seen[b], with_body)).collect();
        if shares.len() < LEAST_PAIRS { None } else { median(&mut shares) }
    };
    let (what, share, least) = match (share_of(false), share_of(true)) {
        (Some(share), _) => ("the background", share, STILL),
        (None, Some(share)) => ("what is seen beside the face", share, STILL_BODY),
        (None, None) => {
            let why = "chose the head route: nothing textured beside the face, only the face can tell".to_owned();
            return (Choice::Head, why);
        }
    };
    let percent = 100.0 * share;
    if share >= least {
        (
            Choice::Head,
            format!("chose the head route: the camera stands still, {percent:.0} % of {what} stays in place"),
        )
    } else {
        (Choice::Colmap, format!("chose COLMAP: the camera moves, only {percent:.0} % of {what} stays in place"))
    }
}

/// Whether a place belongs to neither head nor body.
fn is_beside(outline: &[DVec2], p: DVec2) -> bool {
    let (mut lo, mut hi) = (DVec2::INFINITY, DVec2::NEG_INFINITY);
    for q in outline {
        lo = lo.min(*q);
        hi = hi.max(*q);
    }
    let size = hi - lo;
    let reach = if p.y > hi.y { BODY_REACH } else { HEAD_REACH[0] } * size.x;
    p.x < lo.x - reach || p.x > hi.x + reach || p.y < lo.y - HEAD_REACH[1] * size.y
}

/// Share of the textured places beside the person that stay where they are; `None` with too few of them.
fn still_share(a: (&Picture, &Vec<DVec2>), b: (&Picture, &Vec<DVec2>), with_body: bool) -> Option<f64> {
    let [width, height] = a.0.size();
    let most = STILL_SHARE * f64::from(width.max(height));
    let (mut places, mut still) = (0usize, 0usize);
    for y in 0..height / GRID_PX {
        for x in 0..width / GRID_PX {
            let at = DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5) * f64::from(GRID_PX);
            let beside = |outline: &[DVec2]| {
                if with_body { !hull_contains(outline, at) } else { is_beside(outline, at) }
            };
            if !beside(a.1) || !beside(b.1) {
                continue;
            }
            let Some(template) = Template::cut(a.0, 0, at, false).filter(|t| t.strength >= STRONG) else { continue };
            places += 1;
            let found = template.find(b.0, at, DMat2::IDENTITY);
            still += usize::from(found.is_some_and(|m| m.similarity >= SAME && m.centre.distance(at) <= most));
        }
    }
    (places >= if with_body { LEAST_BODY_PLACES } else { LEAST_PLACES }).then(|| still as f64 / places as f64)
}

#[cfg(test)]
mod tests {
    use super::*;
    use image::{Rgb, RgbImage};

    /// A pattern that moves `step` pixels a frame behind a head that moves 9.
    fn take(step: f64, textured: bool) -> (BTreeMap<u32, Picture>, BTreeMap<u32, Vec<DVec2>>) {
        let picture = |i: u32| {
            let shift = f64::from(i) * step;
            Picture::new(&RgbImage::from_fn(320, 240, |x, y| {
                let (x, y) = (f64::from(x) + shift, f64::from(y) + 0.3 * shift);
                let wave =
                    (0.43 * x + 0.1 * y).sin() + (0.37 * y - 0.21 * x).sin() + (0.031 * x * (0.05 * y).sin()).cos();
                Rgb([if textured { (128.0 + 35.0 * wave) as u8 } else { 150 }; 3])
            }))
        };
        let outline = |i: u32| {
            let at = DVec2::new(120.0 + 9.0 * f64::from(i), 140.0);
            [(-15.0, -20.0), (15.0, -20.0), (15.0, 20.0), (-15.0, 20.0)].map(|(x, y)| at + DVec2::new(x, y)).to_vec()
        };
        ((0..6).map(|i| (i, picture(i))).collect(), (0..6).map(|i| (i, outline(i))).collect())
    }

    #[test]
    fn a_still_background_means_the_head_and_a_moving_one_the_camera() {
        let decide_of = |(pictures, outlines): (BTreeMap<_, _>, BTreeMap<_, _>)| decide(&pictures, &outlines);
        let (choice, why) = decide_of(take(0.0, true));
        assert!(choice == Choice::Head && why.contains("stands still"), "{why}");
        let (choice, why) = decide_of(take(4.3, true));
        assert!(choice == Choice::Colmap && why.contains("moves"), "{why}");
        let (choice, why) = decide_of(take(0.0, false));
        assert!(choice == Choice::Head && why.contains("nothing textured"), "{why}");
        let (pictures, _) = take(0.0, true);
        assert_eq!(decide(&pictures, &BTreeMap::new()).0, Choice::Colmap);
    }
}
