//! Throw-away.
#![allow(
    clippy::all,
    clippy::pedantic,
    clippy::print_stdout,
    clippy::unwrap_used,
    unused_crate_dependencies,
    missing_docs
)]
use glam::DVec3;
use risorius_formats::attribute::AttributeTable;
use risorius_formats::intensities::Intensities;
use risorius_formats::nerfies::{self, Dataset};
use risorius_formats::views::ViewList;
use risorius_formats::{Camera, Isometry};
use risorius_splat::scene::{Frame, Scene};
use risorius_splat::{Fitter, Outputs, Renderer, Settings, Skips};
fn cpu() -> f64 {
    let s = std::fs::read_to_string("/proc/self/stat").unwrap();
    let f: Vec<&str> = s.rsplit(')').next().unwrap().split_whitespace().collect();
    (f[11].parse::<f64>().unwrap() + f[12].parse::<f64>().unwrap()) / 100.0
}
fn main() {
    let args: Vec<String> = std::env::args().collect();
    println!("{:?} {:?}", risorius_splat::simd::level(), risorius_splat::floor::measure());
    let dir = std::path::Path::new(&args[1]);
    let budget: f64 = args[2].trim_end_matches('s').parse().unwrap();
    let by_cpu = args[2].ends_with('s');
    let views = args.get(3).map(|p| ViewList::read(p).unwrap());
    let scale: u32 = std::env::var("SCALE").ok().map_or(2, |s| s.parse().unwrap());
    let mut settings = Settings::default();
    if let Ok(s) = std::env::var("SET") {
        let mut v: serde_json::Value = serde_json::to_value(&settings).unwrap();
        for kv in s.split(',') {
            let (k, x) = kv.split_once('=').unwrap();
            v[k] = serde_json::from_str(&x.replace(';', ",")).unwrap();
        }
        settings = serde_json::from_value(v).unwrap();
    }
    let ds = Dataset::read(dir).unwrap();
    let table = AttributeTable::read(dir.join("attributes.toml")).unwrap();
    let intens = Intensities::read(dir).unwrap().unwrap();
    let lms = risorius_formats::landmark_table::LandmarkTable::read(dir).unwrap();
    let ex = ds.extras.clone().unwrap();
    let mpu = ex.units_per_metre.map_or(0.09 / ex.head_radius, |u| 1.0 / u);
    println!("metres per unit {mpu}, head radius {} m", ex.head_radius * mpu);
    // mean camera axes
    let cams: Vec<Camera> = ds.train_ids.iter().map(|id| ds.cameras[id]).collect();
    let fwd = cams.iter().map(|c| c.camera_from_world.rotation.row(2)).sum::<DVec3>().normalize();
    let down = cams.iter().map(|c| c.camera_from_world.rotation.row(1)).sum::<DVec3>();
    let down = (down - fwd * down.dot(fwd)).normalize();
    let right = down.cross(fwd);
    let rot = glam::DMat3::from_cols(right, down, fwd).transpose(); // scene_from_world
    let conv = |c: &Camera| {
        let mut c = *c;
        // x_cam = R xw + t ; xs = s rot (xw - head) ; xw = rot^T xs / s + head
        let r = c.camera_from_world.rotation * rot.transpose();
        let t = (c.camera_from_world.rotation * ex.head_center + c.camera_from_world.translation) * mpu;
        c.camera_from_world = Isometry::new(r, t);
        c
    };
    let act = |spec: &risorius_formats::AttributeSpec, v: f32| {
        risorius_formats::AuScale::new(spec).activation(risorius_formats::Intensity(v)).0
    };
    struct Own {
        camera: Camera,
        rgb: Vec<u8>,
        labels: Option<Vec<u8>>,
        acts: Option<Vec<f32>>,
        lms: Option<[[f32; 2]; 68]>,
        valid: Option<Vec<u8>>,
    }
    let t0 = std::time::Instant::now();
    use rayon::prelude::*;
    let own: Vec<Own> = ds
        .train_ids
        .par_iter()
        .map(|id| {
            let rgb = image::open(nerfies::rgb_path(dir, scale, id)).unwrap().into_rgb8().into_raw();
            let lp = nerfies::region_path(dir, scale, id);
            let labels = lp.is_file().then(|| risorius_formats::mask::LabelImage::read_png(&lp).unwrap().labels);
            let vp = nerfies::valid_path(dir, scale, id);
            let valid = vp.is_file().then(|| risorius_formats::mask::LabelImage::read_png(&vp).unwrap().labels);
            let acts = intens.rows.get(id).map(|row| {
                table
                    .attributes
                    .iter()
                    .map(|s| {
                        let c = intens.units.iter().position(|u| *u == s.unit);
                        if !s.active { 0.0 } else { c.map_or(0.0, |c| act(s, row[c])) }
                    })
                    .collect()
            });
            let l = lms.as_ref().and_then(|t| t.rows.get(id)).map(|p| {
                let mut q = p.points_px;
                for v in q.iter_mut().flatten() {
                    *v /= scale as f32;
                }
                q
            });
            Own { camera: conv(&ds.cameras[id].reduced(scale)), rgb, labels, acts, lms: l, valid }
        })
        .collect();
    println!("loaded {} frames in {:.1} s", own.len(), t0.elapsed().as_secs_f64());
    let scene = Scene {
        frames: own
            .iter()
            .map(|o| Frame {
                camera: o.camera,
                room_from_head: Isometry::IDENTITY,
                rgb: &o.rgb,
                valid: o.valid.as_deref(),
                labels: o.labels.as_deref(),
                activations: o.acts.clone(),
                landmarks_px: o.lms,
            })
            .collect(),
        region_of: table.attributes.iter().map(|a| a.region).collect(),
        regions: table.regions.len(),
        face_radius_m: (ex.head_radius * mpu) as f32,
        head_hull: None,
        plate: None,
        neutral_frame: 0,
    };
    let c0 = cpu();
    let t0 = std::time::Instant::now();
    let mut fitter = Fitter::new(&scene, settings, &|s| println!("  {:.1} s: {s}", t0.elapsed().as_secs_f64()));
    println!("begun after {:.2} two-core s; deformable groups {}", (cpu() - c0) / 2.0, fitter.model.deformable);
    let mut next = 0.0;
    let (mut mse, mut n) = (0.0, 0);
    let mut prev = cpu();
    loop {
        let done = if by_cpu { (prev - c0) / 2.0 / budget } else { fitter.progress.step as f64 / budget };
        if done >= 1.0 {
            break;
        }
        let s = fitter.step(&scene, done as f32);
        if fitter.progress.step % 4 == 0 {
            prev = cpu();
        }
        mse += s.color;
        n += 1;
        if done >= next {
            println!(
                "step {} {:.1}s2 done {:.2}: train {:.2} dB, {} gaussians, {} visible, {} pairs, mask {:.4} eq17 {:.3} bad {}",
                fitter.progress.step,
                (cpu() - c0) / 2.0,
                done,
                -10.0 * (mse / n as f64).log10(),
                s.gaussians,
                s.visible,
                s.pairs,
                s.mask,
                s.attribute,
                s.not_finite
            );
            next += 0.1;
            mse = 0.0;
            n = 0;
        }
    }
    println!(
        "fit: {} steps, {:.1} two-core s, wall {:.1}",
        fitter.progress.step,
        (cpu() - c0) / 2.0,
        t0.elapsed().as_secs_f64()
    );
    let model = fitter.avatar();
    println!("model {:.1} MB", model.bytes() as f64 / 1e6);
    let Some(views) = views else { return };
    let base = std::path::Path::new(&args[3]).parent().unwrap().to_owned();
    let mut r = Renderer::new(&model, Skips::default());
    let out_dir = std::env::var("OUT").ok();
    let mut kinds: std::collections::BTreeMap<String, Vec<[f64; 3]>> = Default::default();
    let raw: serde_json::Value = serde_json::from_str(&std::fs::read_to_string(&args[3]).unwrap()).unwrap();
    for (v, rawv) in views.views.iter().zip(raw["views"].as_array().unwrap()) {
        let cam = conv(&Camera::from(&v.camera));
        let a: Vec<f32> = table
            .attributes
            .iter()
            .map(|s| if s.active { act(s, v.aus.get(&s.unit).copied().unwrap_or(s.neutral)) } else { 0.0 })
            .collect();
        let pic = r.draw(&cam, &Isometry::IDENTITY, &a, None, Outputs::default());
        let truth = image::open(base.join(v.image.as_ref().unwrap())).unwrap().into_rgb8();
        let depth = image::open(base.join(format!("{}_depth.png", v.id))).unwrap().into_luma16();
        let head_d = (cam.center().length() * 1000.0 + 120.0) as u16;
        let mut e = [(0.0f64, 0usize); 3];
        for (i, (p, q)) in pic.rgb.chunks(3).zip(truth.as_raw().chunks(3)).enumerate() {
            let d: f64 = p.iter().zip(q).map(|(a, b)| (f64::from(*a) - f64::from(*b)).powi(2)).sum();
            let z = depth.as_raw()[i];
            let head = z > 0 && z < head_d;
            for k in [0, if head { 1 } else { 2 }] {
                e[k].0 += d;
                e[k].1 += 3;
            }
        }
        let psnr = e.map(|(s, n)| 10.0 * (255.0 * 255.0 / (s / n.max(1) as f64)).log10());
        kinds.entry(rawv["kind"].as_str().unwrap_or("?").to_owned()).or_default().push(psnr);
        kinds.entry("all".into()).or_default().push(psnr);
        if let Some(o) = &out_dir {
            std::fs::create_dir_all(o).unwrap();
            let mut img = image::RgbImage::new(540, 480);
            image::imageops::replace(&mut img, &truth, 0, 0);
            image::imageops::replace(&mut img, &image::RgbImage::from_raw(270, 480, pic.rgb.clone()).unwrap(), 270, 0);
            img.save(format!("{o}/{}.png", v.id)).unwrap();
        }
    }
    for (k, list) in &kinds {
        let m: [f64; 3] = std::array::from_fn(|i| list.iter().map(|p| p[i]).sum::<f64>() / list.len() as f64);
        println!("{k:>24}: whole {:.2} head {:.2} background {:.2}", m[0], m[1], m[2]);
    }
    let c = conv(&Camera::from(&views.views[0].camera));
    let mut times = vec![];
    for i in 0..200 {
        let mut a = vec![0.0; scene.region_of.len()];
        a[i % 17] = 0.7;
        let t = std::time::Instant::now();
        r.draw(&c, &Isometry::IDENTITY, &a, None, Outputs::default());
        times.push(t.elapsed().as_secs_f64());
    }
    times.sort_by(f64::total_cmp);
    println!("picture: median {:.2} ms, best {:.2} ms", times[100] * 1e3, times[0] * 1e3);
}
