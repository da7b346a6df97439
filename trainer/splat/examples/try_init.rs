//! Throw-away: runs `start` on a dump of a scene and writes what it found.
#![allow(clippy::all, clippy::pedantic, clippy::print_stdout, clippy::unwrap_used, unused_crate_dependencies, missing_docs)]
use std::io::{Read, Write};
use glam::DVec3;
use risorius_formats::{Camera, Intrinsics, Isometry};
use risorius_formats::camera::Distortion;
use risorius_splat::init::{StartSettings, start};
use risorius_splat::scene::{Frame, Plate, Scene};

struct Rd { b: Vec<u8>, at: usize }
impl Rd {
    fn bytes(&mut self, n: usize) -> Vec<u8> { let r = self.b[self.at..self.at + n].to_vec(); self.at += n; r }
    fn u(&mut self) -> u32 { u32::from_le_bytes(self.bytes(4).try_into().unwrap()) }
    fn f(&mut self) -> f32 { f32::from_le_bytes(self.bytes(4).try_into().unwrap()) }
    fn d(&mut self) -> f64 { f64::from_le_bytes(self.bytes(8).try_into().unwrap()) }
    fn iso(&mut self) -> Isometry { let mut m = [[0.0; 4]; 3]; for r in &mut m { for v in r.iter_mut() { *v = self.d(); } } Isometry::from_rows(m) }
}
struct Own { camera: Camera, head: Isometry, rgb: Vec<u8>, valid: Option<Vec<u8>>, labels: Option<Vec<u8>>, acts: Option<Vec<f32>>, lms: Option<[[f32; 2]; 68]> }
fn cpu() -> f64 {
    let s = std::fs::read_to_string("/proc/self/stat").unwrap();
    let f: Vec<&str> = s.rsplit(')').next().unwrap().split_whitespace().collect();
    (f[11].parse::<f64>().unwrap() + f[12].parse::<f64>().unwrap()) / 100.0
}
fn main() {
    let args: Vec<String> = std::env::args().collect();
    let mut b = Vec::new();
    std::fs::File::open(&args[1]).unwrap().read_to_end(&mut b).unwrap();
    let mut r = Rd { b, at: 0 };
    let (n, w, h, k) = (r.u() as usize, r.u() as usize, r.u() as usize, r.u() as usize);
    let radius = r.f(); let neutral = r.u() as usize; let hulls = r.u() as usize; let plate = r.u();
    let region_of: Vec<usize> = (0..k).map(|_| r.u() as usize).collect();
    let hull: Vec<DVec3> = (0..hulls).map(|_| DVec3::new(r.d(), r.d(), r.d())).collect();
    let plate: Option<Vec<u8>> = (plate > 0).then(|| r.bytes(w * h * 3));
    let frames: Vec<Own> = (0..n).map(|_| {
        let (fx, fy, cx, cy, skew) = (r.d(), r.d(), r.d(), r.d(), r.d());
        let mut dist = Distortion::default();
        for i in 0..3 { dist.radial[i] = r.d(); }
        for i in 0..2 { dist.tangential[i] = r.d(); }
        let intrinsics = Intrinsics { width: w as u32, height: h as u32, fx, fy, cx, cy, skew, distortion: dist };
        let camera = Camera { intrinsics, camera_from_world: r.iso() };
        let head = r.iso();
        let flags = r.u();
        let rgb = r.bytes(w * h * 3);
        let valid = (flags & 1 > 0).then(|| r.bytes(w * h));
        let labels = (flags & 2 > 0).then(|| r.bytes(w * h));
        let acts = (flags & 4 > 0).then(|| (0..k).map(|_| r.f()).collect());
        let lms = (flags & 8 > 0).then(|| { let mut l = [[0.0; 2]; 68]; for p in &mut l { *p = [r.f(), r.f()]; } l });
        Own { camera, head, rgb, valid, labels, acts, lms }
    }).collect();
    let scene = Scene {
        frames: frames.iter().map(|o| Frame { camera: o.camera, room_from_head: o.head, rgb: &o.rgb, valid: o.valid.as_deref(), labels: o.labels.as_deref(), activations: o.acts.clone(), landmarks_px: o.lms }).collect(),
        regions: region_of.iter().max().map_or(0, |m| m + 1), region_of, face_radius_m: radius,
        head_hull: (hulls > 0).then_some(hull), plate: plate.as_ref().map(|p| Plate { width: w, height: h, rgb: p }), neutral_frame: neutral,
    };
    drop(std::mem::take(&mut r.b));
    let t = std::time::Instant::now(); let c = cpu();
    let out = start(&scene, &StartSettings::default(), &|s| println!("  {:.2} s (cpu {:.2}): {s}", t.elapsed().as_secs_f64(), cpu() - c));
    println!("start: wall {:.2} s, cpu {:.2} s, seeds {}, deformable {}, head>0.5 {}", t.elapsed().as_secs_f64(), cpu() - c, out.seeds.len(), out.seeds.iter().filter(|s| s.deformable).count(), out.seeds.iter().filter(|s| s.head_weight > 0.5).count());
    let mut f = std::io::BufWriter::new(std::fs::File::create(&args[2]).unwrap());
    let p = |f: &mut dyn Write, v: f32| f.write_all(&v.to_le_bytes()).unwrap();
    f.write_all(&(out.seeds.len() as u32).to_le_bytes()).unwrap();
    for s in &out.seeds {
        for v in s.mean.iter().chain(&s.normal).chain(&s.color).chain(&[s.sigma, s.thickness, s.opacity]).chain(&s.regions).chain(&[s.head_weight, f32::from(s.deformable)]) { p(&mut f, *v); }
    }
    f.write_all(&(n as u32).to_le_bytes()).unwrap();
    for pose in &out.head_poses { for row in pose.to_rows() { for v in row { f.write_all(&v.to_le_bytes()).unwrap(); } } }
    match &out.motion {
        None => f.write_all(&0u32.to_le_bytes()).unwrap(),
        Some(m) => {
            println!("motion: error {:.3} px", m.error_px);
            f.write_all(&(1 + m.deltas.len() as u32).to_le_bytes()).unwrap();
            for q in std::iter::once(&m.rest).chain(&m.deltas) { for v in q.iter().flatten() { f.write_all(&v.to_le_bytes()).unwrap(); } }
        }
    }
}
