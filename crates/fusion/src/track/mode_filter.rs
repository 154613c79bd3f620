//! The Kalman filter of one motion mode.
//!
//! State, 10 components: `x = [p_e p_n v_e v_n b_e b_n c_e c_n s_e s_n]`, axes east and north; position p
//! in m, velocity v in m/s, and the biases of receiver (b, of tens of seconds; s, of the whole session) and
//! camera (c) in units of their own standard deviation, so that one unit-variance Gauss-Markov state serves
//! measurements of any covariance.
//!
//! A measured position with error covariance R, of which W is white, is modelled as
//! `z = p + L b + e`, with `L = sqrtm(R - W)` and `e ~ N(0, k W)`; a fix has the session's bias s beside b,
//! each with its share of `R - W`. k inflates the white
//! part for measurements closer in time than its own correlation
//! (Bar-Shalom, Li and Kirubarajan 2001, 8.2: state augmentation for autocorrelated noise).

use super::measurement::{MeasuredPosition, MeasurementSource};
use super::settings::TrackSettings;
use crate::geo::EastNorth;
use crate::geo::PlaneCovariance;

/// Components of the state.
const STATES: usize = 10;
/// Index of the first (east) component of each pair; north follows.
pub(super) const POSITION: usize = 0;
pub(super) const VELOCITY: usize = 2;
pub(super) const GNSS_BIAS: usize = 4;
pub(super) const CAMERA_BIAS: usize = 6;
pub(super) const SESSION_BIAS: usize = 8;

/// Standard deviation per axis of a stationary target's velocity, m/s: keeps the covariance regular.
const STATIONARY_SPEED_SIGMA_M_S: f64 = 0.02;
/// Standard deviation of a bias after its reset, in units of its stationary one.
const RESET_BIAS_SIGMAS: f64 = 4.0;
/// Mixing weights below this contribute nothing to a covariance.
const NEGLIGIBLE_WEIGHT: f64 = 1e-9;

/// One number per state: arrays, of which loops of constant length are compiled to vector instructions.
type Vector = [f64; STATES];
/// By column; symmetric to the bit.
type SymmetricMatrix = [Vector; STATES];

/// Mean and covariance of the state under one motion mode.
#[derive(Debug, Clone, Copy)]
pub(super) struct ModeFilter {
    pub(super) mean: Vector,
    pub(super) covariance: SymmetricMatrix,
    /// `M`, the derivative of the mean by the camera's lasting error d (a column per axis), in its standard deviations: an
    /// error of all boxes that is not estimated (a consider parameter; Bierman 1977, VIII). `z = p + L_d d`, so
    /// `M <- M + K (L_d - H M)`.
    response: [Vector; 2],
}

/// A propagation `x <- F x + w`: the velocity, integrated over time, adds to the position, and every state decays by a
/// factor of its own.
pub(super) struct Transition {
    /// Integral of the velocity's decay over the step, s.
    integrated_decay_s: f64,
    /// Diagonal of F.
    decay: Vector,
    /// Variances of w, in squared units of each state.
    noise: Vector,
    /// Covariance of w between position and velocity of one axis, m2/s.
    position_velocity_m2_s: f64,
}

/// A measured position with its error split into a bias and a white part.
pub(super) struct NoiseDecomposition {
    pub(super) position: EastNorth,
    /// The bias that tens of seconds, or the place, change; then the session's, of a fix alone.
    pub(super) biases: [ObservedBias; 2],
    /// Covariance of the white part, m2.
    pub(super) white: PlaneCovariance,
    /// `L_d`, the symmetric square root of the stated covariance of a box's position, m; 0 for a fix.
    pub(super) lasting_root_m: [f64; 3],
}

/// A bias as it enters a measurement.
#[derive(Clone, Copy)]
pub(super) struct ObservedBias {
    /// Index of its first state.
    pub(super) state: usize,
    /// L, the symmetric square root of its part of R, m, as (east, north, east-north).
    pub(super) root_m: [f64; 3],
}

/// The measurement as one mode predicts it.
pub(super) struct PredictedMeasurement {
    /// Measured less predicted position (east, north), m.
    pub(super) innovation: [f64; 2],
    /// Innovation covariance S, m2.
    pub(super) innovation_covariance: PlaneCovariance,
    /// S with the camera's bias as uncertain as it is stated, m2: for the gate.
    pub(super) stated_covariance: PlaneCovariance,
    /// Cross-covariance `P H'` of the state with the measured position, by axis.
    cross_covariance: [Vector; 2],
    /// `L_d - H M`, m: the derivatives of the innovation (east, north) by each component of the camera's lasting error.
    lasting: [[f64; 2]; 2],
}

impl NoiseDecomposition {
    /// `white_inflation` (k, at least 1) multiplies the white part.
    pub(super) fn new(
        settings: &TrackSettings,
        source: MeasurementSource,
        measured: MeasuredPosition,
        white_inflation: f64,
    ) -> Self {
        let (bias, white_share, session_share) = match source {
            MeasurementSource::Fix => (GNSS_BIAS, settings.gnss.white_share, settings.gnss_session.share),
            MeasurementSource::Regressed => (CAMERA_BIAS, settings.regression.correlation.white_share, 0.0),
        };
        let session = measured.covariance.scaled(session_share);
        let within = measured.covariance.minus(session);
        let white = measured.white.unwrap_or_else(|| within.scaled(white_share));
        Self {
            position: measured.position,
            lasting_root_m: match source {
                MeasurementSource::Fix => [0.0; 3],
                MeasurementSource::Regressed => {
                    measured.covariance.scaled(measured.stated_scale).square_root_m()
                }
            },
            biases: [
                ObservedBias { state: bias, root_m: within.minus(white).square_root_m() },
                ObservedBias { state: SESSION_BIAS, root_m: session.square_root_m() },
            ],
            white: white.scaled(white_inflation),
        }
    }
}

impl Transition {
    /// Changes nothing.
    const IDENTITY: Self = Self {
        integrated_decay_s: 0.0,
        decay: [1.0; STATES],
        noise: [0.0; STATES],
        position_velocity_m2_s: 0.0,
    };

    /// Stationary mode: the velocity is zero and uncorrelated with everything; the position performs
    /// a random walk of `density_m2_s`. With `step_s = 0` only the velocity is reset.
    pub(super) fn stationary(step_s: f64, density_m2_s: f64) -> Self {
        let mut own = Self::IDENTITY;
        for axis in 0..2 {
            own.decay[VELOCITY + axis] = 0.0;
            own.noise[VELOCITY + axis] = STATIONARY_SPEED_SIGMA_M_S * STATIONARY_SPEED_SIGMA_M_S;
            own.noise[POSITION + axis] = density_m2_s * step_s;
        }
        own
    }

    /// Moving modes: the velocity is an Ornstein-Uhlenbeck process driven by white acceleration of
    /// `density_m2_s3`, the position its integral, discretised exactly (Särkkä and Solin 2019, 6.2).
    pub(super) fn ornstein_uhlenbeck(step_s: f64, density_m2_s3: f64, time_constant_s: f64) -> Self {
        let rate = 1.0 / time_constant_s;
        let exponent = rate * step_s;
        let decay = (-exponent).exp();
        let integrated_decay_s = (1.0 - decay) / rate;
        let position_m2 = if exponent < 0.01 {
            // Series to second order: the closed form loses all digits for short steps.
            density_m2_s3 * step_s.powi(3) / 3.0 * (1.0 - 0.75 * exponent)
        } else {
            density_m2_s3 / rate.powi(3) * (exponent - 2.0 * (1.0 - decay) + 0.5 * (1.0 - decay * decay))
        };
        let mut own = Self {
            integrated_decay_s,
            position_velocity_m2_s: density_m2_s3 * 0.5 * integrated_decay_s * integrated_decay_s,
            ..Self::IDENTITY
        };
        for axis in 0..2 {
            own.decay[VELOCITY + axis] = decay;
            own.noise[VELOCITY + axis] = density_m2_s3 * (1.0 - decay * decay) / (2.0 * rate);
            own.noise[POSITION + axis] = position_m2;
        }
        own
    }

    /// With a bias that is a first-order Gauss-Markov process of unit variance, of which `correlation` is left.
    pub(super) fn with_bias(mut self, bias: usize, correlation: f64) -> Self {
        for state in [bias, bias + 1] {
            self.decay[state] = correlation;
            self.noise[state] = 1.0 - correlation * correlation;
        }
        self
    }
}

/// The interaction step of the IMM: each mode becomes the mixture of all of them with its weights, `weights[to][from]`,
/// by moment matching. The weights of a mode sum to 1.
pub(super) fn mix<const N: usize>(modes: &mut [ModeFilter; N], weights: &[[f64; N]; N]) {
    let before: [(Vector, [Vector; 2]); N] =
        std::array::from_fn(|from| (modes[from].mean, modes[from].response));
    // sqrt(w) (m_from - m_to): its outer products are the spread of the means, symmetric to the bit.
    let mut spread = [[[0.0; STATES]; N]; N];
    for (to, mode) in modes.iter_mut().enumerate() {
        mode.mean = [0.0; STATES];
        mode.response = [[0.0; STATES]; 2];
        for ((mean, response), weight) in before.iter().zip(weights[to]) {
            add_scaled(&mut mode.mean, weight, mean);
            for (own, response) in mode.response.iter_mut().zip(response) {
                add_scaled(own, weight, response);
            }
        }
        for ((mean, _), (spread, weight)) in before.iter().zip(spread[to].iter_mut().zip(weights[to])) {
            let root = of_covariance(weight).sqrt();
            for state in 0..STATES {
                spread[state] = root * (mean[state] - mode.mean[state]);
            }
        }
    }
    for column in 0..STATES {
        let before: [Vector; N] = std::array::from_fn(|from| modes[from].covariance[column]);
        for (to, mode) in modes.iter_mut().enumerate() {
            let mut mixed = [0.0; STATES];
            for from in 0..N {
                let spread = &spread[to][from];
                let (weight, own) = (of_covariance(weights[to][from]), spread[column]);
                for state in 0..STATES {
                    mixed[state] += weight * before[from][state] + own * spread[state];
                }
            }
            mode.covariance[column] = mixed;
        }
    }
}

/// The weight of a component in the covariance of a mixture.
fn of_covariance(weight: f64) -> f64 {
    if weight > NEGLIGIBLE_WEIGHT { weight } else { 0.0 }
}

#[inline(always)]
fn add_scaled(sum: &mut Vector, factor: f64, vector: &Vector) {
    for (sum, value) in sum.iter_mut().zip(vector) {
        *sum += factor * value;
    }
}

impl ModeFilter {
    /// A filter that knows one measured position: `p = z - L b - e`, so position and bias are
    /// correlated from the start; the velocity has mean 0 and `initial_speed_sigma_m_s` per axis.
    pub(super) fn new(
        decomposition: &NoiseDecomposition,
        covariance_m2: PlaneCovariance,
        initial_speed_sigma_m_s: f64,
    ) -> Self {
        let mut mean = [0.0; STATES];
        mean[POSITION] = decomposition.position.east_m;
        mean[POSITION + 1] = decomposition.position.north_m;
        let mut covariance = [[0.0; STATES]; STATES];
        for (bias, column) in covariance.iter_mut().enumerate().skip(GNSS_BIAS) {
            column[bias] = 1.0;
        }
        for state in [VELOCITY, VELOCITY + 1] {
            covariance[state][state] = initial_speed_sigma_m_s.powi(2);
        }
        for ObservedBias { state, root_m } in decomposition.biases {
            for (row, values) in rows(root_m).into_iter().enumerate() {
                for (column, value) in values.into_iter().enumerate() {
                    covariance[POSITION + row][state + column] = -value;
                    covariance[state + column][POSITION + row] = -value;
                }
            }
        }
        for (row, values) in covariance_m2.rows_m2().into_iter().enumerate() {
            covariance[POSITION + row][POSITION..VELOCITY].copy_from_slice(&values);
        }
        let response = rows(decomposition.lasting_root_m).map(|values| {
            let mut column = [0.0; STATES];
            column[POSITION..VELOCITY].copy_from_slice(&values);
            column
        });
        Self { mean, covariance, response }
    }

    /// Speed of the mean velocity, m/s.
    pub(super) fn speed_m_s(&self) -> f64 {
        let [east_m_s, north_m_s] = [self.mean[VELOCITY], self.mean[VELOCITY + 1]];
        (east_m_s * east_m_s + north_m_s * north_m_s).sqrt()
    }

    /// Propagates over a step: `m <- F m`, `M <- F M`, `P <- F P F' + Q`.
    pub(super) fn propagate(&mut self, transition: &Transition) {
        let Transition { integrated_decay_s, decay, noise, position_velocity_m2_s } = transition;
        for axis in 0..2 {
            let velocity = self.covariance[VELOCITY + axis];
            add_scaled(&mut self.covariance[POSITION + axis], *integrated_decay_s, &velocity);
        }
        let [first, second] = &mut self.response;
        for vector in self.covariance.iter_mut().chain([&mut self.mean, first, second]) {
            for axis in 0..2 {
                vector[POSITION + axis] += integrated_decay_s * vector[VELOCITY + axis];
            }
        }
        // The two sums of this element were rounded in different orders.
        self.covariance[POSITION + 1][POSITION] = self.covariance[POSITION][POSITION + 1];
        for vector in [&mut self.mean, first, second] {
            for (value, decay) in vector.iter_mut().zip(decay) {
                *value *= decay;
            }
        }
        for (state, column) in self.covariance.iter_mut().enumerate() {
            for (value, other) in column.iter_mut().zip(decay) {
                *value *= decay[state] * other;
            }
            column[state] += noise[state];
        }
        for axis in 0..2 {
            self.covariance[POSITION + axis][VELOCITY + axis] += position_velocity_m2_s;
            self.covariance[VELOCITY + axis][POSITION + axis] += position_velocity_m2_s;
        }
    }

    /// Propagates a bias of unit variance to one that is correlated with it.
    pub(super) fn decorrelate(&mut self, bias: usize, correlation: f64) {
        for state in [bias, bias + 1] {
            self.scale(state, correlation);
            self.covariance[state][state] += 1.0 - correlation * correlation;
        }
    }

    /// Makes the velocity less certain, m2/s2 per axis.
    pub(super) fn add_velocity_variance(&mut self, variance_m2_s2: f64) {
        for state in [VELOCITY, VELOCITY + 1] {
            self.covariance[state][state] += variance_m2_s2;
        }
    }

    /// Sets a bias to 0 with a wide variance, uncorrelated with everything else.
    pub(super) fn reset_bias(&mut self, bias: usize) {
        for state in [bias, bias + 1] {
            self.scale(state, 0.0);
            self.covariance[state][state] = RESET_BIAS_SIGMAS * RESET_BIAS_SIGMAS;
        }
    }

    /// Multiplies one state component by a factor, its covariances with it.
    fn scale(&mut self, state: usize, factor: f64) {
        self.mean[state] *= factor;
        for response in &mut self.response {
            response[state] *= factor;
        }
        for column in &mut self.covariance {
            column[state] *= factor;
        }
        for value in &mut self.covariance[state] {
            *value *= factor;
        }
    }

    /// Covariance of the pair of components that begins at `pair`: of the position in m2, of the velocity in m2/s2.
    pub(super) fn covariance_of(&self, pair: usize) -> PlaneCovariance {
        PlaneCovariance {
            east_m2: self.covariance[pair][pair],
            north_m2: self.covariance[pair + 1][pair + 1],
            east_north_m2: self.covariance[pair][pair + 1],
        }
    }

    /// The part of a pair's covariance that the camera's bias causes, for the position `P_pc P_pc'`: the error of an
    /// estimate that is linear in the measurements has the covariance `P_pc` with a bias of variance 1.
    pub(super) fn camera_share(&self, pair: usize) -> PlaneCovariance {
        spanned_by(pair, [&self.covariance[CAMERA_BIAS], &self.covariance[CAMERA_BIAS + 1]])
    }

    /// The part of a covariance of position or velocity that the biases of camera and receiver cause, as [`Self::camera_share`].
    pub(super) fn bias_share(&self, row: usize, column: usize) -> f64 {
        (GNSS_BIAS..STATES).map(|bias| self.covariance[row][bias] * self.covariance[column][bias]).sum()
    }

    /// Covariance of a pair if all boxes shared one error, for the position `M_p M_p'`.
    pub(super) fn lasting_error(&self, pair: usize) -> PlaneCovariance {
        let [first, second] = &self.response;
        spanned_by(pair, [first, second])
    }

    /// Innovation, its covariance `S = H P H' + white` and `P H'`, with `H = [I 0 .. L ..]`.
    pub(super) fn predict_measurement(
        &self,
        decomposition: &NoiseDecomposition,
        camera_scale: f64,
    ) -> PredictedMeasurement {
        let measured = |vector: &Vector| decomposition.measured(vector);
        let predicted = measured(&self.mean);
        let EastNorth { east_m, north_m } = decomposition.position;
        let lasting = |column: usize| {
            let root = rows(decomposition.lasting_root_m)[column];
            let predicted = measured(&self.response[column]);
            [root[0] - predicted[0], root[1] - predicted[1]]
        };
        let [mut east, mut north] = [self.covariance[POSITION], self.covariance[POSITION + 1]];
        for ObservedBias { state, root_m } in decomposition.biases {
            if root_m == [0.0; 3] {
                continue;
            }
            let [by_east, by_north] = rows(root_m);
            for (cross, [by_first, by_second]) in [(&mut east, by_east), (&mut north, by_north)] {
                add_scaled(cross, by_first, &self.covariance[state]);
                add_scaled(cross, by_second, &self.covariance[state + 1]);
            }
        }
        let [[east_m2, east_north_m2], [_, north_m2]] = [measured(&east), measured(&north)];
        let innovation_covariance =
            PlaneCovariance { east_m2, north_m2, east_north_m2 }.plus(decomposition.white);
        let by_camera = |state: usize| PlaneCovariance::outer(east[state], north[state]);
        let by_camera = by_camera(CAMERA_BIAS).plus(by_camera(CAMERA_BIAS + 1));
        PredictedMeasurement {
            innovation: [east_m - predicted[0], north_m - predicted[1]],
            innovation_covariance,
            stated_covariance: innovation_covariance.plus(by_camera.scaled(camera_scale - 1.0)),
            cross_covariance: [east, north],
            lasting: [lasting(0), lasting(1)],
        }
    }

    /// The Kalman update `K = P H' S^-1`. Returns what the measurement's likelihood
    /// `exp(-d' S^-1 d / 2) / (2 pi sqrt(det S))` depends on: `d' S^-1 d` and `sqrt(det S)`, m2.
    ///
    /// With the Cholesky factor `S = C C'` and `W = P H' C^-T`, `P <- P - W W'` stays symmetric to the bit, and
    /// `m <- m + W C^-1 d`.
    pub(super) fn update(&mut self, predicted: &PredictedMeasurement) -> [f64; 2] {
        let PredictedMeasurement { innovation, innovation_covariance, cross_covariance, lasting, .. } =
            predicted;
        let root_determinant_m2 = innovation_covariance.determinant().sqrt();
        // C^-1, by rows (first, 0) and (below, second).
        let first = innovation_covariance.east_m2.sqrt().recip();
        let second = (first * root_determinant_m2).recip();
        let below = -innovation_covariance.east_north_m2 * first * first * second;
        let whiten = |[east, north]: [f64; 2]| [first * east, below * east + second * north];
        let [east, north] = cross_covariance;
        let mut gains = [[0.0; STATES]; 2];
        for state in 0..STATES {
            [gains[0][state], gains[1][state]] = whiten([east[state], north[state]]);
        }
        let by_innovation = whiten(*innovation);
        let by_lasting = lasting.map(whiten);
        let [response_east, response_north] = &mut self.response;
        let vectors = [&mut self.mean, response_east, response_north];
        for (vector, residual) in vectors.into_iter().zip([by_innovation, by_lasting[0], by_lasting[1]]) {
            add_scaled(vector, residual[0], &gains[0]);
            add_scaled(vector, residual[1], &gains[1]);
        }
        for (state, column) in self.covariance.iter_mut().enumerate() {
            let (by_first, by_second) = (gains[0][state], gains[1][state]);
            for other in 0..STATES {
                column[other] -= by_first * gains[0][other] + by_second * gains[1][other];
            }
        }
        let [one, other] = by_innovation;
        [one * one + other * other, root_determinant_m2]
    }
}

impl NoiseDecomposition {
    /// H applied to a vector over the states: `p + L b` per bias.
    fn measured(&self, vector: &Vector) -> [f64; 2] {
        let mut sum = [vector[POSITION], vector[POSITION + 1]];
        for ObservedBias { state, root_m } in self.biases {
            for (sum, [by_first, by_second]) in sum.iter_mut().zip(rows(root_m)) {
                *sum += by_first * vector[state] + by_second * vector[state + 1];
            }
        }
        sum
    }
}

/// Rows of a symmetric 2 x 2 matrix that is given as (east, north, east-north).
const fn rows([east, north, east_north]: [f64; 3]) -> [[f64; 2]; 2] {
    [[east, east_north], [east_north, north]]
}

/// `A A'` of one pair of components of two vectors, the columns of A.
fn spanned_by(pair: usize, vectors: [&Vector; 2]) -> PlaneCovariance {
    let [first, second] = vectors.map(|vector| PlaneCovariance::outer(vector[pair], vector[pair + 1]));
    first.plus(second)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn decomposition(source: MeasurementSource, [east_m, north_m]: [f64; 2]) -> NoiseDecomposition {
        let covariance = PlaneCovariance { east_m2: 4.0, north_m2: 2.5, east_north_m2: 0.7 };
        let measured = MeasuredPosition {
            white: Some(covariance.scaled(0.2)),
            covariance,
            stated_scale: 1.4,
            ..MeasuredPosition::isotropic(EastNorth { east_m, north_m }, 1.0)
        };
        NoiseDecomposition::new(&TrackSettings::default(), source, measured, 1.5)
    }

    proptest! {
        #[test]
        fn covariances_stay_symmetric_to_the_bit_and_positive(
            steps in proptest::collection::vec((0.01..2.0f64, -20.0..20.0f64, -20.0..20.0f64, any::<bool>()), 1..40),
            stay in 0.4..0.98f64,
        ) {
            let first = ModeFilter::new(
                &decomposition(MeasurementSource::Regressed, [0.0; 2]),
                PlaneCovariance { east_m2: 4.0, north_m2: 2.5, east_north_m2: 0.7 },
                10.0,
            );
            let mut modes = [first; 3];
            let leave = 0.5 * (1.0 - stay);
            let weights = [[stay, leave, leave], [leave, stay, leave], [leave, leave, stay]];
            for (step_s, east_m, north_m, is_fix) in steps {
                mix(&mut modes, &weights);
                let source = if is_fix { MeasurementSource::Fix } else { MeasurementSource::Regressed };
                let decomposition = decomposition(source, [east_m, north_m]);
                let transitions = [
                    Transition::stationary(step_s, 1e-4),
                    Transition::ornstein_uhlenbeck(step_s, 0.05, 60.0),
                    Transition::ornstein_uhlenbeck(step_s, 2.0, 5.0),
                ];
                for (mode, transition) in modes.iter_mut().zip(transitions) {
                    mode.propagate(&transition.with_bias(CAMERA_BIAS, (-step_s).exp()));
                    let predicted = mode.predict_measurement(&decomposition, 1.4);
                    let [squared_distance, root_determinant_m2] = mode.update(&predicted);
                    let innovation = EastNorth { east_m: predicted.innovation[0], north_m: predicted.innovation[1] };
                    let expected = predicted.innovation_covariance.mahalanobis_squared(innovation);
                    prop_assert!((squared_distance - expected).abs() <= 1e-9 * (1.0 + expected));
                    prop_assert!(root_determinant_m2 > 0.0);
                }
                for mode in &modes {
                    for (column, values) in mode.covariance.iter().enumerate() {
                        prop_assert!(values[column] > 0.0, "{mode:?}");
                        for (row, value) in values.iter().enumerate() {
                            prop_assert_eq!(value.to_bits(), mode.covariance[row][column].to_bits());
                        }
                    }
                }
            }
        }
    }
}
