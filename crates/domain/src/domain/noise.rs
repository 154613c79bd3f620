//! The noise of a sensor over time.
//!
//! Noise is modelled per axis as the sum of white noise and a first-order Gauss-Markov process
//! (Ornstein-Uhlenbeck process; Bar-Shalom, Li and Kirubarajan 2001, 8.2).

/// The autocorrelation of such noise, whose variance is known otherwise: at a lag `t` (s) it is
/// `white_share * [t = 0] + (1 - white_share) * exp(-|t| / time_constant_s)`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct NoiseCorrelation {
    /// Share of the variance that is white, 0 to 1; the rest is the Gauss-Markov process.
    pub white_share: f64,
    /// Time in which the correlation of the Gauss-Markov process falls to 1/e, s.
    pub time_constant_s: f64,
}

impl NoiseCorrelation {
    /// White noise; its time constant has no effect.
    pub const WHITE: Self = Self { white_share: 1.0, time_constant_s: 1.0 };
    /// A phone's GNSS receiver in the open: nearly all of the error is a bias with a time constant of
    /// about 40 s.
    pub const PHONE: Self = Self { white_share: 0.02, time_constant_s: 40.0 };

    /// Correlation of the Gauss-Markov process over a lag, s: the factor by which its prediction decays.
    #[must_use]
    pub fn decay(&self, seconds: f64) -> f64 {
        (-seconds / self.time_constant_s).exp()
    }
}

/// The part of a receiver's error that lasts for a session: atmosphere, satellites, the way that it is carried.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SessionBias {
    /// Share of the error variance of a fix, 0 to 1.
    pub share: f64,
    /// Time in which its correlation falls to 1/e, s.
    pub time_constant_s: f64,
}

impl SessionBias {
    /// An hour, where nothing else is known.
    pub const DEFAULT_TIME_CONSTANT_S: f64 = 3_600.0;
}

/// Zero-mean noise per axis with its variance.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GaussMarkovNoise {
    /// Variance of the sum, m2.
    pub variance_m2: f64,
    /// How it is correlated over time.
    pub correlation: NoiseCorrelation,
}

impl GaussMarkovNoise {
    /// The error of an unknown receiver, a phone in the open: 2.6 m per axis, most of it over half a minute.
    pub const PHONE: Self = Self {
        variance_m2: 2.61 * 2.61,
        correlation: NoiseCorrelation { white_share: 0.083, time_constant_s: 30.0 },
    };

    /// Noise of a standard deviation per axis (m) and its correlation.
    #[must_use]
    pub fn new(sigma_m: f64, correlation: NoiseCorrelation) -> Self {
        Self { variance_m2: sigma_m * sigma_m, correlation }
    }

    /// White noise of a variance (m2).
    #[must_use]
    pub const fn white(variance_m2: f64) -> Self {
        Self { variance_m2, correlation: NoiseCorrelation::WHITE }
    }

    /// Variance of the white part, m2.
    #[must_use]
    pub const fn white_variance_m2(&self) -> f64 {
        self.variance_m2 * self.correlation.white_share
    }

    /// Variance of the Gauss-Markov part, m2.
    #[must_use]
    pub const fn coloured_variance_m2(&self) -> f64 {
        self.variance_m2 * (1.0 - self.correlation.white_share)
    }

    /// Standard deviation of the white part, m.
    #[must_use]
    pub fn white_sigma_m(&self) -> f64 {
        self.white_variance_m2().sqrt()
    }

    /// Standard deviation of the Gauss-Markov part, m.
    #[must_use]
    pub fn coloured_sigma_m(&self) -> f64 {
        self.coloured_variance_m2().sqrt()
    }

    /// The same noise with at least this much white variance, m2.
    #[must_use]
    pub const fn with_white_at_least(self, least_m2: f64) -> Self {
        let white_m2 = self.white_variance_m2().max(least_m2);
        let variance_m2 = self.coloured_variance_m2() + white_m2;
        let correlation = NoiseCorrelation { white_share: white_m2 / variance_m2, ..self.correlation };
        Self { variance_m2, correlation }
    }
}
