//! CPU time of a brick avatar's pictures.
#![allow(clippy::all, clippy::pedantic, clippy::unwrap_used, clippy::print_stdout, missing_docs)]
use glam::DVec2;
use risorius_brick::render::{BakedFace, Face};
use risorius_formats::views::ViewList;
use risorius_trainer::brick::store::{self, Content};
use risorius_trainer::saved::{SavedField, SavedModel};
use std::path::Path;
fn cpu() -> f64 {
    let s = std::fs::read_to_string("/proc/self/schedstat").unwrap();
    let _ = s;
    let mut t = 0.0;
    for e in std::fs::read_dir("/proc/self/task").unwrap() {
        let p = e.unwrap().path().join("schedstat");
        if let Ok(s) = std::fs::read_to_string(p) {
            t += s.split_whitespace().next().unwrap().parse::<f64>().unwrap();
        }
    }
    t * 1e-9
}
fn main() {
    let a: Vec<String> = std::env::args().collect();
    let saved = SavedModel::read(Path::new(&a[1])).unwrap();
    let SavedField::Brick(b) = &saved.field else { panic!() };
    let model = store::read(&Path::new(&a[1]).join("model.safetensors"), b, Content::Avatar, &[]).unwrap().model;
    let views = ViewList::read(Path::new(&a[2])).unwrap();
    let every: usize = a[3].parse().unwrap();
    let mut full = 0.0;
    let mut n = 0.0;
    let mut edits = [[0.0f64; 2]; 3];
    for v in views.views.iter().step_by(every) {
        let cam = risorius_formats::Camera::from(&v.camera);
        let (w, h) = (cam.intrinsics.width as usize, cam.intrinsics.height as usize);
        let attrs: Vec<f32> = saved
            .table
            .attributes
            .iter()
            .map(|s| v.aus.get(&s.unit).map_or(s.neutral_attribute(), |&x| s.attribute_from_intensity(x)))
            .collect();
        let dirs: Vec<[f32; 3]> = (0..w * h)
            .map(|p| {
                cam.ray_direction(DVec2::new((p % w) as f64 + 0.5, (p / w) as f64 + 0.5)).unwrap().as_vec3().to_array()
            })
            .collect();
        let o = cam.center().as_vec3().to_array();
        let mut face = Face::new(&model, &attrs);
        let t = cpu();
        let mut px = face.render(o, &dirs);
        full += cpu() - t;
        n += 1.0;
        for r in 0..3 {
            let k = saved.table.attributes.iter().position(|s| s.region == r).unwrap();
            let mut at = attrs.clone();
            at[k] = if at[k] > 0.0 { -0.5 } else { 0.7 };
            let t = cpu();
            let changed = face.edit(&at);
            let c = face.redraw(o, &dirs, &mut px, changed);
            edits[r][0] += cpu() - t;
            edits[r][1] += c as f64;
            assert!(px == face.render(o, &dirs), "edit differs");
            face.edit(&attrs);
            face.redraw(o, &dirs, &mut px, changed);
        }
    }
    let psnr = |a: &[risorius_brick::render::Shown], b: &[risorius_brick::render::Shown]| {
        let e: f64 = a
            .iter()
            .zip(b)
            .map(|(a, b)| {
                (0..3).map(|c| ((a.color[c] + a.left * 0.5 - b.color[c] - b.left * 0.5) as f64).powi(2)).sum::<f64>()
            })
            .sum::<f64>()
            / (3 * a.len()) as f64;
        -10.0 * e.log10()
    };
    let (mut bk, mut pic, mut ps, mut pe) = (0.0, 0.0, 0.0, 0.0);
    let mut ed = [[0.0f64; 3]; 3];
    let mut truth = [0.0f64; 2];
    for v in views.views.iter().step_by(every) {
        let cam = risorius_formats::Camera::from(&v.camera);
        let (w, h) = (cam.intrinsics.width as usize, cam.intrinsics.height as usize);
        let attrs: Vec<f32> = saved
            .table
            .attributes
            .iter()
            .map(|s| v.aus.get(&s.unit).map_or(s.neutral_attribute(), |&x| s.attribute_from_intensity(x)))
            .collect();
        let dirs: Vec<[f32; 3]> = (0..w * h)
            .map(|p| {
                cam.ray_direction(DVec2::new((p % w) as f64 + 0.5, (p / w) as f64 + 0.5)).unwrap().as_vec3().to_array()
            })
            .collect();
        let o = cam.center().as_vec3().to_array();
        let eye = risorius_formats::Camera::from(&saved.default_camera).center().as_vec3().to_array();
        let t = cpu();
        let mut b = BakedFace::new(&model, &attrs, eye);
        bk += cpu() - t;
        if n == 0.0 || true {
            println!("vertices {:?}", b.vertices());
        }
        let t = cpu();
        let mut p = b.picture(o, dirs.clone());
        pic += cpu() - t;
        let direct = Face::new(&model, &attrs).render(o, &dirs);
        ps += psnr(&p.shown, &direct);
        let im = risorius_trainer::data::read_rgb(&Path::new(&a[2]).parent().unwrap().join(v.image.as_ref().unwrap()))
            .unwrap();
        let real: Vec<_> = im
            .as_raw()
            .chunks_exact(3)
            .map(|c| risorius_brick::render::Shown {
                color: [0, 1, 2].map(|k| c[k] as f32 / 255.0),
                ..Default::default()
            })
            .collect();
        truth[0] += psnr(&p.shown, &real);
        truth[1] += psnr(&direct, &real);
        for r in 0..3 {
            let k = saved.table.attributes.iter().position(|s| s.region == r).unwrap();
            let mut at = attrs.clone();
            at[k] = if at[k] > 0.0 { -0.5 } else { 0.7 };
            let t = cpu();
            b.edit(&at);
            ed[r][2] += cpu() - t;
            let c = b.redraw(&mut p);
            ed[r][0] += cpu() - t;
            ed[r][1] += c as f64;
            let again = BakedFace::new(&model, &at, eye).picture(o, dirs.clone());
            pe += psnr(&p.shown, &again.shown) / 3.0;
            b.edit(&attrs);
            b.redraw(&mut p);
        }
    }
    println!(
        "bake {:.1} picture {:.1} CPU ms, psnr vs direct {:.2}, edited vs baked anew {:.2}; against truth {:.2}, direct {:.2}",
        bk / n * 1e3,
        pic / n * 1e3,
        ps / n,
        pe / n,
        truth[0] / n,
        truth[1] / n
    );
    for (r, e) in ed.iter().enumerate() {
        println!(
            "baked edit region {r}: {:.1} CPU ms of which bake {:.1}, {:.0} pixels",
            e[0] / n * 1e3,
            e[2] / n * 1e3,
            e[1] / n
        );
    }
    println!("full {:.1} CPU ms ({:.1} ms on 2 cores)", full / n * 1e3, full / n * 500.0);
    for (r, e) in edits.iter().enumerate() {
        println!(
            "edit region {r}: {:.1} CPU ms ({:.1} on 2 cores), {:.0} pixels",
            e[0] / n * 1e3,
            e[0] / n * 500.0,
            e[1] / n
        );
    }
}
