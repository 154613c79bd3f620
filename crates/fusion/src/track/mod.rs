//! Sequence fusion: the state of one target from all measurements of it so far.
//!
//! A [`Track`] estimates position, velocity, a slowly varying bias of the receiver and one of the
//! camera's model (METHOD "Sequence fusion") with an interacting-multiple-model filter. Fixes and
//! regressed positions arrive with their error covariances, together or apart, late or never.
//! Measurements beyond the chi-square gate are rejected with a reason; a rejection is part of the
//! answer, not an error. Out-of-sequence measurements within the window are inserted at their time
//! and the filter is replayed from the last checkpoint before them, so the order of arrival does
//! not change the state by a single bit. Does not use clocks, I/O, pixels or degrees.

mod agreement;
mod camera_error;
mod gate;
mod imm_filter;
mod measurement;
mod mode_filter;
mod settings;
mod state;
#[cfg(test)]
mod tests;

use std::cmp::Ordering;
use std::collections::VecDeque;

use jiff::Timestamp;

pub use measurement::{MeasuredPosition, Measurement, MeasurementSource, Rejection, RejectionReason};
pub use settings::{MotionModel, RegressionNoise, TrackSettings};
pub use state::{Innovation, TrackState};

use self::gate::GateOutcome;
use self::imm_filter::ImmFilter;

/// Measurements between two checkpoints: an upper bound on what an insertion replays in addition to
/// the measurements after it.
const CHECKPOINT_INTERVAL: usize = 8;

/// One measurement of the window; every [`CHECKPOINT_INTERVAL`] of them carry the filter after it.
#[derive(Debug, Clone)]
struct WindowEntry {
    measurement: Measurement,
    checkpoint: Option<Box<ImmFilter>>,
}

/// The sequence fusion of one target.
#[derive(Debug, Clone)]
pub struct Track {
    settings: TrackSettings,
    /// The filter before the first entry of the window.
    base: Box<ImmFilter>,
    /// In the order of [`precedes_or_equals`].
    window: VecDeque<WindowEntry>,
    /// The filter after the last entry of the window.
    current: Box<ImmFilter>,
    first: Measurement,
}

impl Track {
    /// Initialises a track from the first measurement of its target; `None` if that has neither a
    /// usable fix nor a usable regressed position.
    #[must_use]
    pub fn start(settings: TrackSettings, first: &Measurement) -> Option<Self> {
        let usable = |measured: Option<MeasuredPosition>| measured.filter(|it| it.covariance.is_positive());
        let (source, measured, remaining_fix) = match (usable(first.regressed), usable(first.fix)) {
            (Some(regressed), fix) => (MeasurementSource::Regressed, regressed, fix),
            (None, Some(fix)) => (MeasurementSource::Fix, fix, None),
            (None, None) => return None,
        };
        let mut filter = ImmFilter::new(&settings, first.time, source, measured);
        filter.compare(&settings, first);
        if remaining_fix.is_some() {
            let fix_only = Measurement { time: first.time, fix: remaining_fix, regressed: None };
            filter.step(&settings, &fix_only);
        }
        let base = Box::new(filter);
        Some(Self { settings, current: base.clone(), base, window: VecDeque::new(), first: *first })
    }

    /// Time of the first measurement.
    #[must_use]
    pub const fn started_at(&self) -> Timestamp {
        self.first.time
    }

    /// Time of the latest measurement.
    #[must_use]
    pub fn measured_at(&self) -> Timestamp {
        self.current.time
    }

    /// True if the target has not been measured for longer than `time_to_live_s`.
    #[must_use]
    pub fn is_expired(&self, at: Timestamp) -> bool {
        at.duration_since(self.current.time).as_secs_f64() > self.settings.time_to_live_s
    }

    /// The noise and motion models in use.
    #[must_use]
    pub const fn settings(&self) -> &TrackSettings {
        &self.settings
    }

    /// Processes a measurement, an out-of-sequence one at its place in time, and returns the state at
    /// the latest measured instant.
    pub fn update(&mut self, measurement: &Measurement) -> TrackState {
        let (measurement, mut rejected) = self.admit(measurement);
        if measurement.fix.is_none() && measurement.regressed.is_none() {
            return self.state_after(&[None, None], rejected);
        }
        let index = self.window.partition_point(|entry| precedes_or_equals(&entry.measurement, &measurement));
        self.window.insert(index, WindowEntry { measurement, checkpoint: None });
        let outcomes = if index + 1 == self.window.len() {
            let outcomes = self.current.step(&self.settings, &measurement);
            self.checkpoint(index);
            outcomes
        } else {
            self.replay_from(index)
        };
        self.prune();
        for outcome in outcomes.iter().flatten() {
            if let Some(reason) = outcome.rejected {
                let nis = outcome.nis.is_finite().then_some(outcome.nis);
                rejected.push(Rejection { source: outcome.source, reason, nis });
            }
        }
        self.state_after(&outcomes, rejected)
    }

    /// The state at another instant: predicted beyond the latest measurement, the filtered state of
    /// that time within the window, and the state at the beginning of the window before that.
    #[must_use]
    pub fn state_at(&self, time: Timestamp) -> TrackState {
        let mut filter = if time >= self.current.time {
            (*self.current).clone()
        } else {
            let end = self.window.partition_point(|entry| entry.measurement.time <= time);
            let (mut filter, begin) = self.latest_checkpoint(end);
            for entry in self.window.range(begin..end) {
                filter.step(&self.settings, &entry.measurement);
            }
            filter
        };
        filter.predict(&self.settings, time);
        filter.track_state()
    }

    /// The measurement without the positions that cannot be processed, and a rejection for each of
    /// those.
    fn admit(&self, measurement: &Measurement) -> (Measurement, Vec<Rejection>) {
        let mut rejected = Vec::new();
        let mut admitted = *measurement;
        let age_s = self.current.time.duration_since(measurement.time).as_secs_f64();
        let before_window = match measurement.time.cmp(&self.base.time) {
            Ordering::Less => true,
            // Duplicates at the base's own instant are recognisable for the first measurement only.
            Ordering::Equal => measurement.time != self.first.time,
            Ordering::Greater => false,
        };
        let too_late = age_s > self.settings.window_s || before_window;
        for source in [MeasurementSource::Regressed, MeasurementSource::Fix] {
            let position = match source {
                MeasurementSource::Regressed => &mut admitted.regressed,
                MeasurementSource::Fix => &mut admitted.fix,
            };
            let Some(measured) = position else { continue };
            let reason = if too_late {
                RejectionReason::TooLate
            } else if !measured.covariance.is_positive() {
                RejectionReason::UnusableVariance
            } else if self.is_duplicate(measurement.time, source) {
                RejectionReason::Duplicate
            } else {
                continue;
            };
            *position = None;
            rejected.push(Rejection { source, reason, nis: None });
        }
        (admitted, rejected)
    }

    fn is_duplicate(&self, time: Timestamp, source: MeasurementSource) -> bool {
        let begin = self.window.partition_point(|entry| entry.measurement.time < time);
        self.window
            .range(begin..)
            .map(|entry| &entry.measurement)
            .take_while(|measurement| measurement.time == time)
            .chain((self.first.time == time).then_some(&self.first))
            .any(|measurement| match source {
                MeasurementSource::Regressed => measurement.regressed.is_some(),
                MeasurementSource::Fix => measurement.fix.is_some(),
            })
    }

    /// The latest checkpoint before an entry, and the index of the first entry after that checkpoint.
    fn latest_checkpoint(&self, before: usize) -> (ImmFilter, usize) {
        (0..before)
            .rev()
            .find_map(|index| Some(((**self.window[index].checkpoint.as_ref()?).clone(), index + 1)))
            .unwrap_or_else(|| ((*self.base).clone(), 0))
    }

    /// Replays the filter from the checkpoint before an inserted entry, and returns the gate outcomes
    /// of that entry.
    fn replay_from(&mut self, inserted: usize) -> [Option<GateOutcome>; 2] {
        let (filter, begin) = self.latest_checkpoint(inserted);
        *self.current = filter;
        let mut outcomes = [None, None];
        for index in begin..self.window.len() {
            let stepped = self.current.step(&self.settings, &self.window[index].measurement);
            if index == inserted {
                outcomes = stepped;
            }
            self.window[index].checkpoint = None;
            self.checkpoint(index);
        }
        outcomes
    }

    /// Stores the filter with an entry if none of the preceding entries of an interval has one.
    fn checkpoint(&mut self, index: usize) {
        let begin = (index + 1).saturating_sub(CHECKPOINT_INTERVAL);
        let has_recent = self.window.range(begin..index).any(|entry| entry.checkpoint.is_some());
        if !has_recent && index + 1 >= CHECKPOINT_INTERVAL {
            self.window[index].checkpoint = Some(self.current.clone());
        }
    }

    /// Drops entries older than the window, up to a checkpoint, which becomes the base.
    fn prune(&mut self) {
        let window_s = self.settings.window_s;
        loop {
            let Some(index) = self.window.iter().position(|entry| entry.checkpoint.is_some()) else {
                return;
            };
            let age_s = self.current.time.duration_since(self.window[index].measurement.time).as_secs_f64();
            let is_full = self.window.len() > self.settings.window_items.max(2 * CHECKPOINT_INTERVAL);
            if age_s <= window_s && !is_full {
                return;
            }
            if let Some(checkpoint) = self.window[index].checkpoint.take() {
                self.base = checkpoint;
            }
            self.window.drain(..=index);
        }
    }

    fn state_after(&self, outcomes: &[Option<GateOutcome>; 2], rejected: Vec<Rejection>) -> TrackState {
        let mut state = self.current.track_state();
        let accepted = outcomes.iter().flatten().filter(|it| it.rejected.is_none());
        state.innovations = accepted
            .clone()
            .filter(|it| !it.restarted)
            .map(|it| Innovation { source: it.source, difference: it.innovation, nis: it.nis })
            .collect();
        state.restarted = accepted.clone().any(|it| it.restarted);
        state.nis = (!state.innovations.is_empty()).then(|| state.innovations.iter().map(|it| it.nis).sum());
        state.rejected = rejected;
        state
    }
}

/// The processing order: by time, and at one instant the regressed position before the fix, so that
/// the result does not depend on the order of arrival.
fn precedes_or_equals(earlier: &Measurement, later: &Measurement) -> bool {
    let rank = |measurement: &Measurement| u8::from(measurement.regressed.is_none());
    (earlier.time, rank(earlier)) <= (later.time, rank(later))
}
