//! The IMM-UKF of the paper's comparison: interacting multiple models (Blom and Bar-Shalom 1988)
//! over two unscented Kalman filters, constant velocity and coordinated turn.
//!
//! Both modes share one state, so that they can be mixed: `[east north v_east v_north turn_rate]` in m,
//! m/s and rad/s. The constant-velocity mode carries the turn rate without using it. Mode
//! probabilities are logarithms normalised by log-sum-exp, so a distant fix cannot turn both to 0.
//! The baseline models fixes as white, as the paper does.

use nalgebra::{Cholesky, Matrix2, SMatrix, SVector, Vector2};

use crate::geo::EastNorth;

/// Size of the state that both modes share.
const STATES: usize = 5;
/// Sigma points of the unscented transform: the mean, and two per state component.
const POINTS: usize = 2 * STATES + 1;
/// Scaling of the sigma points: lambda = 1 (van der Merwe's alpha 1, beta 0, kappa 1), which keeps all
/// weights, and so every covariance, positive.
const LAMBDA: f64 = 1.0;
/// Below this turn rate (rad/s) an arc equals a straight line in double precision.
const MIN_TURN_RATE_RAD_S: f64 = 1e-6;

type State = SVector<f64, STATES>;
type Covariance = SMatrix<f64, STATES, STATES>;

/// Noise and mode transitions of the filter.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ImmUkfOptions {
    /// Constant velocity: spectral density of the acceleration per axis, m2/s3.
    pub cruise_m2_s3: f64,
    /// Coordinated turn: spectral density of the acceleration per axis, m2/s3.
    pub turn_m2_s3: f64,
    /// Spectral density of the turn rate's random walk, rad2/s3.
    pub turn_rate_rad2_s3: f64,
    /// Standard deviation per axis of the initial velocity, m/s.
    pub initial_speed_sigma_m_s: f64,
    /// Standard deviation of the initial turn rate, rad/s.
    pub initial_turn_rate_sigma_rad_s: f64,
    /// Mean sojourn time in constant velocity and in coordinated turn, s.
    pub sojourn_s: [f64; 2],
    /// The filter is restarted by the first fix after a gap longer than this, s.
    pub max_gap_s: f64,
}

impl ImmUkfOptions {
    /// Options for a target of that standard deviation of the acceleration (m/s2).
    #[must_use]
    pub fn from_acceleration(acceleration_m_s2: f64) -> Self {
        // White over one second.
        let density_m2_s3 = acceleration_m_s2 * acceleration_m_s2;
        Self {
            cruise_m2_s3: 0.01 * density_m2_s3,
            turn_m2_s3: density_m2_s3,
            turn_rate_rad2_s3: 1e-3,
            initial_speed_sigma_m_s: 5.0,
            initial_turn_rate_sigma_rad_s: 0.1,
            sojourn_s: [20.0, 10.0],
            max_gap_s: 30.0,
        }
    }
}

/// The moment-matched estimate after a step.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ImmUkfEstimate {
    /// Estimated position.
    pub position: EastNorth,
    /// Error variance per axis, mean over both, m2.
    pub variance_m2: f64,
    /// Probabilities of constant velocity and coordinated turn.
    pub mode_probabilities: [f64; 2],
    /// Log-density of this fix given the preceding ones; 0 without a fix.
    pub log_likelihood: f64,
}

#[derive(Debug, Clone, Copy)]
struct Mode {
    mean: State,
    covariance: Covariance,
}

/// The filter of one target. It allocates nothing.
#[derive(Debug, Clone)]
pub struct ImmUkf {
    options: ImmUkfOptions,
    modes: Option<[Mode; 2]>,
    log_probabilities: [f64; 2],
    since_fix_s: f64,
}

impl ImmUkf {
    /// A filter that its first fix will initialise.
    #[must_use]
    pub fn new(options: ImmUkfOptions) -> Self {
        Self {
            options,
            modes: None,
            log_probabilities: stationary_log_probabilities(&options),
            since_fix_s: 0.0,
        }
    }

    /// Predicts over that many seconds, then updates with a fix and its error variance per axis (m2), if
    /// there is one. Without one, the mode probabilities follow their Markov chain.
    /// `None` until the first fix, and again after a gap longer than `max_gap_s`.
    pub fn step(&mut self, seconds: f64, fix: Option<(EastNorth, f64)>) -> Option<ImmUkfEstimate> {
        self.since_fix_s += seconds;
        if self.since_fix_s > self.options.max_gap_s {
            self.modes = None;
        }
        let Some(mut modes) = self.modes else {
            let (position, variance_m2) = fix?;
            return Some(self.initialize(position, variance_m2));
        };
        let transition = transition(&self.options, seconds);
        let (mixed, predicted) = mix(&modes, self.log_probabilities, &transition);
        self.log_probabilities = predicted;
        for (index, mode) in modes.iter_mut().enumerate() {
            *mode = predict(&mixed[index], index == 1, seconds, &self.options);
        }
        let mut log_likelihood = 0.0;
        if let Some((position, variance_m2)) = fix {
            self.since_fix_s = 0.0;
            for (mode, log_probability) in modes.iter_mut().zip(&mut self.log_probabilities) {
                *log_probability += update(mode, position, variance_m2);
            }
            (self.log_probabilities, log_likelihood) = normalize(self.log_probabilities);
        }
        self.modes = Some(modes);
        Some(self.estimate(&modes, log_likelihood))
    }

    fn initialize(&mut self, position: EastNorth, variance_m2: f64) -> ImmUkfEstimate {
        let options = &self.options;
        let (speed, turn) =
            (options.initial_speed_sigma_m_s.powi(2), options.initial_turn_rate_sigma_rad_s.powi(2));
        let mode = Mode {
            mean: State::new(position.east_m, position.north_m, 0.0, 0.0, 0.0),
            covariance: Covariance::from_diagonal(&State::new(variance_m2, variance_m2, speed, speed, turn)),
        };
        self.log_probabilities = stationary_log_probabilities(options);
        self.since_fix_s = 0.0;
        self.modes = Some([mode; 2]);
        self.estimate(&[mode; 2], 0.0)
    }

    fn estimate(&self, modes: &[Mode; 2], log_likelihood: f64) -> ImmUkfEstimate {
        let mode_probabilities = self.log_probabilities.map(f64::exp);
        let Mode { mean, covariance } = moment_match(modes, mode_probabilities);
        ImmUkfEstimate {
            position: EastNorth { east_m: mean[0], north_m: mean[1] },
            variance_m2: 0.5 * (covariance[(0, 0)] + covariance[(1, 1)]),
            mode_probabilities,
            log_likelihood,
        }
    }
}

/// Logarithms of the mode chain's stationary distribution.
fn stationary_log_probabilities(options: &ImmUkfOptions) -> [f64; 2] {
    let total_s: f64 = options.sojourn_s.iter().sum();
    options.sojourn_s.map(|sojourn_s| (sojourn_s / total_s).ln())
}

/// Transition probabilities from mode i to mode j over that many seconds: exact for the
/// continuous-time chain, so that two steps of half a second equal one of a second.
fn transition(options: &ImmUkfOptions, seconds: f64) -> [[f64; 2]; 2] {
    let rates = options.sojourn_s.map(f64::recip);
    let total = rates[0] + rates[1];
    let changed = 1.0 - (-total * seconds).exp();
    let leave = rates.map(|rate| rate / total * changed);
    [[1.0 - leave[0], leave[0]], [leave[1], 1.0 - leave[1]]]
}

/// The interaction step: the mixed initial condition of each mode, and the logarithms of the predicted
/// mode probabilities.
fn mix(modes: &[Mode; 2], log_probabilities: [f64; 2], transition: &[[f64; 2]; 2]) -> ([Mode; 2], [f64; 2]) {
    let into = |mode: usize| {
        let joint = [0, 1].map(|from| log_probabilities[from] + transition[from][mode].ln());
        let (normalized, total) = normalize(joint);
        (moment_match(modes, normalized.map(f64::exp)), total)
    };
    let ((cruise, log_cruise), (turn, log_turn)) = (into(0), into(1));
    ([cruise, turn], [log_cruise, log_turn])
}

/// Mean and covariance of the mixture (moment matching).
fn moment_match(modes: &[Mode; 2], weights: [f64; 2]) -> Mode {
    let mean = modes[0].mean * weights[0] + modes[1].mean * weights[1];
    let mut covariance = Covariance::zeros();
    for (mode, weight) in modes.iter().zip(weights) {
        let deviation = mode.mean - mean;
        covariance += (mode.covariance + deviation * deviation.transpose()) * weight;
    }
    Mode { mean, covariance }
}

/// The unscented prediction of one mode.
fn predict(mode: &Mode, turning: bool, seconds: f64, options: &ImmUkfOptions) -> Mode {
    let root = square_root(&(mode.covariance * (STATES as f64 + LAMBDA)));
    let mut points = [mode.mean; POINTS];
    for index in 0..STATES {
        let offset = root.column(index);
        points[1 + index] += offset;
        points[1 + STATES + index] -= offset;
    }
    let side = 0.5 / (STATES as f64 + LAMBDA);
    let weight = |index: usize| if index == 0 { 2.0 * LAMBDA * side } else { side };
    let propagated = points.map(|point| advance(&point, turning, seconds));
    let mean =
        propagated.iter().enumerate().fold(State::zeros(), |sum, (index, point)| sum + point * weight(index));
    let mut covariance = process_noise(turning, seconds, options);
    for (index, point) in propagated.iter().enumerate() {
        let offset = point - mean;
        covariance += offset * offset.transpose() * weight(index);
    }
    Mode { mean, covariance }
}

/// Motion on a straight line, or on an arc with the state's turn rate.
fn advance(state: &State, turning: bool, seconds: f64) -> State {
    let [east, north, east_mps, north_mps, rate] = [state[0], state[1], state[2], state[3], state[4]];
    if !turning || rate.abs() < MIN_TURN_RATE_RAD_S {
        return State::new(east + east_mps * seconds, north + north_mps * seconds, east_mps, north_mps, rate);
    }
    let (sine, cosine) = (rate * seconds).sin_cos();
    let (along_s, across_s) = (sine / rate, (1.0 - cosine) / rate);
    State::new(
        east + along_s * east_mps - across_s * north_mps,
        north + across_s * east_mps + along_s * north_mps,
        cosine * east_mps - sine * north_mps,
        sine * east_mps + cosine * north_mps,
        rate,
    )
}

fn process_noise(turning: bool, seconds: f64, options: &ImmUkfOptions) -> Covariance {
    let density = if turning { options.turn_m2_s3 } else { options.cruise_m2_s3 };
    let mut noise = Covariance::zeros();
    for axis in 0..2 {
        noise[(axis, axis)] = density * seconds.powi(3) / 3.0;
        noise[(axis, axis + 2)] = density * seconds.powi(2) / 2.0;
        noise[(axis + 2, axis)] = noise[(axis, axis + 2)];
        noise[(axis + 2, axis + 2)] = density * seconds;
    }
    noise[(4, 4)] = options.turn_rate_rad2_s3 * seconds;
    noise
}

/// Updates a mode with a fix and returns the log-density of that. The measurement is linear, so the
/// unscented update equals the Kalman update.
fn update(mode: &mut Mode, fix: EastNorth, variance_m2: f64) -> f64 {
    let innovation = Vector2::new(fix.east_m - mode.mean[0], fix.north_m - mode.mean[1]);
    let innovation_covariance = mode.covariance.fixed_view::<2, 2>(0, 0) + Matrix2::identity() * variance_m2;
    let Some(inverse) = innovation_covariance.try_inverse() else { return 0.0 };
    let cross = mode.covariance.fixed_columns::<2>(0).into_owned();
    let gain = cross * inverse;
    mode.mean += gain * innovation;
    // Joseph form (I - K H) P (I - K H)' + K R K': stays positive definite for a precise fix and an
    // uncertain prediction.
    let mut complement = Covariance::identity();
    complement.fixed_columns_mut::<2>(0).zip_apply(&gain, |entry, gain| *entry -= gain);
    let covariance =
        complement * mode.covariance * complement.transpose() + gain * gain.transpose() * variance_m2;
    mode.covariance = (covariance + covariance.transpose()) * 0.5;
    let nis = (innovation.transpose() * inverse * innovation)[(0, 0)];
    -0.5 * (nis + innovation_covariance.determinant().ln()) - std::f64::consts::TAU.ln()
}

/// The lower Cholesky factor, with as much added to the diagonal as rounding errors require.
fn square_root(covariance: &Covariance) -> Covariance {
    let mut jitter = 0.0;
    for _ in 0..8 {
        let lifted = covariance + Covariance::identity() * jitter;
        if let Some(root) = Cholesky::new(lifted) {
            return root.l();
        }
        jitter = (jitter * 100.0).max(1e-12 * covariance.trace().abs().max(1e-12));
    }
    Covariance::from_diagonal(&covariance.diagonal().map(|value| value.max(0.0).sqrt()))
}

/// Logarithms of numbers scaled to a sum of 1, and the logarithm of their sum (log-sum-exp). The largest is
/// subtracted first: of logarithms near -1e9, as of a fix that is 10 km away, the total alone has a rounding
/// error of 1e-7, which would be that of the probabilities.
fn normalize(logs: [f64; 2]) -> ([f64; 2], f64) {
    let largest = logs[0].max(logs[1]);
    let relative = logs.map(|log| log - largest);
    let total = relative.iter().map(|log| log.exp()).sum::<f64>().ln();
    (relative.map(|log| log - total), largest + total)
}

#[cfg(test)]
mod tests;
