//! The robust least-squares fit of a [`Projection`] to rows whose fixes have coloured noise.
//!
//! The cost is `sum |W (y - f(x; p))|^2 + sum (p / sigma_prior)^2` with the whitening filter `W` of the
//! fixes' noise. It is minimised by Levenberg and Marquardt's method; noise and the variance inflation of
//! outliers are estimated again between rounds (iteratively reweighted least squares).

use nalgebra::{DMatrix, DVector};
use rand_chacha::ChaCha8Rng;

use super::initial_projection::initial_projection;
use super::projection::{COEFFICIENTS, Projected, Projection};
use crate::domain::{BoundingBox, GaussMarkovNoise};
use crate::geo::{EastNorth, LocalPlane, Position};
use crate::samples::rows::TrainingRow;
use crate::samples::second_differences::{MEAN_SQUARE_PER_VARIANCE, second_differences, trimmed_mean};
use crate::samples::whitening::{Whitener, fit_noise, with_gross_errors};
use crate::statistics::median;

/// Most steps of Levenberg and Marquardt's method per round.
const STEPS: usize = 25;
/// Rounds of refinement, each followed by an estimate of the noise.
const ROUNDS: usize = 4;
/// Fewest pairs that determine a homography with some redundancy.
const FEWEST_PAIRS: usize = 8;
/// Ratio of the median squared distance (2 axes) to the variance per axis of a normal distribution: 2 ln 2.
const MEDIAN_SQUARE_PER_VARIANCE: f64 = 1.39;

/// The white variance of the fixes is taken as at least this many times the variance of the detector's
/// jitter in regressed positions: a whitening filter that weights the differences between neighbours
/// more than that fits the jitter of the boxes, which shrinks the map (errors in variables).
const WHITE_PER_JITTER_VARIANCE: f64 = 20.0;

/// Prior standard deviations of the coefficients, in standardised units.
const NUMERATOR_SIGMA: f64 = 10.0;
const DENOMINATOR_SIGMA: f64 = 0.7;
const SIZE_SIGMA: f64 = 0.3;
/// The same of a coefficient that is not part of the form: it remains at 0.
const EXCLUDED_SIGMA: f64 = 1e-6;

/// The terms that a fit may use.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Form {
    /// True if width and height are used besides the foot point.
    pub(crate) uses_size: bool,
    /// Prior standard deviation of the weight of an extra column, in units of position.
    pub(crate) extra_sigma: f64,
}

/// A fitted projection with the weights of the extra columns and the noise about it.
#[derive(Debug, Clone)]
pub(crate) struct ProjectionFit {
    pub(crate) projection: Projection,
    /// Weights of the extra columns for east, then north, in units of position.
    pub(crate) extra: [Vec<f64>; 2],
    /// Noise of the fixes about the map.
    pub(crate) noise: GaussMarkovNoise,
    pub(crate) covariance: ParameterCovariance,
}

/// The covariance of a fitted projection's parameters: the inverse of the normal matrix at the optimum.
#[derive(Debug, Clone)]
pub(crate) struct ParameterCovariance {
    projection: Projection,
    /// Parameters: coefficients, weights of the extra columns for east, then for north.
    covariance: DMatrix<f64>,
}

impl ParameterCovariance {
    pub(crate) const fn projection(&self) -> &Projection {
        &self.projection
    }

    /// Variance per axis of the map at a box due to the parameters' covariance `P`, m2: the mean over both
    /// axes of `J P J^T`. `columns` are the values of the extra columns at the box.
    pub(crate) fn variance_m2(&self, bounding_box: &BoundingBox, columns: &[f64]) -> f64 {
        let projected = self.projection.at(bounding_box);
        let mut sum = 0.0;
        for axis in 0..2 {
            let mut jacobian = DVector::<f64>::zeros(self.covariance.nrows());
            let derivatives = self.projection.derivatives_m(&projected, axis);
            for (index, derivative) in Projection::coefficient_indexes(axis).into_iter().zip(derivatives) {
                jacobian[index] = derivative;
            }
            for (at, value) in columns.iter().enumerate() {
                jacobian[COEFFICIENTS + axis * columns.len() + at] = self.projection.unit_m * value;
            }
            sum += jacobian.dot(&(&self.covariance * &jacobian));
        }
        0.5 * sum
    }
}

/// Fits a homography of the foot points to pairs of boxes and positions in one plane (m) with independent
/// errors; `None` for fewer than 8 pairs, or pairs that are all at one position.
#[must_use]
pub fn fit_foot_points(pairs: &[(BoundingBox, EastNorth)], rng: &mut ChaCha8Rng) -> Option<Projection> {
    let origin = LocalPlane::new(Position::new(0.0, 0.0).ok()?).origin();
    // Each pair is its own target, so that the errors of neighbours are not taken as correlated.
    let rows: Vec<TrainingRow> = pairs
        .iter()
        .enumerate()
        .map(|(at, (bounding_box, label))| TrainingRow {
            sample: 0,
            time_s: 0.0,
            target: at as u32,
            traverse: at as u32,
            bounding_box: *bounding_box,
            position: origin,
            label: *label,
            stated_variance_m2: None,
        })
        .collect();
    if rows.len() < FEWEST_PAIRS {
        return None;
    }
    let projection = fit(&rows, Form { uses_size: false, extra_sigma: 1.0 }, &[], rng).projection;
    let varies = projection.coefficients.iter().any(|coefficient| coefficient.abs() > 1e-9);
    varies.then_some(projection)
}

/// Fits a projection of a form to rows sorted by target and time; `columns` are the extra columns, one
/// value per row each.
pub(crate) fn fit(
    rows: &[TrainingRow],
    form: Form,
    columns: &[Vec<f64>],
    rng: &mut ChaCha8Rng,
) -> ProjectionFit {
    let projection = initial_projection(rows, rng);
    let mut fitted = ProjectionFit {
        extra: [vec![0.0; columns.len()], vec![0.0; columns.len()]],
        covariance: ParameterCovariance { projection: projection.clone(), covariance: DMatrix::zeros(0, 0) },
        projection,
        noise: GaussMarkovNoise::white(1.0),
    };
    let problem = LeastSquaresProblem { rows, columns, prior: prior(form, columns.len()) };
    let (noise, mut inflation) = initial_noise(&fitted.residuals(rows, columns));
    fitted.noise = noise;
    let mut weighting = noise;
    for round in 0..ROUNDS {
        fitted.refine(&problem, &Whitener::new(rows, &weighting, &inflation));
        let residuals = fitted.residuals(rows, columns);
        fitted.noise = fit_noise(rows, &residuals, &inflation);
        let jitter_m2 = fitted.jitter_variance_m2(&problem);
        weighting = fitted.noise.with_white_at_least(WHITE_PER_JITTER_VARIANCE * jitter_m2);
        if round + 1 < ROUNDS {
            inflation = Whitener::new(rows, &fitted.noise, &inflation).inflation(&fitted.noise, residuals);
        }
    }
    let (normal, _) = fitted.normal_equations(&problem, &Whitener::new(rows, &weighting, &inflation));
    let size = normal.nrows();
    // The prior makes the matrix positive definite; rounding may not.
    let covariance = normal.cholesky().map_or_else(|| DMatrix::identity(size, size), |it| it.inverse());
    fitted.covariance = ParameterCovariance { projection: fitted.projection.clone(), covariance };
    fitted
}

/// White noise with the variance of the median residual, and the variance inflation of rows whose residual
/// exceeds four times the median; beyond six times, or seven standard deviations, it is a gross error.
fn initial_noise(residuals: &[Vec<f64>; 2]) -> (GaussMarkovNoise, Vec<f64>) {
    let distances: Vec<f64> =
        residuals[0].iter().zip(&residuals[1]).map(|(east, north)| east.hypot(*north)).collect();
    let median_m = median(distances.clone()).max(1e-3);
    let inflation = distances
        .iter()
        .map(|distance| {
            let excess = (distance / (4.0 * median_m)).powi(2) - 1.0;
            excess.max(0.0) * 8.0
        })
        .collect();
    let inflation = with_gross_errors(inflation, |row| distances[row] > 6.0 * median_m);
    (GaussMarkovNoise::white(median_m * median_m / MEDIAN_SQUARE_PER_VARIANCE), inflation)
}

/// Prior precision of each parameter about 0.
fn prior(form: Form, columns: usize) -> Vec<f64> {
    let size = if form.uses_size { SIZE_SIGMA } else { EXCLUDED_SIGMA };
    let mut sigmas = Vec::new();
    for _axis in 0..2 {
        sigmas.extend([NUMERATOR_SIGMA, NUMERATOR_SIGMA, NUMERATOR_SIGMA, size, size]);
    }
    sigmas.extend([DENOMINATOR_SIGMA, DENOMINATOR_SIGMA, size, size]);
    sigmas.extend(std::iter::repeat_n(form.extra_sigma, 2 * columns));
    sigmas.iter().map(|sigma| 1.0 / (sigma * sigma)).collect()
}

/// The constants of a fit.
struct LeastSquaresProblem<'a> {
    rows: &'a [TrainingRow],
    columns: &'a [Vec<f64>],
    prior: Vec<f64>,
}

impl ProjectionFit {
    /// Label less map for east and north, m.
    pub(crate) fn residuals(&self, rows: &[TrainingRow], columns: &[Vec<f64>]) -> [Vec<f64>; 2] {
        let mut residuals = [Vec::with_capacity(rows.len()), Vec::with_capacity(rows.len())];
        for (at, row) in rows.iter().enumerate() {
            let extra = std::array::from_fn(|axis: usize| {
                self.extra[axis].iter().zip(columns).map(|(weight, column)| weight * column[at]).sum()
            });
            let point = self.projection.project(&row.bounding_box, extra);
            residuals[0].push(row.label.east_m - point.east_m);
            residuals[1].push(row.label.north_m - point.north_m);
        }
        residuals
    }

    /// Variance per axis of the detector's jitter in the map's positions, m2.
    fn jitter_variance_m2(&self, LeastSquaresProblem { rows, columns, .. }: &LeastSquaresProblem<'_>) -> f64 {
        let [east, north] = self.residuals(rows, columns);
        let positions: Vec<EastNorth> = east
            .iter()
            .zip(&north)
            .zip(*rows)
            .map(|((east, north), row)| EastNorth {
                east_m: row.label.east_m - east,
                north_m: row.label.north_m - north,
            })
            .collect();
        let variances =
            second_differences(rows, &positions).map(|(_, square_m2)| square_m2 / MEAN_SQUARE_PER_VARIANCE);
        trimmed_mean(variances.collect()).unwrap_or(0.0)
    }

    /// Levenberg and Marquardt's method from the present parameters.
    fn refine(&mut self, problem: &LeastSquaresProblem<'_>, whitener: &Whitener) {
        let mut damping = 1e-3;
        let mut cost = self.cost(problem, whitener);
        for _ in 0..STEPS {
            let (normal, gradient) = self.normal_equations(problem, whitener);
            let mut damped = normal.clone();
            for at in 0..damped.nrows() {
                damped[(at, at)] *= 1.0 + damping;
            }
            let Some(factor) = damped.cholesky() else { break };
            let mut candidate = self.clone();
            candidate.add(&factor.solve(&gradient));
            let candidate_cost = candidate.cost(problem, whitener);
            if candidate_cost < cost {
                let gain = (cost - candidate_cost) / cost.max(1e-12);
                (*self, cost) = (candidate, candidate_cost);
                damping = (damping * 0.2).max(1e-9);
                if gain < 1e-7 {
                    break;
                }
            } else {
                damping *= 8.0;
                if damping > 1e6 {
                    break;
                }
            }
        }
    }

    fn parameters(&self) -> impl Iterator<Item = f64> + '_ {
        self.projection.coefficients.iter().chain(self.extra.iter().flatten()).copied()
    }

    fn add(&mut self, step: &DVector<f64>) {
        let parameters = self.projection.coefficients.iter_mut().chain(self.extra.iter_mut().flatten());
        parameters.zip(step.iter()).for_each(|(parameter, step)| *parameter += step);
    }

    fn cost(
        &self,
        LeastSquaresProblem { rows, columns, prior }: &LeastSquaresProblem<'_>,
        whitener: &Whitener,
    ) -> f64 {
        let squares: f64 = self
            .residuals(rows, columns)
            .into_iter()
            .map(|mut axis| {
                whitener.apply(&mut axis);
                axis.iter().map(|value| value * value).sum::<f64>()
            })
            .sum();
        let of_prior = self.parameters().zip(prior).map(|(value, precision)| precision * value * value);
        squares + of_prior.sum::<f64>()
    }

    /// The normal matrix `J^T W^T W J + prior` and the negative gradient of half the cost.
    fn normal_equations(
        &self,
        problem: &LeastSquaresProblem<'_>,
        whitener: &Whitener,
    ) -> (DMatrix<f64>, DVector<f64>) {
        let LeastSquaresProblem { rows, columns, prior } = problem;
        let mut normal = DMatrix::<f64>::from_diagonal(&DVector::from_column_slice(prior));
        let mut gradient =
            DVector::from_iterator(prior.len(), self.parameters().zip(prior).map(|(value, p)| -value * p));
        let projected: Vec<Projected> =
            rows.iter().map(|row| self.projection.at(&row.bounding_box)).collect();
        for (axis, mut residual) in self.residuals(rows, columns).into_iter().enumerate() {
            whitener.apply(&mut residual);
            let mut jacobian = self.jacobian(&projected, columns, axis);
            for (_, column) in &mut jacobian {
                whitener.apply(column);
            }
            for (at, (row, left)) in jacobian.iter().enumerate() {
                gradient[*row] += dot(left, &residual);
                for (column, right) in &jacobian[..=at] {
                    let product = dot(left, right);
                    normal[(*row, *column)] += product;
                    if row != column {
                        normal[(*column, *row)] += product;
                    }
                }
            }
        }
        (normal, gradient)
    }

    /// Derivatives of one axis of the map (m), one column of all rows per parameter, with the parameter's
    /// index.
    fn jacobian(&self, projected: &[Projected], columns: &[Vec<f64>], axis: usize) -> Vec<(usize, Vec<f64>)> {
        let derivatives: Vec<_> =
            projected.iter().map(|projected| self.projection.derivatives_m(projected, axis)).collect();
        let of_coefficients = Projection::coefficient_indexes(axis)
            .into_iter()
            .enumerate()
            .map(|(at, index)| (index, derivatives.iter().map(|row| row[at]).collect()));
        let of_extra = columns.iter().enumerate().map(|(at, column)| {
            let index = COEFFICIENTS + axis * columns.len() + at;
            (index, column.iter().map(|value| self.projection.unit_m * value).collect())
        });
        of_coefficients.chain(of_extra).collect()
    }
}

/// Sum of products in four lanes, which the compiler vectorises.
fn dot(left: &[f64], right: &[f64]) -> f64 {
    let (left, left_rest) = left.as_chunks::<4>();
    let (right, right_rest) = right.as_chunks::<4>();
    let mut sums = [0.0; 4];
    for (one, other) in left.iter().zip(right) {
        for lane in 0..4 {
            sums[lane] += one[lane] * other[lane];
        }
    }
    let rest: f64 = left_rest.iter().zip(right_rest).map(|(one, other)| one * other).sum();
    sums.iter().sum::<f64>() + rest
}
