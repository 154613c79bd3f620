//! Positions without boxes: targets in the local plane whose fixes and regressed positions have
//! errors of known statistics. For tests of what works on positions alone.

use std::f64::consts::TAU;

use jiff::{SignedDuration, Timestamp};
use rand::RngExt;
use rand_chacha::ChaCha8Rng;

use super::noise::{GaussMarkov, standard_normal, stream};
use crate::domain::{GaussMarkovNoise, NoiseCorrelation};
use crate::geo::EastNorth;

/// True, received and regressed position of one instant.
#[derive(Debug, Clone, Copy)]
pub struct SimulatedPositions {
    /// The instant.
    pub time: Timestamp,
    /// Where the target is.
    pub truth: EastNorth,
    /// Where its receiver says that it is.
    pub fix: EastNorth,
    /// Where a model says that it is.
    pub regressed: EastNorth,
}

/// One target that walks at constant speed and turns at random, a measurement per second.
#[derive(Debug, Clone, Copy)]
pub struct Walk {
    /// Error of the receiver.
    pub gnss: GaussMarkovNoise,
    /// Error of the model.
    pub regression: GaussMarkovNoise,
    /// Distance over which the regression's bias decorrelates to 1/e, m.
    pub regression_length_m: f64,
    /// Speed, m/s.
    pub speed_m_s: f64,
    /// Interval between choices of a new heading, s.
    pub turn_interval_s: u32,
    /// Largest lateral acceleration, m/s2.
    pub max_lateral_m_s2: f64,
}

impl Walk {
    /// A pedestrian with a phone.
    #[must_use]
    pub fn pedestrian() -> Self {
        Self {
            gnss: GaussMarkovNoise::new(2.2, NoiseCorrelation::PHONE),
            regression: GaussMarkovNoise::new(
                0.9,
                NoiseCorrelation { white_share: 0.3, time_constant_s: 300.0 },
            ),
            regression_length_m: 10.0,
            speed_m_s: 1.3,
            turn_interval_s: 25,
            max_lateral_m_s2: 3.0,
        }
    }

    /// Positions at 0, 1, 2 ... s after [`at_s`]`(0.0)`.
    #[must_use]
    pub fn simulate(&self, seed: u64, seconds: u32) -> Vec<SimulatedPositions> {
        let mut random = stream(seed, 0);
        let (mut place, mut heading_rad, mut wanted_rad) = ([0.0; 2], 0.0_f64, 0.0_f64);
        let max_turn_rad = self.max_lateral_m_s2 / self.speed_m_s.max(0.1);
        let regression_rate =
            1.0 / self.regression.correlation.time_constant_s + self.speed_m_s / self.regression_length_m;
        let mut gnss_bias = bias_pair(self.gnss.correlation.time_constant_s, &mut random);
        let mut regression_bias = bias_pair(1.0 / regression_rate, &mut random);
        (0..seconds)
            .map(|second| {
                if second % self.turn_interval_s == 0 {
                    wanted_rad = random.random::<f64>() * TAU;
                }
                heading_rad += (wanted_rad - heading_rad).clamp(-max_turn_rad, max_turn_rad);
                place[0] += self.speed_m_s * heading_rad.cos();
                place[1] += self.speed_m_s * heading_rad.sin();
                let gnss = advance(&mut gnss_bias, &mut random);
                let regression = advance(&mut regression_bias, &mut random);
                SimulatedPositions {
                    time: at_s(f64::from(second)),
                    truth: EastNorth { east_m: place[0], north_m: place[1] },
                    fix: measure(&self.gnss, place, gnss, &mut random),
                    regressed: measure(&self.regression, place, regression, &mut random),
                }
            })
            .collect()
    }
}

/// A place with that noise; `bias` is the Gauss-Markov part in units of its standard deviation.
fn measure(noise: &GaussMarkovNoise, place: [f64; 2], bias: [f64; 2], random: &mut ChaCha8Rng) -> EastNorth {
    let [east_m, north_m] = [0, 1].map(|axis| {
        place[axis] + noise.coloured_sigma_m() * bias[axis] + noise.white_sigma_m() * standard_normal(random)
    });
    EastNorth { east_m, north_m }
}

/// Standard deviation per axis of the fixes of [`SiteVisits`], m.
pub const VISIT_GNSS_SIGMA_M: f64 = 2.2;
/// Standard deviation per axis of the regressed positions of [`SiteVisits`], m.
pub const VISIT_MODEL_SIGMA_M: f64 = 0.8;

/// Visits of several receivers to an area of 30 to 80 m before a camera at the origin that looks
/// north. Beside the biases of tens of seconds there are errors that change every hour, one common to
/// all receivers and one of each, and an error of the model that depends on the place.
pub struct SiteVisits {
    random: ChaCha8Rng,
    common_m: [f64; 2],
    receivers_m: Vec<[f64; 2]>,
    hour: i64,
    model_phases: [f64; 4],
}

impl SiteVisits {
    /// Visits by that number of receivers, drawn from a seed.
    #[must_use]
    pub fn new(seed: u64, receivers: usize) -> Self {
        let mut random = stream(seed, 0);
        let model_phases = std::array::from_fn(|_| standard_normal(&mut random));
        Self { random, common_m: [0.0; 2], receivers_m: vec![[0.0; 2]; receivers], hour: -1, model_phases }
    }

    /// Number of receivers.
    #[must_use]
    pub fn receivers(&self) -> usize {
        self.receivers_m.len()
    }

    /// One visit of five minutes, walking or stationary; `pan_rad` is the camera's rotation since its
    /// model was trained.
    pub fn visit(
        &mut self,
        receiver: usize,
        begin_s: f64,
        pan_rad: f64,
        walks: bool,
    ) -> Vec<SimulatedPositions> {
        self.draw_hourly_errors(begin_s);
        let mut place = [25.0 * self.draw().sin(), 55.0 + 25.0 * self.draw().sin()];
        let mut heading_rad = self.draw();
        let mut bias = bias_pair(40.0, &mut self.random);
        (0..300)
            .map(|second| {
                if walks {
                    heading_rad += 0.2 * self.draw();
                    place[0] = (place[0] + 1.2 * heading_rad.cos()).clamp(-25.0, 25.0);
                    place[1] = (place[1] + 1.2 * heading_rad.sin()).clamp(30.0, 80.0);
                }
                let bias = advance(&mut bias, &mut self.random);
                let hourly_m = [0, 1].map(|axis| self.common_m[axis] + self.receivers_m[receiver][axis]);
                let fix = [0, 1].map(|axis| place[axis] + VISIT_GNSS_SIGMA_M * bias[axis] + hourly_m[axis]);
                SimulatedPositions {
                    time: at_s(begin_s + f64::from(second)),
                    truth: EastNorth { east_m: place[0], north_m: place[1] },
                    fix: EastNorth { east_m: fix[0], north_m: fix[1] },
                    regressed: self.regressed(place, pan_rad),
                }
            })
            .collect()
    }

    fn draw(&mut self) -> f64 {
        standard_normal(&mut self.random)
    }

    fn draw_hourly_errors(&mut self, begin_s: f64) {
        let hour = (begin_s / 3_600.0) as i64;
        if hour != self.hour {
            self.hour = hour;
            let random = &mut self.random;
            let mut pair = |sigma: f64| [0, 1].map(|_| sigma * VISIT_GNSS_SIGMA_M * standard_normal(random));
            self.common_m = pair(0.2);
            for receiver_m in &mut self.receivers_m {
                *receiver_m = pair(0.35);
            }
        }
    }

    /// The model's answer: rotated about the camera, with an error that is a fixed function of place.
    fn regressed(&mut self, place: [f64; 2], pan_rad: f64) -> EastNorth {
        let wave = |phase: f64, slope: f64| (place[0] / 12.0 + place[1] / 15.0 * slope + 3.0 * phase).sin();
        let [a, b, c, d] = self.model_phases;
        let (sin, cos) = pan_rad.sin_cos();
        EastNorth {
            east_m: place[0] * cos - place[1] * sin + VISIT_MODEL_SIGMA_M * wave(a, b) + 0.2 * self.draw(),
            north_m: place[0] * sin + place[1] * cos + VISIT_MODEL_SIGMA_M * wave(c, d) + 0.2 * self.draw(),
        }
    }
}

fn bias_pair(time_constant_s: f64, random: &mut ChaCha8Rng) -> [GaussMarkov; 2] {
    [0, 1].map(|_| GaussMarkov::new(time_constant_s, random))
}

/// Both axes one second later.
fn advance(bias: &mut [GaussMarkov; 2], random: &mut ChaCha8Rng) -> [f64; 2] {
    [0, 1].map(|axis| bias[axis].advance(1.0, random))
}

/// The instant that many seconds into a simulation.
#[must_use]
pub fn at_s(seconds: f64) -> Timestamp {
    Timestamp::UNIX_EPOCH + SignedDuration::from_secs(1_600_000_000) + SignedDuration::from_secs_f64(seconds)
}
