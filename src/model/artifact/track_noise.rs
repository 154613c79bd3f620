//! What training shows of how errors stay, for tracks: numbers in a model's metadata, which the floor
//! above learns and uses.

use std::collections::BTreeMap;

use super::Parts;
use crate::domain::Result;

/// How the errors of receiver and model, of known variances, are spread over time and ground.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TrackBeliefs {
    /// Share of the receiver's variance that is new with each fix, 0 to 1; the rest stays for a while.
    pub gnss_white_share: f64,
    /// Time in which that rest's correlation falls to 1/e, s.
    pub gnss_time_constant_s: f64,
    /// Share of the model's variance that is new with each box, 0 to 1.
    pub regression_white_share: f64,
    /// Time in which the correlation of the rest falls to 1/e while the target stands, s.
    pub regression_time_constant_s: f64,
    /// Way in which it does, m.
    pub regression_length_m: f64,
}

const NAMES: [&str; 5] = [
    "track_gnss_white_share",
    "track_gnss_time_constant_s",
    "track_regression_white_share",
    "track_regression_time_constant_s",
    "track_regression_length_m",
];

impl TrackBeliefs {
    /// Writes them into a model's metadata.
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

    /// What a model's metadata says; nothing in models of before.
    ///
    /// # Errors
    /// Names the parameter that is missing beside others, not finite, or out of range.
    pub(crate) fn read(parts: &Parts) -> Result<Option<Self>> {
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
