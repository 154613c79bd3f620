//! What a track believes of receivers, cameras and targets. Every number here is a belief about the
//! world, none is a limit of the machine but the last three.

/// How a receiver's error, of a known variance, is spread over time.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GnssNoise {
    /// Share of the variance that is new with every fix, 0 to 1. The rest is a bias.
    pub white_share: f64,
    /// Seconds after which the bias keeps 1/e of itself (first-order Gauss-Markov).
    pub time_constant_s: f64,
}

/// A white share below this is beyond what fixes can tell, and a filter that believed it would take
/// every motion of the bias for the target's.
pub(super) const SMALLEST_WHITE_SHARE: f64 = 0.01;

impl Default for GnssNoise {
    /// A phone in the open: almost all of the error is a bias of about 40 s.
    fn default() -> Self {
        Self { white_share: 0.02, time_constant_s: 40.0 }
    }
}

/// How a regressed position's error, of a known variance, is spread over time and ground.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RegressionNoise {
    /// Share of the variance that is new with every box, 0 to 1. The rest is the model's bias.
    pub white_share: f64,
    /// Seconds after which the bias keeps 1/e of itself while the target stands.
    pub time_constant_s: f64,
    /// Metres walked after which the bias keeps 1/e of itself: the model errs by place.
    pub length_m: f64,
    /// Boxes nearer in time than this share their white error (gait, detector), so that 25 boxes
    /// a second tell no more than 1 / `jitter_s` independent ones would.
    pub jitter_s: f64,
}

impl Default for RegressionNoise {
    fn default() -> Self {
        Self { white_share: 0.3, time_constant_s: 300.0, length_m: 10.0, jitter_s: 0.5 }
    }
}

/// How targets move. Three ways are followed side by side (interacting multiple models): standing,
/// going steadily, and turning or starting. How sharply a target turns is scaled by how fast it was
/// seen to go, so that the same settings serve walkers and vehicles, and the stated error of a walker
/// who is out of sight does not grow like a car's.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Motion {
    /// Random walk of a standing target's position, m2/s.
    pub still_m2_s: f64,
    /// Acceleration density of steady going, m2/s3.
    pub steady_m2_s3: f64,
    /// Seconds after which a steady velocity keeps 1/e of itself when nothing is measured.
    pub steady_time_constant_s: f64,
    /// The same for a target that turns or starts; its velocity then spreads to its own speed.
    pub agile_time_constant_s: f64,
    /// Every target is believed to be able to go this fast, per axis, m/s.
    pub least_speed_m_s: f64,
    /// Seconds after which half of a speed that was reached is forgotten.
    pub speed_memory_s: f64,
    /// Mean stay in each way of moving, s: still, steady, agile.
    pub stay_s: [f64; 3],
    /// Standard deviation per axis of the unknown first velocity, m/s.
    pub first_speed_m_s: f64,
}

impl Default for Motion {
    fn default() -> Self {
        Self {
            still_m2_s: 1e-4,
            steady_m2_s3: 0.05,
            steady_time_constant_s: 60.0,
            agile_time_constant_s: 5.0,
            least_speed_m_s: 1.5,
            speed_memory_s: 120.0,
            stay_s: [30.0, 20.0, 5.0],
            first_speed_m_s: 10.0,
        }
    }
}

/// All of it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TrackSettings {
    /// The receiver.
    pub gnss: GnssNoise,
    /// The camera's model.
    pub regression: RegressionNoise,
    /// The target.
    pub motion: Motion,
    /// A measurement is rejected beyond this squared Mahalanobis length (chi-square, 2 degrees).
    pub gate: f64,
    /// A source that was rejected without a break for this long, s, and at least five times, is
    /// believed again: its bias has jumped.
    pub reopen_after_s: f64,
    /// Items that come late by at most this long, s, take their place in time.
    pub window_s: f64,
    /// At most so many items are kept for that; busy streams have a shorter window instead.
    pub window_items: usize,
    /// A target that was not measured for this long, s, is gone.
    pub time_to_live_s: f64,
}

impl Default for TrackSettings {
    fn default() -> Self {
        Self {
            gnss: GnssNoise::default(),
            regression: RegressionNoise::default(),
            motion: Motion::default(),
            // One good measurement in 2,000 is lost.
            gate: 15.2,
            reopen_after_s: 3.0,
            window_s: 3.0,
            window_items: 128,
            time_to_live_s: 60.0,
        }
    }
}
