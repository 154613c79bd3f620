//! The correlation of the errors of receiver and model over time and ground, for tracks: scalars of a
//! model's metadata.

use super::ModelParts;
use crate::domain::{NoiseCorrelation, Result, SessionBias};

/// Correlation of the errors of receiver and model, whose variances are stated elsewhere.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TrackNoiseModel {
    /// The noise of the receiver's error besides its bias of the session.
    pub gnss: NoiseCorrelation,
    /// The part of the receiver's error that lasts for a session.
    pub gnss_session: SessionBias,
    /// The noise of the model's error while the target is stationary.
    pub regression: NoiseCorrelation,
    /// Radius of the scene, m: the unit of the distance over which the model's error decorrelates.
    pub regression_length_m: f64,
}

/// Least white share of a receiver's error: below it a filter would attribute every change of the bias to the
/// target's motion, and fixes cannot distinguish smaller values.
pub(crate) const LEAST_GNSS_WHITE_SHARE: f64 = 0.01;

const NAMES: [&str; 7] = [
    "track_gnss_white_share",
    "track_gnss_time_constant_s",
    "track_gnss_session_share",
    "track_gnss_session_time_constant_s",
    "track_regression_white_share",
    "track_regression_time_constant_s",
    "track_regression_length_m",
];

impl TrackNoiseModel {
    /// Adds the scalars to the parts of a model.
    pub(crate) fn put(&self, parts: &mut ModelParts) {
        let values = [
            self.gnss.white_share,
            self.gnss.time_constant_s,
            self.gnss_session.share,
            self.gnss_session.time_constant_s,
            self.regression.white_share,
            self.regression.time_constant_s,
            self.regression_length_m,
        ];
        for (name, value) in NAMES.into_iter().zip(values) {
            parts.set(name, value);
        }
    }

    /// The scalars of a model's metadata; `None` before they are estimated.
    ///
    /// # Errors
    /// Names the parameter that is not finite or out of range, or missing although others are there.
    pub(crate) fn read(parts: &ModelParts) -> Result<Option<Self>> {
        if !NAMES.iter().any(|name| parts.parameters.contains_key(*name)) {
            return Ok(None);
        }
        let [
            gnss_share,
            gnss_constant,
            session_share,
            session_constant,
            regression_share,
            regression_constant,
            regression_length,
        ] = NAMES;
        Ok(Some(Self {
            gnss: NoiseCorrelation {
                white_share: parts.parameter(gnss_share)?.clamp(LEAST_GNSS_WHITE_SHARE, 1.0),
                time_constant_s: parts.positive_parameter(gnss_constant)?,
            },
            gnss_session: SessionBias {
                share: parts.parameter(session_share)?.clamp(0.0, 1.0),
                time_constant_s: parts.positive_parameter(session_constant)?,
            },
            regression: NoiseCorrelation {
                white_share: parts.parameter(regression_share)?.clamp(0.0, 1.0),
                time_constant_s: parts.positive_parameter(regression_constant)?,
            },
            regression_length_m: parts.positive_parameter(regression_length)?,
        }))
    }
}
