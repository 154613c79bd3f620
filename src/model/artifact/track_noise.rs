//! How the errors of receiver and model are correlated over time and ground, for tracks: scalars of a
//! model's metadata.

use std::collections::BTreeMap;

use super::ModelParts;
use crate::domain::Result;

/// Autocorrelation of the errors of receiver and model, whose variances are stated elsewhere.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TrackNoiseModel {
    /// White share of the receiver's error variance, 0 to 1; the rest is a Gauss-Markov process.
    pub gnss_white_share: f64,
    /// Time in which the correlation of that process falls to 1/e, s.
    pub gnss_time_constant_s: f64,
    /// White share of the model's error variance, 0 to 1; the rest is a Gauss-Markov process of time and
    /// distance.
    pub regression_white_share: f64,
    /// Time in which the correlation of that process falls to 1/e for a stationary target, s.
    pub regression_time_constant_s: f64,
    /// Distance over which it falls to 1/e, m.
    pub regression_length_m: f64,
}

const NAMES: [&str; 5] = [
    "track_gnss_white_share",
    "track_gnss_time_constant_s",
    "track_regression_white_share",
    "track_regression_time_constant_s",
    "track_regression_length_m",
];

impl TrackNoiseModel {
    /// Adds the scalars to a model's metadata.
    pub fn write(&self, parameters: &mut BTreeMap<String, f64>) {
        let values = [
            self.gnss_white_share,
            self.gnss_time_constant_s,
            self.regression_white_share,
            self.regression_time_constant_s,
            self.regression_length_m,
        ];
        parameters.extend(NAMES.map(str::to_owned).into_iter().zip(values));
    }

    /// The scalars of a model's metadata; `None` in an earlier format, which has none of them.
    ///
    /// # Errors
    /// Names the parameter that is not finite or out of range, or missing although others are there.
    pub(crate) fn read(parts: &ModelParts) -> Result<Option<Self>> {
        if !NAMES.iter().any(|name| parts.parameters.contains_key(*name)) {
            return Ok(None);
        }
        Ok(Some(Self {
            gnss_white_share: parts.parameter(NAMES[0])?.clamp(0.0, 1.0),
            gnss_time_constant_s: parts.positive_parameter(NAMES[1])?,
            regression_white_share: parts.parameter(NAMES[2])?.clamp(0.0, 1.0),
            regression_time_constant_s: parts.positive_parameter(NAMES[3])?,
            regression_length_m: parts.positive_parameter(NAMES[4])?,
        }))
    }
}
