//! `trainer export` of Gaussians: files read back by other readers, and the page in a browser, against the avatar's own pictures.

use std::collections::BTreeMap;
use std::path::Path;

use image::{RgbImage, RgbaImage};
use risorius_formats::report::Silent;
use risorius_formats::{ActionUnit, Camera, Isometry};
use risorius_splat::{Outputs, Renderer, Skips};
use risorius_tests::{run, succeed, text, tiny};
use risorius_trainer::path::Orbit;
use risorius_trainer::{Avatar, cutout, devices};
use serde_json::json;

use super::readers::{self, Splat};
use super::viewing::browser_result;
use super::{json as parsed, made};

fn open(run_dir: &Path) -> Avatar {
    Avatar::open(run_dir, &devices::open("cpu").unwrap()).unwrap()
}

/// PSNR in dB over the pixels that `counts` names.
fn psnr(a: &RgbImage, b: &RgbImage, counts: impl Fn(usize) -> bool) -> f64 {
    assert_eq!(a.dimensions(), b.dimensions());
    let (mut sum, mut n) = (0.0, 0usize);
    for (_, (a, b)) in a.pixels().zip(b.pixels()).enumerate().filter(|(i, _)| counts(*i)) {
        sum += (0..3).map(|c| (f64::from(a.0[c]) - f64::from(b.0[c])).powi(2)).sum::<f64>();
        n += 3;
    }
    10.0 * (255.0f64.powi(2) / (sum / n.max(1) as f64).max(1e-9)).log10()
}

/// What the avatar's own camera sees of a file's Gaussians.
fn picture_of(splats: &[Splat], avatar: &Avatar) -> RgbImage {
    let model = readers::model(splats);
    let camera = Camera::from(&avatar.saved.default_camera);
    let camera = avatar.field.gaussians().unwrap().space().camera(&camera);
    let mut renderer = Renderer::new(&model, Skips::default());
    let picture = renderer.draw(&camera, &Isometry::IDENTITY, &[], None, Outputs::default());
    RgbImage::from_raw(picture.width as u32, picture.height as u32, picture.rgb.clone()).unwrap()
}

#[test]
fn files_of_gaussians_are_read_back_by_other_readers() {
    let made = made();
    let run_dir = made.given("run");
    let avatar = open(&run_dir);
    let camera = Camera::from(&avatar.saved.default_camera);
    let write = |name: &str, more: &[&str]| {
        let file = made.at(name);
        let args = ["export", text(&run_dir), "--out", text(&file), "--json"];
        let summary = parsed(&succeed("trainer", &[&args[..], more].concat()));
        let bytes = std::fs::read(&file).unwrap();
        assert_eq!(summary["bytes"].as_u64().unwrap(), bytes.len() as u64);
        (bytes, summary["gaussians"].as_u64().unwrap() as usize)
    };
    for aus in [vec![], vec![(ActionUnit(12), 3.0), (ActionUnit(26), 2.0)]] {
        let options: Vec<String> = aus.iter().flat_map(|(u, v)| ["--au".to_owned(), format!("{u}={v}")]).collect();
        let options: Vec<&str> = options.iter().map(String::as_str).collect();
        let expression = avatar.expression(&aus.into_iter().collect());
        let own = avatar.render(&camera, &expression, &Silent).unwrap().rgb;
        let (bytes, count) = write("avatar.ply", &options);
        let ply = readers::ply(&bytes);
        assert_eq!(ply.len(), count);
        let (bytes, _) = write("avatar.splat", &options);
        let dot_splat = readers::dot_splat(&bytes);
        let (bytes, _) = write("avatar.spz", &options);
        let (spz, antialiased) = readers::spz(&bytes);
        assert!(antialiased && spz.len() == count && dot_splat.len() == count);
        for (name, splats, least) in [("ply", &ply, 70.0), ("splat", &dot_splat, 45.0), ("spz", &spz, 48.0)] {
            let psnr = psnr(&picture_of(splats, &avatar), &own, |_| true);
            eprintln!("{name}: {psnr:.1} dB");
            assert!(psnr > least, "{name}: {psnr:.1} dB");
        }
        // Positions in millimetres, fixed point.
        let worst = ply.iter().zip(&spz).flat_map(|(a, b)| (0..3).map(move |c| (a.mean[c] - b.mean[c]).abs()));
        assert!(worst.fold(0.0, f32::max) < 1e-4);
    }
    let (_, all) = write("avatar.ply", &[]);
    let (_, head) = write("head.ply", &["--head-only"]);
    assert!(head > 0 && head <= all, "{head} of {all}");
}

#[test]
fn exports_that_make_no_sense_are_refused() {
    let made = made();
    let run_dir = made.given("run");
    let refused = |run_dir: &Path, name: &str, more: &[&str], code: i32, word: &str| {
        let out = made.at(name);
        let output = run("trainer", &[&["export", text(run_dir), "--out", text(&out)], more].concat());
        let said = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(output.status.code() == Some(code) && said.contains(word), "{name} {more:?}: {said}");
        assert!(!out.exists());
    };
    refused(&run_dir, "a.obj", &[], 2, ".spz");
    refused(&run_dir, "a.ply", &["--kind", "points"], 2, "`--kind` goes with .glb only");
    refused(&run_dir, "a.glb", &["--au", "AU12=3"], 2, "`--au` goes with");
    refused(&run_dir, "a.html", &["--head-only"], 2, "`--head-only` goes with");
    refused(&run_dir, "a.ply", &["--au", "AU12=9"], 2, "between 0 and 5");
    let networks = tiny().join("confies");
    for name in ["a.ply", "a.splat", "a.spz", "a.html"] {
        refused(&networks, name, &[], 1, "holds no Gaussians");
    }
    let table = made.at("bad.csv");
    std::fs::write(&table, "secs,smile\n0,1\n1,2\n").unwrap();
    refused(&run_dir, "a.html", &["--curves", text(&table)], 1, "bad.csv");
}

#[test]
fn the_page_is_one_file_and_shows_what_render_shows() {
    let made = made();
    let run_dir = made.given("run");
    let file = made.at("ada <1>.html");
    let curves = made.at("curves.csv");
    std::fs::write(&curves, "secs,AU12\n0,0\n1,4\n").unwrap();
    let summary = parsed(&succeed("trainer", &["export", text(&run_dir), "--out", text(&file), "--json"]));
    let page = std::fs::read_to_string(&file).unwrap();
    assert_eq!(summary["bytes"].as_u64().unwrap(), page.len() as u64);
    assert!(page.len() < 15_000_000 && !page.contains("http://") && !page.contains("https://"));
    assert!(!page.contains(text(&run_dir)), "no path of the machine");
    assert!(summary["most_levels"].as_f64().unwrap() < 2.0 && summary["most_mm"].as_f64().unwrap() < 0.5, "{summary}");
    let with = made.at("curves.html");
    let args = ["export", text(&run_dir), "--out", text(&with), "--curves", text(&curves), "--au", "AU12=2", "-q"];
    succeed("trainer", &args);
    assert!(std::fs::read_to_string(&with).unwrap().contains(r#""begin":{"AU12":2.0}"#));

    // Every AU alone at its strongest, pairs, presets; from the front and from the sides; by scene and cut out.
    let avatar = open(&run_dir);
    let (width, height) = (avatar.saved.default_camera.width, avatar.saved.default_camera.height);
    let active = avatar.saved.table.attributes.iter().filter(|a| a.active);
    let mut wanted: Vec<(Orbit, BTreeMap<ActionUnit, f32>, &str, u32)> =
        active.map(|a| (Orbit::default(), [(a.unit, a.au_max)].into(), "scene", 1)).collect();
    let mouth: BTreeMap<ActionUnit, f32> =
        [(ActionUnit(12), 3.0), (ActionUnit(25), 2.0), (ActionUnit(26), 2.5), (ActionUnit(4), 1.5)].into();
    let side = Orbit { yaw_deg: 14.0, pitch_deg: -6.0, ..Orbit::default() };
    let near = Orbit { zoom: 1.7, shift_x: 0.1, shift_y: -0.05, ..Orbit::default() };
    wanted.extend([
        (Orbit::default(), BTreeMap::new(), "scene", 1),
        (side, mouth.clone(), "scene", 1),
        (near, mouth.clone(), "scene", 2),
        (Orbit { yaw_deg: -20.0, ..near }, mouth.clone(), "scene", 2),
        (Orbit::default(), mouth.clone(), "clear", 2),
        (side, BTreeMap::new(), "clear", 1),
    ]);
    let pictures: Vec<serde_json::Value> = wanted
        .iter()
        .enumerate()
        .map(|(i, (orbit, aus, background, scale))| {
            json!({"id": format!("{i:03}"), "orbit": orbit, "aus": aus, "background": background, "width": width * scale, "height": height * scale})
        })
        .collect();
    let (list, folder) = (made.at("pictures.json"), made.at("pictures"));
    std::fs::write(&list, serde_json::to_string(&pictures).unwrap()).unwrap();
    let Some(result) = browser_result("share.mjs", &[text(&file), text(&list), text(&folder)]) else { return };
    assert!(result["checks"].as_u64().unwrap() > 40, "{result}");
    let reference = Camera::from(&avatar.saved.default_camera);
    let (mut least, mut sum) = (f64::INFINITY, 0.0);
    for (i, (orbit, aus, background, scale)) in wanted.iter().enumerate() {
        let camera = enlarged(&orbit.camera(&reference, avatar.saved.center_in_world), *scale);
        let render = avatar.render(&camera, &avatar.expression(aus), &Silent).unwrap();
        let shown = image::open(folder.join(format!("{i:03}.png"))).unwrap();
        let is_head = |p: usize| render.head[p][3] >= 0.5;
        let (head, all) = if *background == "scene" {
            let shown = shown.into_rgb8();
            (psnr(&shown, &render.rgb, is_head), psnr(&shown, &render.rgb, |_| true))
        } else {
            let cut = cutout::straight(&render.head, render.rgb.dimensions(), render.rgb.dimensions());
            let (shown, own) = (over_white(&shown.into_rgba8()), over_white(&cut));
            (psnr(&shown, &own, is_head), psnr(&shown, &own, |_| true))
        };
        eprintln!("{i:03} {background} ×{scale} {aus:?}: head {head:.1} dB, all {all:.1} dB");
        assert!(
            head >= 38.0 && all >= 38.0,
            "{i:03} {orbit:?} {aus:?} {background}: head {head:.1} dB, all {all:.1} dB"
        );
        least = least.min(head);
        sum += head;
    }
    eprintln!(
        "head: least {least:.1} dB, mean {:.1} dB; {} pictures a second at {}",
        sum / wanted.len() as f64,
        result["fps"],
        result["size"]
    );
}

/// The same view with `scale` times the pixels on each side.
fn enlarged(camera: &Camera, scale: u32) -> Camera {
    let (i, by) = (camera.intrinsics, f64::from(scale));
    let intrinsics = risorius_formats::Intrinsics {
        width: i.width * scale,
        height: i.height * scale,
        fx: i.fx * by,
        fy: i.fy * by,
        cx: i.cx * by,
        cy: i.cy * by,
        skew: i.skew * by,
        ..i
    };
    Camera { intrinsics, ..*camera }
}

fn over_white(picture: &RgbaImage) -> RgbImage {
    RgbImage::from_fn(picture.width(), picture.height(), |x, y| {
        let [r, g, b, a] = picture.get_pixel(x, y).0.map(f32::from);
        image::Rgb([r, g, b].map(|c| (c * a / 255.0 + 255.0 - a).round() as u8))
    })
}
