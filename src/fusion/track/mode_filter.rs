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

use nalgebra::{SMatrix, SVector};

use super::measurement::{MeasuredPosition, MeasurementSource};
use super::settings::TrackSettings;
use crate::geo::EastNorth;
use crate::geo::PlaneCovariance;

/// Components of the state.
pub(super) const STATES: usize = 10;
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

pub(super) type State = SVector<f64, STATES>;
pub(super) type StateCovariance = SMatrix<f64, STATES, STATES>;

/// Mean and covariance of the state under one motion mode.
#[derive(Debug, Clone)]
pub(super) struct ModeFilter {
    pub(super) mean: State,
    pub(super) covariance: StateCovariance,
    /// `M`, the derivative of the mean by the camera's lasting error d, in its standard deviations: an error of all boxes
    /// that is not estimated (a consider parameter; Bierman 1977, VIII). `z = p + L_d d`, so `M <- M + K (L_d - H M)`.
    response: SMatrix<f64, STATES, 2>,
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
    /// Cross-covariance `P H'` of the state with the measured position.
    cross_covariance: SMatrix<f64, STATES, 2>,
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

impl ModeFilter {
    /// A filter that knows one measured position: `p = z - L b - e`, so position and bias are
    /// correlated from the start; the velocity has mean 0 and `initial_speed_sigma_m_s` per axis.
    pub(super) fn new(
        decomposition: &NoiseDecomposition,
        covariance_m2: PlaneCovariance,
        initial_speed_sigma_m_s: f64,
    ) -> Self {
        let mut mean = State::zeros();
        mean[POSITION] = decomposition.position.east_m;
        mean[POSITION + 1] = decomposition.position.north_m;
        let mut covariance = StateCovariance::zeros();
        for bias in GNSS_BIAS..STATES {
            covariance[(bias, bias)] = 1.0;
        }
        for axis in 0..2 {
            covariance[(VELOCITY + axis, VELOCITY + axis)] = initial_speed_sigma_m_s.powi(2);
        }
        for ObservedBias { state, root_m: [east, north, east_north] } in decomposition.biases {
            for (row, column, value) in [(0, 0, east), (1, 1, north), (0, 1, east_north), (1, 0, east_north)]
            {
                covariance[(POSITION + row, state + column)] = -value;
                covariance[(state + column, POSITION + row)] = -value;
            }
        }
        for (row, values) in covariance_m2.rows_m2().iter().enumerate() {
            for (column, value) in values.iter().enumerate() {
                covariance[(POSITION + row, POSITION + column)] = *value;
            }
        }
        let mut response = SMatrix::zeros();
        let [east, north, east_north] = decomposition.lasting_root_m;
        for (row, values) in [[east, east_north], [east_north, north]].into_iter().enumerate() {
            for (column, value) in values.into_iter().enumerate() {
                response[(POSITION + row, column)] = value;
            }
        }
        Self { mean, covariance, response }
    }

    /// Mean and covariance of a mixture with the given weights, which sum to 1 (moment matching).
    pub(super) fn moment_match<const N: usize>(components: &[Self; N], weights: [f64; N]) -> Self {
        let mut mean = State::zeros();
        let mut response = SMatrix::zeros();
        for (component, weight) in components.iter().zip(weights) {
            mean += component.mean * weight;
            response += component.response * weight;
        }
        let mut covariance = StateCovariance::zeros();
        for (component, weight) in components.iter().zip(weights) {
            if weight > NEGLIGIBLE_WEIGHT {
                let deviation = component.mean - mean;
                covariance += (component.covariance + deviation * deviation.transpose()) * weight;
            }
        }
        Self { mean, covariance, response }
    }

    /// Multiplies one state component by a factor, its covariances with it.
    fn scale(&mut self, state: usize, factor: f64) {
        self.mean[state] *= factor;
        self.response[(state, 0)] *= factor;
        self.response[(state, 1)] *= factor;
        for other in 0..STATES {
            self.covariance[(state, other)] *= factor;
            self.covariance[(other, state)] *= factor;
        }
    }

    /// Propagates the biases as first-order Gauss-Markov processes of unit variance,
    /// `phi = exp(-rate)`; the camera's also decorrelates with the distance travelled.
    pub(super) fn propagate_biases(&mut self, settings: &TrackSettings, step_s: f64) {
        let speed_m_s = self.mean[VELOCITY].hypot(self.mean[VELOCITY + 1]);
        let regression = &settings.regression;
        let rates = [
            (GNSS_BIAS, step_s / settings.gnss.time_constant_s),
            (SESSION_BIAS, step_s / settings.gnss_session.time_constant_s),
            (
                CAMERA_BIAS,
                step_s / regression.correlation.time_constant_s
                    + step_s * speed_m_s / regression.correlation_length_m,
            ),
        ];
        for (bias, rate) in rates {
            self.decorrelate(bias, (-rate).exp());
        }
    }

    /// Propagates a bias of unit variance to one that is correlated with it.
    pub(super) fn decorrelate(&mut self, bias: usize, correlation: f64) {
        for state in [bias, bias + 1] {
            self.scale(state, correlation);
            self.covariance[(state, state)] += 1.0 - correlation * correlation;
        }
    }

    /// Stationary mode: the velocity is zero and uncorrelated with everything; the position performs
    /// a random walk of `density_m2_s`. With `step_s = 0` only the velocity is reset.
    pub(super) fn predict_stationary(&mut self, step_s: f64, density_m2_s: f64) {
        for state in [VELOCITY, VELOCITY + 1] {
            self.scale(state, 0.0);
            self.covariance[(state, state)] = STATIONARY_SPEED_SIGMA_M_S * STATIONARY_SPEED_SIGMA_M_S;
        }
        for state in [POSITION, POSITION + 1] {
            self.covariance[(state, state)] += density_m2_s * step_s;
        }
    }

    /// Moving modes: the velocity is an Ornstein-Uhlenbeck process driven by white acceleration of
    /// `density_m2_s3`, the position its integral, discretised exactly (Särkkä and Solin 2019, 6.2).
    pub(super) fn predict_ornstein_uhlenbeck(
        &mut self,
        step_s: f64,
        density_m2_s3: f64,
        time_constant_s: f64,
    ) {
        let rate = 1.0 / time_constant_s;
        let exponent = rate * step_s;
        let decay = (-exponent).exp();
        let integrated_decay_s = (1.0 - decay) / rate;
        for axis in 0..2 {
            let (position, velocity) = (POSITION + axis, VELOCITY + axis);
            self.mean[position] += integrated_decay_s * self.mean[velocity];
            for column in 0..2 {
                self.response[(position, column)] += integrated_decay_s * self.response[(velocity, column)];
            }
            for other in 0..STATES {
                self.covariance[(position, other)] += integrated_decay_s * self.covariance[(velocity, other)];
            }
            for other in 0..STATES {
                self.covariance[(other, position)] += integrated_decay_s * self.covariance[(other, velocity)];
            }
            self.scale(velocity, decay);
            let cross = density_m2_s3 * 0.5 * integrated_decay_s * integrated_decay_s;
            let position_m2 = if exponent < 0.01 {
                // Series to second order: the closed form loses all digits for short steps.
                density_m2_s3 * step_s.powi(3) / 3.0 * (1.0 - 0.75 * exponent)
            } else {
                density_m2_s3 / rate.powi(3) * (exponent - 2.0 * (1.0 - decay) + 0.5 * (1.0 - decay * decay))
            };
            self.covariance[(position, position)] += position_m2;
            self.covariance[(velocity, velocity)] += density_m2_s3 * (1.0 - decay * decay) / (2.0 * rate);
            self.covariance[(position, velocity)] += cross;
            self.covariance[(velocity, position)] += cross;
        }
    }

    /// The part of the position's covariance that the camera's bias causes, m2, `P_pc P_pc'`: the error of an estimate
    /// that is linear in the measurements has the covariance `P_pc` with a bias of variance 1.
    pub(super) fn camera_share(&self) -> PlaneCovariance {
        let of = |state| {
            PlaneCovariance::outer(self.covariance[(POSITION, state)], self.covariance[(POSITION + 1, state)])
        };
        of(CAMERA_BIAS).plus(of(CAMERA_BIAS + 1))
    }

    /// Covariance of the position, m2, if all boxes shared one error: `M_p M_p'`.
    pub(super) fn lasting_error(&self) -> PlaneCovariance {
        let of = |column| {
            PlaneCovariance::outer(self.response[(POSITION, column)], self.response[(POSITION + 1, column)])
        };
        of(0).plus(of(1))
    }

    /// Sets a bias to 0 with a wide variance, uncorrelated with everything else.
    pub(super) fn reset_bias(&mut self, bias: usize) {
        for state in [bias, bias + 1] {
            self.scale(state, 0.0);
            self.covariance[(state, state)] = RESET_BIAS_SIGMAS * RESET_BIAS_SIGMAS;
        }
    }

    /// Innovation, its covariance `S = H P H' + white` and `P H'`, with `H = [I 0 .. L ..]`.
    pub(super) fn predict_measurement(
        &self,
        decomposition: &NoiseDecomposition,
        camera_scale: f64,
    ) -> PredictedMeasurement {
        // H applied to a vector over the states.
        let measured = |of: &dyn Fn(usize) -> f64| {
            let mut sum = [of(POSITION), of(POSITION + 1)];
            for ObservedBias { state, root_m: [east, north, east_north] } in decomposition.biases {
                sum[0] += east * of(state) + east_north * of(state + 1);
                sum[1] += east_north * of(state) + north * of(state + 1);
            }
            sum
        };
        let [east_m, north_m] = measured(&|state| self.mean[state]);
        let [root_east, root_north, root_east_north] = decomposition.lasting_root_m;
        let of_east = measured(&|state| self.response[(state, 0)]);
        let of_north = measured(&|state| self.response[(state, 1)]);
        let lasting = [
            [root_east - of_east[0], root_east_north - of_east[1]],
            [root_east_north - of_north[0], root_north - of_north[1]],
        ];
        let innovation = [decomposition.position.east_m - east_m, decomposition.position.north_m - north_m];
        let mut cross = SMatrix::<f64, STATES, 2>::zeros();
        for state in 0..STATES {
            let [east, north] = measured(&|column| self.covariance[(state, column)]);
            cross[(state, 0)] = east;
            cross[(state, 1)] = north;
        }
        let [east_m2, _] = measured(&|state| cross[(state, 0)]);
        let [east_north_m2, north_m2] = measured(&|state| cross[(state, 1)]);
        let predicted = PlaneCovariance { east_m2, north_m2, east_north_m2 };
        let innovation_covariance = predicted.plus(decomposition.white);
        let camera = [CAMERA_BIAS, CAMERA_BIAS + 1]
            .map(|state| PlaneCovariance::outer(cross[(state, 0)], cross[(state, 1)]));
        PredictedMeasurement {
            innovation,
            innovation_covariance,
            stated_covariance: innovation_covariance
                .plus(camera[0].plus(camera[1]).scaled(camera_scale - 1.0)),
            cross_covariance: cross,
            lasting,
        }
    }

    /// The Kalman update `K = P H' S^-1`. Returns the log-likelihood of the measurement without its
    /// constant, `-(d' S^-1 d + ln det S) / 2`.
    pub(super) fn update(&mut self, predicted: &PredictedMeasurement) -> f64 {
        let PredictedMeasurement {
            innovation, innovation_covariance, cross_covariance: cross, lasting, ..
        } = predicted;
        let determinant = innovation_covariance.determinant();
        let inverse = [
            innovation_covariance.north_m2 / determinant,
            innovation_covariance.east_m2 / determinant,
            -innovation_covariance.east_north_m2 / determinant,
        ];
        for state in 0..STATES {
            let (east, north) = (cross[(state, 0)], cross[(state, 1)]);
            let gain = [east * inverse[0] + north * inverse[2], east * inverse[2] + north * inverse[1]];
            self.mean[state] += gain[0] * innovation[0] + gain[1] * innovation[1];
            for (column, [east, north]) in lasting.iter().enumerate() {
                self.response[(state, column)] += gain[0] * east + gain[1] * north;
            }
            for other in 0..=state {
                let reduction = gain[0] * cross[(other, 0)] + gain[1] * cross[(other, 1)];
                let value = self.covariance[(state, other)] - reduction;
                self.covariance[(state, other)] = value;
                self.covariance[(other, state)] = value;
            }
        }
        let innovation = EastNorth { east_m: innovation[0], north_m: innovation[1] };
        -0.5 * (innovation_covariance.mahalanobis_squared(innovation) + determinant.ln())
    }
}
