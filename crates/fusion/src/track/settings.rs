//! Noise, motion and window parameters of a track.

use super::measurement::MeasurementSource;
use crate::domain::{NoiseCorrelation, SessionBias};
use crate::model::Regressor;

/// Correlation length of the error of a camera's model, in radii of its scene (three standard deviations of the training
/// positions): most of the error is one shift or scale of the whole scene. Chosen from 0.3 to 100 on the simulated worlds
/// from seed 901 on (docs/explanation/method.md, "Tracking").
const LENGTH_PER_SCENE_RADIUS: f64 = 4.0;

/// Correlation in time and space of a regressed position's error, whose variance is known.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RegressionNoise {
    /// Correlation over time while the target is stationary; the Gauss-Markov part is the bias of the
    /// camera's model.
    pub correlation: NoiseCorrelation,
    /// Travelled distance over which the bias decorrelates to 1/e, m: the model's error depends on
    /// the place.
    pub correlation_length_m: f64,
    /// Correlation time of the white part (gait, detector), s: boxes closer in time share one error,
    /// so 25 boxes per second carry no more information than `1 / detector_correlation_s`
    /// independent ones.
    pub detector_correlation_s: f64,
}

impl Default for RegressionNoise {
    fn default() -> Self {
        Self {
            correlation: NoiseCorrelation { white_share: 0.3, time_constant_s: 300.0 },
            correlation_length_m: 10.0,
            detector_correlation_s: 0.5,
        }
    }
}

/// Motion model with the modes stationary, steady and agile (see [`super::Track`]). The process noise
/// of the agile mode scales with the speed that the target was observed at, so that one set of
/// parameters serves pedestrians and vehicles, and the predicted error of a pedestrian does not grow
/// like that of a car.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MotionModel {
    /// Stationary: density of the position's random walk, m2/s.
    pub stationary_m2_s: f64,
    /// Steady: spectral density of the white acceleration, m2/s3.
    pub steady_m2_s3: f64,
    /// Steady: time constant of the velocity, s.
    pub steady_time_constant_s: f64,
    /// Agile: time constant of the velocity, s; its stationary variance is the squared speed envelope.
    pub agile_time_constant_s: f64,
    /// Lower bound of the speed envelope, m/s per axis.
    pub min_speed_m_s: f64,
    /// Half-life of the squared speed envelope, s.
    pub speed_half_life_s: f64,
    /// Mean sojourn time in each mode, s: stationary, steady, agile.
    pub sojourn_s: [f64; 3],
    /// Standard deviation per axis of the velocity before anything is known, m/s.
    pub initial_speed_sigma_m_s: f64,
}

impl Default for MotionModel {
    fn default() -> Self {
        Self {
            stationary_m2_s: 1e-4,
            steady_m2_s3: 0.05,
            steady_time_constant_s: 1_000.0,
            agile_time_constant_s: 5.0,
            min_speed_m_s: 1.5,
            speed_half_life_s: 120.0,
            sojourn_s: [30.0, 20.0, 5.0],
            initial_speed_sigma_m_s: 20.0,
        }
    }
}

/// All parameters of a track.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TrackSettings {
    /// Noise of the receiver beside its bias of the session.
    pub gnss: NoiseCorrelation,
    /// Its bias of the session.
    pub gnss_session: SessionBias,
    /// Noise of the camera's model.
    pub regression: RegressionNoise,
    /// Motion of the target.
    pub motion: MotionModel,
    /// Gate on the normalised innovation squared (chi-square, 2 degrees of freedom).
    pub gate: f64,
    /// A source is reacquired after at least five consecutive rejections over at least this time, s.
    pub reacquire_after_s: f64,
    /// Boxes are frozen that have been the same to the pixel for this long, s.
    pub frozen_after_s: f64,
    /// Largest delay of an out-of-sequence measurement, s.
    pub window_s: f64,
    /// Largest number of measurements in that window; at high rates the window is shorter.
    pub window_items: usize,
    /// A target is expired once it was not measured for longer than this, s.
    pub time_to_live_s: f64,
}

impl Default for TrackSettings {
    fn default() -> Self {
        Self {
            gnss: NoiseCorrelation::PHONE,
            gnss_session: SessionBias { share: 0.0, time_constant_s: SessionBias::DEFAULT_TIME_CONSTANT_S },
            regression: RegressionNoise::default(),
            motion: MotionModel::default(),
            // Rejects one consistent measurement in 2,000.
            gate: 15.2,
            reacquire_after_s: 3.0,
            frozen_after_s: f64::INFINITY,
            window_s: 3.0,
            window_items: 128,
            time_to_live_s: 60.0,
        }
    }
}

impl TrackSettings {
    /// White share of the error variance of a source's positions, 0 to 1, where they do not state it.
    pub(super) fn white_share(&self, source: MeasurementSource) -> f64 {
        match source {
            MeasurementSource::Fix => self.gnss.white_share * (1.0 - self.gnss_session.share),
            MeasurementSource::Regressed => self.regression.correlation.white_share,
        }
    }

    /// The settings with the noise model that was estimated with a camera's model; the defaults for a model
    /// of an earlier format without it.
    #[must_use]
    pub fn from_model(regressor: &Regressor) -> Self {
        let Some(noise) = regressor.track_noise() else { return Self::default() };
        Self {
            gnss: noise.gnss,
            gnss_session: noise.gnss_session,
            regression: RegressionNoise {
                correlation: noise.regression,
                correlation_length_m: LENGTH_PER_SCENE_RADIUS * noise.regression_length_m,
                ..RegressionNoise::default()
            },
            frozen_after_s: regressor.frozen_after_s(),
            ..Self::default()
        }
    }
}
