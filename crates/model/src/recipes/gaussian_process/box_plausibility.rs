//! The plausibility of a box at its place, by the boxes of training, and the box that would be plausible.
//!
//! In each cell of the image, log width and log height are regressed on the foot's place (Bayesian linear
//! regression; the slopes' prior is the regression over all cells). A box's deviation from it, in units of
//! its covariance, has a squared Mahalanobis length with two degrees of freedom; so has the mean deviation
//! over a target's recent boxes. Only the sides are tested, so a target at a new place is no bad box.

use std::f64::consts::TAU;

use nalgebra::{Matrix2, Matrix3, Matrix3x2, Vector2, Vector3};

use super::kernel::nearest;
use super::noise::Epoch;

use super::projective_mean::{Box4, moments};

pub(crate) const MAX_CELLS: usize = 24;
const ROWS_PER_CELL: usize = 40;
const LLOYD_ROUNDS: usize = 12;
/// Rows that the prior of a cell's slopes counts for.
const PRIOR_ROWS: f64 = 5.0;
/// Squared length beyond which a training box counts less.
const CREDIBLE: f64 = 9.21;
const ROUNDS: usize = 3;
/// Smallest standard deviation of a logarithmic side.
const MIN_LOG_SIDE: f64 = 0.01;
/// Largest logarithm of a side in px: no image is larger.
pub(crate) const MAX_LOG_SIDE: f64 = 11.8;
/// A deviation is normal up to the 99 % point, or to this factor on training's own.
const NORMAL_QUANTILE: f64 = 0.99;
const NORMAL_FACTOR: f64 = 1.5;
/// Boxes that a target's running mean covers.
pub(crate) const RECENT_BOXES: usize = 10;

#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Cell {
    pub(crate) centre: [f64; 2],
    /// Log width and log height by (1, u, v).
    pub(crate) coefficients: [[f64; 3]; 2],
    /// Inverse Cholesky factor of the deviations' covariance: (a, b, c) of [[a, 0], [b, c]].
    pub(crate) whitening: [f64; 3],
    /// Covariance of the coefficients per unit variance: upper triangle.
    pub(crate) leverage: [f64; 6],
}

/// The regressions of all cells.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct BoxPlausibility {
    /// Centre and unit of the foot, px.
    pub(crate) scales_px: [[f64; 2]; 2],
    pub(crate) cells: Vec<Cell>,
    /// Squared lengths up to which a box, and the mean of recent ones, is normal.
    pub(crate) normal: [f64; 2],
    /// Inverse Cholesky factor of the covariance of running means of normalised deviations.
    pub(crate) recent_whitening: [f64; 3],
}

/// How a box deviates from those of its cell.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Deviation {
    cell: usize,
    foot: [f64; 2],
    /// Normalised: unit covariance in training.
    pub(crate) normalized: [f64; 2],
    /// Weight of the cell's box, 0 for a normal box to 1.
    pub(crate) weight: f64,
    /// Factor on the normalised deviation by what the cell's coefficients are uncertain.
    widen: f64,
}

/// Running means of how a target's boxes deviate from those of training, and of the probability that its foot is hidden:
/// one per target, kept by the caller between its boxes.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct RecentBoxes {
    mean: [f64; 2],
    count: u32,
    /// Exponential mean, over as many boxes, of the probability that the foot is hidden.
    pub(super) hidden: f64,
}

impl RecentBoxes {
    /// Takes a box's deviation in: the plain mean of the first ten, then an exponential one.
    fn push(&mut self, deviation: &Deviation) {
        self.count = (self.count + 1).min(RECENT_BOXES as u32);
        for (mean, own) in self.mean.iter_mut().zip(deviation.normalized) {
            *mean += (own - *mean) / f64::from(self.count);
        }
    }
}

impl BoxPlausibility {
    /// From rows in the order of target and time.
    pub(crate) fn fit(epochs: &[Epoch], boxes: &[Box4]) -> Self {
        let scales_px = [0, 1].map(|side| {
            let (mean, sigma) = moments(boxes.iter().map(|sides| sides[side]));
            [mean, sigma.max(5.0)]
        });
        let mut fitted =
            Self { scales_px, cells: Vec::new(), normal: [CREDIBLE; 2], recent_whitening: [1.0, 0.0, 1.0] };
        let feet: Vec<[f64; 2]> = boxes.iter().map(|sides| fitted.foot(sides)).collect();
        let sides: Vec<[f64; 2]> = boxes.iter().map(log_sides).collect();
        let centres = centres(&feet, (boxes.len() / ROWS_PER_CELL).clamp(1, MAX_CELLS));
        let everywhere: Vec<usize> = (0..boxes.len()).collect();
        let prior = LinearRegression::fit(&feet, &sides, &everywhere, None);
        let mut members = vec![Vec::new(); centres.len()];
        for (row, foot) in feet.iter().enumerate() {
            members[nearest(&centres, foot)].push(row);
        }
        fitted.cells = centres
            .iter()
            .zip(&members)
            .map(|(centre, own)| LinearRegression::fit(&feet, &sides, own, Some(&prior)).cell(*centre))
            .collect();
        fitted.set_normal(epochs, boxes);
        fitted
    }

    fn set_normal(&mut self, epochs: &[Epoch], boxes: &[Box4]) {
        let deviations: Vec<Deviation> = boxes.iter().map(|sides| self.deviation(sides)).collect();
        let mut means: Vec<[f64; 2]> = Vec::new();
        let mut recent = RecentBoxes::default();
        for (row, deviation) in deviations.iter().enumerate() {
            if row == 0 || epochs[row].sequence != epochs[row - 1].sequence {
                recent = RecentBoxes::default();
            }
            recent.push(deviation);
            if recent.count as usize == RECENT_BOXES {
                means.push(recent.mean);
            }
        }
        let limit = |squares: Vec<f64>| (NORMAL_FACTOR * quantile(squares, NORMAL_QUANTILE)).max(CREDIBLE);
        self.normal[0] = limit(deviations.iter().map(|deviation| square(&deviation.normalized)).collect());
        if means.len() < ROWS_PER_CELL {
            return;
        }
        let mut covariance = Matrix2::identity() * (0.2 / RECENT_BOXES as f64);
        for mean in &means {
            covariance += Vector2::from(*mean) * Vector2::from(*mean).transpose() / means.len() as f64;
        }
        self.recent_whitening = whitening(&covariance);
        let squares = means.iter().map(|mean| square(&whiten(&self.recent_whitening, mean)));
        self.normal[1] = limit(squares.collect());
    }

    #[inline]
    fn foot(&self, sides: &Box4) -> [f64; 2] {
        [0, 1].map(|side| (sides[side] - self.scales_px[side][0]) / self.scales_px[side][1])
    }

    /// How far a box deviates.
    #[inline]
    pub(crate) fn deviation(&self, sides: &Box4) -> Deviation {
        let foot = self.foot(sides);
        let mut best = (f64::INFINITY, 0);
        for (at, cell) in self.cells.iter().enumerate() {
            let distance = (cell.centre[0] - foot[0]).powi(2) + (cell.centre[1] - foot[1]).powi(2);
            if distance < best.0 {
                best = (distance, at);
            }
        }
        let cell = &self.cells[best.1];
        let [log_width, log_height] = log_sides(sides);
        let predicted = cell.predict(&foot);
        let widen = 1.0 / (1.0 + cell.leverage(&foot)).sqrt();
        let normalized = whiten(&cell.whitening, &[log_width - predicted[0], log_height - predicted[1]])
            .map(|value| value * widen);
        let weight = share_beyond(square(&normalized), self.normal[0]);
        Deviation { cell: best.1, foot, normalized, weight, widen }
    }

    /// Density of log width and log height at a deviation.
    #[inline]
    pub(crate) fn density(&self, deviation: &Deviation) -> f64 {
        let [first, _, second] = self.cells[deviation.cell].whitening;
        let peak = first * second * deviation.widen * deviation.widen / TAU;
        peak * (-0.5 * square(&deviation.normalized)).exp()
    }

    /// How far a box, and the recent boxes of its target with it, deviate; `recent` takes the box in.
    #[inline]
    pub(crate) fn next_deviation(&self, sides: &Box4, recent: &mut RecentBoxes) -> Deviation {
        let mut deviation = self.deviation(sides);
        recent.push(&deviation);
        if recent.count as usize == RECENT_BOXES {
            let lasting = square(&whiten(&self.recent_whitening, &recent.mean));
            deviation.weight = deviation.weight.max(share_beyond(lasting, self.normal[1]));
        }
        deviation
    }

    /// The box with the cell's sides whose edges are nearest to the given one's.
    #[inline]
    pub(crate) fn nearest_plausible(&self, sides: &Box4, deviation: &Deviation) -> Box4 {
        let cell = &self.cells[deviation.cell];
        let predicted = cell.predict(&deviation.foot).map(|log_px| log_px.clamp(0.0, MAX_LOG_SIDE).exp());
        let slope = |side: usize, by: usize| {
            predicted[side] * cell.coefficients[side][1 + by] / self.scales_px[by][1]
        };
        let slopes = [[slope(0, 0), slope(0, 1)], [slope(1, 0), slope(1, 1)]];
        let (wider, taller) = (predicted[0] - sides[2], predicted[1] - sides[3]);
        // Squares of the edges' moves as functions of the foot's: (coefficients of u and v, constant).
        let edges = [
            ([1.0 - 0.5 * slopes[0][0], -0.5 * slopes[0][1]], -0.5 * wider),
            ([1.0 + 0.5 * slopes[0][0], 0.5 * slopes[0][1]], 0.5 * wider),
            ([-slopes[1][0], 1.0 - slopes[1][1]], -taller),
            ([0.0, 1.0], 0.0),
        ];
        let (mut a, mut b, mut c, mut right) = (0.0, 0.0, 0.0, [0.0; 2]);
        for ([by_u, by_v], constant) in edges {
            a += by_u * by_u;
            b += by_u * by_v;
            c += by_v * by_v;
            right[0] -= by_u * constant;
            right[1] -= by_v * constant;
        }
        let determinant = a * c - b * b;
        let moved =
            [(c * right[0] - b * right[1]) / determinant, (a * right[1] - b * right[0]) / determinant];
        let side = |at: usize| (predicted[at] + slopes[at][0] * moved[0] + slopes[at][1] * moved[1]).max(1.0);
        [sides[0] + moved[0], sides[1] + moved[1], side(0), side(1)]
    }
}

/// Share of a squared distance that is beyond what is normal.
#[inline]
fn share_beyond(square: f64, normal: f64) -> f64 {
    if square > normal { 1.0 - normal / square } else { 0.0 }
}

impl Cell {
    #[inline]
    fn predict(&self, foot: &[f64; 2]) -> [f64; 2] {
        self.coefficients.map(|[constant, by_u, by_v]| constant + by_u * foot[0] + by_v * foot[1])
    }

    /// Variance of the prediction per unit variance of a deviation.
    #[inline]
    fn leverage(&self, foot: &[f64; 2]) -> f64 {
        let [a, b, c, d, e, f] = self.leverage;
        let [u, v] = *foot;
        (a + 2.0 * (b * u + c * v) + d * u * u + 2.0 * e * u * v + f * v * v).max(0.0)
    }
}

/// A robust linear regression of log sides on place.
struct LinearRegression {
    coefficients: Matrix3x2<f64>,
    covariance: Matrix2<f64>,
    inverse: Matrix3<f64>,
}

impl LinearRegression {
    fn fit(feet: &[[f64; 2]], sides: &[[f64; 2]], rows: &[usize], prior: Option<&Self>) -> Self {
        let ridge = match prior {
            Some(_) => Matrix3::from_diagonal(&Vector3::new(0.1, PRIOR_ROWS, PRIOR_ROWS)),
            None => Matrix3::identity() * 1e-3,
        };
        let prior_coefficients = prior.map_or_else(Matrix3x2::zeros, |prior| prior.coefficients);
        let mut fitted = Self {
            coefficients: prior_coefficients,
            covariance: prior.map_or_else(|| Matrix2::identity() * 1e6, |prior| prior.covariance),
            inverse: Matrix3::identity(),
        };
        for _ in 0..ROUNDS {
            let factor = whitening(&fitted.covariance);
            let mut normal = ridge;
            let mut right = ridge * prior_coefficients;
            let mut weights = Vec::with_capacity(rows.len());
            for row in rows {
                let terms = Vector3::new(1.0, feet[*row][0], feet[*row][1]);
                let miss = fitted.miss(&terms, &sides[*row]);
                let weight =
                    (CREDIBLE / square(&whiten(&factor, &[miss[0], miss[1]])).max(CREDIBLE)).min(1.0);
                normal += weight * terms * terms.transpose();
                right += weight * terms * Vector2::from(sides[*row]).transpose();
                weights.push(weight);
            }
            fitted.inverse = normal.try_inverse().unwrap_or_else(Matrix3::identity);
            fitted.coefficients = fitted.inverse * right;
            let prior_weight = if prior.is_some() { PRIOR_ROWS } else { 0.0 };
            let mut covariance = prior.map_or_else(Matrix2::zeros, |prior| prior.covariance * PRIOR_ROWS);
            let mut total = prior_weight;
            for (row, weight) in rows.iter().zip(&weights) {
                let miss = fitted.miss(&Vector3::new(1.0, feet[*row][0], feet[*row][1]), &sides[*row]);
                covariance += *weight * miss * miss.transpose();
                total += weight;
            }
            fitted.covariance =
                covariance / f64::max(total, 1.0) + Matrix2::identity() * (MIN_LOG_SIDE * MIN_LOG_SIDE);
        }
        fitted
    }

    fn miss(&self, terms: &Vector3<f64>, sides: &[f64; 2]) -> Vector2<f64> {
        Vector2::from(*sides) - self.coefficients.transpose() * terms
    }

    fn cell(&self, centre: [f64; 2]) -> Cell {
        let of = |side: usize| std::array::from_fn(|term| self.coefficients[(term, side)]);
        let inverse = &self.inverse;
        Cell {
            centre,
            coefficients: [of(0), of(1)],
            whitening: whitening(&self.covariance),
            leverage: [
                inverse[(0, 0)],
                inverse[(0, 1)],
                inverse[(0, 2)],
                inverse[(1, 1)],
                inverse[(1, 2)],
                inverse[(2, 2)],
            ],
        }
    }
}

#[inline]
fn log_sides(sides: &Box4) -> [f64; 2] {
    [sides[2].max(1.0).ln(), sides[3].max(1.0).ln()]
}

#[inline]
fn square(value: &[f64; 2]) -> f64 {
    value[0] * value[0] + value[1] * value[1]
}

#[inline]
fn whiten([a, b, c]: &[f64; 3], value: &[f64; 2]) -> [f64; 2] {
    [a * value[0], b * value[0] + c * value[1]]
}

/// Inverse of the lower Cholesky factor.
fn whitening(covariance: &Matrix2<f64>) -> [f64; 3] {
    let first = covariance[(0, 0)].max(1e-12).sqrt();
    let cross = covariance[(1, 0)] / first;
    let second = (covariance[(1, 1)] - cross * cross).max(1e-12).sqrt();
    [1.0 / first, -cross / (first * second), 1.0 / second]
}

/// Quantile by rank, without interpolation; 0 for none.
fn quantile(mut values: Vec<f64>, share: f64) -> f64 {
    if values.is_empty() {
        return 0.0;
    }
    let rank = ((values.len() - 1) as f64 * share).round() as usize;
    *values.select_nth_unstable_by(rank, f64::total_cmp).1
}

fn centres(feet: &[[f64; 2]], count: usize) -> Vec<[f64; 2]> {
    let mut centres: Vec<[f64; 2]> = (0..count).map(|at| feet[at * feet.len() / count]).collect();
    for _ in 0..LLOYD_ROUNDS {
        let mut sums = vec![([0.0; 2], 0.0); count];
        for foot in feet {
            let (sum, members) = &mut sums[nearest(&centres, foot)];
            *sum = [sum[0] + foot[0], sum[1] + foot[1]];
            *members += 1.0;
        }
        for (centre, (sum, members)) in
            centres.iter_mut().zip(&sums).filter(|(_, (_, members))| *members > 0.0)
        {
            *centre = sum.map(|sum| sum / members);
        }
    }
    centres
}
