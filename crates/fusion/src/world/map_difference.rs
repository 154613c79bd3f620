//! The difference of two cameras' maps, and what else explains how far apart they place targets.
//!
//! ```text
//! d = m(x) + b + sum_k c_k r_k + w
//! ```
//!
//! d is an observation, m the difference of the maps at the target's position x: a Gaussian process with an unknown mean.
//! b is what the target keeps, an exponential process over time. The r_k are regressors, w is noise. The coefficients c_k
//! are the generalized least-squares solution, with observations that miss the others counting less (Huber).

use jiff::Timestamp;
use nalgebra::{DMatrix, DVector, Matrix2xX, RowDVector, Vector2};

use super::frame::WorldTrackId;
use super::world_track::seconds_from;

/// Fewest observations.
const LEAST_OBSERVATIONS: usize = 16;
/// Mean square by which the velocities of targets differ from their mean at least, m2/s2: where all walk alike, the
/// difference of two maps looks like that of two clocks.
const LEAST_SPREAD_M2_S2: f64 = 0.25;
/// The difference of two maps: its variance in variances of an observation's noise, and its length in root mean square
/// distances of the targets from their mean.
const MAP_VARIANCE: f64 = 2.0;
const MAP_LENGTH: f64 = 1.5;
/// The length at least, m.
const LEAST_LENGTH_M: f64 = 1.0;
/// Time constant of what a target keeps, s.
const TARGET_TIME_S: f64 = 60.0;
/// Observations that miss the others by more than this many standard deviations count less (Huber), down to the least weight.
const HUBER: f64 = 1.5;
const LEAST_WEIGHT: f64 = 0.05;

/// What a target shows of two cameras within some seconds: its velocity, m/s, its position, m, and what the first camera's
/// positions are ahead of the second's at equal times, m.
#[derive(Debug, Clone, Copy)]
pub(super) struct Observation {
    pub(super) track: WorldTrackId,
    pub(super) began: Timestamp,
    pub(super) velocity: Vector2<f64>,
    pub(super) apart: Vector2<f64>,
    pub(super) position: Vector2<f64>,
}

/// A regressor: two axes for each observation.
pub(super) type Regressor = Matrix2xX<f64>;

/// The coefficients of regressors with their covariance.
#[derive(Debug, Clone)]
pub(super) struct Effects {
    pub(super) coefficients: DVector<f64>,
    pub(super) covariance: DMatrix<f64>,
}

/// What regressors leave.
struct Residual {
    apart: Matrix2xX<f64>,
    /// Variance of an observation's noise with the full weight, m2.
    variance_m2: f64,
}

/// Observations of two cameras with the covariance of what they have beside the regressors.
#[derive(Debug, Clone)]
pub(super) struct MapDifference {
    apart: Matrix2xX<f64>,
    /// The velocities of the targets, if they differ enough to tell clocks from maps.
    pub(super) velocity: Option<Regressor>,
    precision: DMatrix<f64>,
    /// Row sums of `precision`.
    of_mean: RowDVector<f64>,
}

impl MapDifference {
    /// Of the observations of two cameras, with their weights; `None` if they are too few. `target_variance` is that of what a
    /// target keeps, in variances of an observation's noise; `rounds` are those of reweighting.
    pub(super) fn of(observations: &[Observation], target_variance: f64, rounds: usize) -> Option<Self> {
        if observations.len() < LEAST_OBSERVATIONS {
            return None;
        }
        let columns = |of: fn(&Observation) -> Vector2<f64>| {
            Matrix2xX::from_columns(&observations.iter().map(of).collect::<Vec<_>>())
        };
        let velocity = columns(|own| own.velocity);
        let map =
            map_covariance(&columns(|own| own.position)) + target_covariance(observations) * target_variance;
        let mut own = Self {
            apart: columns(|own| own.apart),
            velocity: (spread(&velocity) >= LEAST_SPREAD_M2_S2).then_some(velocity),
            precision: DMatrix::zeros(0, 0),
            of_mean: RowDVector::zeros(0),
        };
        let regressors: Vec<Regressor> = own.velocity.iter().cloned().collect();
        let mut weights = DVector::from_element(observations.len(), 1.0);
        for _ in 0..rounds {
            let noise = DMatrix::from_diagonal(&weights.map(f64::recip));
            own.precision = (&map + noise).cholesky()?.inverse();
            own.of_mean = own.precision.row_sum();
            weights = own.weights(own.solved(&regressors)?.1);
        }
        Some(own)
    }

    /// The effects of regressors; `None` if these observations do not determine them.
    pub(super) fn effects(&self, regressors: &[Regressor]) -> Option<Effects> {
        Some(self.solved(regressors)?.0)
    }

    fn solved(&self, regressors: &[Regressor]) -> Option<(Effects, Residual)> {
        let (count, unknown) = (self.apart.ncols(), regressors.len());
        let information = DMatrix::from_fn(unknown, unknown, |one, other| {
            self.product(&regressors[one], &regressors[other])
        });
        let right = DVector::from_fn(unknown, |at, _| self.product(&regressors[at], &self.apart));
        let inverse = information.cholesky()?.inverse();
        let coefficients = &inverse * right;
        let explained = regressors.iter().zip(coefficients.iter());
        let apart = explained.fold(self.apart.clone(), |rest, (own, by)| rest - own * *by);
        // Two degrees of freedom are the means of both axes.
        let variance_m2 = self.product(&apart, &apart) / (2 * count - 2 - unknown) as f64;
        Some((Effects { coefficients, covariance: inverse * variance_m2 }, Residual { apart, variance_m2 }))
    }

    /// Of both axes, without their means.
    fn product(&self, one: &Matrix2xX<f64>, other: &Matrix2xX<f64>) -> f64 {
        let of_mean = self.of_mean.transpose();
        let means = (one * &of_mean).dot(&(other * &of_mean));
        (one * &self.precision).dot(other) - means / of_mean.sum()
    }

    /// Weights by what each observation misses its value by that the others tell.
    fn weights(&self, residual: Residual) -> DVector<f64> {
        let Residual { apart: mut centred, variance_m2 } = residual;
        let mean = &centred * self.of_mean.transpose() / self.of_mean.sum();
        for mut column in centred.column_iter_mut() {
            column -= &mean;
        }
        let missed = centred * &self.precision;
        DVector::from_fn(missed.ncols(), |at, _| {
            let sigma = (2.0 * variance_m2 * self.precision[(at, at)]).sqrt();
            (HUBER / (missed.column(at).norm() / sigma).max(1e-9)).clamp(LEAST_WEIGHT, 1.0)
        })
    }
}

/// Of the difference of two maps at these positions, in variances of an observation's noise.
fn map_covariance(position: &Matrix2xX<f64>) -> DMatrix<f64> {
    let length_m = (MAP_LENGTH * spread(position).sqrt()).max(LEAST_LENGTH_M);
    let count = position.ncols();
    DMatrix::from_fn(count, count, |one, other| {
        let apart_m = (position.column(one) - position.column(other)).norm();
        MAP_VARIANCE * (-0.5 * (apart_m / length_m).powi(2)).exp()
    })
}

/// Of what targets keep.
fn target_covariance(observations: &[Observation]) -> DMatrix<f64> {
    let count = observations.len();
    DMatrix::from_fn(count, count, |one, other| {
        let (one, other) = (&observations[one], &observations[other]);
        let apart_s = seconds_from(one.began, other.began).abs();
        if one.track == other.track { (-apart_s / TARGET_TIME_S).exp() } else { 0.0 }
    })
}

/// Mean square of the distance from the mean.
fn spread(of: &Matrix2xX<f64>) -> f64 {
    of.column_variance().sum()
}
