//! The IMM-UKF of the paper's comparison: interacting multiple models (Blom and Bar-Shalom 1988)
//! over two unscented Kalman filters, constant velocity and coordinated turn.
//!
//! Both modes share one state, so that they can be mixed: east, north (m), their velocities (m/s)
//! and the turn rate (rad/s). The constant-velocity mode carries the turn rate along unused. Mode
//! probabilities live as logarithms and are normalised by log-sum-exp, so a fix that no mode
//! foresaw cannot turn both into zero. What never happens here: knowledge of the receiver's colour;
//! the baseline takes fixes for white, as it does in the paper.

use nalgebra::{Cholesky, Matrix2, SMatrix, SVector, Vector2};

use crate::geo::EastNorth;

/// Size of the state that both modes share.
const STATES: usize = 5;
/// Points of the unscented transform: the mean and one either way per state.
const POINTS: usize = 2 * STATES + 1;
/// Spread of the points: lambda = 1 (alpha 1, beta 0, kappa 1 of van der Merwe), which keeps all
/// weights positive and so every covariance positive definite.
const LAMBDA: f64 = 1.0;
/// Below this turn rate (rad/s) the arc is a straight line to double precision.
const STRAIGHT_RAD_PER_S: f64 = 1e-6;

type State = SVector<f64, STATES>;
type Covariance = SMatrix<f64, STATES, STATES>;

/// Noise and switching of the two modes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ImmUkfOptions {
    /// Spectral density of the acceleration under constant velocity, per axis, m2/s3.
    pub cruise_density: f64,
    /// The same under coordinated turn, m2/s3.
    pub turn_density: f64,
    /// Random walk of the turn rate, rad2/s3.
    pub turn_rate_density: f64,
    /// Standard deviation of the speed per axis before anything is known, m/s.
    pub speed_sigma_mps: f64,
    /// Standard deviation of the turn rate before anything is known, rad/s.
    pub turn_rate_sigma: f64,
    /// Mean seconds in constant velocity, and in coordinated turn.
    pub sojourn_s: [f64; 2],
    /// After so many seconds without a fix nothing is known any more, and the next one starts anew.
    pub forget_s: f64,
}

impl ImmUkfOptions {
    /// For a target of which only the usual acceleration (m/s2) is known.
    #[must_use]
    pub fn of_acceleration(acceleration_mps2: f64) -> Self {
        let density = acceleration_mps2 * acceleration_mps2;
        Self {
            cruise_density: 0.01 * density,
            turn_density: density,
            turn_rate_density: 1e-3,
            speed_sigma_mps: 5.0,
            turn_rate_sigma: 0.1,
            sojourn_s: [20.0, 10.0],
            forget_s: 30.0,
        }
    }
}

/// What the filter holds after a step.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Estimate {
    /// Where the target is.
    pub position: EastNorth,
    /// Error variance per axis (mean over the two), m2.
    pub variance_m2: f64,
    /// Probabilities of constant velocity and coordinated turn.
    pub mode_probabilities: [f64; 2],
    /// Logarithm of the density of this fix, given all before it; 0 without a fix.
    pub log_likelihood: f64,
}

#[derive(Debug, Clone, Copy)]
struct Mode {
    mean: State,
    covariance: Covariance,
}

/// The filter of one target. Nothing is allocated after it is made.
#[derive(Debug, Clone)]
pub struct ImmUkf {
    options: ImmUkfOptions,
    modes: Option<[Mode; 2]>,
    log_probabilities: [f64; 2],
    since_fix_s: f64,
}

impl ImmUkf {
    /// A filter that has seen nothing.
    #[must_use]
    pub fn new(options: ImmUkfOptions) -> Self {
        Self { options, modes: None, log_probabilities: prior(&options), since_fix_s: 0.0 }
    }

    /// Moves on by some seconds and takes a fix with its error variance per axis (m2), if there is
    /// one. A missed fix moves the mode probabilities along their Markov chain and nothing else.
    /// `None` until the first fix, and again once a gap was too long.
    pub fn step(&mut self, seconds: f64, fix: Option<(EastNorth, f64)>) -> Option<Estimate> {
        self.since_fix_s += seconds;
        if self.since_fix_s > self.options.forget_s {
            self.modes = None;
        }
        let Some(mut modes) = self.modes else {
            let (position, variance_m2) = fix?;
            return Some(self.start(position, variance_m2));
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
            log_likelihood = log_sum_exp(self.log_probabilities);
            self.log_probabilities = self.log_probabilities.map(|log| log - log_likelihood);
        }
        self.modes = Some(modes);
        Some(self.estimate(&modes, log_likelihood))
    }

    fn start(&mut self, position: EastNorth, variance_m2: f64) -> Estimate {
        let options = &self.options;
        let (speed, turn) = (options.speed_sigma_mps.powi(2), options.turn_rate_sigma.powi(2));
        let mode = Mode {
            mean: State::new(position.east_m, position.north_m, 0.0, 0.0, 0.0),
            covariance: Covariance::from_diagonal(&State::new(variance_m2, variance_m2, speed, speed, turn)),
        };
        self.log_probabilities = prior(options);
        self.since_fix_s = 0.0;
        self.modes = Some([mode; 2]);
        self.estimate(&[mode; 2], 0.0)
    }

    /// The mixture's mean and covariance.
    fn estimate(&self, modes: &[Mode; 2], log_likelihood: f64) -> Estimate {
        let mode_probabilities = self.log_probabilities.map(f64::exp);
        let Mode { mean, covariance } = mixture(modes, mode_probabilities);
        Estimate {
            position: EastNorth { east_m: mean[0], north_m: mean[1] },
            variance_m2: 0.5 * (covariance[(0, 0)] + covariance[(1, 1)]),
            mode_probabilities,
            log_likelihood,
        }
    }
}

/// The chain's stationary distribution, as logarithms.
fn prior(options: &ImmUkfOptions) -> [f64; 2] {
    let total_s: f64 = options.sojourn_s.iter().sum();
    options.sojourn_s.map(|sojourn_s| (sojourn_s / total_s).ln())
}

/// Probabilities of going from mode i to mode j within some seconds: the exact transition of the
/// continuous chain, so that two steps of half a second are one of a second.
fn transition(options: &ImmUkfOptions, seconds: f64) -> [[f64; 2]; 2] {
    let rates = options.sojourn_s.map(f64::recip);
    let total = rates[0] + rates[1];
    let changed = 1.0 - (-total * seconds).exp();
    let leave = rates.map(|rate| rate / total * changed);
    [[1.0 - leave[0], leave[0]], [leave[1], 1.0 - leave[1]]]
}

/// Interaction: what each mode starts from, and the logarithms of the predicted probabilities.
fn mix(modes: &[Mode; 2], log_probabilities: [f64; 2], transition: &[[f64; 2]; 2]) -> ([Mode; 2], [f64; 2]) {
    let into = |mode: usize| {
        let joint = [0, 1].map(|from| log_probabilities[from] + transition[from][mode].ln());
        let total = log_sum_exp(joint);
        (mixture(modes, joint.map(|log| (log - total).exp())), total)
    };
    let ((cruise, log_cruise), (turn, log_turn)) = (into(0), into(1));
    ([cruise, turn], [log_cruise, log_turn])
}

fn mixture(modes: &[Mode; 2], weights: [f64; 2]) -> Mode {
    let mean = modes[0].mean * weights[0] + modes[1].mean * weights[1];
    let mut covariance = Covariance::zeros();
    for (mode, weight) in modes.iter().zip(weights) {
        let offset = mode.mean - mean;
        covariance += (mode.covariance + offset * offset.transpose()) * weight;
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
    let moved = points.map(|point| advance(&point, turning, seconds));
    let mean =
        moved.iter().enumerate().fold(State::zeros(), |sum, (index, point)| sum + point * weight(index));
    let mut covariance = process_noise(turning, seconds, options);
    for (index, point) in moved.iter().enumerate() {
        let offset = point - mean;
        covariance += offset * offset.transpose() * weight(index);
    }
    Mode { mean, covariance }
}

/// Straight ahead, or along an arc of the state's turn rate.
fn advance(state: &State, turning: bool, seconds: f64) -> State {
    let [east, north, east_mps, north_mps, rate] = [state[0], state[1], state[2], state[3], state[4]];
    if !turning || rate.abs() < STRAIGHT_RAD_PER_S {
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
    let density = if turning { options.turn_density } else { options.cruise_density };
    let mut noise = Covariance::zeros();
    for axis in 0..2 {
        noise[(axis, axis)] = density * seconds.powi(3) / 3.0;
        noise[(axis, axis + 2)] = density * seconds.powi(2) / 2.0;
        noise[(axis + 2, axis)] = noise[(axis, axis + 2)];
        noise[(axis + 2, axis + 2)] = density * seconds;
    }
    noise[(4, 4)] = options.turn_rate_density * seconds;
    noise
}

/// Takes a fix into a mode and returns the logarithm of its density. The measurement is linear, so
/// the unscented update is the Kalman update.
fn update(mode: &mut Mode, fix: EastNorth, variance_m2: f64) -> f64 {
    let innovation = Vector2::new(fix.east_m - mode.mean[0], fix.north_m - mode.mean[1]);
    let spread = mode.covariance.fixed_view::<2, 2>(0, 0) + Matrix2::identity() * variance_m2;
    let Some(inverse) = spread.try_inverse() else { return 0.0 };
    let cross = mode.covariance.fixed_columns::<2>(0).into_owned();
    let gain = cross * inverse;
    mode.mean += gain * innovation;
    // Joseph's form stays positive definite where a precise fix meets a vague prediction.
    let mut kept = Covariance::identity();
    kept.fixed_columns_mut::<2>(0).zip_apply(&gain, |entry, gain| *entry -= gain);
    let covariance = kept * mode.covariance * kept.transpose() + gain * gain.transpose() * variance_m2;
    mode.covariance = (covariance + covariance.transpose()) * 0.5;
    let nis = (innovation.transpose() * inverse * innovation)[(0, 0)];
    -0.5 * (nis + spread.determinant().ln()) - std::f64::consts::TAU.ln()
}

/// The lower root of a covariance; what rounding took from its diagonal is put back.
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

fn log_sum_exp(logs: [f64; 2]) -> f64 {
    let largest = logs[0].max(logs[1]);
    largest + logs.map(|log| (log - largest).exp()).iter().sum::<f64>().ln()
}

#[cfg(test)]
mod tests;
