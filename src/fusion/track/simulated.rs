//! A seeded walker with a phone and a camera, for tests of this floor alone.

use jiff::{SignedDuration, Timestamp};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::{GnssNoise, Measured, Measurement, RegressionNoise};
use crate::geo::EastNorth;

/// Seeded normal deviates.
pub(in crate::fusion) struct Normal(pub(in crate::fusion) ChaCha8Rng);

impl Normal {
    pub(in crate::fusion) fn seeded(seed: u64) -> Self {
        Self(ChaCha8Rng::seed_from_u64(seed))
    }

    pub(in crate::fusion) fn draw(&mut self) -> f64 {
        let (first, second): (f64, f64) = (self.0.random(), self.0.random());
        (-2.0 * (1.0 - first).ln()).sqrt() * (std::f64::consts::TAU * second).cos()
    }

    pub(in crate::fusion) fn pair(&mut self) -> [f64; 2] {
        [self.draw(), self.draw()]
    }
}

/// What is to be simulated; sigmas per axis.
#[derive(Clone, Copy)]
pub(in crate::fusion) struct World {
    pub(in crate::fusion) gnss_sigma_m: f64,
    pub(in crate::fusion) gnss: GnssNoise,
    pub(in crate::fusion) camera_sigma_m: f64,
    pub(in crate::fusion) regression: RegressionNoise,
    pub(in crate::fusion) speed_m_s: f64,
    /// Seconds between turns of a random angle.
    pub(in crate::fusion) turn_s: u32,
    /// Sharpest acceleration to the side, m/s2.
    pub(in crate::fusion) turn_m_s2: f64,
}

impl World {
    pub(in crate::fusion) fn phone() -> Self {
        Self {
            gnss_sigma_m: 2.2,
            gnss: GnssNoise::default(),
            camera_sigma_m: 0.9,
            regression: RegressionNoise::default(),
            speed_m_s: 1.3,
            turn_s: 25,
            turn_m_s2: 3.0,
        }
    }

    /// One measurement a second, with the truth.
    pub(in crate::fusion) fn walk(&self, seed: u64, seconds: u32) -> Vec<(EastNorth, Measurement)> {
        let mut random = Normal::seeded(seed);
        let (mut place, mut heading, mut wanted) = ([0.0; 2], 0.0_f64, 0.0_f64);
        let sharpest = self.turn_m_s2 / self.speed_m_s.max(0.1);
        let (mut gnss_bias, mut camera_bias) = (random.pair(), random.pair());
        let gnss_keep = (-1.0 / self.gnss.time_constant_s).exp();
        let camera_rate = 1.0 / self.regression.time_constant_s + self.speed_m_s / self.regression.length_m;
        let camera_keep = (-camera_rate).exp();
        (0..seconds)
            .map(|second| {
                if second % self.turn_s == 0 {
                    wanted = random.0.random::<f64>() * std::f64::consts::TAU;
                }
                heading += (wanted - heading).clamp(-sharpest, sharpest);
                place[0] += self.speed_m_s * heading.cos();
                place[1] += self.speed_m_s * heading.sin();
                fade(&mut gnss_bias, gnss_keep, &mut random);
                fade(&mut camera_bias, camera_keep, &mut random);
                let fix = seen(place, gnss_bias, self.gnss_sigma_m, self.gnss.white_share, &mut random);
                let regressed =
                    seen(place, camera_bias, self.camera_sigma_m, self.regression.white_share, &mut random);
                let truth = EastNorth { east_m: place[0], north_m: place[1] };
                (
                    truth,
                    Measurement { time: at_s(f64::from(second)), fix: Some(fix), regressed: Some(regressed) },
                )
            })
            .collect()
    }
}

fn fade(bias: &mut [f64; 2], keep: f64, random: &mut Normal) {
    for value in bias {
        *value = keep * *value + (1.0 - keep * keep).sqrt() * random.draw();
    }
}

fn seen(place: [f64; 2], bias: [f64; 2], sigma_m: f64, white_share: f64, random: &mut Normal) -> Measured {
    let mut axis = |index: usize| {
        place[index]
            + sigma_m * ((1.0 - white_share).sqrt() * bias[index] + white_share.sqrt() * random.draw())
    };
    Measured::isotropic(EastNorth { east_m: axis(0), north_m: axis(1) }, sigma_m * sigma_m)
}

/// An instant so many seconds into the simulation.
pub(in crate::fusion) fn at_s(seconds: f64) -> Timestamp {
    Timestamp::UNIX_EPOCH + SignedDuration::from_secs(1_600_000_000) + SignedDuration::from_secs_f64(seconds)
}
