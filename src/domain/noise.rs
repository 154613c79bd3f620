//! The noise of a sensor over time.

/// Zero-mean noise per axis: the sum of white noise and of a first-order Gauss-Markov process
/// (Ornstein-Uhlenbeck process; Bar-Shalom, Li and Kirubarajan 2001, 8.2).
///
/// Its autocovariance at a lag `t` (s) is
/// `variance_m2 * (white_share * [t = 0] + (1 - white_share) * exp(-|t| / time_constant_s))`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GaussMarkovNoise {
    /// Variance of the sum, m2.
    pub variance_m2: f64,
    /// Share of the variance that is white, 0 to 1.
    pub white_share: f64,
    /// Time in which the correlation of the Gauss-Markov part falls to 1/e, s.
    pub time_constant_s: f64,
}

impl GaussMarkovNoise {
    /// White noise of a variance (m2); its time constant has no effect.
    #[must_use]
    pub const fn white(variance_m2: f64) -> Self {
        Self { variance_m2, white_share: 1.0, time_constant_s: 1.0 }
    }

    /// Variance of the white part, m2.
    #[must_use]
    pub const fn white_variance_m2(&self) -> f64 {
        self.variance_m2 * self.white_share
    }

    /// Variance of the Gauss-Markov part, m2.
    #[must_use]
    pub const fn coloured_variance_m2(&self) -> f64 {
        self.variance_m2 * (1.0 - self.white_share)
    }

    /// Correlation of the Gauss-Markov part over a lag, s: the factor by which its prediction decays.
    #[must_use]
    pub fn decay(&self, seconds: f64) -> f64 {
        (-seconds / self.time_constant_s).exp()
    }

    /// The same noise with at least this much white variance, m2.
    #[must_use]
    pub const fn with_white_at_least(self, least_m2: f64) -> Self {
        let white_m2 = self.white_variance_m2().max(least_m2);
        let variance_m2 = self.coloured_variance_m2() + white_m2;
        Self { variance_m2, white_share: white_m2 / variance_m2, ..self }
    }
}
