//! The fixes of a recording on their way to the tracker, and what comes of them.

use std::collections::BTreeMap;

use jiff::{SignedDuration, Timestamp};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use serde::Serialize;

use super::clock_figures::ClockFigures;
use super::recording::{LabelledBox, RecordedFix, SiteRecording};
use crate::domain::ReceiverId;
use crate::fusion::association::{Cancellation, LiveMatchSettings, WorldReceiverWindow};
use crate::fusion::world::{FrameOutcome, WorldTrackId, WorldTracker};

/// Time between two rounds of matching: that of a service with as many targets.
const ROUND: SignedDuration = SignedDuration::from_secs(2);
/// Seed of the sampler.
const SEED: u64 = 1;
/// Standard deviation of a fix per axis in the tracker, m: that of a phone.
const FIX_SIGMA_M: f64 = 2.6;

/// Boxes on tracks with a receiver.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
pub struct NamedFigures {
    /// Boxes on tracks that have a receiver at that instant.
    pub named: usize,
    /// Those of them whose target carries it.
    pub right: usize,
    /// Boxes of carriers.
    pub carried: usize,
    /// Boxes on tracks that have a receiver by the last round, whose window may hold the whole recording.
    pub named_in_hindsight: usize,
    /// Those of them whose target carries it.
    pub right_in_hindsight: usize,
}

impl NamedFigures {
    /// These and others together.
    #[must_use]
    pub const fn plus(self, other: Self) -> Self {
        Self {
            named: self.named + other.named,
            right: self.right + other.right,
            carried: self.carried + other.carried,
            named_in_hindsight: self.named_in_hindsight + other.named_in_hindsight,
            right_in_hindsight: self.right_in_hindsight + other.right_in_hindsight,
        }
    }

    /// Share of the boxes on tracks with a receiver whose target carries it: at that instant, and in hindsight.
    #[must_use]
    pub fn right_shares(&self) -> [f64; 2] {
        [(self.right, self.named), (self.right_in_hindsight, self.named_in_hindsight)]
            .map(|(right, named)| right as f64 / named.max(1) as f64)
    }

    /// Share of the carriers' boxes on tracks with their receiver: at that instant, and in hindsight.
    #[must_use]
    pub fn found_shares(&self) -> [f64; 2] {
        [self.right, self.right_in_hindsight].map(|right| right as f64 / self.carried.max(1) as f64)
    }
}

/// Feeds the fixes of a recording to its tracker in the order of time.
pub(super) struct ReceiverFeed<'a> {
    recording: &'a SiteRecording,
    /// Fixes that are yet to come, in the order of time.
    rest: &'a [RecordedFix],
    carriers: BTreeMap<&'a ReceiverId, usize>,
    /// Probability from which on a track has a receiver.
    matched_from: f64,
    window: WorldReceiverWindow,
    next_round: Option<Timestamp>,
    figures: NamedFigures,
    /// Boxes of each track by target.
    tracks: BTreeMap<WorldTrackId, BTreeMap<Option<usize>, usize>>,
}

impl<'a> ReceiverFeed<'a> {
    pub(super) fn new(recording: &'a SiteRecording) -> Self {
        let settings = LiveMatchSettings::of_site();
        Self {
            recording,
            rest: &recording.fixes,
            matched_from: settings.matched_from,
            carriers: recording.receivers.iter().map(|(id, target)| (id, *target)).collect(),
            window: WorldReceiverWindow::new(settings),
            next_round: None,
            figures: NamedFigures::default(),
            tracks: BTreeMap::new(),
        }
    }

    /// Feeds the fixes until an instant, and matches if it is time for it.
    pub(super) fn advance(&mut self, tracker: &mut WorldTracker, time: Timestamp) {
        let (now, rest) = self.rest.split_at(self.rest.partition_point(|fix| fix.time <= time));
        self.rest = rest;
        for fix in now {
            let receiver = &self.recording.receivers[fix.receiver].0;
            self.window.observe_fix(receiver, fix.time, fix.position, None);
            let time = self.window.corrected(receiver, fix.time);
            tracker.observe_fix(receiver, time, fix.position, FIX_SIGMA_M);
        }
        if self.next_round.is_none_or(|next| time >= next) {
            self.next_round = time.checked_add(ROUND).ok();
            let mut random = ChaCha8Rng::seed_from_u64(SEED);
            if let Ok(matched) = self.window.matched(&mut random, Cancellation::NEVER) {
                self.window.accept(matched);
                tracker.set_receiver_matches(self.window.receivers());
            }
        }
    }

    /// Counts the boxes of a frame, and takes its tracks for the next round.
    pub(super) fn observe(&mut self, tracker: &WorldTracker, outcome: &FrameOutcome, boxes: &[&LabelledBox]) {
        self.window.observe(tracker, outcome);
        for (labelled, track) in boxes.iter().zip(&outcome.tracks) {
            let carrier = track.and_then(|track| self.carrier_of(tracker, track));
            if let Some(track) = track {
                *self.tracks.entry(*track).or_default().entry(labelled.target).or_default() += 1;
            }
            let is_carrier = |target: &usize| self.carriers.values().any(|carrier| carrier == target);
            self.figures = self.figures.plus(NamedFigures {
                named: usize::from(carrier.is_some()),
                right: usize::from(carrier.is_some() && carrier == labelled.target),
                carried: usize::from(labelled.target.as_ref().is_some_and(is_carrier)),
                ..NamedFigures::default()
            });
        }
    }

    /// The target that carries the receiver of a track.
    fn carrier_of(&self, tracker: &WorldTracker, track: WorldTrackId) -> Option<usize> {
        self.carriers.get(&tracker.track(track)?.receiver_match()?.receiver_id).copied()
    }

    /// The receivers' clocks, all of which are late by so much, s.
    pub(super) fn clock_figures(&self, late_s: f64) -> ClockFigures {
        ClockFigures::of(self.window.clocks(), late_s)
    }

    pub(super) fn figures(self) -> NamedFigures {
        let mut random = ChaCha8Rng::seed_from_u64(SEED);
        let last = self.window.matched(&mut random, Cancellation::NEVER).unwrap_or_default();
        let sure = last.receivers.iter().filter(|(_, own)| own.probability >= self.matched_from);
        let in_hindsight = sure.filter_map(|(track, own)| {
            let (boxes, carrier) = (self.tracks.get(track)?, self.carriers.get(&own.receiver_id)?);
            Some(NamedFigures {
                named_in_hindsight: boxes.values().sum(),
                right_in_hindsight: boxes.get(&Some(*carrier)).copied().unwrap_or_default(),
                ..NamedFigures::default()
            })
        });
        in_hindsight.fold(self.figures, NamedFigures::plus)
    }
}
