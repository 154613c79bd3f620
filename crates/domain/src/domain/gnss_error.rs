//! The error of a GNSS receiver.

use super::error::{Error, Result};

/// A standard deviation per horizontal axis in metres, from 1 mm to 10 km.
#[derive(Debug, Clone, Copy, PartialEq, PartialOrd)]
pub struct SigmaM(f64);

impl SigmaM {
    /// Least standard deviation, m.
    pub const LEAST_M: f64 = 0.001;
    /// Largest standard deviation, m.
    pub const LARGEST_M: f64 = 10_000.0;

    /// # Errors
    /// Refuses what is not a finite number from 0.001 to 10,000 m; the field is named `sigma_m`.
    pub fn new(sigma_m: f64) -> Result<Self> {
        if (Self::LEAST_M..=Self::LARGEST_M).contains(&sigma_m) {
            Ok(Self(sigma_m))
        } else {
            Err(Error::invalid("sigma_m", "must be a standard deviation from 0.001 to 10000 metres per axis"))
        }
    }

    /// The standard deviation, m.
    #[must_use]
    pub const fn metres(self) -> f64 {
        self.0
    }

    /// Variance per axis, m2.
    #[must_use]
    pub fn variance_m2(self) -> f64 {
        self.0 * self.0
    }
}

/// Standard deviation per horizontal axis of the bias that all fixes of a camera's training have in common
/// (the session bias of the only receiver, or what several receivers share), m. No sample shows it.
#[derive(Debug, Clone, Copy, PartialEq, PartialOrd)]
pub struct GnssBiasSigma(f64);

impl GnssBiasSigma {
    /// # Errors
    /// Refuses what is not a finite number above 0 and up to 100 m; the field is named `gnss_bias_sigma_m`.
    pub fn new(sigma_m: f64) -> Result<Self> {
        if sigma_m > 0.0 && sigma_m <= 100.0 {
            Ok(Self(sigma_m))
        } else {
            Err(Error::invalid(
                "gnss_bias_sigma_m",
                "must be a standard deviation above 0 and up to 100 metres per axis",
            ))
        }
    }

    /// The standard deviation, m.
    #[must_use]
    pub const fn metres(self) -> f64 {
        self.0
    }
}

/// The receivers' error in a camera's profile.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub enum GnssError {
    /// Standard deviation per axis, from the data sheet or from many fixes at one fixed point.
    Known(SigmaM),
    /// Estimated from the training samples.
    #[default]
    Unknown,
}
