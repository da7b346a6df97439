//! Numbers of an avatar in fewer bytes.
//!
//! Means stay f32 and other channels become f16. AU deltas become bytes with a scale for each group of 16 Gaussians, AU and
//! kind (the three channels of the mean, the three of the colour): `delta = byte · scale`, and the error is at most half a
//! scale, 0.4 % of the largest delta beside it. A delta of 0 stays 0.

use half::f16;
use risorius_splat::model::{DELTAS, LANES};

/// Channels that share a scale.
const KIND: usize = DELTAS / 2;
/// Numbers that share a scale.
pub const BLOCK: usize = KIND * LANES;
/// The largest byte.
const MOST: f32 = 127.0;

/// f16 numbers, little-endian.
pub fn to_half(values: impl Iterator<Item = f32>) -> Vec<u8> {
    values.flat_map(|v| f16::from_f32(v).to_le_bytes()).collect()
}

/// The numbers of little-endian f16.
pub fn from_half(bytes: &[u8]) -> Vec<f32> {
    bytes.as_chunks::<2>().0.iter().map(|b| f16::from_le_bytes(*b).to_f32()).collect()
}

/// Bytes and their scales.
pub fn to_bytes(deltas: &[f32]) -> (Vec<u8>, Vec<f32>) {
    let mut bytes = Vec::with_capacity(deltas.len());
    let mut scales = Vec::with_capacity(deltas.len() / BLOCK);
    for block in deltas.chunks(BLOCK) {
        let most = block.iter().fold(0.0f32, |m, v| m.max(v.abs()));
        let mut scale = f16::from_f32(most / MOST);
        if scale.is_finite() && scale.to_f32() * MOST < most && scale > f16::ZERO {
            scale = f16::from_bits(scale.to_bits() + 1);
        }
        let inverse = if scale > f16::ZERO { 1.0 / scale.to_f32() } else { 0.0 };
        bytes.extend(block.iter().map(|v| (v * inverse).round().clamp(-MOST, MOST) as i8 as u8));
        scales.push(scale.to_f32());
    }
    (bytes, scales)
}

/// The deltas of bytes with their scales.
pub fn from_bytes(bytes: &[u8], scales: &[f32]) -> Vec<f32> {
    let blocks = bytes.chunks(BLOCK).zip(scales);
    blocks.flat_map(|(block, scale)| block.iter().map(move |b| f32::from(*b as i8) * scale)).collect()
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn nothing_stays_nothing() {
        let (bytes, scales) = to_bytes(&[0.0; 2 * BLOCK]);
        assert_eq!((bytes.len(), scales.as_slice()), (2 * BLOCK, &[0.0, 0.0][..]));
        assert_eq!(from_bytes(&bytes, &scales), [0.0; 2 * BLOCK]);
    }

    proptest! {
        #[test]
        fn deltas_come_back_within_half_a_scale(values in prop::collection::vec(-1f32..1.0, BLOCK), size in 1e-4f32..10.0) {
            let deltas: Vec<f32> = values.iter().map(|v| v * size).collect();
            let (bytes, scales) = to_bytes(&deltas);
            let most = deltas.iter().fold(0.0f32, |m, v| m.max(v.abs()));
            prop_assert!(scales[0] <= most / MOST * 1.01 + 1e-7);
            for (back, was) in from_bytes(&bytes, &scales).iter().zip(&deltas) {
                prop_assert!((back - was).abs() <= 0.5001 * scales[0] + 1e-7, "{} {}", back, was);
            }
        }

        #[test]
        fn halves_come_back_to_eleven_bits(v in -100f32..100.0) {
            let back = from_half(&to_half([v].into_iter()))[0];
            prop_assert!((back - v).abs() <= v.abs() / 2048.0 + 1e-7);
        }
    }
}
