//! Hyper-parameters by marginal likelihood with weak log-normal priors (type II maximum a posteriori;
//! Rasmussen and Williams 2006, section 5.4).

use nalgebra::{DMatrix, SMatrix, SVector};

use super::kernel::LengthScales;
use super::known_rows::KnownRows;
use super::noise::{Epoch, ReceiverNoise, ReceiverWhitener};
use super::posterior::{Gram, Posterior, TangentPrior};
use super::projective_mean::ProjectiveMean;

/// Logarithms of: white, short and session standard deviation, short and session time constants, residual's standard
/// deviation, length scales of place and size, scale of the sides' coefficients.
pub(crate) const COUNT: usize = 9;
/// Noise parameters among them.
const NOISE: usize = 5;
/// Smallest share of the short and slow variance that the white part keeps once the noise is frozen:
/// likelihood alone trusts differences between neighbours to centimetres and bends the map after them.
const MIN_WHITE_SHARE: f64 = 0.3;
/// Median of the slow part's standard deviation, as a share of the short one's.
pub(crate) const SESSION_SHARE: f64 = 0.5;
/// Range of the white share that the priors are built on: an estimate is never exactly 0 or 1.
const WHITE_SHARES: [f64; 2] = [0.02, 0.999];
/// Standard deviation of the logarithm of a slow part that is stated from outside.
const STATED_SESSION_SIGMA: f64 = 0.02;
/// Scale and degrees of freedom of the logarithm of a receiver's standard deviation about what is known of such receivers.
const RECEIVER_SIGMA: f64 = 0.3;
const RECEIVER_FREEDOM: f64 = 3.0;
const MAX_ITERATIONS: usize = 12;
const DIFFERENCE: f64 = 0.02;
const CONVERGED: f64 = 0.02;

#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Hyperparameters {
    pub(crate) noise: ReceiverNoise,
    /// Standard deviation of the residual, m.
    pub(crate) residual_m: f64,
    pub(crate) lengths: LengthScales,
    /// Scale of the sides' coefficients, as a share of the foot's spread.
    pub(crate) side_scale: f64,
}

type Logs = SVector<f64, COUNT>;

impl Hyperparameters {
    fn of_logs(logs: &Logs) -> Self {
        let value = |at: usize| logs[at].exp();
        Self {
            noise: ReceiverNoise {
                white_m2: value(0) * value(0),
                short_m2: value(1) * value(1),
                session_m2: value(2) * value(2),
                short_time_s: value(3),
                session_time_s: value(4),
            },
            residual_m: value(5),
            lengths: LengthScales { place: value(6), size: value(7) },
            side_scale: value(8),
        }
    }

    fn logs(&self) -> Logs {
        let noise = &self.noise;
        Logs::from_column_slice(&[
            0.5 * noise.white_m2.ln(),
            0.5 * noise.short_m2.ln(),
            0.5 * noise.session_m2.ln(),
            noise.short_time_s.ln(),
            noise.session_time_s.ln(),
            self.residual_m.ln(),
            self.lengths.place.ln(),
            self.lengths.size.ln(),
            self.side_scale.ln(),
        ])
    }

    /// The same with a white part that differences between neighbours cannot bend a map by.
    pub(crate) fn with_min_white(mut self) -> Self {
        let coloured_m2 = self.noise.short_m2 + self.noise.session_m2;
        self.noise.white_m2 = self.noise.white_m2.max(MIN_WHITE_SHARE * coloured_m2);
        self
    }
}

/// Medians and logarithmic standard deviations of the priors.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Priors {
    medians: Logs,
    sigmas: Logs,
    /// Median interval between neighbouring fixes of a receiver, s.
    interval_s: f64,
    /// True if the slow part is stated from outside, not derived from the short one.
    session_is_stated: bool,
    /// Standard deviation of white and short part together by what is known of such receivers, m, and the weight of that.
    receiver: (f64, f64),
}

impl Priors {
    /// `scatter_m` is the robust standard deviation per axis about the geometric map and `white_share` the
    /// share of its square that is white by the autocorrelation of all rows; `spread_m` is the standard
    /// deviation of the positions, `interval_s` the median interval between neighbouring fixes.
    pub(crate) fn new(scatter_m: f64, white_share: f64, spread_m: f64, interval_s: f64) -> Self {
        let white_share = white_share.clamp(WHITE_SHARES[0], WHITE_SHARES[1]);
        let short_m = (1.0 - white_share).sqrt() * scatter_m;
        let medians = [
            white_share.sqrt() * scatter_m,
            short_m,
            SESSION_SHARE * short_m,
            30.0,
            3600.0,
            0.02 * spread_m,
            1.0,
            2.0,
            0.05,
        ];
        Self {
            medians: Logs::from_column_slice(&medians.map(f64::ln)),
            sigmas: Logs::from_column_slice(&[1.0, 1.0, 0.5, 0.4, 1.0, 1.2, 0.7, 0.7, 1.2]),
            interval_s,
            session_is_stated: false,
            receiver: (scatter_m, 0.0),
        }
    }

    /// The same with a weight of what is known of such receivers: their standard deviation per axis, m.
    pub(crate) fn with_receiver(self, sigma_m: f64, weight: f64) -> Self {
        Self { receiver: (sigma_m, weight), ..self }
    }

    /// The same with a slow part of that standard deviation, m, which samples hardly change.
    pub(crate) fn with_session(mut self, sigma_m: f64) -> Self {
        self.medians[2] = sigma_m.ln();
        self.sigmas[2] = STATED_SESSION_SIGMA;
        self.session_is_stated = true;
        self
    }

    pub(crate) fn start(&self) -> Hyperparameters {
        Hyperparameters::of_logs(&self.medians)
    }

    fn penalty(&self, logs: &Logs) -> f64 {
        let mut centre = self.medians;
        // The slow part continues the short one's spectrum: its prior is a share of the short part as far
        // as that is low in frequency and lasts until the next fix, and nearly none for a receiver whose
        // error is white.
        if !self.session_is_stated {
            let visible = -0.5 * self.interval_s / logs[3].exp();
            centre[2] = SESSION_SHARE.ln() + logs[1] + visible + 0.5 * (logs[3] - self.medians[3]).min(0.0);
        }
        (logs - centre).component_div(&self.sigmas).norm_squared() + self.receiver_penalty(logs)
    }

    /// Penalty of a logarithm with a t distribution: it holds phones together, and lets go of a much better receiver.
    fn receiver_penalty(&self, logs: &Logs) -> f64 {
        let (sigma_m, weight) = self.receiver;
        let stated_m = logs[0].exp().hypot(logs[1].exp());
        let apart = (stated_m / sigma_m).ln() / RECEIVER_SIGMA;
        weight * (RECEIVER_FREEDOM + 1.0) * (apart * apart / RECEIVER_FREEDOM).ln_1p()
    }
}

/// The input of the likelihood: some rows, linearised.
#[derive(Debug)]
pub(crate) struct LikelihoodRows<'a> {
    pub(crate) epochs: &'a [Epoch],
    pub(crate) inputs: &'a [[f64; 4]],
    pub(crate) inducing: &'a [[f64; 4]],
    /// Tangent of both axes and linearised labels, as columns.
    pub(crate) tangent: &'a DMatrix<f64>,
    pub(crate) labels_m: &'a DMatrix<f64>,
    /// White variance per row beside the receiver's, m2.
    pub(crate) white_m2: &'a [f64],
    pub(crate) mean: &'a ProjectiveMean,
    pub(crate) known: LikelihoodPoints<'a>,
}

/// Known points, linearised: they tell the bias of the receivers.
#[derive(Debug)]
pub(crate) struct LikelihoodPoints<'a> {
    pub(crate) points: &'a KnownRows,
    pub(crate) tangent: DMatrix<f64>,
    pub(crate) labels_m: DMatrix<f64>,
    /// Variance of each, m2.
    pub(crate) variances_m2: Vec<f64>,
}

impl LikelihoodPoints<'_> {
    /// As that of the rows.
    fn gram(&self, inducing: &[[f64; 4]], parameters: &Hyperparameters) -> Option<(Gram, f64)> {
        let (phi, left_out_m2) = kernel_columns(&self.points.inputs, inducing, parameters)?;
        let variances_m2: Vec<f64> =
            left_out_m2.iter().zip(&self.variances_m2).map(|(left_out, own)| left_out + own).collect();
        let whitener = self.points.whitener(&variances_m2);
        let gram = Gram::new(join(&[&self.tangent, &phi, &self.labels_m]), &whitener);
        Some((gram, 2.0 * whitener.log_determinant))
    }
}

impl LikelihoodRows<'_> {
    /// Kernel columns phi, m, and per row the variance that the inducing points leave out, m2.
    pub(crate) fn kernel_columns(&self, parameters: &Hyperparameters) -> Option<(DMatrix<f64>, Vec<f64>)> {
        kernel_columns(self.inputs, self.inducing, parameters)
    }

    /// Gram matrix of all columns, and the noise's log determinant over both axes.
    pub(crate) fn gram(&self, parameters: &Hyperparameters) -> Option<(Gram, f64)> {
        let (phi, left_out_m2) = self.kernel_columns(parameters)?;
        let variances: Vec<f64> =
            left_out_m2.iter().zip(self.white_m2).map(|(left_out, white)| left_out + white).collect();
        let whitener = ReceiverWhitener::new(self.epochs, &parameters.noise, &variances);
        let gram = Gram::new(join(&[self.tangent, &phi, self.labels_m]), &whitener);
        let log_determinant = 2.0 * whitener.log_determinant;
        if self.known.points.is_empty() {
            return Some((gram, log_determinant));
        }
        let (of_known, log_determinant_of_known) = self.known.gram(self.inducing, parameters)?;
        Some((gram.plus(&of_known), log_determinant + log_determinant_of_known))
    }

    /// Minus twice the logarithm of the marginal likelihood; infinite where it cannot be computed.
    fn misfit(&self, parameters: &Hyperparameters) -> f64 {
        let fitted = self.gram(parameters).and_then(|(gram, log_determinant)| {
            let prior = TangentPrior::independent(&self.mean.prior_variances(parameters.side_scale));
            Some(Posterior::new(&gram, &prior)?.misfit + log_determinant)
        });
        fitted.filter(|misfit| misfit.is_finite()).unwrap_or(f64::INFINITY)
    }

    /// The likeliest parameters; with `noise_frozen` only those of the kernel and the sides.
    pub(crate) fn maximize(
        &self,
        start: &Hyperparameters,
        priors: &Priors,
        noise_frozen: bool,
    ) -> Hyperparameters {
        let free: Vec<usize> = if noise_frozen { (NOISE..COUNT).collect() } else { (0..COUNT).collect() };
        let objective = |logs: &Logs| self.misfit(&Hyperparameters::of_logs(logs)) + priors.penalty(logs);
        Hyperparameters::of_logs(&minimize(&objective, start.logs(), &free))
    }
}

/// Kernel columns phi, m, and per input the variance that the inducing points leave out, m2.
pub(crate) fn kernel_columns(
    inputs: &[[f64; 4]],
    inducing: &[[f64; 4]],
    parameters: &Hyperparameters,
) -> Option<(DMatrix<f64>, Vec<f64>)> {
    let inverse_factor = parameters.lengths.inverse_factor(inducing)?;
    let phi = parameters.lengths.cross(inputs, inducing) * inverse_factor.transpose() * parameters.residual_m;
    let mut left_out_m2 = vec![parameters.residual_m * parameters.residual_m; inputs.len()];
    for column in phi.column_iter() {
        for (left, value) in left_out_m2.iter_mut().zip(column.iter()) {
            *left -= value * value;
        }
    }
    left_out_m2.iter_mut().for_each(|left| *left = left.max(0.0));
    Some((phi, left_out_m2))
}

/// Matrices side by side.
pub(crate) fn join(parts: &[&DMatrix<f64>]) -> DMatrix<f64> {
    let rows = parts.first().map_or(0, |part| part.nrows());
    let values: Vec<f64> = parts.iter().flat_map(|part| part.as_slice()).copied().collect();
    DMatrix::from_vec(rows, values.len() / rows.max(1), values)
}

/// Quasi-Newton (BFGS) with forward differences and a halving line search over the free coordinates.
fn minimize(objective: &dyn Fn(&Logs) -> f64, start: Logs, free: &[usize]) -> Logs {
    let gradient = |at: &Logs, value: f64| {
        let mut gradient = Logs::zeros();
        for coordinate in free {
            let mut moved = *at;
            moved[*coordinate] += DIFFERENCE;
            gradient[*coordinate] = (objective(&moved) - value) / DIFFERENCE;
        }
        gradient
    };
    let mut at = start;
    let mut value = objective(&at);
    let mut slope = gradient(&at, value);
    let mut inverse = SMatrix::<f64, COUNT, COUNT>::identity() * 0.1;
    for _ in 0..MAX_ITERATIONS {
        let mut step = -(inverse * slope);
        let longest = step.amax();
        if longest > 1.0 {
            step /= longest;
        }
        let mut taken = None;
        for _ in 0..6 {
            let next = at + step;
            let next_value = objective(&next);
            if next_value < value {
                taken = Some((next, next_value));
                break;
            }
            step *= 0.3;
        }
        let Some((next, next_value)) = taken else { break };
        let gain = value - next_value;
        let next_slope = gradient(&next, next_value);
        let change = next_slope - slope;
        let along = change.dot(&step);
        if along > 1e-9 {
            let identity = SMatrix::<f64, COUNT, COUNT>::identity();
            let left = identity - step * change.transpose() / along;
            inverse = left * inverse * left.transpose() + step * step.transpose() / along;
        }
        (at, value, slope) = (next, next_value, next_slope);
        if gain < CONVERGED {
            break;
        }
    }
    at
}
