//! The training rows of a fit, and the rows that it leaves out as gross errors.

use super::noise::Epoch;
use super::projective_mean::{Box4, ProjectiveMean};
use crate::statistics::{GROSS_SIGMAS, median};

/// Neighbours in time on either side that a row's residual is compared with.
const NEIGHBOURS: usize = 3;
/// Neighbours are at most so far away in time, s.
const MAX_GAP_S: f64 = 10.0;

/// Rows in the order of target and time.
#[derive(Debug, Clone, Default)]
pub(crate) struct MapRows {
    pub(crate) epochs: Vec<Epoch>,
    pub(crate) boxes: Vec<Box4>,
    /// Fixes in the plane, m.
    pub(crate) labels_m: Vec<[f64; 2]>,
}

/// Rows, and their boxes as the kernel takes them.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Evidence<'a> {
    pub(crate) rows: &'a MapRows,
    pub(crate) inputs: &'a [[f64; 4]],
}

impl MapRows {
    pub(crate) fn picked(&self, rows: &[usize]) -> Self {
        Self {
            epochs: rows.iter().map(|row| self.epochs[*row]).collect(),
            boxes: rows.iter().map(|row| self.boxes[*row]).collect(),
            labels_m: rows.iter().map(|row| self.labels_m[*row]).collect(),
        }
    }

    pub(crate) fn thinned(&self, most: usize) -> Self {
        let stride = self.boxes.len().div_ceil(most).max(1);
        self.picked(&(0..self.boxes.len()).step_by(stride).collect::<Vec<_>>())
    }

    /// Fixes less what a mean says, m.
    pub(crate) fn misses_m(&self, mean: &ProjectiveMean) -> Vec<[f64; 2]> {
        let miss = |(sides, label): (&Box4, &[f64; 2])| {
            let [east_m, north_m] = mean.project(sides);
            [label[0] - east_m, label[1] - north_m]
        };
        self.boxes.iter().zip(&self.labels_m).map(miss).collect()
    }

    /// The rows without gross errors about a mean. What departs is a residual from the median of its neighbours': what a map
    /// misses, and a receiver's coloured error, change slowly.
    pub(crate) fn without_gross_errors(&self, mean: &ProjectiveMean) -> Self {
        let misses_m = self.misses_m(mean);
        let departures_m: Vec<Option<f64>> =
            (0..misses_m.len()).map(|row| self.departure_m(&misses_m, row)).collect();
        let sigma_m =
            median(departures_m.iter().flatten().copied().collect()) / (2.0 * std::f64::consts::LN_2).sqrt();
        let kept: Vec<usize> = (0..misses_m.len())
            .filter(|row| departures_m[*row].is_none_or(|departure_m| departure_m <= GROSS_SIGMAS * sigma_m))
            .collect();
        // Where a fifth of the rows departs, departures are what these rows are like.
        if 5 * kept.len() < 4 * misses_m.len() { self.clone() } else { self.picked(&kept) }
    }

    fn departure_m(&self, misses_m: &[[f64; 2]], row: usize) -> Option<f64> {
        let own = self.epochs[row];
        let near: Vec<usize> = (row.saturating_sub(NEIGHBOURS)..(row + NEIGHBOURS + 1).min(misses_m.len()))
            .filter(|other| {
                let other_epoch = self.epochs[*other];
                *other != row
                    && other_epoch.sequence == own.sequence
                    && (other_epoch.time_s - own.time_s).abs() <= MAX_GAP_S
            })
            .collect();
        let of = |axis: usize| {
            misses_m[row][axis] - median(near.iter().map(|other| misses_m[*other][axis]).collect())
        };
        (near.len() >= NEIGHBOURS).then(|| of(0).hypot(of(1)))
    }
}

/// Variance per axis by the median, m2.
pub(crate) fn scatter_m2(residuals_m: &[[f64; 2]]) -> f64 {
    let squares = residuals_m.iter().map(|residual| residual[0].powi(2) + residual[1].powi(2));
    median(squares.collect()) / (2.0 * std::f64::consts::LN_2)
}
