//! The least-squares problem of all cameras' maps, by Levenberg and Marquardt's method.
//!
//! ```text
//! cost = sum_receivers |W (z - mean_c f_c(box_c))|^2            fixes, whitened per receiver
//!      + w sum_pairs rho(|f_b^-1(f_a(box_a)) - box_b|^2 / s^2)  feet carried from view a to view b, px
//!      + sum_known rho(|z - f_c(foot)|^2 / s^2)                known points
//!      + sum (p / sigma_prior)^2 + sum (p - p_0)' P (p - p_0)    weak prior; what the boxes' heights say, if asked
//! ```
//!
//! `rho(x) = k^2 ln(1 + x / k^2)` is Cauchy's loss. In metres the pairs would pull all maps together to a point;
//! in pixels they do not.

use std::ops::ControlFlow;

use nalgebra::{DMatrix, DVector, Matrix2, SVector, Vector2};

use super::ground_map::{GroundMap, GroundTangent, PARAMETERS};
use super::input::{SiteFitError, SiteKnownPoint};
use crate::domain::GaussMarkovNoise;
use crate::geo::EastNorth;
use crate::recipes::gaussian_process::projective_mean::Box4;
use crate::recipes::gaussian_process::{
    Epoch, FootPrior, POINTER_SIGMA_PX, ReceiverNoise, ReceiverWhitener, SESSION_SHARE,
};

/// Share of the transfers that counts as independent: a detector's error lasts for some frames.
const INDEPENDENT_TRANSFERS: f64 = 0.25;
/// Standardised distance at which a pair has half its weight.
const CAUCHY_SCALE: f64 = 2.0;
/// Cost of a pair whose foot cannot be carried over, in squared standard deviations.
const LOST_PAIR: f64 = 400.0;
const STEPS: usize = 30;
const LEAST_GAIN: f64 = 1e-6;

/// A fix with the feet of its carrier.
#[derive(Debug, Clone)]
pub(super) struct FixRow {
    pub(super) time_s: f64,
    pub(super) position: [f64; 2],
    pub(super) feet: Vec<(usize, Box4)>,
}

/// Feet of one target in two cameras: carried from the first to the second.
#[derive(Debug, Clone, Copy)]
pub(super) struct Transfer {
    pub(super) cameras: [usize; 2],
    pub(super) feet: [Box4; 2],
}

impl Transfer {
    /// The carried foot less the one in the second view, px, scaled to the noise of one foot; `None` where it cannot be
    /// carried over.
    pub(super) fn difference(&self, maps: &[GroundMap]) -> Option<Vector2<f64>> {
        let carried = Carried::new(maps, self)?;
        Some(carried.residual_px / carried.variance_factor.sqrt())
    }
}

/// All rows with their noise.
pub(super) struct LeastSquaresProblem {
    /// Fixes by receiver, in the order of time.
    pub(super) receivers: Vec<Vec<FixRow>>,
    pub(super) transfers: Vec<Transfer>,
    /// Standard deviation of a foot per axis, px.
    pub(super) foot_sigma_px: f64,
    /// Priors of each camera's parameters from the heights of boxes, if any.
    pub(super) foot_priors: Vec<Option<FootPrior>>,
    /// Points whose place is known.
    pub(super) known_points: Vec<SiteKnownPoint>,
    /// Noise of the fixes per axis, and the filters that whiten each receiver's.
    noise: GaussMarkovNoise,
    /// Variance per axis of the mean position of each row's feet, m2.
    foot_m2: Vec<Vec<f64>>,
    whiteners: Vec<ReceiverWhitener>,
}

/// Gauss-Newton matrix and gradient.
struct NormalEquations {
    matrix: DMatrix<f64>,
    /// Minus half the gradient.
    right: DVector<f64>,
    cost: f64,
}

impl LeastSquaresProblem {
    pub(super) fn new(
        receivers: Vec<Vec<FixRow>>,
        transfers: Vec<Transfer>,
        known_points: Vec<SiteKnownPoint>,
        noise: GaussMarkovNoise,
        foot_sigma_px: f64,
    ) -> Self {
        let foot_m2: Vec<Vec<f64>> = receivers.iter().map(|rows| vec![0.0; rows.len()]).collect();
        let mut problem = Self {
            receivers,
            transfers,
            foot_sigma_px,
            foot_priors: Vec::new(),
            known_points,
            noise,
            foot_m2,
            whiteners: Vec::new(),
        };
        problem.set_noise(noise);
        problem
    }

    pub(super) const fn noise(&self) -> GaussMarkovNoise {
        self.noise
    }

    pub(super) fn set_noise(&mut self, noise: GaussMarkovNoise) {
        self.whiteners = self.whiteners_of(&noise);
        self.noise = noise;
    }

    /// The filters that whiten the receivers' errors. Known points tell what lasts of an error; without any, every map has it
    /// in common and it is stated beside the maps.
    fn whiteners_of(&self, noise: &GaussMarkovNoise) -> Vec<ReceiverWhitener> {
        let mut of_receiver = ReceiverNoise::of_gauss_markov(noise);
        if !self.known_points.is_empty() {
            of_receiver.session_m2 = SESSION_SHARE.powi(2) * noise.coloured_variance_m2();
            of_receiver.session_time_s = f64::INFINITY;
        }
        whiteners(&self.receivers, &of_receiver, &self.foot_m2)
    }

    /// Takes the noise of the feet for a part of the noise of the rows, as large as the maps make it.
    pub(super) fn set_foot_noise(&mut self, maps: &[GroundMap]) {
        let foot_px2 = self.foot_sigma_px.powi(2);
        let of_row = |row: &FixRow| foot_px2 * foot_variance_factor(maps, row);
        self.foot_m2 = self.receivers.iter().map(|rows| rows.iter().map(of_row).collect()).collect();
        self.set_noise(self.noise);
    }

    /// Twice the negative log likelihood of the fixes' residuals under a noise of the receivers.
    pub(super) fn noise_misfit(&self, residuals: &[[Vec<f64>; 2]], noise: &GaussMarkovNoise) -> f64 {
        let whiteners = self.whiteners_of(noise);
        let log_determinants = 2.0 * whiteners.iter().map(|own| own.log_determinant).sum::<f64>();
        log_determinants + whitened_squares(residuals, &whiteners)
    }

    /// Fixes less mean positions by receiver and axis, m.
    pub(super) fn residuals_m(&self, maps: &[GroundMap]) -> Vec<[Vec<f64>; 2]> {
        let of_receiver = |rows: &Vec<FixRow>| {
            let means: Vec<[f64; 2]> = rows.iter().map(|row| mean_position(maps, row)).collect();
            [0, 1].map(|axis| {
                rows.iter().zip(&means).map(|(row, mean)| row.position[axis] - mean[axis]).collect()
            })
        };
        self.receivers.iter().map(of_receiver).collect()
    }

    /// Refines the maps; returns their parameters' covariance. The observer is asked before each step.
    ///
    /// # Errors
    /// There is no finite solution, or the observer breaks.
    pub(super) fn solve(
        &self,
        maps: &mut Vec<GroundMap>,
        observer: &mut dyn FnMut() -> ControlFlow<()>,
    ) -> Result<DMatrix<f64>, SiteFitError> {
        let mut damping = 1e-3;
        let mut normal = self.normal_equations(maps);
        for _ in 0..STEPS {
            if observer().is_break() {
                return Err(SiteFitError::Cancelled);
            }
            let mut damped = normal.matrix.clone();
            for at in 0..damped.nrows() {
                damped[(at, at)] *= 1.0 + damping;
            }
            let step = damped.cholesky().ok_or(SiteFitError::NoSolution)?.solve(&normal.right);
            let moved: Vec<GroundMap> = maps
                .iter()
                .zip(step.as_slice().chunks(PARAMETERS))
                .map(|(map, step)| map.moved_by(step))
                .collect();
            let cost = self.cost(&moved);
            if cost.is_finite() && cost <= normal.cost {
                let gain = normal.cost - cost;
                *maps = moved;
                let converged = gain <= LEAST_GAIN * cost;
                normal = self.normal_equations(maps);
                damping = (damping * 0.1).max(1e-9);
                if converged {
                    break;
                }
            } else {
                damping *= 10.0;
                if damping > 1e9 {
                    break;
                }
            }
        }
        let covariance = normal.matrix.cholesky().ok_or(SiteFitError::NoSolution)?.inverse();
        let is_finite = covariance.iter().all(|value| value.is_finite());
        is_finite.then_some(covariance).ok_or(SiteFitError::NoSolution)
    }

    /// Squared standardised distances of the transfers that can be made, with unit foot noise.
    pub(super) fn transfer_distances(&self, maps: &[GroundMap]) -> Vec<f64> {
        let differences = self.transfers.iter().filter_map(|transfer| transfer.difference(maps));
        differences.map(|difference| difference.norm_squared()).collect()
    }

    fn cost(&self, maps: &[GroundMap]) -> f64 {
        let transfers: f64 = self.transfers.iter().map(|it| self.transfer_cost(maps, it)).sum();
        whitened_squares(&self.residuals_m(maps), &self.whiteners)
            + transfers
            + prior_cost(maps)
            + self.foot_prior_cost(maps)
            + self.known_points.iter().map(|point| KnownMisfit::new(maps, point).cost()).sum::<f64>()
    }

    fn foot_prior_cost(&self, maps: &[GroundMap]) -> f64 {
        let of_map = |(map, prior): (&GroundMap, &Option<FootPrior>)| {
            let FootPrior { centre, precision } = prior.as_ref()?;
            let apart = SVector::<f64, PARAMETERS>::from_column_slice(map.parameters()) - centre;
            Some(apart.dot(&(precision * apart)))
        };
        maps.iter().zip(&self.foot_priors).filter_map(of_map).sum()
    }

    fn add_foot_prior(prior: &FootPrior, map: &GroundMap, first: usize, normal: &mut NormalEquations) {
        let FootPrior { centre, precision } = prior;
        let pull = precision * (centre - SVector::<f64, PARAMETERS>::from_column_slice(map.parameters()));
        for row in 0..PARAMETERS {
            normal.right[first + row] += pull[row];
            for column in 0..PARAMETERS {
                normal.matrix[(first + row, first + column)] += precision[(row, column)];
            }
        }
    }

    fn transfer_cost(&self, maps: &[GroundMap], transfer: &Transfer) -> f64 {
        let squared = Carried::new(maps, transfer)
            .map_or(LOST_PAIR, |it| it.residual_px.norm_squared() / self.carried_variance_px2(&it));
        let scale = CAUCHY_SCALE * CAUCHY_SCALE;
        INDEPENDENT_TRANSFERS * scale * (squared.min(LOST_PAIR) / scale).ln_1p()
    }

    fn carried_variance_px2(&self, carried: &Carried) -> f64 {
        self.foot_sigma_px * self.foot_sigma_px * carried.variance_factor
    }

    fn normal_equations(&self, maps: &[GroundMap]) -> NormalEquations {
        let size = PARAMETERS * maps.len();
        let mut normal =
            NormalEquations { matrix: DMatrix::zeros(size, size), right: DVector::zeros(size), cost: 0.0 };
        for (camera, map) in maps.iter().enumerate() {
            let parameters = map.parameters().iter().zip(map.prior_variances());
            for (at, (parameter, variance)) in parameters.enumerate() {
                let index = PARAMETERS * camera + at;
                normal.matrix[(index, index)] += variance.recip();
                normal.right[index] -= parameter / variance;
            }
        }
        for (camera, (map, prior)) in maps.iter().zip(&self.foot_priors).enumerate() {
            if let Some(prior) = prior {
                Self::add_foot_prior(prior, map, PARAMETERS * camera, &mut normal);
            }
        }
        for point in &self.known_points {
            KnownMisfit::new(maps, point).add_to(point.camera, &mut normal);
        }
        for (rows, whitener) in self.receivers.iter().zip(&self.whiteners) {
            add_receiver(maps, rows, whitener, &mut normal);
        }
        for own in self.transfers.chunk_by(|one, next| one.cameras == next.cameras) {
            self.add_transfers(maps, own, &mut normal);
        }
        normal.cost = self.cost(maps);
        normal
    }

    /// Adds the transfers between two cameras.
    fn add_transfers(&self, maps: &[GroundMap], transfers: &[Transfer], normal: &mut NormalEquations) {
        let mut matrix = [[0.0; 2 * PARAMETERS]; 2 * PARAMETERS];
        let mut right = [0.0; 2 * PARAMETERS];
        for transfer in transfers {
            let Some(carried) = Carried::new(maps, transfer) else { continue };
            let variance_px2 = self.carried_variance_px2(&carried);
            let squared = carried.residual_px.norm_squared() / variance_px2;
            if squared > LOST_PAIR {
                continue;
            }
            let weight =
                INDEPENDENT_TRANSFERS / (1.0 + squared / (CAUCHY_SCALE * CAUCHY_SCALE)) / variance_px2;
            let residual_px = [carried.residual_px[0], carried.residual_px[1]];
            for (slopes, residual_px) in carried.slopes().iter().zip(residual_px) {
                for (row, slope) in slopes.iter().enumerate() {
                    right[row] -= weight * slope * residual_px;
                    for (sum, other) in matrix[row].iter_mut().zip(slopes) {
                        *sum += weight * slope * other;
                    }
                }
            }
        }
        let Some([from, to]) = transfers.first().map(|transfer| transfer.cameras) else { return };
        normal.add(&[from, to], &right, |row, column| matrix[row][column]);
    }
}

impl NormalEquations {
    /// Adds a part over the parameters of some cameras.
    fn add(&mut self, cameras: &[usize], right: &[f64], matrix: impl Fn(usize, usize) -> f64) {
        for (one, value) in right.iter().enumerate() {
            let row = global_index(cameras, one);
            self.right[row] += value;
            for other in 0..right.len() {
                self.matrix[(row, global_index(cameras, other))] += matrix(one, other);
            }
        }
    }
}

fn add_receiver(
    maps: &[GroundMap],
    rows: &[FixRow],
    whitener: &ReceiverWhitener,
    normal: &mut NormalEquations,
) {
    let cameras = cameras_of(rows);
    for axis in 0..2 {
        // The derivatives by each parameter, then the misfit.
        let mut columns = vec![vec![0.0; rows.len()]; PARAMETERS * cameras.len() + 1];
        for (at, row) in rows.iter().enumerate() {
            let share = 1.0 / row.feet.len() as f64;
            let mut misfit_m = row.position[axis];
            for (camera, foot) in &row.feet {
                let first = PARAMETERS * cameras.partition_point(|other| other < camera);
                let tangent = maps[*camera].tangent(foot);
                misfit_m -= share * tangent.position[axis];
                for (offset, slope) in tangent.by_parameters[axis].iter().enumerate() {
                    columns[first + offset][at] += share * slope;
                }
            }
            if let Some(misfits) = columns.last_mut() {
                misfits[at] = misfit_m;
            }
        }
        columns.iter_mut().for_each(|column| whitener.apply(column));
        let Some((misfit, slopes)) = columns.split_last() else { continue };
        let right: Vec<f64> = slopes.iter().map(|own| dot(own, misfit)).collect();
        normal.add(&cameras, &right, |one, other| dot(&slopes[one], &slopes[other]));
    }
}

fn dot(one: &[f64], other: &[f64]) -> f64 {
    one.iter().zip(other).map(|(one, other)| one * other).sum()
}

fn whiteners(
    receivers: &[Vec<FixRow>],
    noise: &ReceiverNoise,
    foot_m2: &[Vec<f64>],
) -> Vec<ReceiverWhitener> {
    let of_receiver = |(rows, foot_m2): (&Vec<FixRow>, &Vec<f64>)| {
        let epochs: Vec<Epoch> = rows.iter().map(|row| Epoch { time_s: row.time_s, sequence: 0 }).collect();
        ReceiverWhitener::new(&epochs, noise, foot_m2)
    };
    receivers.iter().zip(foot_m2).map(of_receiver).collect()
}

/// Sum of squares of the whitened residuals of all receivers, in both axes.
fn whitened_squares(residuals: &[[Vec<f64>; 2]], whiteners: &[ReceiverWhitener]) -> f64 {
    let of_receiver = |(residuals, whitener): (&[Vec<f64>; 2], &ReceiverWhitener)| -> f64 {
        let of_axis = |column: &Vec<f64>| {
            let mut column = column.clone();
            whitener.apply(&mut column);
            column.iter().map(|value| value * value).sum::<f64>()
        };
        residuals.iter().map(of_axis).sum()
    };
    residuals.iter().zip(whiteners).map(of_receiver).sum()
}

/// A known point less where a map has it.
struct KnownMisfit {
    tangent: GroundTangent,
    apart_m: Vector2<f64>,
    /// Variance per axis, m2.
    variance_m2: f64,
}

impl KnownMisfit {
    fn new(maps: &[GroundMap], point: &SiteKnownPoint) -> Self {
        let [u_px, v_px] = point.image_px;
        // The sides have no part in the map of a foot.
        let tangent = maps[point.camera].tangent(&[u_px, v_px, 0.0, 0.0]);
        let EastNorth { east_m, north_m } = point.position;
        let pointer_m2 = 0.5 * POINTER_SIGMA_PX.powi(2) * tangent.by_foot.norm_squared();
        Self {
            apart_m: Vector2::new(east_m, north_m) - tangent.position,
            variance_m2: point.variance_m2 + pointer_m2,
            tangent,
        }
    }

    fn squared(&self) -> f64 {
        self.apart_m.norm_squared() / self.variance_m2
    }

    fn cost(&self) -> f64 {
        CAUCHY_SCALE.powi(2) * (self.squared() / CAUCHY_SCALE.powi(2)).ln_1p()
    }

    fn add_to(&self, camera: usize, normal: &mut NormalEquations) {
        let weight = 1.0 / (1.0 + self.squared() / CAUCHY_SCALE.powi(2)) / self.variance_m2;
        let [east, north] = self.tangent.by_parameters;
        let right: [f64; PARAMETERS] =
            std::array::from_fn(|at| weight * (east[at] * self.apart_m[0] + north[at] * self.apart_m[1]));
        normal.add(&[camera], &right, |row, column| {
            weight * (east[row] * east[column] + north[row] * north[column])
        });
    }
}

/// A foot carried from one view into another.
struct Carried {
    from: GroundTangent,
    /// At the carried foot.
    to: GroundTangent,
    /// Pixels of the second view per metre.
    px_per_m: Matrix2<f64>,
    residual_px: Vector2<f64>,
    /// Mean variance per axis of the residual for unit noise of both feet.
    variance_factor: f64,
}

impl Carried {
    fn new(maps: &[GroundMap], transfer: &Transfer) -> Option<Self> {
        let [from_camera, to_camera] = transfer.cameras;
        let from = maps[from_camera].tangent(&transfer.feet[0]);
        let [u_px, v_px] = maps[to_camera].foot_at(from.position)?;
        let [.., width_px, height_px] = transfer.feet[1];
        let to = maps[to_camera].tangent(&[u_px, v_px, width_px, height_px]);
        let px_per_m = to.by_foot.try_inverse()?;
        let residual_px = Vector2::new(u_px - transfer.feet[1][0], v_px - transfer.feet[1][1]);
        let variance_factor = 1.0 + 0.5 * (px_per_m * from.by_foot).norm_squared();
        Some(Self { from, to, px_per_m, residual_px, variance_factor })
    }

    /// Derivatives of the residual by the parameters of the first, then of the second map, px.
    fn slopes(&self) -> [[f64; 2 * PARAMETERS]; 2] {
        [0, 1].map(|axis| {
            std::array::from_fn(|at| {
                let (tangent, parameter, sign) =
                    if at < PARAMETERS { (&self.from, at, 1.0) } else { (&self.to, at - PARAMETERS, -1.0) };
                let [east, north] = tangent.by_parameters;
                sign * (self.px_per_m[(axis, 0)] * east[parameter]
                    + self.px_per_m[(axis, 1)] * north[parameter])
            })
        })
    }
}

fn mean_position(maps: &[GroundMap], row: &FixRow) -> [f64; 2] {
    let share = 1.0 / row.feet.len() as f64;
    row.feet.iter().fold([0.0; 2], |sum, (camera, foot)| {
        let position = maps[*camera].position(foot);
        [sum[0] + share * position.east_m, sum[1] + share * position.north_m]
    })
}

/// Variance per axis of a row's mean position for unit noise of its feet, m2/px2.
fn foot_variance_factor(maps: &[GroundMap], row: &FixRow) -> f64 {
    let count = row.feet.len() as f64;
    let of_foot = |(camera, foot): &(usize, Box4)| 0.5 * maps[*camera].tangent(foot).by_foot.norm_squared();
    row.feet.iter().map(of_foot).sum::<f64>() / (count * count)
}

fn prior_cost(maps: &[GroundMap]) -> f64 {
    let of_map = |map: &GroundMap| -> f64 {
        let parameters = map.parameters().iter().zip(map.prior_variances());
        parameters.map(|(parameter, variance)| parameter * parameter / variance).sum()
    };
    maps.iter().map(of_map).sum()
}

fn cameras_of(rows: &[FixRow]) -> Vec<usize> {
    let mut cameras: Vec<usize> =
        rows.iter().flat_map(|row| row.feet.iter().map(|(camera, _)| *camera)).collect();
    cameras.sort_unstable();
    cameras.dedup();
    cameras
}

fn global_index(cameras: &[usize], local: usize) -> usize {
    PARAMETERS * cameras[local / PARAMETERS] + local % PARAMETERS
}
