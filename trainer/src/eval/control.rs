//! What an avatar's AUs do, as numbers: agreement with what was asked (ICC), cross-talk, spill outside the masks.

use serde::Serialize;

use super::icc::{Icc, correlation, icc};

/// One frame of a sweep: which AU was moved (an index), the intensities that were asked and those that were read again.
#[derive(Clone, Debug)]
pub struct ControlFrame {
    /// Index of the AU that is swept; `None` at rest.
    pub swept: Option<usize>,
    /// Asked, 0–5, per AU.
    pub asked: Vec<f64>,
    /// Read by the tracker, 0–5, per AU; `None` where it saw no face or does not know the AU.
    pub read: Vec<Option<f64>>,
}

/// How one AU follows.
#[derive(Clone, Debug, Serialize)]
pub struct UnitControl {
    /// The AU.
    pub unit: String,
    /// Its FACS name.
    pub name: String,
    /// ICC over the frames in which it is swept alone.
    pub sweep: Option<Icc>,
    /// ICC over all frames, in which the others are swept too: cross-talk counts against it.
    pub all_frames: Option<Icc>,
    /// Pearson's correlation over its own sweep.
    pub correlation: Option<f64>,
    /// Frames of its sweep that were read.
    pub frames: usize,
    /// Whether the tracker is said to be able to read it.
    pub readable: bool,
}

/// The whole protocol.
#[derive(Clone, Debug, Serialize)]
pub struct Control {
    /// AU by AU.
    pub units: Vec<UnitControl>,
    /// Mean ICC(3,1) over own sweeps; AUs that do not vary at all count as 0, as in the paper's table.
    pub mean_icc_3_1: f64,
    /// The same over the AUs that the tracker is said to read.
    pub mean_readable_icc_3_1: f64,
    /// Mean ICC(2,1) over own sweeps.
    pub mean_icc_2_1: f64,
    /// Mean ICC(1,1) over own sweeps.
    pub mean_icc_1_1: f64,
    /// Mean ICC(3,1) over all frames.
    pub mean_all_frames_icc_3_1: f64,
    /// Cross-talk `[swept][read]`: how much the reading of one AU rises per unit that another is raised (slope of the least
    /// squares line over the sweep); the diagonal is the gain.
    pub cross_talk: Vec<Vec<Option<f64>>>,
    /// Mean absolute value off the diagonal, over pairs that were read.
    pub mean_cross_talk: f64,
    /// Frames without a face.
    pub lost_frames: usize,
    /// All frames.
    pub frames: usize,
}

impl Control {
    /// Sums up a sweep of the AUs `units` (name, FACS name, readable).
    pub fn new(units: &[(String, String, bool)], frames: &[ControlFrame]) -> Self {
        let pair = |f: &ControlFrame, k: usize| Some([f.asked[k], f.read[k]?]);
        let own = |k: usize| frames.iter().filter(move |f| f.swept == Some(k));
        let table = |pairs: &[[f64; 2]]| icc(&pairs.iter().map(|p| p.to_vec()).collect::<Vec<_>>());
        let of_unit = |(k, (unit, name, readable)): (usize, &(String, String, bool))| {
            let pairs: Vec<[f64; 2]> = own(k).filter_map(|f| pair(f, k)).collect();
            let all: Vec<[f64; 2]> = frames.iter().filter_map(|f| pair(f, k)).collect();
            UnitControl {
                unit: unit.clone(),
                name: name.clone(),
                sweep: table(&pairs),
                all_frames: table(&all),
                correlation: correlation(&pairs),
                frames: pairs.len(),
                readable: *readable,
            }
        };
        let rows: Vec<UnitControl> = units.iter().enumerate().map(of_unit).collect();
        let mean = |values: Vec<f64>| values.iter().sum::<f64>() / values.len().max(1) as f64;
        let over = |of: &dyn Fn(&UnitControl) -> Option<f64>| mean(rows.iter().map(|u| of(u).unwrap_or(0.0)).collect());
        let cross_talk: Vec<Vec<Option<f64>>> = (0..units.len())
            .map(|i| {
                let slope =
                    |j: usize| slope(&own(i).filter_map(|f| Some([f.asked[i], f.read[j]?])).collect::<Vec<[f64; 2]>>());
                (0..units.len()).map(slope).collect()
            })
            .collect();
        let off = |i: usize| {
            let row = &cross_talk[i];
            row.iter().enumerate().filter(move |(j, _)| *j != i).filter_map(|(_, v)| *v).map(f64::abs)
        };
        Self {
            mean_icc_3_1: over(&|u| Some(u.sweep?.icc_3_1)),
            mean_icc_2_1: over(&|u| Some(u.sweep?.icc_2_1)),
            mean_icc_1_1: over(&|u| Some(u.sweep?.icc_1_1)),
            mean_all_frames_icc_3_1: over(&|u| Some(u.all_frames?.icc_3_1)),
            mean_readable_icc_3_1: mean(
                rows.iter().filter(|u| u.readable).map(|u| u.sweep.map_or(0.0, |i| i.icc_3_1)).collect(),
            ),
            mean_cross_talk: mean((0..units.len()).flat_map(off).collect()),
            lost_frames: frames.iter().filter(|f| f.read.iter().all(Option::is_none)).count(),
            frames: frames.len(),
            cross_talk,
            units: rows,
        }
    }
}

/// Slope of the least squares line through `[x, y]`.
fn slope(pairs: &[[f64; 2]]) -> Option<f64> {
    let n = pairs.len() as f64;
    let (x, y) = (pairs.iter().map(|p| p[0]).sum::<f64>() / n, pairs.iter().map(|p| p[1]).sum::<f64>() / n);
    let (xx, xy) = pairs.iter().fold((0.0, 0.0), |(xx, xy), p| (xx + (p[0] - x).powi(2), xy + (p[0] - x) * (p[1] - y)));
    (xx > 1e-9).then(|| xy / xx)
}

/// What an AU changes in a picture, in and outside the mask of its region.
#[derive(Clone, Debug, Serialize)]
pub struct Spill {
    /// The AU that goes from neutral to the strongest the capture saw.
    pub unit: String,
    /// Its region.
    pub region: String,
    /// Greatest change of a colour where the region's mask is 0 of 255 levels with and without the AU, levels of 255.
    pub outside_max: u8,
    /// Mean change of a colour there.
    pub outside_mean: f64,
    /// 99.9 % of the colours there change by no more than this.
    pub outside_999: u8,
    /// Mean change of a colour where the mask is 50 % and more.
    pub inside_mean: f64,
    /// Greatest change of a colour where the mask is below 2 %.
    pub faint_max: u8,
}

/// The decoupling protocol.
#[derive(Clone, Debug, Serialize)]
pub struct Decoupling {
    /// AU by AU.
    pub units: Vec<Spill>,
    /// The greatest change outside a mask over all AUs, levels of 255.
    pub outside_max: u8,
    /// Mean over AUs of the mean change outside.
    pub outside_mean: f64,
    /// 99.9 % of the colours outside change by no more than this, for every AU.
    pub outside_999: u8,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_faithful_face_scores_one_and_a_mixed_up_one_shows_cross_talk() {
        let units = ["AU01", "AU12"].map(|u| (u.to_owned(), String::new(), u == "AU12"));
        let frames = |read: &dyn Fn(f64, f64) -> [f64; 2]| -> Vec<ControlFrame> {
            (0..2)
                .flat_map(|k| (0..=10).map(move |i| (k, f64::from(i) / 2.0)))
                .map(|(k, v)| {
                    let asked = if k == 0 { [v, 0.0] } else { [0.0, v] };
                    ControlFrame {
                        swept: Some(k),
                        asked: asked.to_vec(),
                        read: read(asked[0], asked[1]).map(Some).to_vec(),
                    }
                })
                .collect()
        };
        let faithful = Control::new(&units, &frames(&|a, b| [a, b]));
        assert!((faithful.mean_icc_3_1 - 1.0).abs() < 1e-9 && faithful.mean_cross_talk < 1e-9);
        // The smile raises the brows by 0.4 per unit, and the brows do nothing.
        let mixed = Control::new(&units, &frames(&|_, b| [0.4 * b, b]));
        assert!((mixed.cross_talk[1][0].unwrap() - 0.4).abs() < 1e-9);
        assert!((mixed.mean_icc_3_1 - 0.5).abs() < 1e-9 && (mixed.mean_readable_icc_3_1 - 1.0).abs() < 1e-9);
        assert!(mixed.mean_all_frames_icc_3_1 < 0.5);
        assert!((mixed.mean_cross_talk - 0.2).abs() < 1e-9);
    }
}
