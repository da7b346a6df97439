//! Intraclass correlation (Shrout and Fleiss 1979): how well raters agree on targets. Here one rater is the control that was
//! given, the other what the tracker reads from the render.

use serde::Serialize;

/// The three single-rater coefficients.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Icc {
    /// ICC(1,1): raters drawn anew for each target.
    pub icc_1_1: f64,
    /// ICC(2,1): the same raters, absolute agreement.
    pub icc_2_1: f64,
    /// ICC(3,1): the same raters, a constant offset does not count.
    pub icc_3_1: f64,
}

/// ICC of `ratings[target][rater]`; `None` for fewer than two targets or raters, unequal rows, values that are not finite or
/// whose squares are not, or when nothing varies at all.
pub fn icc(ratings: &[Vec<f64>]) -> Option<Icc> {
    let (n, k) = (ratings.len(), ratings.first()?.len());
    if n < 2 || k < 2 || ratings.iter().any(|r| r.len() != k || r.iter().any(|v| !v.is_finite())) {
        return None;
    }
    let (targets, raters) = (n as f64, k as f64);
    // Residuals are formed one by one: differences of large sums of squares would cancel.
    let grand = ratings.iter().flatten().sum::<f64>() / (targets * raters);
    let rows: Vec<f64> = ratings.iter().map(|r| r.iter().sum::<f64>() / raters - grand).collect();
    let columns: Vec<f64> = (0..k).map(|c| ratings.iter().map(|r| r[c]).sum::<f64>() / targets - grand).collect();
    let squares = |values: &[f64]| values.iter().map(|v| v * v).sum::<f64>();
    let (between, across) = (raters * squares(&rows), targets * squares(&columns));
    let residual =
        |(i, r): (usize, &Vec<f64>)| (0..k).map(|c| (r[c] - grand - rows[i] - columns[c]).powi(2)).sum::<f64>();
    let error: f64 = ratings.iter().enumerate().map(residual).sum();
    let ms_targets = between / (targets - 1.0);
    let ms_within = (error + across) / (targets * (raters - 1.0));
    let ms_raters = across / (raters - 1.0);
    let ms_error = error / ((targets - 1.0) * (raters - 1.0));
    if between + across + error <= f64::EPSILON * targets * raters * grand.abs().max(1.0).powi(2) {
        return None;
    }
    let icc = Icc {
        icc_1_1: (ms_targets - ms_within) / (ms_targets + (raters - 1.0) * ms_within),
        icc_2_1: (ms_targets - ms_error)
            / (ms_targets + (raters - 1.0) * ms_error + raters * (ms_raters - ms_error) / targets),
        icc_3_1: (ms_targets - ms_error) / (ms_targets + (raters - 1.0) * ms_error),
    };
    [icc.icc_1_1, icc.icc_2_1, icc.icc_3_1].iter().all(|v| v.is_finite()).then_some(icc)
}

/// Pearson's correlation; `None` where one of the two does not vary, or a number or its square is not finite.
pub fn correlation(pairs: &[[f64; 2]]) -> Option<f64> {
    let n = pairs.len() as f64;
    let mean: [f64; 2] = std::array::from_fn(|c| pairs.iter().map(|p| p[c]).sum::<f64>() / n);
    let (mut xx, mut yy, mut xy) = (0.0, 0.0, 0.0);
    for p in pairs {
        let (x, y) = (p[0] - mean[0], p[1] - mean[1]);
        (xx, yy, xy) = (xx + x * x, yy + y * y, xy + x * y);
    }
    // The roots one by one: the product of two large sums would overflow.
    (xx > 1e-12 && yy > 1e-12).then(|| xy / (xx.sqrt() * yy.sqrt())).filter(|r| r.is_finite())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_published_example() {
        let ratings = [[9, 2, 5, 8], [6, 1, 3, 2], [8, 4, 6, 8], [7, 1, 2, 6], [10, 5, 6, 9], [6, 2, 4, 7]]
            .map(|r| r.map(f64::from).to_vec());
        let i = icc(&ratings).unwrap();
        for (got, expected) in [(i.icc_1_1, 0.16574), (i.icc_2_1, 0.28976), (i.icc_3_1, 0.71484)] {
            assert!((got - expected).abs() < 1e-5, "{got} {expected}");
        }
    }

    #[test]
    fn offsets_and_nothing() {
        let pairs = [(0.0, 0.2), (1.0, 0.8), (2.0, 2.5), (3.0, 2.6), (4.0, 4.4), (5.0, 4.1)];
        let ratings = |shift: f64| pairs.map(|(a, b)| vec![a, b + shift]).to_vec();
        let i = icc(&ratings(0.0)).unwrap();
        for (got, expected) in [(i.icc_1_1, 0.96165), (i.icc_2_1, 0.96152), (i.icc_3_1, 0.95497)] {
            assert!((got - expected).abs() < 1e-5, "{got} {expected}");
        }
        let shifted = icc(&ratings(1e6)).unwrap();
        assert!((shifted.icc_3_1 - i.icc_3_1).abs() < 1e-6 && shifted.icc_2_1 < 0.01);
        assert!(icc(&[vec![1.0, 1.0], vec![1.0, 1.0]]).is_none());
        assert!(icc(&[vec![1.0, 2.0]]).is_none() && icc(&[vec![1.0, f64::NAN], vec![0.0, 1.0]]).is_none());
        // One rater that never moves: exactly no agreement.
        let flat = icc(&[vec![0.0, 1.0], vec![1.0, 1.0], vec![2.0, 1.0]]).unwrap();
        assert!(flat.icc_3_1.abs() < 1e-12, "{}", flat.icc_3_1);
    }
}
