//! `.splat` (antimatter15/splat, `convert.py`): 32 bytes per Gaussian, no header.
//!
//! | bytes | |
//! |---|---|
//! | 0–11 | mean, 3 f32 |
//! | 12–23 | standard deviations, 3 f32, linear |
//! | 24–27 | red, green, blue, opacity, 0–255 |
//! | 28–31 | unit quaternion w, x, y, z as 128 + 128 q |
//!
//! The format has no spherical harmonics: colours are those seen from the avatar's own view. Rows lie in falling order of
//! opacity times volume, which viewers that draw while they load rely on.

use glam::DVec3;

use super::cloud::Row;

/// The file; `eye` is the avatar's own view point, metres.
pub(super) fn encode(rows: &[Row], eye: DVec3) -> Vec<u8> {
    let weight = |row: &Row| row.opacity() * row.log_scale.iter().sum::<f32>().exp();
    let mut order: Vec<usize> = (0..rows.len()).collect();
    order.sort_by(|&a, &b| weight(&rows[b]).total_cmp(&weight(&rows[a])));
    let byte = |v: f32| v.round().clamp(0.0, 255.0) as u8;
    let mut file = Vec::with_capacity(rows.len() * 32);
    for row in order.into_iter().map(|i| &rows[i]) {
        let numbers = row.mean.into_iter().chain(row.log_scale.map(f32::exp));
        file.extend(numbers.flat_map(f32::to_le_bytes));
        file.extend(row.color_from(eye).map(|c| byte(c * 255.0)));
        file.push(byte(row.opacity() * 255.0));
        file.extend(row.quaternion.map(|q| byte(q * 128.0 + 128.0)));
    }
    file
}
