//! peek
use glam::{DMat3, DVec3};
use risorius_formats::*;
use risorius_synth::*;
fn camera(yaw: f64, pitch: f64, w: u32, h: u32) -> Camera {
    let (y, p) = (yaw.to_radians(), pitch.to_radians());
    let d = DVec3::new(y.sin() * p.cos(), p.sin(), y.cos() * p.cos());
    let c = d * 0.55;
    let z = -d;
    let x = z.cross(DVec3::Y).normalize();
    let yv = z.cross(x);
    let r = DMat3::from_cols(x, yv, z).transpose();
    Camera {
        intrinsics: Intrinsics::pinhole(w, h, w as f64 * 576.0 / 270.0),
        camera_from_world: Isometry::new(r, -(r * c)),
    }
}
fn main() {
    let k: u32 = std::env::args().nth(1).map_or(1, |a| a.parse().unwrap());
    let (w, h) = (270 * k, 480 * k);
    let t = std::time::Instant::now();
    let s = Scene::new(Person::subject(1), 1);
    println!("build {:?}", t.elapsed());
    let list: Vec<(f64, f64, Vec<(u8, f32)>)> = vec![
        (0.0, 0.0, vec![]),
        (30.0, 10.0, vec![]),
        (-30.0, -10.0, vec![]),
        (0.0, 0.0, vec![(12, 5.0)]),
        (0.0, 0.0, vec![(26, 5.0)]),
        (0.0, 0.0, vec![(2, 5.0)]),
        (0.0, 0.0, vec![(45, 5.0)]),
        (0.0, 0.0, vec![(4, 5.0)]),
        (0.0, 0.0, vec![(1, 5.0), (5, 5.0)]),
        (0.0, 0.0, vec![(12, 5.0), (25, 5.0), (6, 5.0)]),
        (0.0, 0.0, vec![(15, 5.0), (17, 5.0)]),
        (0.0, 0.0, vec![(20, 5.0), (25, 4.0), (9, 5.0)]),
        (0.0, 0.0, vec![(23, 5.0), (7, 5.0)]),
        (0.0, 0.0, vec![(10, 5.0), (14, 5.0)]),
    ];
    let cols = 7u32.min(list.len() as u32);
    let rows = (list.len() as u32).div_ceil(cols);
    let mut sheet = image::RgbImage::new(w * cols, h * rows);
    let t = std::time::Instant::now();
    for (i, (y, p, a)) in list.iter().enumerate() {
        let v = s.render(&camera(*y, *p, w, h), &Expression::of(a));
        image::imageops::replace(&mut sheet, &v.rgb, (i as u32 % cols * w) as i64, (i as u32 / cols * h) as i64);
        if i == 0 {
            let m: Vec<u8> = v.labels.labels.iter().map(|l| l * 80).collect();
            image::save_buffer("/tmp/E_labels.png", &m, w, h, image::ExtendedColorType::L8).unwrap();
        }
    }
    println!("{:?} per frame", t.elapsed() / list.len() as u32);
    let _ = cols;
    sheet.save("/tmp/E_sheet.png").unwrap();
    if std::env::args().nth(2).is_some() {
        let d = Scene::new(Person::driver(1), 2);
        let v = d.render(&camera(8.0, 5.0, w, h), &Expression::of(&[(12, 3.0)]));
        v.rgb.save("/tmp/E_driver.png").unwrap();
    }
}
