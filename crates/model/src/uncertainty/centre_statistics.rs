//! How an encoder responds to noise at each centre of the coverage.

use super::coverage::Coverage;
use super::jacobian::{Encode, edge_variance_m2, foot_variance_m2, jacobian_at};
use crate::encoder::geometry::GeometricCovariance;
use crate::samples::rows::TrainingRow;

/// One value per centre, except for `of_row`.
pub(super) struct CentreStatistics {
    /// Nearest centre of each row.
    pub(super) of_row: Vec<usize>,
    /// Rows at each centre.
    counts: Vec<f64>,
    /// Variance per axis due to the covariance of the parameters, m2.
    pub(super) parameter_m2: Vec<f64>,
    /// Variance per axis due to independent noise of 1 px2 in each edge, m2.
    pub(super) edge_m2: Vec<f64>,
    /// Variance per axis due to independent noise of one squared box height in each coordinate of the foot
    /// point, m2.
    pub(super) height_m2: Vec<f64>,
}

impl CentreStatistics {
    pub(super) fn new(
        coverage: &Coverage,
        rows: &[TrainingRow],
        covariance: &GeometricCovariance,
        encode: &Encode<'_>,
    ) -> Self {
        let of_row: Vec<usize> = rows.iter().map(|row| coverage.nearest(&row.bounding_box)).collect();
        let mut counts = vec![0.0; coverage.len()];
        of_row.iter().for_each(|at| counts[*at] += 1.0);
        let mut statistics =
            Self { of_row, counts, parameter_m2: Vec::new(), edge_m2: Vec::new(), height_m2: Vec::new() };
        for centre in coverage.boxes() {
            let jacobian = centre.map_or([[0.0; 4]; 2], |centre| jacobian_at(encode, &centre).0);
            let height_px = centre.map_or(0.0, |centre| centre.height_px());
            statistics.parameter_m2.push(centre.map_or(0.0, |centre| covariance.variance_m2(&centre)));
            statistics.edge_m2.push(edge_variance_m2(&jacobian));
            statistics.height_m2.push(foot_variance_m2(&jacobian) * height_px * height_px);
        }
        statistics
    }

    /// Mean over the training boxes of a value per centre.
    pub(super) fn mean(&self, values: impl IntoIterator<Item = f64>) -> f64 {
        let total: f64 = self.counts.iter().sum();
        values.into_iter().zip(&self.counts).map(|(value, count)| value * count).sum::<f64>() / total
    }
}
