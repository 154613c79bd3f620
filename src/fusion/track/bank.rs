//! The filter under a track: three ways of moving followed side by side (interacting multiple
//! models, Blom and Bar-Shalom 1988) over eight states, and the gate before them.
//!
//! States per axis: position (m), velocity (m/s), and the biases of receiver and camera in units
//! of their own standard deviations, so that both scale with the error a measurement states.
//! What never happens here: history, time to live, late items ([`super::Track`] knows those).

use jiff::Timestamp;
use nalgebra::{SMatrix, SVector};

use super::settings::{Motion, TrackSettings};
use super::{Measured, Measurement, RejectionReason, Source};
use crate::fusion::plane_covariance::PlaneCovariance;
use crate::geo::EastNorth;

const STATES: usize = 8;
const POSITION: usize = 0;
const VELOCITY: usize = 2;
const GNSS_BIAS: usize = 4;
const CAMERA_BIAS: usize = 6;
const MODES: usize = 3;
const STILL: usize = 0;

/// A source believed again gets a bias this many times its usual standard deviation.
const REOPENED_SIGMAS: f64 = 4.0;
/// Rejections without a break before a source may be believed again.
const REOPEN_COUNT: u32 = 5;
/// A source is alive for this long after it was accepted last.
const ALIVE_S: f64 = 10.0;
/// A standing target's velocity, m/s: what its filter may hold of it.
const STILL_SPEED_M_S: f64 = 0.02;

type State = SVector<f64, STATES>;
type Covariance = SMatrix<f64, STATES, STATES>;

/// One way of moving with what it believes.
#[derive(Debug, Clone)]
struct Hypothesis {
    mean: State,
    covariance: Covariance,
}

/// How a source has fared.
#[derive(Debug, Clone, Copy, Default)]
struct Standing {
    accepted_at: Option<Timestamp>,
    rejected_since: Option<Timestamp>,
    rejections: u32,
}

/// What became of one half of a measurement.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Judgement {
    pub(super) source: Source,
    pub(super) innovation: EastNorth,
    pub(super) nis: f64,
    pub(super) rejected: Option<RejectionReason>,
    pub(super) restarted: bool,
}

/// What the bank believes, the three ways summed up.
#[derive(Debug, Clone, Copy)]
pub(super) struct Belief {
    pub(super) position: EastNorth,
    pub(super) velocity: [f64; 2],
    pub(super) covariance: PlaneCovariance,
    pub(super) still: f64,
}

/// The filter at one instant; a value that can be copied and taken up again.
#[derive(Debug, Clone)]
pub(super) struct Bank {
    pub(super) time: Timestamp,
    hypotheses: [Hypothesis; MODES],
    weights: [f64; MODES],
    standings: [Standing; 2],
    last_box_at: Option<Timestamp>,
    /// Square of the speed the target was seen to reach, slowly forgotten, m2/s2.
    reached_m2_s2: f64,
}

/// A measurement split into its coloured part (a root that scales the bias) and its white part.
struct Split {
    position: EastNorth,
    bias: usize,
    root_m: [f64; 3],
    white: PlaneCovariance,
}

/// What one way of moving expects of a measurement.
struct Foretold {
    /// Measured less expected, m.
    innovation: [f64; 2],
    /// Its covariance.
    moments: PlaneCovariance,
    /// The covariance of the states with the measured position.
    cross: SMatrix<f64, STATES, 2>,
}

impl Bank {
    /// A filter that knows one measured position and nothing else.
    pub(super) fn start(
        settings: &TrackSettings,
        time: Timestamp,
        source: Source,
        measured: Measured,
    ) -> Self {
        let split = split(settings, source, measured, 1.0);
        let mut mean = State::zeros();
        mean[POSITION] = split.position.east_m;
        mean[POSITION + 1] = split.position.north_m;
        let mut covariance = Covariance::zeros();
        let [east, north, across] = split.root_m;
        for bias in GNSS_BIAS..STATES {
            covariance[(bias, bias)] = 1.0;
        }
        for axis in 0..2 {
            covariance[(VELOCITY + axis, VELOCITY + axis)] = settings.motion.first_speed_m_s.powi(2);
        }
        // position = measured - root * bias - white, so position and bias are bound from the start.
        for (row, column, value) in [(0, 0, east), (1, 1, north), (0, 1, across), (1, 0, across)] {
            covariance[(POSITION + row, split.bias + column)] = -value;
            covariance[(split.bias + column, POSITION + row)] = -value;
        }
        let total = measured.covariance.scaled(1.0).rows_m2();
        for (row, values) in total.iter().enumerate() {
            for (column, value) in values.iter().enumerate() {
                covariance[(POSITION + row, POSITION + column)] = *value;
            }
        }
        let hypothesis = Hypothesis { mean, covariance };
        let mut still = hypothesis.clone();
        still.stand();
        let mut standings = [Standing::default(); 2];
        standings[source as usize].accepted_at = Some(time);
        Self {
            time,
            hypotheses: [still, hypothesis.clone(), hypothesis],
            weights: stationary_weights(&settings.motion),
            standings,
            last_box_at: (source == Source::Regressed).then_some(time),
            reached_m2_s2: settings.motion.least_speed_m_s.powi(2),
        }
    }

    /// Goes to a later instant without measuring.
    pub(super) fn predict(&mut self, settings: &TrackSettings, time: Timestamp) {
        let step_s = time.duration_since(self.time).as_secs_f64();
        if step_s <= 0.0 {
            return;
        }
        self.time = time;
        self.mix(&settings.motion, step_s);
        let motion = &settings.motion;
        self.remember_speed(motion, step_s);
        // An agile target's velocity spreads to the speed it was seen to reach, and no further.
        let agile_m2_s3 = 2.0 * self.reached_m2_s2 / motion.agile_time_constant_s;
        let ways = [
            (0.0, f64::INFINITY),
            (motion.steady_m2_s3, motion.steady_time_constant_s),
            (agile_m2_s3, motion.agile_time_constant_s),
        ];
        for (mode, hypothesis) in self.hypotheses.iter_mut().enumerate() {
            hypothesis.fade_biases(settings, step_s);
            if mode == STILL {
                hypothesis.stand();
                for axis in 0..2 {
                    hypothesis.covariance[(POSITION + axis, POSITION + axis)] += motion.still_m2_s * step_s;
                }
            } else {
                let (density_m2_s3, time_constant_s) = ways[mode];
                hypothesis.go(step_s, density_m2_s3, time_constant_s);
            }
        }
    }

    /// Holds the highest speed that is beyond doubt, and lets it fade.
    fn remember_speed(&mut self, motion: &Motion, step_s: f64) {
        self.reached_m2_s2 *= (-step_s * std::f64::consts::LN_2 / motion.speed_memory_s).exp();
        self.reached_m2_s2 = self.reached_m2_s2.max(motion.least_speed_m_s.powi(2));
        for (hypothesis, weight) in self.hypotheses.iter().zip(self.weights).skip(1) {
            let speed_m2_s2: f64 = (VELOCITY..GNSS_BIAS)
                .map(|state| hypothesis.mean[state].powi(2) - hypothesis.covariance[(state, state)])
                .sum();
            if weight > 0.3 && speed_m2_s2 > self.reached_m2_s2 {
                self.reached_m2_s2 = speed_m2_s2;
            }
        }
    }

    /// Goes to the measurement's instant and takes up what passes the gate: the regressed position
    /// first, then the fix.
    pub(super) fn step(
        &mut self,
        settings: &TrackSettings,
        measurement: &Measurement,
    ) -> [Option<Judgement>; 2] {
        self.predict(settings, measurement.time);
        let regressed =
            measurement.regressed.map(|measured| self.take(settings, Source::Regressed, measured));
        let fix = measurement.fix.map(|measured| self.take(settings, Source::Fix, measured));
        [regressed, fix]
    }

    fn take(&mut self, settings: &TrackSettings, source: Source, measured: Measured) -> Judgement {
        if !measured.covariance.is_positive() {
            return Judgement {
                source,
                innovation: EastNorth::default(),
                nis: f64::NAN,
                rejected: Some(RejectionReason::UnusableVariance),
                restarted: false,
            };
        }
        let crowd = self.crowding(settings, source);
        let split = split(settings, source, measured, crowd);
        let mut foretold = self.foretell(&split);
        let (innovation, nis) = self.innovation(&foretold);
        let mut judgement = Judgement { source, innovation, nis, rejected: None, restarted: false };
        if nis > settings.gate && self.likeliest_length(&foretold) > settings.gate {
            match self.appeal(settings, source, measured, &split) {
                Appeal::Refused => {
                    judgement.rejected = Some(RejectionReason::OutsideGate);
                    return judgement;
                }
                Appeal::Restarted => {
                    judgement.restarted = true;
                    return judgement;
                }
                Appeal::Reopened => foretold = self.foretell(&split),
            }
        }
        self.update(&foretold);
        self.standings[source as usize] =
            Standing { accepted_at: Some(self.time), rejected_since: None, rejections: 0 };
        if source == Source::Regressed {
            self.last_box_at = Some(self.time);
        }
        judgement
    }

    /// How many boxes share one white error, at least 1.
    fn crowding(&self, settings: &TrackSettings, source: Source) -> f64 {
        match (source, self.last_box_at) {
            (Source::Regressed, Some(last)) => {
                let apart_s = self.time.duration_since(last).as_secs_f64().max(1e-3);
                (settings.regression.jitter_s / apart_s).max(1.0)
            }
            _ => 1.0,
        }
    }

    fn foretell(&self, split: &Split) -> [Foretold; MODES] {
        std::array::from_fn(|mode| self.hypotheses[mode].foretell(split))
    }

    /// Mean innovation over the ways of moving, and its squared Mahalanobis length.
    fn innovation(&self, foretold: &[Foretold; MODES]) -> (EastNorth, f64) {
        let mut mean = [0.0; 2];
        for (Foretold { innovation, .. }, weight) in foretold.iter().zip(self.weights) {
            mean[0] += weight * innovation[0];
            mean[1] += weight * innovation[1];
        }
        let mut total = PlaneCovariance::default();
        for (Foretold { innovation, moments, .. }, weight) in foretold.iter().zip(self.weights) {
            let (east, north) = (innovation[0] - mean[0], innovation[1] - mean[1]);
            let spread = PlaneCovariance {
                east_m2: east * east,
                north_m2: north * north,
                east_north_m2: east * north,
            };
            total = total.plus(moments.plus(spread).scaled(weight));
        }
        let innovation = EastNorth { east_m: mean[0], north_m: mean[1] };
        (innovation, total.squared_length(innovation))
    }

    /// Squared Mahalanobis length under the way of moving that explains the measurement best, dearer
    /// by how little that way is believed: a target that stood and now starts is no outlier, though
    /// the three ways taken together hardly expect it.
    fn likeliest_length(&self, foretold: &[Foretold; MODES]) -> f64 {
        let lengths =
            foretold.iter().zip(self.weights).map(|(Foretold { innovation, moments, .. }, weight)| {
                let innovation = EastNorth { east_m: innovation[0], north_m: innovation[1] };
                moments.squared_length(innovation) - 2.0 * weight.max(1e-12).ln()
            });
        lengths.fold(f64::INFINITY, f64::min)
    }

    fn update(&mut self, foretold: &[Foretold; MODES]) {
        let mut logs = [0.0; MODES];
        for (mode, log) in logs.iter_mut().enumerate() {
            *log = self.weights[mode].max(1e-12).ln() + self.hypotheses[mode].update(&foretold[mode]);
        }
        // Log-sum-exp: a far measurement must not turn every weight to zero.
        let highest = logs.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        let total: f64 = logs.iter().map(|log| (log - highest).exp()).sum();
        for (weight, log) in self.weights.iter_mut().zip(logs) {
            *weight = (log - highest).exp() / total;
        }
    }

    /// What to do about a measurement beyond the gate. A source that is refused again and again has
    /// a bias that jumped; where nothing else speaks, the track itself is wrong.
    fn appeal(
        &mut self,
        settings: &TrackSettings,
        source: Source,
        measured: Measured,
        split: &Split,
    ) -> Appeal {
        let now = self.time;
        let elapsed_s = |since: Timestamp| now.duration_since(since).as_secs_f64();
        let standing = &mut self.standings[source as usize];
        standing.rejections += 1;
        let refused_s = elapsed_s(*standing.rejected_since.get_or_insert(now));
        if standing.rejections < REOPEN_COUNT || refused_s < settings.reopen_after_s {
            return Appeal::Refused;
        }
        let other = self.standings[1 - source as usize];
        let other_alive = other.accepted_at.is_some_and(|at| elapsed_s(at) < ALIVE_S);
        if other_alive {
            let mut reopened = self.clone();
            for hypothesis in &mut reopened.hypotheses {
                hypothesis.forget_bias(split.bias);
            }
            let foretold = reopened.foretell(split);
            if reopened.innovation(&foretold).1.min(reopened.likeliest_length(&foretold)) <= settings.gate {
                *self = reopened;
                return Appeal::Reopened;
            }
        }
        // A regressed position cannot leave the scene, a fix can: when both go on speaking and no
        // bias reconciles them, the camera has the last word.
        let overrules = source == Source::Regressed && refused_s >= ALIVE_S;
        if !other_alive || overrules {
            *self = Self::start(settings, now, source, measured);
            return Appeal::Restarted;
        }
        Appeal::Refused
    }

    /// The mixing step of the interacting multiple models, for a step of any length.
    fn mix(&mut self, motion: &Motion, step_s: f64) {
        let stays = motion.stay_s.map(|stay_s| (-step_s / stay_s).exp());
        let chance = |from: usize, to: usize| {
            if from == to { stays[from] } else { 0.5 * (1.0 - stays[from]) }
        };
        let before = self.hypotheses.clone();
        let mut weights = [0.0; MODES];
        for (to, mixed) in weights.iter_mut().enumerate() {
            let shares: [f64; MODES] = std::array::from_fn(|from| self.weights[from] * chance(from, to));
            let total: f64 = shares.iter().sum();
            *mixed = total;
            if total > 1e-12 {
                self.hypotheses[to] = blend(&before, shares.map(|share| share / total));
            }
        }
        let total: f64 = weights.iter().sum();
        self.weights = weights.map(|weight| weight / total);
    }

    /// Position, velocity and covariance over the three ways of moving.
    pub(super) fn belief(&self) -> Belief {
        let mut sum = [0.0; 4];
        for (hypothesis, weight) in self.hypotheses.iter().zip(self.weights) {
            for (value, mean) in sum.iter_mut().zip(hypothesis.mean.iter()) {
                *value += weight * mean;
            }
        }
        let mut covariance = PlaneCovariance::default();
        for (hypothesis, weight) in self.hypotheses.iter().zip(self.weights) {
            let moments = &hypothesis.covariance;
            let (east, north) = (hypothesis.mean[0] - sum[0], hypothesis.mean[1] - sum[1]);
            let part = PlaneCovariance {
                east_m2: moments[(0, 0)] + east * east,
                north_m2: moments[(1, 1)] + north * north,
                east_north_m2: moments[(0, 1)] + east * north,
            };
            covariance = covariance.plus(part.scaled(weight));
        }
        Belief {
            position: EastNorth { east_m: sum[0], north_m: sum[1] },
            velocity: [sum[2], sum[3]],
            covariance,
            still: self.weights[STILL],
        }
    }
}

enum Appeal {
    Refused,
    Reopened,
    Restarted,
}

impl Hypothesis {
    fn scale(&mut self, state: usize, factor: f64) {
        self.mean[state] *= factor;
        for other in 0..STATES {
            self.covariance[(state, other)] *= factor;
            self.covariance[(other, state)] *= factor;
        }
    }

    /// Gauss-Markov decay of both biases; the camera's goes by the ground covered too.
    fn fade_biases(&mut self, settings: &TrackSettings, step_s: f64) {
        let speed_m_s = self.mean[VELOCITY].hypot(self.mean[VELOCITY + 1]);
        let regression = &settings.regression;
        let rates = [
            (GNSS_BIAS, step_s / settings.gnss.time_constant_s),
            (CAMERA_BIAS, step_s / regression.time_constant_s + step_s * speed_m_s / regression.length_m),
        ];
        for (bias, rate) in rates {
            let keep = (-rate).exp();
            for state in [bias, bias + 1] {
                self.scale(state, keep);
                self.covariance[(state, state)] += 1.0 - keep * keep;
            }
        }
    }

    /// A standing target: no velocity, and none of what was believed of it.
    fn stand(&mut self) {
        for state in [VELOCITY, VELOCITY + 1] {
            self.scale(state, 0.0);
            self.covariance[(state, state)] = STILL_SPEED_M_S * STILL_SPEED_M_S;
        }
    }

    /// A going target: position by velocity, velocity an Ornstein-Uhlenbeck process.
    fn go(&mut self, step_s: f64, density_m2_s3: f64, time_constant_s: f64) {
        let rate = 1.0 / time_constant_s;
        let turn = rate * step_s;
        let keep = (-turn).exp();
        let lever_s = (1.0 - keep) / rate;
        for axis in 0..2 {
            let (position, velocity) = (POSITION + axis, VELOCITY + axis);
            self.mean[position] += lever_s * self.mean[velocity];
            for other in 0..STATES {
                self.covariance[(position, other)] += lever_s * self.covariance[(velocity, other)];
            }
            for other in 0..STATES {
                self.covariance[(other, position)] += lever_s * self.covariance[(other, velocity)];
            }
            self.scale(velocity, keep);
            let both = density_m2_s3 * 0.5 * lever_s * lever_s;
            let position_m2 = if turn < 0.01 {
                // The closed form cancels to nothing for short steps.
                density_m2_s3 * step_s.powi(3) / 3.0 * (1.0 - 0.75 * turn)
            } else {
                density_m2_s3 / rate.powi(3) * (turn - 2.0 * (1.0 - keep) + 0.5 * (1.0 - keep * keep))
            };
            self.covariance[(position, position)] += position_m2;
            self.covariance[(velocity, velocity)] += density_m2_s3 * (1.0 - keep * keep) / (2.0 * rate);
            self.covariance[(position, velocity)] += both;
            self.covariance[(velocity, position)] += both;
        }
    }

    fn forget_bias(&mut self, bias: usize) {
        for state in [bias, bias + 1] {
            self.scale(state, 0.0);
            self.covariance[(state, state)] = REOPENED_SIGMAS * REOPENED_SIGMAS;
        }
    }

    fn foretell(&self, split: &Split) -> Foretold {
        let [east, north, across] = split.root_m;
        let bias = split.bias;
        let innovation = [
            split.position.east_m
                - self.mean[POSITION]
                - east * self.mean[bias]
                - across * self.mean[bias + 1],
            split.position.north_m
                - self.mean[POSITION + 1]
                - across * self.mean[bias]
                - north * self.mean[bias + 1],
        ];
        let mut cross = SMatrix::<f64, STATES, 2>::zeros();
        for state in 0..STATES {
            let row = |column: usize| self.covariance[(state, column)];
            cross[(state, 0)] = row(POSITION) + east * row(bias) + across * row(bias + 1);
            cross[(state, 1)] = row(POSITION + 1) + across * row(bias) + north * row(bias + 1);
        }
        let moments = PlaneCovariance {
            east_m2: cross[(POSITION, 0)] + east * cross[(bias, 0)] + across * cross[(bias + 1, 0)],
            north_m2: cross[(POSITION + 1, 1)] + across * cross[(bias, 1)] + north * cross[(bias + 1, 1)],
            east_north_m2: cross[(POSITION, 1)] + east * cross[(bias, 1)] + across * cross[(bias + 1, 1)],
        };
        Foretold { innovation, moments: moments.plus(split.white), cross }
    }

    /// Takes the measurement up and returns the log of its likelihood, less a constant.
    fn update(&mut self, foretold: &Foretold) -> f64 {
        let Foretold { innovation, moments, cross } = foretold;
        let determinant = moments.determinant();
        let inverse = [
            moments.north_m2 / determinant,
            moments.east_m2 / determinant,
            -moments.east_north_m2 / determinant,
        ];
        for state in 0..STATES {
            let (east, north) = (cross[(state, 0)], cross[(state, 1)]);
            let gain = [east * inverse[0] + north * inverse[2], east * inverse[2] + north * inverse[1]];
            self.mean[state] += gain[0] * innovation[0] + gain[1] * innovation[1];
            for other in 0..=state {
                let less = gain[0] * cross[(other, 0)] + gain[1] * cross[(other, 1)];
                let value = self.covariance[(state, other)] - less;
                self.covariance[(state, other)] = value;
                self.covariance[(other, state)] = value;
            }
        }
        let innovation = EastNorth { east_m: innovation[0], north_m: innovation[1] };
        -0.5 * (moments.squared_length(innovation) + determinant.ln())
    }
}

/// Mean and covariance of a weighted set of hypotheses.
fn blend(hypotheses: &[Hypothesis; MODES], shares: [f64; MODES]) -> Hypothesis {
    let mut mean = State::zeros();
    for (hypothesis, share) in hypotheses.iter().zip(shares) {
        mean += hypothesis.mean * share;
    }
    let mut covariance = Covariance::zeros();
    for (hypothesis, share) in hypotheses.iter().zip(shares) {
        if share > 1e-9 {
            let away = hypothesis.mean - mean;
            covariance += (hypothesis.covariance + away * away.transpose()) * share;
        }
    }
    Hypothesis { mean, covariance }
}

/// Weights that the ways of moving have when nothing was measured for long. Leaving one, a target
/// takes either of the others alike.
fn stationary_weights(motion: &Motion) -> [f64; MODES] {
    let total: f64 = motion.stay_s.iter().sum();
    motion.stay_s.map(|stay_s| stay_s / total)
}

fn split(settings: &TrackSettings, source: Source, measured: Measured, crowding: f64) -> Split {
    let (bias, white_share) = match source {
        Source::Fix => (GNSS_BIAS, settings.gnss.white_share),
        Source::Regressed => (CAMERA_BIAS, settings.regression.white_share),
    };
    Split {
        position: measured.position,
        bias,
        root_m: measured.covariance.scaled(1.0 - white_share).root_m(),
        white: measured.covariance.scaled(white_share * crowding),
    }
}
