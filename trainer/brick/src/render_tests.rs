//! Pictures that are brought up to date, and baked ones, against pictures rendered from nothing.

use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::*;
use crate::model::{BackgroundFrame, HeadBox, Layout};

/// A soft avatar of two AUs in two regions that meet, smooth enough to be baked.
fn soft() -> Brick {
    let layout = Layout {
        head_box: HeadBox { center: [0.0; 3], half: 0.5 },
        background: Some(BackgroundFrame {
            position: [0.0, 0.0, -2.0],
            axes: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
            near: 2.6,
            far: 6.0,
            middle: [0.0; 2],
            extent: [0.5; 2],
        }),
        region_of: vec![0, 1],
        regions: 2,
        images: 1,
        expression_vertices: 16,
        finest: 128,
    };
    let mut model = Brick::new(layout, 3, |p| u8::from(p[1] < -0.1) | u8::from(p[1] > 0.1) << 1);
    let mut rng = ChaCha8Rng::seed_from_u64(5);
    let mut stir =
        |values: &mut [f32], size: f32| values.iter_mut().for_each(|v| *v = (rng.random::<f32>() - 0.5) * size);
    for part in [Some(&mut model.head), model.background.as_mut()].into_iter().flatten() {
        part.field.live = 1;
        stir(&mut part.field.features[0].values, 1.5);
        stir(&mut part.field.net.values, 1.0);
    }
    for table in &mut model.expression.residuals {
        stir(&mut table.values, 0.1);
        table.steps.fill(1);
    }
    stir(&mut model.expression.masks.values, 6.0);
    model
}

const ORIGIN: [f32; 3] = [0.02, 0.03, -2.0];

fn directions() -> Vec<[f32; 3]> {
    (0..24 * 24)
        .map(|i| {
            let d = [((i % 24) as f32 / 24.0 - 0.5) * 0.5, ((i / 24) as f32 / 24.0 - 0.5) * 0.5, 1.0f32];
            let n = (d[0] * d[0] + d[1] * d[1] + 1.0).sqrt();
            d.map(|v| v / n)
        })
        .collect()
}

/// Largest and mean difference of two pictures.
fn apart(a: &[Shown], b: &[Shown]) -> (f32, f32) {
    let each: Vec<f32> =
        a.iter().zip(b).flat_map(|(a, b)| (0..3).map(move |c| (a.color[c] - b.color[c]).abs())).collect();
    (each.iter().copied().fold(0.0, f32::max), each.iter().sum::<f32>() / each.len() as f32)
}

#[test]
fn an_edited_picture_is_that_rendered_from_nothing() {
    let model = soft();
    let directions = directions();
    let mut face = Face::new(&model, &[-1.0, -1.0]);
    let mut picture = face.picture(ORIGIN, directions.clone());
    let mut fewest = directions.len();
    for attributes in [[0.5, -1.0], [0.5, 0.2], [-1.0, 0.2], [-1.0, 0.2], [1.0, 1.0]] {
        let changed = face.edit(&attributes);
        let sent = face.redraw(&mut picture, changed).len();
        fewest = fewest.min(sent);
        assert_eq!(picture.shown, Face::new(&model, &attributes).render(ORIGIN, &directions), "{attributes:?}");
    }
    assert_eq!(fewest, 0, "an edit that changes nothing sends no ray");
    let changed = face.edit(&[-1.0, 1.0]);
    assert_eq!(changed, 0b01, "only the first region's AU moved");
    let sent = face.redraw(&mut picture, changed).len();
    assert!(sent > 0 && sent < directions.len() * 3 / 4, "{sent} of {} rays", directions.len());
}

#[test]
fn a_baked_picture_is_close_to_a_direct_one() {
    let model = soft();
    let directions = directions();
    let direct = Face::new(&model, &[0.4, -0.6]).render(ORIGIN, &directions);
    let mut baked = BakedFace::new(&model, &[0.4, -0.6], ORIGIN);
    assert!(baked.vertices().iter().all(|&n| n > 1000), "{:?}", baked.vertices());
    let picture = baked.picture(ORIGIN, directions);
    let (worst, mean) = apart(&picture.shown, &direct);
    assert!(worst < 0.05 && mean < 0.004, "baked differs by {worst}, {mean} in the mean");
}

#[test]
fn a_baked_picture_follows_an_edit() {
    let model = soft();
    let directions = directions();
    let mut baked = BakedFace::new(&model, &[-1.0, -1.0], ORIGIN);
    let mut picture = baked.picture(ORIGIN, directions.clone());
    baked.edit(&[0.8, -1.0]);
    let sent = baked.redraw(&mut picture).len();
    assert!(sent > 0, "the edit changes nothing");
    let anew = BakedFace::new(&model, &[0.8, -1.0], ORIGIN).picture(ORIGIN, directions);
    let (worst, _) = apart(&picture.shown, &anew.shown);
    assert!(worst < 0.01, "an edit differs from baking anew by {worst}");
    baked.edit(&[0.8, -1.0]);
    assert_eq!(baked.redraw(&mut picture).len(), 0, "nothing changed");
}

#[test]
fn the_head_alone_is_what_the_scene_shows_without_its_background() {
    let model = soft();
    let directions = directions();
    let whole = Face::new(&model, &[0.4, -0.6]).render(ORIGIN, &directions);
    let mut alone = model.clone();
    alone.background = None;
    let alone = Face::new(&alone, &[0.4, -0.6]).render(ORIGIN, &directions);
    let mut soft = 0;
    for (whole, alone) in whole.iter().zip(&alone) {
        let [red, green, blue, opacity] = whole.head;
        assert_eq!(whole.head, alone.head);
        assert_eq!([red, green, blue], alone.color);
        assert!((1.0 - opacity - alone.left).abs() < 1e-4, "{opacity} {}", alone.left);
        // Premultiplied: a colour is never stronger than its opacity.
        assert!([red, green, blue].iter().all(|&c| c <= opacity + 1e-4));
        soft += usize::from((0.05..0.95).contains(&opacity));
    }
    assert!(soft > 0, "no ray is half opaque");
}

#[test]
fn an_au_changes_nothing_where_its_mask_rounds_to_nothing() {
    let mut model = soft();
    // Warps and features strong enough to show where a mask is next to nothing.
    model.expression.residuals.iter_mut().flat_map(|t| &mut t.values).for_each(|v| *v *= 40.0);
    let directions: Vec<[f32; 3]> = (0..96 * 96)
        .map(|i| {
            let d = [((i % 96) as f32 / 96.0 - 0.5) * 0.5, ((i / 96) as f32 / 96.0 - 0.5) * 0.5, 1.0f32];
            let n = (d[0] * d[0] + d[1] * d[1] + 1.0).sqrt();
            d.map(|v| v / n)
        })
        .collect();
    let (mut as_it_came, mut inside) = (0.0f32, 0.0f32);
    for (n, other) in [(0, -1.0), (1, -1.0), (0, 0.7), (1, 0.7)] {
        let mut attributes = [other; 2];
        let pictures = [-1.0, 1.0].map(|value| {
            attributes[n] = value;
            let face = Face::new(&model, &attributes);
            let mut as_it_comes = vec![Shown::default(); directions.len()];
            face.render_with(&face.blend, ORIGIN, &directions, &mut as_it_comes);
            (face.render(ORIGIN, &directions), as_it_comes)
        });
        let [(rest, rest_came), (edited, edited_came)] = pictures;
        for ((a, b), (c, d)) in rest.iter().zip(&edited).zip(rest_came.iter().zip(&edited_came)) {
            let apart = |a: &Shown, b: &Shown| (0..3).map(|c| (a.color[c] - b.color[c]).abs()).fold(0.0, f32::max);
            let mask = a.masks[n].max(b.masks[n]);
            if mask < NOTHING {
                assert!(apart(a, b) < 0.5 / 255.0, "{} at {mask}", apart(a, b));
                as_it_came = as_it_came.max(apart(c, d));
            } else if mask > 0.1 {
                inside = inside.max(apart(a, b));
            }
        }
    }
    assert!(as_it_came > 0.5 / 255.0, "without it nothing would have shown either: {as_it_came}");
    assert!(inside > 2.0 * as_it_came, "AUs still act inside: {inside}");
}

#[test]
fn what_a_face_keeps_from_earlier_pictures_does_not_show() {
    let mut model = soft();
    model.expression.residuals.iter_mut().flat_map(|t| &mut t.values).for_each(|v| *v *= 40.0);
    let directions = directions();
    let mut face = Face::new(&model, &[-1.0, -1.0]);
    let aside = [-0.2, 0.1, -1.9];
    let mut picture = face.picture(aside, directions[..7].to_vec());
    let mut kept = 0;
    for (attributes, origin) in [
        ([1.0, 0.7], ORIGIN),
        ([1.0, 0.7], aside),
        ([1.0, -0.2], aside),
        ([0.3, -0.2], ORIGIN),
        ([0.3, -0.2], aside),
        ([-1.0, 0.9], ORIGIN),
    ] {
        face.edit(&attributes);
        kept += face.without.iter().filter(|blend| blend.get().is_some()).count();
        face.take_again(&mut picture, origin, directions.clone());
        assert_eq!(picture.shown, Face::new(&model, &attributes).render(origin, &directions), "{attributes:?}");
    }
    assert!(kept > 2, "nothing was kept: {kept}");
}
