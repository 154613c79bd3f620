//! The parametric part of the mean: a ratio of linear functions of the box, and its tangent.
//!
//! East and north are `n_axis / d`, where numerators and denominator are linear in the standardised foot
//! (u, v) and sides (width, height). With the foot alone this is the homography of a flat ground (8
//! numbers); the sides (6 more) let the antenna stand anywhere in the box.

use nalgebra::{SMatrix, SVector};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::statistics::median;

/// Coefficients: numerators of east (1, u, v), of north (1, u, v), denominator (u, v), then width and
/// height of east, of north, of the denominator.
pub(crate) const COEFFICIENTS: usize = 14;
/// Those of the foot.
pub(crate) const FOOT_COEFFICIENTS: usize = 8;
/// The denominator is kept above it, so that a box at the horizon stays finite.
pub(crate) const MIN_DENOMINATOR: f64 = 0.02;
/// Standardised sides are bounded, so that one abnormal box cannot land far away.
pub(crate) const MAX_SIDE: f64 = 3.5;
/// Prior standard deviation of the foot's numerators, in standard deviations of the positions, and of
/// the denominator's coefficients per standardised pixel.
const NUMERATOR_PRIOR: f64 = 30.0;
const DENOMINATOR_PRIOR: f64 = 0.5;
const STARTS: u32 = 60;
const ROWS_PER_START: usize = 12;
const MAX_START_ROWS: usize = 600;
/// The starts are the same for every run, so that no answer depends on the run's seed.
const START_SEED: u64 = 1;
const ROUNDS: usize = 15;

/// Foot u, foot v, width, height of a box, px.
pub(crate) type Box4 = [f64; 4];

/// The ratio with its scales.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct ProjectiveMean {
    /// Centre and unit of foot u, foot v, width, height, px.
    pub(crate) scales_px: [[f64; 2]; 4],
    /// Mean position, m.
    pub(crate) centre_m: [f64; 2],
    /// Standard deviation of the positions, m.
    pub(crate) spread_m: f64,
    /// In the order of [`COEFFICIENTS`]; numerators in m.
    pub(crate) coefficients: [f64; COEFFICIENTS],
}

/// Where the ratio is evaluated: numerators' terms and their values.
#[derive(Debug, Clone, Copy)]
pub(crate) struct EvaluatedMean {
    terms: [f64; 5],
    denominator: f64,
    /// East and north less the centre, m.
    pub(crate) offset_m: [f64; 2],
}

impl ProjectiveMean {
    /// Scales from the rows; every box at the mean position.
    pub(crate) fn of_rows(boxes: &[Box4], labels_m: &[[f64; 2]]) -> Self {
        let mut scales_px = [[0.0, 1.0]; 4];
        for (side, scale) in scales_px.iter_mut().enumerate() {
            let (mean, sigma) = moments(boxes.iter().map(|sides| sides[side]));
            *scale = [mean, sigma.max(2.0)];
        }
        // One unit for both coordinates of the foot keeps the image's proportions.
        let foot_px = (0.5 * (scales_px[0][1].powi(2) + scales_px[1][1].powi(2))).sqrt();
        (scales_px[0][1], scales_px[1][1]) = (foot_px, foot_px);
        // Medians, so that gross errors of fixes do not set the scale.
        let centre_m = [0, 1].map(|axis| median(labels_m.iter().map(|label| label[axis]).collect()));
        let distances =
            labels_m.iter().map(|label| (label[0] - centre_m[0]).powi(2) + (label[1] - centre_m[1]).powi(2));
        let spread_m = (median(distances.collect()) / (2.0 * std::f64::consts::LN_2)).sqrt().max(0.1);
        Self { scales_px, centre_m, spread_m, coefficients: [0.0; COEFFICIENTS] }
    }

    #[inline]
    pub(crate) fn evaluate(&self, sides: &Box4) -> EvaluatedMean {
        let scaled = |at: usize| (sides[at] - self.scales_px[at][0]) / self.scales_px[at][1];
        let bounded = |at: usize| scaled(at).clamp(-MAX_SIDE, MAX_SIDE);
        let terms = [1.0, scaled(0), scaled(1), bounded(2), bounded(3)];
        let c = &self.coefficients;
        let denominator = (1.0 + c[6] * terms[1] + c[7] * terms[2] + c[12] * terms[3] + c[13] * terms[4])
            .max(MIN_DENOMINATOR);
        let numerator = |foot: usize, side: usize| {
            c[foot]
                + c[foot + 1] * terms[1]
                + c[foot + 2] * terms[2]
                + c[side] * terms[3]
                + c[side + 1] * terms[4]
        };
        let offset_m = [numerator(0, 8) / denominator, numerator(3, 10) / denominator];
        EvaluatedMean { terms, denominator, offset_m }
    }

    /// East and north, m.
    #[inline]
    pub(crate) fn project(&self, sides: &Box4) -> [f64; 2] {
        let offset_m = self.evaluate(sides).offset_m;
        [self.centre_m[0] + offset_m[0], self.centre_m[1] + offset_m[1]]
    }

    /// Derivatives of east and north by foot u, foot v, width and height, m per px.
    #[inline]
    pub(crate) fn jacobian(&self, at: &EvaluatedMean) -> [[f64; 4]; 2] {
        let c = &self.coefficients;
        let slopes_d = [c[6], c[7], c[12], c[13]];
        let slopes_n = [[c[1], c[2], c[8], c[9]], [c[4], c[5], c[10], c[11]]];
        std::array::from_fn(|axis| {
            std::array::from_fn(|side| {
                (slopes_n[axis][side] - at.offset_m[axis] * slopes_d[side])
                    / (at.denominator * self.scales_px[side][1])
            })
        })
    }

    /// Derivatives of [`EvaluatedMean::moved_m`] by foot u, foot v, width and height, m per px; `slopes` are those of
    /// [`Self::jacobian`].
    #[inline]
    pub(crate) fn jacobian_of_move(
        &self,
        at: &EvaluatedMean,
        step: &[f64; COEFFICIENTS],
        slopes: &[[f64; 4]; 2],
    ) -> [[f64; 4]; 2] {
        let moved_m = at.moved_m(step);
        let c = &self.coefficients;
        let slopes_d = [c[6], c[7], c[12], c[13]];
        let steps_d = [step[6], step[7], step[12], step[13]];
        let steps_n = [[step[1], step[2], step[8], step[9]], [step[4], step[5], step[10], step[11]]];
        let moved_d = at.moved_denominator(step) / at.denominator;
        std::array::from_fn(|axis| {
            std::array::from_fn(|side| {
                let own =
                    steps_n[axis][side] - at.offset_m[axis] * steps_d[side] - moved_m[axis] * slopes_d[side];
                own / (at.denominator * self.scales_px[side][1]) - slopes[axis][side] * moved_d
            })
        })
    }

    /// Variances of the prior: wide for the foot, `side_scale` in units of the foot's spread for the sides.
    pub(crate) fn prior_variances(&self, side_scale: f64) -> [f64; COEFFICIENTS] {
        let numerator = (NUMERATOR_PRIOR * self.spread_m).powi(2);
        let denominator = DENOMINATOR_PRIOR * DENOMINATOR_PRIOR;
        let side_n = (side_scale * self.spread_m).powi(2);
        let side_d = side_scale * side_scale * 0.25;
        let mut variances = [numerator; COEFFICIENTS];
        variances[6..8].fill(denominator);
        variances[8..12].fill(side_n);
        variances[12..14].fill(side_d);
        variances
    }

    /// Robust least squares of the foot's eight coefficients alone: many starts on few rows, then
    /// iteratively reweighted Gauss-Newton under Cauchy's loss.
    pub(crate) fn fit_foot(&mut self, boxes: &[Box4], labels_m: &[[f64; 2]]) {
        let stride = boxes.len().div_ceil(MAX_START_ROWS).max(1);
        let few: Vec<usize> = (0..boxes.len()).step_by(stride).collect();
        let mut rng = ChaCha8Rng::seed_from_u64(START_SEED);
        let mut best = (f64::INFINITY, self.coefficients);
        for start in 0..=STARTS {
            let picked: Vec<usize> = if start == 0 {
                few.clone()
            } else {
                (0..ROWS_PER_START).map(|_| few[rng.random_range(0..few.len())]).collect()
            };
            self.coefficients = self.linear_start(boxes, labels_m, &picked);
            self.refine(boxes, labels_m, &few, 3);
            let miss_m = median(self.misses_m(boxes, labels_m, &few));
            if miss_m < best.0 {
                best = (miss_m, self.coefficients);
            }
        }
        self.coefficients = best.1;
        let all: Vec<usize> = (0..boxes.len()).collect();
        self.refine(boxes, labels_m, &all, ROUNDS);
    }

    fn misses_m(&self, boxes: &[Box4], labels_m: &[[f64; 2]], rows: &[usize]) -> Vec<f64> {
        let miss = |row: &usize| {
            let [east_m, north_m] = self.project(&boxes[*row]);
            (east_m - labels_m[*row][0]).hypot(north_m - labels_m[*row][1])
        };
        rows.iter().map(miss).collect()
    }

    /// Direct linear transform with the prior as ridge.
    fn linear_start(&self, boxes: &[Box4], labels_m: &[[f64; 2]], rows: &[usize]) -> [f64; COEFFICIENTS] {
        let mut normal = SMatrix::<f64, 8, 8>::zeros();
        let mut right = SVector::<f64, 8>::zeros();
        for row in rows {
            let evaluation =
                Self { coefficients: [0.0; COEFFICIENTS], ..self.clone() }.evaluate(&boxes[*row]);
            let [_, u, v, ..] = evaluation.terms;
            for axis in 0..2 {
                let y = (labels_m[*row][axis] - self.centre_m[axis]) / self.spread_m;
                let mut column = SVector::<f64, 8>::zeros();
                column[3 * axis] = 1.0;
                column[3 * axis + 1] = u;
                column[3 * axis + 2] = v;
                column[6] = -y * u;
                column[7] = -y * v;
                normal += column * column.transpose();
                right += column * y;
            }
        }
        for at in 0..8 {
            normal[(at, at)] += if at < 6 { 1e-6 } else { 0.1 };
        }
        let solution = normal.cholesky().map_or_else(SVector::zeros, |factor| factor.solve(&right));
        let mut coefficients = [0.0; COEFFICIENTS];
        for at in 0..8 {
            coefficients[at] = solution[at] * if at < 6 { self.spread_m } else { 1.0 };
        }
        coefficients
    }

    fn refine(&mut self, boxes: &[Box4], labels_m: &[[f64; 2]], rows: &[usize], rounds: usize) {
        let variances = self.prior_variances(1.0);
        for _ in 0..rounds {
            let misses_m = self.misses_m(boxes, labels_m, rows);
            let scale_m = median(misses_m.clone()).max(1e-3 * self.spread_m);
            let mut normal = SMatrix::<f64, 8, 8>::zeros();
            let mut right = SVector::<f64, 8>::zeros();
            for at in 0..8 {
                normal[(at, at)] = scale_m * scale_m / variances[at];
                right[at] = -self.coefficients[at] * normal[(at, at)];
            }
            for (row, miss_m) in rows.iter().zip(&misses_m) {
                let evaluation = self.evaluate(&boxes[*row]);
                let tangent = evaluation.tangent();
                let weight = 1.0 / (1.0 + (miss_m / (2.0 * scale_m)).powi(2));
                for axis in 0..2 {
                    let column = SVector::<f64, 8>::from_column_slice(&tangent[axis][..8]);
                    let residual = labels_m[*row][axis] - self.centre_m[axis] - evaluation.offset_m[axis];
                    normal += weight * column * column.transpose();
                    right += weight * residual * column;
                }
            }
            let Some(factor) = normal.cholesky() else { return };
            let step = factor.solve(&right);
            for at in 0..8 {
                self.coefficients[at] += step[at];
            }
        }
    }
}

impl EvaluatedMean {
    /// True where the ratio is bounded, so that its tangent says nothing.
    pub(crate) fn is_beyond_horizon(&self) -> bool {
        self.denominator <= MIN_DENOMINATOR
    }

    /// How far a step of the coefficients moves east and north along the tangent, m.
    #[inline]
    pub(crate) fn moved_m(&self, step: &[f64; COEFFICIENTS]) -> [f64; 2] {
        let [one, u, v, width, height] = self.terms;
        let moved_d = self.moved_denominator(step);
        std::array::from_fn(|axis| {
            let (foot, side) = (3 * axis, 8 + 2 * axis);
            let moved_n = step[foot] * one
                + step[foot + 1] * u
                + step[foot + 2] * v
                + step[side] * width
                + step[side + 1] * height;
            (moved_n - self.offset_m[axis] * moved_d) / self.denominator
        })
    }

    #[inline]
    fn moved_denominator(&self, step: &[f64; COEFFICIENTS]) -> f64 {
        let [_, u, v, width, height] = self.terms;
        step[6] * u + step[7] * v + step[12] * width + step[13] * height
    }

    /// Derivatives of east and north by the coefficients.
    #[inline]
    pub(crate) fn tangent(&self) -> [[f64; COEFFICIENTS]; 2] {
        let inverse = 1.0 / self.denominator;
        let [_, u, v, width, height] = self.terms.map(|term| term * inverse);
        std::array::from_fn(|axis| {
            let mut slopes = [0.0; COEFFICIENTS];
            slopes[3 * axis..3 * axis + 3].copy_from_slice(&[inverse, u, v]);
            slopes[8 + 2 * axis..10 + 2 * axis].copy_from_slice(&[width, height]);
            let offset_m = self.offset_m[axis];
            slopes[6] = -offset_m * u;
            slopes[7] = -offset_m * v;
            slopes[12] = -offset_m * width;
            slopes[13] = -offset_m * height;
            slopes
        })
    }
}

/// Mean and standard deviation.
pub(crate) fn moments(values: impl Iterator<Item = f64> + Clone) -> (f64, f64) {
    let count = values.clone().count().max(1) as f64;
    let mean = values.clone().sum::<f64>() / count;
    (mean, (values.map(|value| (value - mean).powi(2)).sum::<f64>() / count).sqrt())
}
