//! The white noise of a sequence of positions, from its second differences.
//!
//! For positions `p` at even intervals, `p[i+1] - 2 p[i] + p[i-1]` cancels a constant velocity. White
//! noise of variance `v` per axis gives it the variance `6 v` per axis, so its squared length has the
//! mean `12 v`.

use super::rows::TrainingRow;
use crate::geo::EastNorth;

/// Ratio of the mean squared second difference (both axes) to the variance per axis of white noise.
pub(crate) const MEAN_SQUARE_PER_VARIANCE: f64 = 12.0;

/// Share of the squares that [`trimmed_mean`] keeps; larger ones are stops, turns and outliers.
const KEPT_SHARE: f64 = 0.97;
/// Mean of the smallest [`KEPT_SHARE`] of exponentially distributed values (the squared length of a
/// normal vector in the plane), as a share of the mean of all.
const KEPT_MEAN: f64 = 0.89;

/// Longest interval between neighbouring rows, s.
const LONGEST_INTERVAL_S: f64 = 2.5;

/// Squared second differences (m2, both axes) of one position per row, with the index of the row in
/// their centre; only of rows that follow each other at even intervals within one traverse.
pub(crate) fn second_differences<'a>(
    rows: &'a [TrainingRow],
    positions: &'a [EastNorth],
) -> impl Iterator<Item = (usize, f64)> + 'a {
    (1..rows.len().saturating_sub(1)).filter_map(|at| {
        let (first, centre, last) = (&rows[at - 1], &rows[at], &rows[at + 1]);
        let (first_s, second_s) = (centre.time_s - first.time_s, last.time_s - centre.time_s);
        let even =
            first_s > 0.0 && first_s < LONGEST_INTERVAL_S && (first_s - second_s).abs() < 0.1 * first_s;
        let difference = |of: fn(&EastNorth) -> f64| {
            of(&positions[at + 1]) - 2.0 * of(&positions[at]) + of(&positions[at - 1])
        };
        let square_m2 = difference(|point| point.east_m).powi(2) + difference(|point| point.north_m).powi(2);
        (even && first.traverse == last.traverse).then_some((at, square_m2))
    })
}

/// Mean of exponentially distributed squares without the largest of them; `None` for no squares.
pub(crate) fn trimmed_mean(mut squares: Vec<f64>) -> Option<f64> {
    squares.sort_by(f64::total_cmp);
    squares.truncate((squares.len() as f64 * KEPT_SHARE).ceil() as usize);
    let count = squares.len() as f64;
    (count > 0.0).then(|| squares.iter().sum::<f64>() / (count * KEPT_MEAN))
}
