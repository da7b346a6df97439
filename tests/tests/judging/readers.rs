//! Readers of splat files, written for these tests from the formats' descriptions and sharing nothing with what writes them.

use std::io::Read as _;

use flate2::read::GzDecoder;
use risorius_splat::model::{EMPTY, LANES, channel};
use risorius_splat::{Gaussians, Layout};

/// A Gaussian as a renderer takes it: x right, y down, z forward.
#[derive(Clone, Debug, Default)]
pub(super) struct Splat {
    pub mean: [f32; 3],
    pub log_scale: [f32; 3],
    pub quaternion: [f32; 4],
    pub logit: f32,
    pub color: [f32; 3],
    pub sh1: [[f32; 3]; 3],
}

const SH_C0: f32 = 0.282_094_8;

fn float(bytes: &[u8], at: usize) -> f32 {
    f32::from_le_bytes(bytes[at..at + 4].try_into().unwrap())
}

fn logit(opacity: f32) -> f32 {
    let o = opacity.clamp(1e-4, 1.0 - 1e-4);
    (o / (1.0 - o)).ln()
}

/// Any binary PLY of f32 vertices, by the names of its properties.
pub(super) fn ply(bytes: &[u8]) -> Vec<Splat> {
    let end = b"end_header\n";
    let body = bytes.windows(end.len()).position(|w| w == end).unwrap() + end.len();
    let header = std::str::from_utf8(&bytes[..body]).unwrap();
    assert!(header.starts_with("ply\nformat binary_little_endian 1.0\nelement vertex "), "{header}");
    let count: usize = header.lines().nth(2).unwrap().rsplit(' ').next().unwrap().parse().unwrap();
    let names: Vec<&str> = header.lines().filter_map(|l| l.strip_prefix("property float ")).collect();
    let column = |name: &str| names.iter().position(|n| *n == name).unwrap_or_else(|| panic!("no {name}"));
    assert_eq!(bytes.len() - body, count * names.len() * 4, "whole rows and nothing after them");
    let rest = names.iter().filter(|n| n.starts_with("f_rest_")).count() / 3;
    (0..count)
        .map(|i| {
            let v = |name: &str| float(bytes, body + (i * names.len() + column(name)) * 4);
            let numbered = |name: &str, k: usize| v(&format!("{name}_{k}"));
            Splat {
                mean: [v("x"), v("y"), v("z")],
                log_scale: [0, 1, 2].map(|k| numbered("scale", k)),
                quaternion: [0, 1, 2, 3].map(|k| numbered("rot", k)),
                logit: v("opacity"),
                color: [0, 1, 2].map(|c| 0.5 + SH_C0 * numbered("f_dc", c)),
                // Channel-major: all of red first.
                sh1: [0, 1, 2].map(|b| [0, 1, 2].map(|c| numbered("f_rest", c * rest + b))),
            }
        })
        .collect()
}

/// `.splat`: rows of 32 bytes.
pub(super) fn dot_splat(bytes: &[u8]) -> Vec<Splat> {
    assert_eq!(bytes.len() % 32, 0);
    bytes
        .chunks_exact(32)
        .map(|row| Splat {
            mean: [0, 4, 8].map(|at| float(row, at)),
            log_scale: [12, 16, 20].map(|at| float(row, at).ln()),
            color: [24, 25, 26].map(|at| f32::from(row[at]) / 255.0),
            logit: logit(f32::from(row[27]) / 255.0),
            quaternion: [28, 29, 30, 31].map(|at| (f32::from(row[at]) - 128.0) / 128.0),
            sh1: [[0.0; 3]; 3],
        })
        .collect()
}

/// `.spz` of version 2 and degree 1, with whether it says that the fit was antialiased.
pub(super) fn spz(bytes: &[u8]) -> (Vec<Splat>, bool) {
    let mut raw = Vec::new();
    GzDecoder::new(bytes).read_to_end(&mut raw).unwrap();
    let word = |at: usize| u32::from_le_bytes(raw[at..at + 4].try_into().unwrap());
    assert_eq!((&raw[..4], word(4), raw[12]), (&b"NGSP"[..], 2, 1));
    let (n, steps) = (word(8) as usize, f32::from(1u16 << (raw[13] - 8)) * 256.0);
    assert_eq!(raw.len(), 16 + n * (9 + 1 + 3 + 3 + 3 + 9));
    let mut at = 16;
    let mut array = |each: usize| {
        let part = &raw[at..at + n * each];
        at += n * each;
        part
    };
    let (positions, alphas, colors, scales, rotations, harmonics) =
        (array(9), array(1), array(3), array(3), array(3), array(9));
    // From y up, z backward to y down, z forward.
    let flip = [1.0, -1.0, -1.0f32];
    let read = |i: usize| {
        let fixed = |c: usize| {
            let b = &positions[9 * i + 3 * c..];
            (i32::from_le_bytes([0, b[0], b[1], b[2]]) >> 8) as f32 / steps * flip[c]
        };
        let q = [0, 1, 2].map(|c| (f32::from(rotations[3 * i + c]) / 127.5 - 1.0) * flip[c]);
        let w = (1.0 - q.iter().map(|v| v * v).sum::<f32>()).max(0.0).sqrt();
        let harmonic =
            |b: usize, c: usize| (f32::from(harmonics[9 * i + 3 * b + c]) - 128.0) / 128.0 * [-1.0, -1.0, 1.0][b];
        Splat {
            mean: [0, 1, 2].map(fixed),
            log_scale: [0, 1, 2].map(|c| f32::from(scales[3 * i + c]) / 16.0 - 10.0),
            quaternion: [w, q[0], q[1], q[2]],
            logit: logit(f32::from(alphas[i]) / 255.0),
            color: [0, 1, 2].map(|c| 0.5 + SH_C0 * (f32::from(colors[3 * i + c]) / 255.0 - 0.5) / 0.15),
            sh1: [0, 1, 2].map(|b| [0, 1, 2].map(|c| harmonic(b, c))),
        }
    };
    ((0..n).map(read).collect(), raw[14] & 1 == 1)
}

/// What was read as a model without AUs that can be drawn.
pub(super) fn model(splats: &[Splat]) -> Gaussians {
    let groups = splats.len().div_ceil(LANES);
    let mut base = vec![0.0; groups * channel::COUNT * LANES];
    for slot in 0..groups * LANES {
        let mut set = |c: usize, v: f32| base[(slot / LANES * channel::COUNT + c) * LANES + slot % LANES] = v;
        let Some(splat) = splats.get(slot) else {
            set(channel::OPACITY, EMPTY);
            continue;
        };
        for c in 0..3 {
            set(channel::MEAN + c, splat.mean[c]);
            set(channel::LOG_SCALE + c, splat.log_scale[c]);
            set(channel::COLOR + c, splat.color[c]);
            for b in 0..3 {
                set(channel::SH1 + 3 * b + c, splat.sh1[b][c]);
            }
        }
        (0..4).for_each(|c| set(channel::QUATERNION + c, splat.quaternion[c]));
        set(channel::OPACITY, splat.logit);
    }
    let layout = Layout { region_of: Vec::new(), also_in: Vec::new(), regions: 1, latent: 0, images: 0 };
    let (membership, head) = (vec![0.0; groups * 3 * LANES], vec![1.0; groups * LANES]);
    Gaussians::from_arrays(layout, base, Vec::new(), Vec::new(), membership, head).unwrap()
}
