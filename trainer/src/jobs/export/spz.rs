//! `.spz` version 2 (nianticlabs/spz, README "File Format"): a gzip stream of a 16-byte header and one array per attribute.
//!
//! | array | per Gaussian |
//! |---|---|
//! | header | magic `NGSP`, version 2, count (u32 each); degree 1, fractional bits, flags (1: antialiased), 0 |
//! | positions | 3 signed 24-bit fixed-point numbers |
//! | alphas | opacity · 255 |
//! | colours | (0.15 · `f_dc` + 0.5) · 255 |
//! | scales | (logarithm + 10) · 16 |
//! | rotations | x, y, z of the unit quaternion with w ≥ 0, as 127.5 + 127.5 q |
//! | harmonics | y, z, x, each red, green, blue, as 128 + 128 v |
//!
//! The format's axes are RUB (y up, z backward): y and z change their signs, and with them those of quaternions and
//! harmonics. The flag tells readers that know it to compensate the low-pass, as the fit did.

use std::io::Write as _;

use flate2::Compression;
use flate2::write::GzEncoder;

use super::cloud::Row;

const MAGIC: u32 = 0x5053_474e;
const ANTIALIASED: u8 = 1;
/// Factor of the coefficients of degree 0.
const COLOR: f32 = 0.15;
/// Fractional bits at most: steps of 4 µm, up to 32 m.
const MOST_BITS: u32 = 18;
/// The largest fixed-point number.
const MOST: f32 = 8_388_607.0;
/// RDF to RUB: signs of x, y, z.
const FLIP: [f32; 3] = [1.0, -1.0, -1.0];

/// The file.
pub(super) fn encode(rows: &[Row]) -> std::io::Result<Vec<u8>> {
    let mut file = GzEncoder::new(Vec::new(), Compression::best());
    file.write_all(&packed(rows))?;
    file.finish()
}

fn packed(rows: &[Row]) -> Vec<u8> {
    let extent = rows.iter().flat_map(|r| r.mean).fold(0.0f32, |m, v| m.max(v.abs()));
    let bits = (0..=MOST_BITS).rev().find(|&b| extent * (1u32 << b) as f32 <= MOST).unwrap_or(0);
    let byte = |v: f32| v.round().clamp(0.0, 255.0) as u8;
    let mut out = Vec::with_capacity(16 + rows.len() * 28);
    for word in [MAGIC, 2, rows.len() as u32] {
        out.extend(word.to_le_bytes());
    }
    out.extend([1, bits as u8, ANTIALIASED, 0]);
    let steps = (1u32 << bits) as f32;
    for row in rows {
        for (v, sign) in row.mean.iter().zip(FLIP) {
            let fixed = (v * sign * steps).round().clamp(-MOST, MOST) as i32;
            out.extend(&fixed.to_le_bytes()[..3]);
        }
    }
    out.extend(rows.iter().map(|r| byte(r.opacity() * 255.0)));
    out.extend(rows.iter().flat_map(|r| r.dc().map(|v| byte((v * COLOR + 0.5) * 255.0))));
    out.extend(rows.iter().flat_map(|r| r.log_scale.map(|v| byte((v + 10.0) * 16.0))));
    for row in rows {
        let [_, x, y, z] = row.quaternion;
        out.extend([x, y, z].iter().zip(FLIP).map(|(v, sign)| byte(v * sign * 127.5 + 127.5)));
    }
    // Degree 1 runs y, z, x.
    let signs = [FLIP[1], FLIP[2], FLIP[0]];
    for row in rows {
        for (rgb, sign) in row.sh1.iter().zip(signs) {
            out.extend(rgb.map(|v| byte(v * sign * 128.0 + 128.0)));
        }
    }
    out
}
