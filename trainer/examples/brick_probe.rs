//! Throw-away: fits the brick field and prints PSNR over time.
use glam::DVec2;
use risorius_brick::{render::Face, *};
use risorius_formats::{Silent, views::ViewList};
use risorius_trainer::{
    brick::{hull::RegionHull, layout, views::TrainViews},
    data::TrainData,
    data::read_rgb,
};
use std::path::Path;
use std::time::Instant;
fn cpu() -> f32 {
    let s = std::fs::read_to_string("/proc/self/stat").unwrap();
    let f: Vec<&str> = s.rsplit(')').next().unwrap().split_whitespace().collect();
    (f[11].parse::<f32>().unwrap() + f[12].parse::<f32>().unwrap()) / 200.0
}
fn main() {
    let a: Vec<String> = std::env::args().collect();
    let data = TrainData::load(&a[1], a[4].parse().unwrap(), &Silent).unwrap();
    let views = ViewList::read(Path::new(&a[2])).unwrap();
    let secs: f32 = a[3].parse().unwrap();
    let out = &a[5];
    let sub: usize = a[6].parse().unwrap();
    let env = |k: &str, d: f32| std::env::var(k).ok().and_then(|v| v.parse().ok()).unwrap_or(d);
    let t = Instant::now();
    let hull = RegionHull::new(&data);
    let lay = layout::of(&data, env("EV", 64.0) as usize, env("FIN", 512.0) as usize);
    println!("{:?} {:?}", lay.head_box, lay.background);
    let mut model = Brick::new(lay, 0, |p| hull.regions_at(p));
    model.neutral_image = data.neutral_frame();
    println!(
        "setup {:.1}s bricks {} per region {:?} params {}",
        t.elapsed().as_secs_f32(),
        model.expression.lattice.slots,
        model.expression.slots_of.iter().map(|s| s.len()).collect::<Vec<_>>(),
        model.parameters()
    );
    let mut st =
        Settings { refine_cameras: env("CAM", 0.0) > 0.0, latent: env("LAT", 1.0) > 0.0, ..Default::default() };
    st.spread = [env("SP", st.spread[0]), env("SPB", st.spread[1])];
    st.smooth = [env("SM", st.smooth[0]), env("SMW", st.smooth[1])];
    st.finest = [env("DIV", 160.0) as usize, env("PL", 160.0) as usize];
    st.residual_rate = env("RR", st.residual_rate);
    st.images = env("NI", st.images as f32) as usize;
    st.warp_rate = env("LRW", st.warp_rate);
    st.grid_rate = env("LR", st.grid_rate);
    st.haze[0] = env("HAZE", st.haze[0]);
    st.haze[1] = env("HAZE1", st.haze[1]);
    st.final_rate = env("FR", st.final_rate);
    st.samples = env("B", st.samples as f32) as usize;
    let tv = TrainViews::new(&data, env("PF", 0.3));
    if let Some(p) = tv.plate() {
        image::save_buffer(format!("{out}_plate.png"), &p.rgb, p.width, p.height, image::ColorType::Rgb8).unwrap();
    }
    let mut f = Fitter::new(model, st, Progress::default());
    let t0 = cpu();
    let mut el = 0.0f32;
    let mut next = 0;
    let marks: Vec<f32> = [0.06, 0.125, 0.25, 0.5, 0.75, 1.0].iter().map(|m| m * secs).collect();
    let (mut rays, mut samples, mut mse, mut n, mut mask, mut attr) = (0, 0, 0.0, 0, 0.0, 0.0);
    let mut lost = 0.0;
    while el < secs {
        let x = f.step(&tv, el / secs);
        el = cpu() - t0 - lost;
        rays += x.rays;
        samples += x.samples[0] + x.samples[1];
        mse += x.color;
        mask += x.mask;
        attr += x.attribute;
        n += 1;
        if el >= marks[next] {
            next += 1;
            let z = cpu();
            let mut sums = [0.0; 4];
            let mut cnt = [0; 4];
            let mut rt = 0.0;
            let mut imgs = 0;
            let table = &data.table;
            for (i, v) in views.views.iter().enumerate() {
                if i % sub != 0 && el < secs {
                    continue;
                }
                let cam = risorius_formats::Camera::from(&v.camera);
                let (w, h) = (cam.intrinsics.width as usize, cam.intrinsics.height as usize);
                let attrs: Vec<f32> = table
                    .attributes
                    .iter()
                    .map(|s| v.aus.get(&s.unit).map_or(s.neutral_attribute(), |&x| s.attribute_from_intensity(x)))
                    .collect();
                let dirs: Vec<[f32; 3]> = (0..w * h)
                    .map(|p| {
                        cam.ray_direction(DVec2::new((p % w) as f64 + 0.5, (p / w) as f64 + 0.5))
                            .unwrap()
                            .as_vec3()
                            .to_array()
                    })
                    .collect();
                let r = Instant::now();
                let face = Face::new(&f.model, &attrs);
                let px = face.render(cam.center().as_vec3().to_array(), &dirs);
                rt += r.elapsed().as_secs_f32();
                imgs += 1;
                let plate = tv.plate().filter(|p| p.width as usize == w);
                let bytes: Vec<u8> = px
                    .iter()
                    .enumerate()
                    .flat_map(|(i, s)| {
                        (0..3).map(move |c| {
                            ((s.color[c] + s.left * plate.map_or(0.5, |p| p.rgb[i * 3 + c] as f32 / 255.0))
                                .clamp(0.0, 1.0)
                                * 255.0)
                                .round() as u8
                        })
                    })
                    .collect();
                if el >= secs {
                    image::save_buffer(
                        format!("{out}_{}.png", v.id),
                        &bytes,
                        w as u32,
                        h as u32,
                        image::ColorType::Rgb8,
                    )
                    .unwrap();
                    let m: Vec<u8> = px
                        .iter()
                        .flat_map(|s| (0..3).map(move |c| (s.masks[c].clamp(0.0, 1.0) * 255.0) as u8))
                        .collect();
                    image::save_buffer(format!("{out}_{}_m.png", v.id), &m, w as u32, h as u32, image::ColorType::Rgb8)
                        .unwrap();
                }
                if let Some(im) = &v.image {
                    let truth = read_rgb(&Path::new(&a[2]).parent().unwrap().join(im)).unwrap();
                    let e: f64 =
                        truth.as_raw().iter().zip(&bytes).map(|(a, b)| (*a as f64 - *b as f64).powi(2)).sum::<f64>()
                            / bytes.len() as f64;
                    let kind = v.kind.clone().unwrap_or_default();
                    let k = if kind.starts_with("novel_v") {
                        0
                    } else if kind.contains("both") {
                        2
                    } else {
                        1
                    };
                    let p = 10.0 * (65025.0 / e).log10();
                    sums[k] += p;
                    cnt[k] += 1;
                    sums[3] += p;
                    cnt[3] += 1;
                }
            }
            let m: Vec<f64> = (0..4).map(|k| sums[k] / cnt[k].max(1) as f64).collect();
            println!(
                "hd/bg {:?} t {:.0} step {} stage {} spr {:.1} occ {} {} bricks {} {} rays {:.2}M samp/s {:.2}M train {:.2} mask {:.4} attr {:.3} | test view {:.2} expr {:.2} both {:.2} ALL {:.2} | render {:.0} ms",
                x.samples.map(|s| (s as f32 / x.rays as f32 * 10.0).round() / 10.0),
                el,
                f.progress.step,
                f.progress.stage,
                f.progress.samples_per_ray,
                f.model.head.occupancy.occupied(),
                f.model.background.as_ref().map_or(0, |b| b.occupancy.occupied()),
                f.model.head.field.levels.get(4).map_or(0, |l| l.slots),
                f.model.head.field.levels.get(5).map_or(0, |l| l.slots),
                rays as f32 / 1e6,
                samples as f32 / el / 1e6,
                -10.0 * (mse / n as f64).log10(),
                mask / n as f64,
                attr / n as f64,
                m[0],
                m[1],
                m[2],
                m[3],
                rt * 1e3 / imgs.max(1) as f32
            );
            mse = 0.0;
            n = 0;
            mask = 0.0;
            attr = 0.0;
            lost += cpu() - z;
        }
    }
}
