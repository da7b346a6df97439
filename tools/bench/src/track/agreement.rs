//! How far the AUs of a track agree with those of a reference: the truth of a rendered capture, or OpenFace on a real clip.

use risorius_formats::Track;
use risorius_formats::au::OPENFACE_INTENSITIES;
use risorius_trainer::eval::icc;
use serde::Serialize;

use super::metrics::icc31;

/// An AU whose reference never rises above this says nothing about a tracker.
const MOVES: f64 = 0.5;
/// AUs whose reference rises above this are reported apart.
const MOVES_MUCH: f64 = 1.0;
/// At least so much is a saturated intensity.
const SATURATED: f64 = 4.9;
/// An AU of the reference up to this rests.
const RESTS: f64 = 0.1;
/// Another AU of the reference has to be this strong for cross-talk to be asked.
const LOUD: f64 = 1.0;

/// One AU.
#[derive(Clone, Debug, Serialize)]
pub(crate) struct UnitAgreement {
    pub(crate) unit: String,
    /// Largest intensity of the reference.
    pub(crate) reference_peak: f64,
    /// 99th percentile of the track's intensity.
    pub(crate) p99: f64,
    /// Pearson's r; 0 where the track does not move.
    pub(crate) r: f64,
    pub(crate) icc31: f64,
}

/// Agreement of a track with a reference over the frames that both have.
#[derive(Clone, Debug, Default, Serialize)]
pub(crate) struct Agreement {
    pub(crate) frames: usize,
    /// AUs whose reference rises above 0.5.
    pub(crate) units: Vec<UnitAgreement>,
    /// Means of r and ICC(3,1) over these, and over those that rise above 1.
    pub(crate) moving: [f64; 2],
    pub(crate) moving_much: [f64; 2],
    /// Share of the frames in which some AU stands at 4.9 or more.
    pub(crate) saturated_share: f64,
    /// Mean change from frame to frame of AUs that rest in the reference.
    pub(crate) jitter_at_rest: f64,
    /// Mean intensity of AUs that rest in the reference while another is 1 or more there.
    pub(crate) cross_talk: f64,
}

/// Compares a track with the intensities of its frames, 17 in OpenFace's order; `None` is a frame that the reference lacks.
pub(crate) fn compare(track: &Track, reference: &[Option<[f64; 17]>]) -> Agreement {
    let columns = OPENFACE_INTENSITIES.map(|unit| track.unit_index(unit));
    let both: Vec<(usize, [f64; 17], [f64; 17])> = track
        .rows
        .iter()
        .filter(|row| row.success)
        .filter_map(|row| {
            let frame = row.frame.0 as usize;
            let found = columns.map(|k| k.and_then(|k| row.intensities[k]).map_or(0.0, f64::from));
            Some((frame, found, (*reference.get(frame)?)?))
        })
        .collect();
    let mut out = Agreement { frames: both.len(), ..Agreement::default() };
    for (j, unit) in OPENFACE_INTENSITIES.into_iter().enumerate().filter(|(j, _)| columns[*j].is_some()) {
        let pairs: Vec<(f64, f64)> = both.iter().map(|b| (b.1[j], b.2[j])).collect();
        let reference_peak = pairs.iter().map(|p| p.1).fold(0.0, f64::max);
        if reference_peak > MOVES {
            let p99 = percentile99(pairs.iter().map(|p| p.0).collect());
            let (r, icc31) = (correlation(&pairs), icc31(&pairs));
            out.units.push(UnitAgreement { unit: unit.to_string(), reference_peak, p99, r, icc31 });
        }
    }
    let means = |above: f64| {
        let units: Vec<&UnitAgreement> = out.units.iter().filter(|u| u.reference_peak > above).collect();
        let count = units.len().max(1) as f64;
        [units.iter().map(|u| u.r).sum::<f64>() / count, units.iter().map(|u| u.icc31).sum::<f64>() / count]
    };
    (out.moving, out.moving_much) = (means(MOVES), means(MOVES_MUCH));
    let saturated = both.iter().filter(|b| b.1.iter().any(|v| *v >= SATURATED)).count();
    out.saturated_share = saturated as f64 / both.len().max(1) as f64;
    let known = || (0..17).filter(|&j| columns[j].is_some());
    out.jitter_at_rest = mean(both.windows(2).filter(|w| w[1].0 == w[0].0 + 1).flat_map(|w| {
        let resting = |j: &usize| w[0].2[*j] <= RESTS && w[1].2[*j] <= RESTS;
        known().filter(resting).map(|j| (w[1].1[j] - w[0].1[j]).abs()).collect::<Vec<_>>()
    }));
    out.cross_talk = mean(
        both.iter()
            .filter(|b| b.2.iter().any(|v| *v >= LOUD))
            .flat_map(|b| known().filter(|&j| b.2[j] <= RESTS).map(|j| b.1[j])),
    );
    out
}

fn mean(values: impl Iterator<Item = f64>) -> f64 {
    let (sum, count) = values.fold((0.0, 0usize), |(s, n), v| (s + v, n + 1));
    sum / count.max(1) as f64
}

fn percentile99(mut values: Vec<f64>) -> f64 {
    values.sort_unstable_by(f64::total_cmp);
    values.get(values.len() * 99 / 100).copied().unwrap_or(0.0)
}

/// Pearson's r; 0 where one of the two does not vary.
pub(crate) fn correlation(pairs: &[(f64, f64)]) -> f64 {
    icc::correlation(&pairs.iter().map(|p| [p.0, p.1]).collect::<Vec<_>>()).unwrap_or(0.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use risorius_formats::{FrameIndex, TrackRow};

    fn track(values: &[[f32; 2]]) -> Track {
        let row = |(i, v): (usize, &[f32; 2])| TrackRow {
            frame: FrameIndex(i as u32),
            face_id: 0,
            timestamp_secs: None,
            confidence: 1.0,
            success: true,
            intensities: v.iter().map(|v| Some(*v)).collect(),
            presences: Vec::new(),
            landmarks: None,
            landmarks_in_camera_mm: None,
            head_pose: None,
        };
        Track {
            units: OPENFACE_INTENSITIES[..2].to_vec(),
            rows: values.iter().enumerate().map(row).collect(),
            ..Track::default()
        }
    }

    #[test]
    fn only_what_moves_in_the_reference_is_judged() {
        let values: Vec<[f32; 2]> = (0..100).map(|i| [(i % 10) as f32 * 0.5, 0.25]).collect();
        let mut reference: Vec<Option<[f64; 17]>> = Vec::new();
        for v in &values {
            let mut row = [0.0; 17];
            row[0] = 0.5 * f64::from(v[0]);
            reference.push(Some(row));
        }
        reference[7] = None;
        let found = compare(&track(&values), &reference);
        assert_eq!((found.frames, found.units.len()), (99, 1));
        assert!((found.moving[0] - 1.0).abs() < 1e-9 && (found.moving[1] - 0.8).abs() < 1e-9, "{found:?}");
        assert_eq!(found.moving, found.moving_much);
        // The other AU stands at 0.25 and never moves.
        assert!((found.cross_talk - 0.25).abs() < 1e-9 && found.jitter_at_rest < 0.1, "{found:?}");
        assert_eq!(found.saturated_share, 0.0);
    }

    #[test]
    fn correlation_is_that_of_pearson() {
        assert!((correlation(&[(0.0, 1.0), (1.0, 3.0), (2.0, 5.0)]) - 1.0).abs() < 1e-12);
        assert_eq!(correlation(&[(1.0, 1.0), (1.0, 3.0)]), 0.0);
    }
}
