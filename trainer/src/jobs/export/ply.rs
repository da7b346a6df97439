//! 3D Gaussian splatting's `.ply` (Kerbl et al. 2023, graphdeco-inria/gaussian-splatting, `GaussianModel.save_ply`): binary
//! little-endian, one vertex of 62 f32 properties per Gaussian.
//!
//! | properties | |
//! |---|---|
//! | `x y z`, `nx ny nz` | mean; normals, always 0 |
//! | `f_dc_0..2` | (colour − 0.5) / 0.28209479 |
//! | `f_rest_0..44` | degrees 1–3, channel-major: 15 of red, of green, of blue; those of degrees 2 and 3 are 0 |
//! | `opacity`, `scale_0..2`, `rot_0..3` | logit; logarithms; unit quaternion, w first |
//!
//! All 45 `f_rest` are there because the method's own viewers read nothing else. The layout has no word for the low-pass: the
//! comment before `end_header` states it, where readers that count the first lines do not meet it.

use std::fmt::Write as _;

use super::cloud::Row;

/// Coefficients of one colour beyond degree 0.
const REST: usize = 15;
/// Numbers of a vertex.
const NUMBERS: usize = 17 + 3 * REST;

/// The file.
pub(super) fn encode(rows: &[Row]) -> Vec<u8> {
    let mut header = format!("ply\nformat binary_little_endian 1.0\nelement vertex {}\n", rows.len());
    for name in ["x", "y", "z", "nx", "ny", "nz"] {
        let _ = writeln!(header, "property float {name}");
    }
    for (name, count) in [("f_dc", 3), ("f_rest", 3 * REST), ("opacity", 0), ("scale", 3), ("rot", 4)] {
        match count {
            0 => _ = writeln!(header, "property float {name}"),
            _ => (0..count).for_each(|i| _ = writeln!(header, "property float {name}_{i}")),
        }
    }
    header.push_str("comment antialiased: fitted with a low-pass of 0.1 px^2 and compensated opacity\nend_header\n");
    let mut file = header.into_bytes();
    file.reserve(rows.len() * NUMBERS * 4);
    for row in rows {
        let mut numbers = [0.0f32; NUMBERS];
        numbers[..3].copy_from_slice(&row.mean);
        numbers[6..9].copy_from_slice(&row.dc());
        for (basis, rgb) in row.sh1.iter().enumerate() {
            for (c, v) in rgb.iter().enumerate() {
                numbers[9 + c * REST + basis] = *v;
            }
        }
        let tail = &mut numbers[9 + 3 * REST..];
        tail[0] = row.logit;
        tail[1..4].copy_from_slice(&row.log_scale);
        tail[4..].copy_from_slice(&row.quaternion);
        file.extend(numbers.iter().flat_map(|v| v.to_le_bytes()));
    }
    file
}
