//! The interacting-multiple-model (IMM) filter of a track (Blom and Bar-Shalom 1988; Bar-Shalom, Li
//! and Kirubarajan 2001, 11.6.6): one [`ModeFilter`] per motion mode, their mixing, and the gate.
//!
//! Motion modes: stationary, steady (slowly varying velocity), agile (turning or starting).
//! Does not contain history, time to live, or out-of-sequence measurements ([`super::Track`]).

use jiff::Timestamp;
use nalgebra::Matrix4;

use super::agreement::{Agreement, Expected};
use super::camera_error::CameraError;
use super::gate::{ACTIVE_S, GateOutcome, Reach, Reacquisition, SourceHistory};
use super::measurement::{MeasuredPosition, Measurement, MeasurementSource, RejectionReason};
use super::mode_filter::{
    CAMERA_BIAS, GNSS_BIAS, ModeFilter, NoiseDecomposition, POSITION, PredictedMeasurement, SESSION_BIAS,
    Transition, VELOCITY, mix,
};
use super::settings::{MotionModel, TrackSettings};
use super::state::TrackState;
use crate::domain::Velocity;
use crate::geo::EastNorth;
use crate::geo::PlaneCovariance;
use crate::smoother::FilterMoments;

const MODES: usize = 3;
/// Components of a mode's state that are position and velocity.
const KINEMATIC: usize = GNSS_BIAS;
/// Index of the stationary mode; steady and agile follow.
const STATIONARY: usize = 0;
const AGILE: usize = 2;

/// Floor of a mode probability inside a logarithm or a division.
const MIN_PROBABILITY: f64 = 1e-12;
/// Largest speed of a target in units of the speed envelope.
const LARGEST_SPEED_RATIO: f64 = 3.0;
/// Probability that a mode needs before its speed counts as observed.
const SPEED_MODE_PROBABILITY: f64 = 0.3;

/// The filter at one instant: a plain value, so that checkpoints are copies.
#[derive(Debug, Clone)]
pub(super) struct ImmFilter {
    pub(super) time: Timestamp,
    modes: [ModeFilter; MODES],
    /// Sum to 1.
    mode_probabilities: [f64; MODES],
    /// By `MeasurementSource as usize`.
    histories: [SourceHistory; 2],
    last_regressed_at: Option<Timestamp>,
    camera: CameraError,
    agreement: Agreement,
    /// True if the filter is to restart from the next fix, as what the boxes have told it is void.
    awaits_fix: bool,
    /// Square of the highest speed observed with confidence, decaying, m2/s2.
    speed_envelope_m2_s2: f64,
    /// Spectral density of the acceleration of each mode in the latest prediction, m2/s3.
    acceleration_m2_s3: [f64; MODES],
}

impl ImmFilter {
    /// A filter initialised from one measured position.
    pub(super) fn new(
        settings: &TrackSettings,
        time: Timestamp,
        source: MeasurementSource,
        measured: MeasuredPosition,
    ) -> Self {
        let motion = &settings.motion;
        let decomposition = NoiseDecomposition::new(settings, source, measured, 1.0);
        let moving = ModeFilter::new(&decomposition, measured.covariance, motion.initial_speed_sigma_m_s);
        let mut stationary = moving;
        stationary.propagate(&Transition::stationary(0.0, motion.stationary_m2_s));
        let mut histories = [SourceHistory::default(); 2];
        histories[source as usize] = SourceHistory::accepted(time);
        Self {
            time,
            modes: [stationary, moving, moving],
            mode_probabilities: initial_probabilities(motion),
            histories,
            last_regressed_at: (source == MeasurementSource::Regressed).then_some(time),
            camera: CameraError::new(settings, (source == MeasurementSource::Regressed).then_some(&measured)),
            agreement: Agreement::default(),
            awaits_fix: false,
            speed_envelope_m2_s2: motion.min_speed_m_s.powi(2),
            acceleration_m2_s3: [0.0, motion.steady_m2_s3, motion.steady_m2_s3],
        }
    }

    /// Starts again from one measured position; what is known of the sources stays.
    fn restart(&mut self, settings: &TrackSettings, source: MeasurementSource, measured: MeasuredPosition) {
        *self = Self { agreement: self.agreement, ..Self::new(settings, self.time, source, measured) };
    }

    /// Holds boxes and fixes against each other.
    pub(super) fn compare(&mut self, settings: &TrackSettings, measurement: &Measurement) {
        let used_boxes = self.agreement.verdict().refutes(MeasurementSource::Regressed).is_none();
        let [east_m, north_m] = [POSITION, POSITION + 1].map(|state| self.mean_of(state));
        let speed_m_s = LARGEST_SPEED_RATIO * self.speed_envelope_m2_s2.sqrt();
        let expected = Expected { position: EastNorth { east_m, north_m }, speed_m_s };
        self.agreement.observe(settings, measurement, expected);
        let uses_boxes = self.agreement.verdict().refutes(MeasurementSource::Regressed).is_none();
        self.awaits_fix = !uses_boxes && (self.awaits_fix || used_boxes);
    }

    /// Propagates to a later instant; an earlier one changes nothing.
    pub(super) fn predict(&mut self, settings: &TrackSettings, time: Timestamp) {
        let step_s = time.duration_since(self.time).as_secs_f64();
        if step_s <= 0.0 {
            return;
        }
        let motion = &settings.motion;
        self.time = time;
        self.mix(motion, step_s);
        self.update_speed_envelope(motion, step_s);
        self.camera.travel(self.mean_speed_m_s() * step_s);
        // Stationary variance of the agile velocity = speed envelope: density = 2 v^2 / tau.
        let agile_m2_s3 = 2.0 * self.speed_envelope_m2_s2 / motion.agile_time_constant_s;
        self.acceleration_m2_s3 = [0.0, motion.steady_m2_s3, agile_m2_s3];
        let transitions = [
            Transition::stationary(step_s, motion.stationary_m2_s),
            Transition::ornstein_uhlenbeck(step_s, motion.steady_m2_s3, motion.steady_time_constant_s),
            Transition::ornstein_uhlenbeck(step_s, agile_m2_s3, motion.agile_time_constant_s),
        ];
        let regression = &settings.regression;
        let gnss = settings.gnss.decay(step_s);
        let session = (-step_s / settings.gnss_session.time_constant_s).exp();
        for (mode, transition) in self.modes.iter_mut().zip(transitions) {
            // The camera's bias also decorrelates with the distance travelled.
            let camera = step_s / regression.correlation.time_constant_s
                + step_s * mode.speed_m_s() / regression.correlation_length_m;
            let transition = transition
                .with_bias(GNSS_BIAS, gnss)
                .with_bias(SESSION_BIAS, session)
                .with_bias(CAMERA_BIAS, (-camera).exp());
            mode.propagate(&transition);
        }
    }

    /// The interaction step of the IMM for a step of any length. The chance to stay in a mode is
    /// `exp(-step / sojourn)`; a mode that is left goes to either of the others alike.
    fn mix(&mut self, motion: &MotionModel, step_s: f64) {
        let stay = motion.sojourn_s.map(|sojourn_s| (-step_s / sojourn_s).exp());
        let transition_probability = |from: usize, to: usize| {
            if from == to { stay[from] } else { 0.5 * (1.0 - stay[from]) }
        };
        let mut probabilities = [0.0; MODES];
        let mut weights = [[0.0; MODES]; MODES];
        for (to, predicted) in probabilities.iter_mut().enumerate() {
            let joint: [f64; MODES] =
                std::array::from_fn(|from| self.mode_probabilities[from] * transition_probability(from, to));
            *predicted = joint.iter().sum();
            if *predicted > MIN_PROBABILITY {
                weights[to] = joint.map(|share| share / *predicted);
            } else {
                weights[to][to] = 1.0;
            }
        }
        mix(&mut self.modes, &weights);
        // Who stood and now moves has a velocity of which nothing is known yet.
        self.modes[AGILE].add_velocity_variance(weights[AGILE][STATIONARY] * self.speed_envelope_m2_s2);
        let total: f64 = probabilities.iter().sum();
        self.mode_probabilities = probabilities.map(|probability| probability / total);
    }

    /// Lets the speed envelope decay, and raises it to the speed of any probable moving mode, its
    /// variance subtracted.
    fn update_speed_envelope(&mut self, motion: &MotionModel, step_s: f64) {
        self.speed_envelope_m2_s2 *= (-step_s * std::f64::consts::LN_2 / motion.speed_half_life_s).exp();
        self.speed_envelope_m2_s2 = self.speed_envelope_m2_s2.max(motion.min_speed_m_s.powi(2));
        for (mode, probability) in self.modes.iter().zip(self.mode_probabilities).skip(1) {
            let speed_m2_s2: f64 = (VELOCITY..GNSS_BIAS)
                .map(|state| mode.mean[state].powi(2) - mode.covariance[state][state])
                .sum();
            if probability > SPEED_MODE_PROBABILITY && speed_m2_s2 > self.speed_envelope_m2_s2 {
                self.speed_envelope_m2_s2 = speed_m2_s2;
            }
        }
    }

    /// Speed of the mixture's mean velocity, m/s.
    fn mean_speed_m_s(&self) -> f64 {
        self.mean_of(VELOCITY).hypot(self.mean_of(VELOCITY + 1))
    }

    /// Mean of a state component over the modes.
    fn mean_of(&self, state: usize) -> f64 {
        self.modes.iter().zip(self.mode_probabilities).map(|(mode, share)| share * mode.mean[state]).sum()
    }

    /// Propagates to the measurement's instant and processes its positions, the regressed one first.
    /// The outcomes are in that order.
    pub(super) fn step(
        &mut self,
        settings: &TrackSettings,
        measurement: &Measurement,
    ) -> [Option<GateOutcome>; 2] {
        self.predict(settings, measurement.time);
        self.compare(settings, measurement);
        let verdict = self.agreement.verdict();
        let usable_fix = measurement.fix.filter(|_| verdict.refutes(MeasurementSource::Fix).is_none());
        let regressed = measurement.regressed.map(|measured| {
            if let Some(reason) = verdict.refutes(MeasurementSource::Regressed) {
                return GateOutcome::unused(MeasurementSource::Regressed, reason);
            }
            if measured.is_vague {
                return GateOutcome::unused(MeasurementSource::Regressed, RejectionReason::UnusableVariance);
            }
            let measured = self.camera.at_place(settings, measured);
            let correlation = self.camera.correlation(settings, &measured);
            for mode in &mut self.modes {
                mode.decorrelate(CAMERA_BIAS, correlation);
            }
            self.gate_and_update(settings, MeasurementSource::Regressed, measured, usable_fix)
        });
        let fix = measurement.fix.map(|measured| match verdict.refutes(MeasurementSource::Fix) {
            Some(reason) => GateOutcome::unused(MeasurementSource::Fix, reason),
            None if self.awaits_fix && measured.covariance.is_positive() => {
                self.restart(settings, MeasurementSource::Fix, measured);
                GateOutcome { restarted: true, ..GateOutcome::of(MeasurementSource::Fix) }
            }
            None => self.gate_and_update(settings, MeasurementSource::Fix, measured, None),
        });
        [regressed, fix]
    }

    /// Updates with a position that passes the gate. `fix` is that of the same instant as a regressed position.
    fn gate_and_update(
        &mut self,
        settings: &TrackSettings,
        source: MeasurementSource,
        measured: MeasuredPosition,
        fix: Option<MeasuredPosition>,
    ) -> GateOutcome {
        if !measured.covariance.is_positive() {
            return GateOutcome::unused(source, RejectionReason::UnusableVariance);
        }
        let mut outcome = GateOutcome::of(source);
        let decomposition = self.decompose(settings, source, measured);
        let mut predicted = self.predict_measurement(&decomposition);
        (outcome.innovation, outcome.nis) = self.innovation(&predicted);
        if !self.passes_gate(settings, &predicted, outcome.nis) {
            let confirming = fix.filter(|fix| agree(settings, measured, *fix));
            if confirming.is_some_and(|fix| self.is_outside(settings, MeasurementSource::Fix, fix)) {
                // The track's target id now names another target.
                self.restart(settings, source, measured);
                outcome.restarted = true;
                return outcome;
            }
            match self.reacquire(settings, source, measured, &decomposition, confirming.is_some()) {
                Reacquisition::Rejected => {
                    outcome.rejected = Some(RejectionReason::OutsideGate);
                    return outcome;
                }
                Reacquisition::Restarted => {
                    outcome.restarted = true;
                    return outcome;
                }
                Reacquisition::BiasReset => predicted = self.predict_measurement(&decomposition),
            }
        }
        self.update(&predicted);
        self.histories[source as usize] = SourceHistory::accepted(self.time);
        if source == MeasurementSource::Regressed {
            self.last_regressed_at = Some(self.time);
            self.camera = CameraError::new(settings, Some(&measured));
        }
        outcome
    }

    fn is_outside(
        &self,
        settings: &TrackSettings,
        source: MeasurementSource,
        measured: MeasuredPosition,
    ) -> bool {
        let predicted = self.predict_measurement(&self.decompose(settings, source, measured));
        !self.passes_gate(settings, &predicted, self.innovation(&predicted).1)
    }

    fn decompose(
        &self,
        settings: &TrackSettings,
        source: MeasurementSource,
        measured: MeasuredPosition,
    ) -> NoiseDecomposition {
        let inflation = self.correlated_noise_inflation(settings, source);
        NoiseDecomposition::new(settings, source, measured, inflation)
    }

    /// Factor, at least 1, on the white variance of a regressed position: boxes closer in time than
    /// the detector's correlation time share one error, so n of them carry the information of one.
    fn correlated_noise_inflation(&self, settings: &TrackSettings, source: MeasurementSource) -> f64 {
        match (source, self.last_regressed_at) {
            (MeasurementSource::Regressed, Some(last)) => {
                let interval_s = self.time.duration_since(last).as_secs_f64().max(1e-3);
                (settings.regression.detector_correlation_s / interval_s).max(1.0)
            }
            _ => 1.0,
        }
    }

    /// Deals with a measurement beyond the gate. Where those that were rejected agree with each other,
    /// restarts the filter if the other source is not active or confirms this one
    /// (`is_confirmed`). Once its source was rejected often and for long enough: resets the source's
    /// bias if the other source is active and the measurement then passes the gate; restarts the
    /// filter if the other source is not active.
    fn reacquire(
        &mut self,
        settings: &TrackSettings,
        source: MeasurementSource,
        measured: MeasuredPosition,
        decomposition: &NoiseDecomposition,
        is_confirmed: bool,
    ) -> Reacquisition {
        let now = self.time;
        let other_is_active = self.histories[1 - source as usize].is_active(now);
        let reach = self.reach(settings, decomposition);
        let history = &mut self.histories[source as usize];
        // A fix of 30 m passes the gate of a track that has lost its target, too, and would keep it for long.
        // Positions that are the same to the last digit are one observation: those of a frozen picture agree, too.
        let is_another = measured.repeated_s == 0.0
            && history.agree_on(now, measured.position, reach)
            && (!other_is_active || is_confirmed);
        let rejected_s = history.record_rejection(now, settings.reacquire_after_s);
        if is_another {
            self.restart(settings, source, measured);
            return Reacquisition::Restarted;
        }
        let Some(rejected_s) = rejected_s else { return Reacquisition::Rejected };
        if other_is_active {
            let mut candidate = self.clone();
            for mode in &mut candidate.modes {
                mode.reset_bias(decomposition.biases[0].state);
            }
            let predicted = candidate.predict_measurement(decomposition);
            let (_, nis) = candidate.innovation(&predicted);
            if candidate.passes_gate(settings, &predicted, nis) {
                *self = candidate;
                return Reacquisition::BiasReset;
            }
        }
        // A regressed position is confined to the scene, a fix is not: if both stay active and no
        // bias reconciles them, the camera prevails.
        let camera_prevails = source == MeasurementSource::Regressed && rejected_s >= ACTIVE_S;
        if !other_is_active || camera_prevails {
            self.restart(settings, source, measured);
            return Reacquisition::Restarted;
        }
        Reacquisition::Rejected
    }

    /// How far a target may be from a position that was measured before, with the noise of the latest one.
    fn reach(&self, settings: &TrackSettings, decomposition: &NoiseDecomposition) -> Reach {
        let white_m2 = decomposition.white.east_m2 + decomposition.white.north_m2;
        Reach {
            speed_m_s: LARGEST_SPEED_RATIO * self.speed_envelope_m2_s2.sqrt(),
            noise_m: (settings.gate * white_m2).sqrt(),
        }
    }

    fn predict_measurement(&self, decomposition: &NoiseDecomposition) -> [PredictedMeasurement; MODES] {
        let of = |mode: &ModeFilter| mode.predict_measurement(decomposition, self.camera.stated_scale);
        let [stationary, steady, agile] = &self.modes;
        [of(stationary), of(steady), of(agile)]
    }

    /// The chi-square gate: `nis`, of the mixture, or the penalised NIS of the best mode is within
    /// `settings.gate`.
    fn passes_gate(
        &self,
        settings: &TrackSettings,
        predicted: &[PredictedMeasurement; MODES],
        nis: f64,
    ) -> bool {
        let is_outside = nis > settings.gate && self.min_mode_nis(predicted) > settings.gate;
        !is_outside
    }

    /// Mean innovation of the mixture, m, and its NIS under the moment-matched covariance.
    fn innovation(&self, predicted: &[PredictedMeasurement; MODES]) -> (EastNorth, f64) {
        let mut mean = [0.0; 2];
        for (PredictedMeasurement { innovation, .. }, probability) in
            predicted.iter().zip(self.mode_probabilities)
        {
            mean[0] += probability * innovation[0];
            mean[1] += probability * innovation[1];
        }
        let mut covariance = PlaneCovariance::default();
        for (PredictedMeasurement { innovation, stated_covariance, .. }, probability) in
            predicted.iter().zip(self.mode_probabilities)
        {
            let deviation = PlaneCovariance::outer(innovation[0] - mean[0], innovation[1] - mean[1]);
            covariance = covariance.plus(stated_covariance.plus(deviation).scaled(probability));
        }
        let innovation = EastNorth { east_m: mean[0], north_m: mean[1] };
        (innovation, covariance.mahalanobis_squared(innovation))
    }

    /// The smallest `d' S_j^-1 d - 2 ln mu_j` over the modes j of probability `mu_j`: a stationary
    /// target that sets out fits the agile mode well, though the mixture hardly predicts it.
    fn min_mode_nis(&self, predicted: &[PredictedMeasurement; MODES]) -> f64 {
        let penalised = predicted.iter().zip(self.mode_probabilities).map(
            |(PredictedMeasurement { innovation, stated_covariance, .. }, probability)| {
                let innovation = EastNorth { east_m: innovation[0], north_m: innovation[1] };
                stated_covariance.mahalanobis_squared(innovation)
                    - 2.0 * probability.max(MIN_PROBABILITY).ln()
            },
        );
        penalised.fold(f64::INFINITY, f64::min)
    }

    /// Kalman update of every mode, then Bayes' rule for the mode probabilities, relative to the likeliest
    /// mode so that a distant measurement cannot turn all of them to 0.
    fn update(&mut self, predicted: &[PredictedMeasurement; MODES]) {
        let mut squared_distances = [0.0; MODES];
        for (mode, squared_distance) in squared_distances.iter_mut().enumerate() {
            let [squared, root_determinant_m2] = self.modes[mode].update(&predicted[mode]);
            *squared_distance = squared;
            let prior = self.mode_probabilities[mode].max(MIN_PROBABILITY);
            self.mode_probabilities[mode] = prior / root_determinant_m2;
        }
        let least = squared_distances.iter().copied().fold(f64::INFINITY, f64::min);
        for (probability, squared) in self.mode_probabilities.iter_mut().zip(squared_distances) {
            *probability *= (0.5 * (least - squared)).exp();
        }
        let total: f64 = self.mode_probabilities.iter().sum();
        for probability in &mut self.mode_probabilities {
            *probability /= total;
        }
    }

    /// The moment-matched estimate over the modes, without anything about the latest measurement.
    pub(super) fn track_state(&self) -> TrackState {
        let ([east_m, north_m], covariance) = self.moments(POSITION);
        let ([east_m_s, north_m_s], velocity_covariance) = self.moments(VELOCITY);
        TrackState {
            time: self.time,
            position: EastNorth { east_m, north_m },
            velocity: Velocity { east_m_s, north_m_s },
            covariance,
            velocity_covariance,
            moments: self.filter_moments(),
            r95_m: self.agreement.radius_m(self.time, covariance.r95_m()),
            stationary_probability: self.mode_probabilities[STATIONARY],
            nis: None,
            innovations: Vec::new(),
            rejected: Vec::new(),
            restarted: false,
            sources_disagree: self.agreement.verdict().disagrees,
        }
    }

    /// The moments of position and velocity over the modes without the biases, which last along a track, and the mean of their
    /// acceleration noise.
    fn filter_moments(&self) -> FilterMoments {
        let mean: [f64; KINEMATIC] = std::array::from_fn(|state| self.mean_of(state));
        let covariance = Matrix4::from_fn(|row, column| {
            let modes = self.modes.iter().zip(self.mode_probabilities);
            let moment = |mode: &ModeFilter| {
                mode.covariance[row][column] - mode.bias_share(row, column)
                    + (mode.mean[row] - mean[row]) * (mode.mean[column] - mean[column])
            };
            modes.map(|(mode, probability)| probability * moment(mode)).sum()
        });
        let densities = self.acceleration_m2_s3.iter().zip(self.mode_probabilities);
        let acceleration_m2_s3 = densities.map(|(density, probability)| density * probability).sum();
        FilterMoments { covariance, acceleration_m2_s3 }
    }

    /// Mean and stated covariance of a pair of components, position or velocity, over the modes.
    fn moments(&self, pair: usize) -> ([f64; 2], PlaneCovariance) {
        let modes = || self.modes.iter().zip(self.mode_probabilities);
        let mean = [pair, pair + 1].map(|state| self.mean_of(state));
        let (mut covariance, mut lasting) = (PlaneCovariance::default(), PlaneCovariance::default());
        for (mode, probability) in modes() {
            let deviation = PlaneCovariance::outer(mode.mean[pair] - mean[0], mode.mean[pair + 1] - mean[1]);
            let by_camera = mode.camera_share(pair).scaled(self.camera.stated_scale - 1.0);
            let stated = mode.covariance_of(pair).plus(by_camera);
            lasting = lasting.plus(mode.lasting_error(pair).scaled(probability));
            covariance = covariance.plus(stated.plus(deviation).scaled(probability));
        }
        let [stated, shared] = [covariance, lasting].map(|it| it.east_m2 + it.north_m2);
        // No average over boxes is stated to be better than a box, for a model's errors at two places may be one.
        if shared > stated {
            covariance = covariance.plus(lasting.scaled(1.0 - stated / shared));
        }
        (mean, covariance)
    }
}

/// True if a regressed position and a fix of one instant pass each other's gate.
fn agree(settings: &TrackSettings, regressed: MeasuredPosition, fix: MeasuredPosition) -> bool {
    let covariance = fix.covariance.plus(regressed.covariance.scaled(regressed.stated_scale));
    fix.covariance.is_positive()
        && covariance.mahalanobis_squared(fix.position.minus(regressed.position)) <= settings.gate
}

/// The share of time spent in each mode, proportional to its mean sojourn: the stationary
/// distribution of the mode chain, since every mode is entered equally often.
fn initial_probabilities(motion: &MotionModel) -> [f64; MODES] {
    let total: f64 = motion.sojourn_s.iter().sum();
    motion.sojourn_s.map(|sojourn_s| sojourn_s / total)
}
