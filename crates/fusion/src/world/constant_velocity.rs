//! An interacting-multiple-model filter of two constant-velocity modes (Bar-Shalom, Li and Kirubarajan 2001,
//! 6.2.2 and 11.6.6): state (east, north, east velocity, north velocity), white acceleration noise of a
//! different spectral density per mode.

use nalgebra::{Matrix2, Matrix4, Matrix4x2, Vector2, Vector4};

use super::settings::WorldTrackSettings;
use crate::domain::Velocity;
use crate::geo::{EastNorth, PlaneCovariance};
use crate::smoother::FilterMoments;

/// Probability below which a mode is not left, so that it can be entered again.
const LEAST_PROBABILITY: f64 = 1e-6;

/// Mean and covariance of one mode.
#[derive(Debug, Clone, Copy)]
struct Gaussian {
    mean: Vector4<f64>,
    covariance: Matrix4<f64>,
}

/// The filter of one target.
#[derive(Debug, Clone)]
pub(super) struct ConstantVelocityFilter {
    modes: [Gaussian; 2],
    mode_probabilities: [f64; 2],
    /// Standard deviation per axis of the velocity before anything is known, m/s.
    prior_speed_sigma_m_s: f64,
}

impl ConstantVelocityFilter {
    /// At a measured position, with a velocity about zero.
    pub(super) fn new(position: EastNorth, r: PlaneCovariance, speed_sigma_m_s: f64) -> Self {
        let mut covariance = Matrix4::zeros();
        covariance.fixed_view_mut::<2, 2>(0, 0).copy_from(&r.matrix_m2());
        covariance[(2, 2)] = speed_sigma_m_s * speed_sigma_m_s;
        covariance[(3, 3)] = speed_sigma_m_s * speed_sigma_m_s;
        let mean = Vector4::new(position.east_m, position.north_m, 0.0, 0.0);
        Self {
            modes: [Gaussian { mean, covariance }; 2],
            mode_probabilities: [0.5; 2],
            prior_speed_sigma_m_s: speed_sigma_m_s,
        }
    }

    /// Predicts over an interval (s).
    pub(super) fn predict(&mut self, seconds: f64, settings: &WorldTrackSettings) {
        if seconds <= 0.0 {
            return;
        }
        self.mix(0.5 * (1.0 - (-2.0 * seconds / settings.mode_sojourn_s).exp()));
        for (mode, noise_m2_s3) in self.modes.iter_mut().zip(settings.acceleration_noise_m2_s3) {
            mode.predict(seconds, noise_m2_s3);
        }
    }

    /// Mixes the modes before a prediction; `switching` is the probability that the mode changes.
    fn mix(&mut self, switching: f64) {
        let [p, q] = self.mode_probabilities;
        let predicted = [p * (1.0 - switching) + q * switching, p * switching + q * (1.0 - switching)];
        let mixed = |to: usize| {
            let stayed_or_switched = if to == 0 { 1.0 - switching } else { switching };
            let from_first = p * stayed_or_switched / predicted[to];
            moment_match(&self.modes, [from_first, 1.0 - from_first])
        };
        self.modes = [mixed(0), mixed(1)];
        self.mode_probabilities = predicted;
    }

    /// Takes a measured position in; `r` is the covariance of its error, m2.
    pub(super) fn update(&mut self, measured: EastNorth, r: PlaneCovariance) {
        let measured = Vector2::new(measured.east_m, measured.north_m);
        let log_likelihoods = [0, 1].map(|mode| self.modes[mode].update(measured, r.matrix_m2()));
        let largest = log_likelihoods[0].max(log_likelihoods[1]);
        let weights: [f64; 2] = std::array::from_fn(|mode| {
            (self.mode_probabilities[mode] * (log_likelihoods[mode] - largest).exp()).max(LEAST_PROBABILITY)
        });
        let sum = weights[0] + weights[1];
        self.mode_probabilities = weights.map(|weight| weight / sum);
    }

    /// Adds a covariance of the position (m2), as for an unknown constant error of its measurements so far.
    pub(super) fn inflate_position(&mut self, added: PlaneCovariance) {
        for mode in &mut self.modes {
            let mut position = mode.covariance.fixed_view_mut::<2, 2>(0, 0);
            position += added.matrix_m2();
        }
    }

    /// Position of the moment-matched state, m.
    pub(super) fn position(&self) -> EastNorth {
        let [east_m, north_m, ..] = self.mean();
        EastNorth { east_m, north_m }
    }

    /// Velocity of the moment-matched state.
    pub(super) fn velocity(&self) -> Velocity {
        let [.., east_m_s, north_m_s] = self.mean();
        Velocity { east_m_s, north_m_s }
    }

    /// Covariance of the moment-matched position, m2.
    pub(super) fn position_covariance(&self) -> PlaneCovariance {
        self.covariance_of(0)
    }

    /// Covariance of the moment-matched velocity, m2/s2.
    pub(super) fn velocity_covariance(&self) -> PlaneCovariance {
        self.covariance_of(2)
    }

    /// Probability that the target is stationary, 0 to 1.
    pub(super) fn stationary_probability(&self) -> f64 {
        self.velocity().stationary_probability(self.velocity_covariance(), self.prior_speed_sigma_m_s)
    }

    /// What a smoother needs besides.
    pub(super) fn moments(&self, settings: &WorldTrackSettings) -> FilterMoments {
        let noises = settings.acceleration_noise_m2_s3.iter().zip(self.mode_probabilities);
        FilterMoments {
            covariance: moment_match(&self.modes, self.mode_probabilities).covariance,
            acceleration_m2_s3: noises.map(|(noise, probability)| noise * probability).sum(),
        }
    }

    fn covariance_of(&self, first: usize) -> PlaneCovariance {
        let c = moment_match(&self.modes, self.mode_probabilities).covariance;
        let second = first + 1;
        PlaneCovariance {
            east_m2: c[(first, first)],
            north_m2: c[(second, second)],
            east_north_m2: c[(first, second)],
        }
    }

    fn mean(&self) -> [f64; 4] {
        let [p, q] = self.mode_probabilities;
        (self.modes[0].mean * p + self.modes[1].mean * q).into()
    }
}

impl Gaussian {
    fn predict(&mut self, t: f64, noise_m2_s3: f64) {
        let Self { mean, covariance: p } = self;
        mean[0] += t * mean[2];
        mean[1] += t * mean[3];
        // F P F' of the transition [I tI; 0 I] by rows, then by columns.
        for axis in 0..2 {
            for column in 0..4 {
                p[(axis, column)] += t * p[(axis + 2, column)];
            }
        }
        for axis in 0..2 {
            for row in 0..4 {
                p[(row, axis)] += t * p[(row, axis + 2)];
            }
        }
        for axis in 0..2 {
            p[(axis, axis)] += noise_m2_s3 * t * t * t / 3.0;
            p[(axis, axis + 2)] += noise_m2_s3 * t * t / 2.0;
            p[(axis + 2, axis)] += noise_m2_s3 * t * t / 2.0;
            p[(axis + 2, axis + 2)] += noise_m2_s3 * t;
        }
    }

    /// Kalman update in Joseph's form; returns the log-likelihood of the measurement but for a constant.
    fn update(&mut self, measured: Vector2<f64>, r: Matrix2<f64>) -> f64 {
        let innovation = measured - self.mean.fixed_rows::<2>(0);
        let s: Matrix2<f64> = self.covariance.fixed_view::<2, 2>(0, 0) + r;
        let Some(inverse) = s.try_inverse() else { return 0.0 };
        let gain: Matrix4x2<f64> = self.covariance.fixed_view::<4, 2>(0, 0) * inverse;
        self.mean += gain * innovation;
        let mut remaining = Matrix4::identity();
        let mut position_columns = remaining.fixed_view_mut::<4, 2>(0, 0);
        position_columns -= gain;
        self.covariance = remaining * self.covariance * remaining.transpose() + gain * r * gain.transpose();
        -0.5 * (innovation.dot(&(inverse * innovation)) + s.determinant().ln())
    }
}

fn moment_match(modes: &[Gaussian; 2], weights: [f64; 2]) -> Gaussian {
    let [p, q] = weights;
    let mean = modes[0].mean * p + modes[1].mean * q;
    let apart = modes[0].mean - modes[1].mean;
    let covariance = modes[0].covariance * p + modes[1].covariance * q + apart * apart.transpose() * (p * q);
    Gaussian { mean, covariance }
}
