//! HDR to SDR: the light of an HLG or PQ signal, with diffuse white (203 nits, ITU-R BT.2408) as the white of SDR.
//!
//! Light up to 95 % of diffuse white stays as it is; highlights above roll off towards white, by the brightest of the three
//! channels so that their hue stays. Curves: ITU-R BT.2100, PQ and HLG on a display of 1,000 nits; HLG's system gamma of 1.2
//! is applied to each channel, as FFmpeg's `zscale` does unless told otherwise. The result is sRGB with BT.709 primaries.
#![allow(clippy::inline_always, reason = "the vectorised build of a caller has to take in all that it calls")]

use crate::coding::Transfer;

/// Diffuse white, nits.
const WHITE_NITS: f32 = 203.0;
/// The display that HLG is shown on, nits.
const HLG_PEAK_NITS: f32 = 1000.0;
/// System gamma of HLG on that display.
const HLG_GAMMA: f32 = 1.2;
/// Below this share of white nothing changes.
const KNEE: f32 = 0.95;
/// Entries of the tables per unit of signal.
const STEPS: usize = 1 << 14;
/// BT.2020's primaries in BT.709's, linear light (ITU-R BT.2087).
const BT709_FROM_BT2020: [[f32; 3]; 3] =
    [[1.660_491, -0.587_641, -0.072_850], [-0.124_550, 1.132_9, -0.008_349], [-0.018_151, -0.100_579, 1.118_73]];

/// Maps pixels of one transfer curve.
#[derive(Debug)]
pub(crate) struct ToneMap {
    /// Signal to light in units of diffuse white.
    light: Vec<f32>,
    /// Linear light of 0 to 1 to levels of sRGB.
    levels: Vec<u8>,
    wide_gamut: bool,
    /// Light of the brightest signal, in units of diffuse white.
    peak: f32,
}

impl ToneMap {
    pub(crate) fn new(transfer: Transfer, wide_gamut: bool) -> Self {
        let table =
            |curve: &dyn Fn(f32) -> f32| (0..=STEPS).map(|i| curve(i as f32 / STEPS as f32)).collect::<Vec<_>>();
        let hlg = transfer == Transfer::Hlg;
        let light = table(&|s| if hlg { hlg_nits(s) } else { pq_nits(s) } / WHITE_NITS);
        let levels = table(&srgb_level).into_iter().map(|level| level.round() as u8).collect();
        // PQ can code 10,000 nits; what is graded for it is graded on 1,000 to 4,000.
        let peak = if hlg { HLG_PEAK_NITS } else { 4000.0 } / WHITE_NITS;
        Self { light, levels, wide_gamut, peak }
    }

    /// RGB signals of 0 to 255 to levels of sRGB.
    #[inline(always)]
    pub(crate) fn pixel(&self, signals: [f32; 3]) -> [u8; 3] {
        let mut light = signals.map(|s| self.light[place(s / 255.0)]);
        if self.wide_gamut {
            light = BT709_FROM_BT2020.map(|row| row[0] * light[0] + row[1] * light[1] + row[2] * light[2]);
        }
        let brightest = light[0].max(light[1]).max(light[2]);
        if brightest > KNEE {
            let factor = self.roll_off(brightest) / brightest;
            light = light.map(|l| l * factor);
        }
        light.map(|l| self.levels[place(l)])
    }

    /// KNEE to KNEE with slope 1, the peak to 1.
    fn roll_off(&self, light: f32) -> f32 {
        let room = 1.0 - KNEE;
        let (x, end) = ((light - KNEE) / room, (self.peak - KNEE) / room);
        KNEE + room * (x * (1.0 + x / (end * end)) / (1.0 + x)).min(1.0)
    }
}

#[inline(always)]
fn place(value: f32) -> usize {
    let clamped = if value > 0.0 { value } else { 0.0 };
    let clamped = if clamped < 1.0 { clamped } else { 1.0 };
    (clamped * STEPS as f32 + 0.5) as usize
}

/// The inverse of HLG's OETF, then the system gamma.
fn hlg_nits(signal: f32) -> f32 {
    const A: f32 = 0.178_832_77;
    const B: f32 = 0.284_668_92;
    const C: f32 = 0.559_910_7;
    let scene = if signal <= 0.5 { signal * signal / 3.0 } else { (((signal - C) / A).exp() + B) / 12.0 };
    HLG_PEAK_NITS * scene.powf(HLG_GAMMA)
}

/// PQ's EOTF.
fn pq_nits(signal: f32) -> f32 {
    const M1: f64 = 2610.0 / 16384.0;
    const M2: f64 = 2523.0 / 4096.0 * 128.0;
    const C1: f64 = 3424.0 / 4096.0;
    const C2: f64 = 2413.0 / 4096.0 * 32.0;
    const C3: f64 = 2392.0 / 4096.0 * 32.0;
    let power = f64::from(signal).powf(1.0 / M2);
    (10_000.0 * ((power - C1).max(0.0) / (C2 - C3 * power)).powf(1.0 / M1)) as f32
}

fn srgb_level(light: f32) -> f32 {
    255.0 * if light <= 0.003_130_8 { 12.92 * light } else { 1.055 * light.powf(1.0 / 2.4) - 0.055 }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn diffuse_white_is_white_and_highlights_keep_their_order() {
        // Diffuse white is 75 % of HLG's signal and 58 % of PQ's (ITU-R BT.2408, table 1).
        for (transfer, white) in [(Transfer::Hlg, 0.75), (Transfer::Pq, 0.5807)] {
            let map = ToneMap::new(transfer, true);
            let level = |share: f32| map.pixel([255.0 * share; 3])[0];
            assert!((250..=254).contains(&level(white)), "{transfer:?}: {}", level(white));
            assert!(level(1.0) == 255 && level(0.0) == 0);
            let levels: Vec<u8> = (0..=100).map(|i| level(i as f32 / 100.0)).collect();
            assert!(levels.is_sorted(), "{transfer:?}: {levels:?}");
        }
    }

    #[test]
    fn light_below_white_is_kept() {
        // 20.3 nits are a tenth of white: 0.1 in linear light is level 89 of sRGB.
        let map = ToneMap::new(Transfer::Pq, false);
        let signal = (0..=10_000).map(|i| i as f32 / 10_000.0).find(|&s| pq_nits(s) >= 20.3).unwrap();
        assert!(map.pixel([255.0 * signal; 3])[0].abs_diff(89) <= 1);
    }
}
