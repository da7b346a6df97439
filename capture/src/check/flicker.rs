//! Light that pulses: lamps on the mains brighten a hundred or a hundred and twenty times a second, which a camera sees as a
//! slow beat.

use serde::Serialize;

use crate::timing::median;

/// Frames of one spectrum; fewer give one of their own length.
const WINDOW: usize = 256;
/// Fewer frames tell nothing.
const LEAST: usize = 64;
/// Slower changes are people and clouds, hertz.
const SLOWEST_HZ: f64 = 3.0;
/// How far a peak has to stand out of the spectrum's median, in power.
const STANDS_OUT: f64 = 20.0;
/// How often lamps on the mains of 50 and 60 hertz pulse.
const MAINS: [(u32, f64); 2] = [(50, 100.0), (60, 120.0)];

/// The strongest pulse of the brightness.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Flicker {
    /// How often the recording brightens, hertz; the lamp may be faster.
    pub frequency_hz: f64,
    /// From the mean to the top, 8-bit levels.
    pub amplitude: f64,
    /// The mains that would look like this, 50 or 60 hertz.
    pub mains_hz: Option<u32>,
}

/// What a pulse of `hz` looks like in `fps` frames a second.
fn alias(hz: f64, fps: f64) -> f64 {
    let folded = hz.rem_euclid(fps);
    folded.min(fps - folded)
}

/// Finds a pulse in the mean luma of frames that follow each other at `fps`; `None` without one, or with too few frames.
pub(super) fn flicker(luma: &[f32], fps: f64) -> Option<Flicker> {
    let n = luma.len().min(WINDOW);
    if n < LEAST || fps.is_nan() || fps <= 2.0 * SLOWEST_HZ {
        return None;
    }
    let bins = n / 2;
    let mut power = vec![0.0; bins];
    let mut segments = 0.0;
    for start in (0..=luma.len() - n).step_by(n / 2) {
        segments += 1.0;
        let part = flattened(&luma[start..start + n]);
        for (bin, power) in power.iter_mut().enumerate() {
            let step = std::f64::consts::TAU * bin as f64 / n as f64;
            let (mut re, mut im) = (0.0, 0.0);
            for (i, v) in part.iter().enumerate() {
                let (sin, cos) = (step * i as f64).sin_cos();
                (re, im) = (re + v * cos, im + v * sin);
            }
            // A Hann window passes half of a sine's amplitude, and a sine has its power in two bins of opposite sign.
            *power += (4.0 * re.hypot(im) / n as f64).powi(2);
        }
    }
    for p in &mut power {
        *p /= segments;
    }
    let width = fps / n as f64;
    let first = (SLOWEST_HZ / width).ceil() as usize;
    let band = power.get(first..)?;
    let (peak, top) = band.iter().enumerate().max_by(|a, b| a.1.total_cmp(b.1))?;
    if *top < STANDS_OUT * median(band)?.max(1e-9) {
        return None;
    }
    let frequency_hz = (first + peak) as f64 * width;
    // The peak of a Hann window is two bins wide.
    let mains = MAINS.iter().find(|(_, pulse)| {
        let seen = alias(*pulse, fps);
        seen >= SLOWEST_HZ && (seen - frequency_hz).abs() <= 1.5 * width
    });
    Some(Flicker { frequency_hz, amplitude: top.sqrt(), mains_hz: mains.map(|m| m.0) })
}

/// Without mean and slope, under a Hann window.
fn flattened(part: &[f32]) -> Vec<f64> {
    let n = part.len() as f64;
    let middle = (n - 1.0) / 2.0;
    let mean = part.iter().map(|v| f64::from(*v)).sum::<f64>() / n;
    let (mut up, mut across) = (0.0, 0.0);
    for (i, v) in part.iter().enumerate() {
        let x = i as f64 - middle;
        up += x * (f64::from(*v) - mean);
        across += x * x;
    }
    let slope = up / across.max(1e-12);
    let window = |i: usize| 0.5 - 0.5 * (std::f64::consts::TAU * i as f64 / n).cos();
    part.iter().enumerate().map(|(i, v)| (f64::from(*v) - mean - slope * (i as f64 - middle)) * window(i)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A lamp that pulses at `hz`, filmed at `fps`, in a room that gets darker, with noise.
    fn filmed(hz: f64, amplitude: f64, fps: f64, count: usize) -> Vec<f32> {
        (0..count)
            .map(|i| {
                let t = i as f64 / fps;
                let noise = f64::from((i as u32).wrapping_mul(2_654_435_761) >> 16) / 65536.0 - 0.5;
                (120.0 - 2.0 * t + amplitude * (std::f64::consts::TAU * hz * t).sin() + 0.2 * noise) as f32
            })
            .collect()
    }

    #[test]
    fn mains_light_is_found_by_its_beat() {
        for (hz, fps, seen, mains) in
            [(100.0, 120.0, 20.0, 50), (100.0, 30.0, 10.0, 50), (120.0, 50.0, 20.0, 60), (100.0, 239.76, 100.0, 50)]
        {
            let found = flicker(&filmed(hz, 3.0, fps, 1200), fps).unwrap();
            assert!((found.frequency_hz - seen).abs() < 1.5 * fps / 256.0, "{found:?}");
            assert!((found.amplitude - 3.0).abs() < 0.5, "{found:?}");
            assert_eq!(found.mains_hz, Some(mains), "{hz} at {fps}");
        }
        let other = flicker(&filmed(37.0, 2.0, 120.0, 600), 120.0).unwrap();
        assert_eq!(other.mains_hz, None);
    }

    #[test]
    fn steady_light_and_slow_changes_are_no_flicker() {
        // The noise of the pictures may have its own small peaks; 120 pulses in 120 frames look like none.
        for (hz, amplitude) in [(0.0, 0.0), (0.5, 20.0), (120.0, 5.0)] {
            let found = flicker(&filmed(hz, amplitude, 120.0, 1200), 120.0).filter(|f| f.amplitude > 0.2);
            assert_eq!(found, None, "{hz}");
        }
        assert_eq!(flicker(&[100.0; 20], 120.0), None);
    }
}
