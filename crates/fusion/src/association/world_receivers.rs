//! The receivers of a site matched with its world tracks.
//!
//! The positions of world tracks over the latest minutes are compared with the fixes of receivers as tracklets of one
//! camera are (chains, evidence and posterior of [`super::match_with_model`]). A world track has the boxes of all
//! cameras, so it is longer than a tracklet, and its own covariance says what is noise and what lasts: the offset of
//! the camera and what all cameras have in common. A receiver is an attribute of a track: nothing here changes which
//! boxes are on which track.

use std::collections::{BTreeMap, VecDeque};

use jiff::{SignedDuration, Timestamp};
use rand::Rng;

use super::cancellation::Cancellation;
use super::chains::ChainSettings;
use super::companions::missed_companion_factor;
use super::evidence::EvidenceModel;
use super::live::LiveMatchSettings;
use super::matching::{LEAST_WHITE_SIGMA_M, OwnedPiece, piece_posterior};
use super::receiver_clocks::{CarriedFixes, ReceiverClocks};
use super::tracklet::{SceneMotion, TimedFix, TrackPoint, Tracklet};
use crate::clock_estimate::earlier;
use crate::domain::{GaussMarkovNoise, ReceiverId, ReceiverMatch, Result};
use crate::geo::EastNorth;
use crate::world::{FrameOutcome, WorldEvent, WorldTrack, WorldTrackId, WorldTracker};

/// The receivers of world tracks by their latest round.
pub type WorldReceivers = BTreeMap<WorldTrackId, ReceiverMatch>;

/// The findings of a round.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct MatchedReceivers {
    /// The most probable receiver of each track as it is now.
    pub receivers: WorldReceivers,
    /// How late the receivers' clocks are.
    pub clocks: ReceiverClocks,
}

/// Position of a track at an instant with the variances per axis of its noise and of its lasting error, m2.
#[derive(Debug, Clone, Copy)]
struct SeenPoint {
    time: Timestamp,
    position: EastNorth,
    noise_m2: f64,
    lasting_m2: f64,
}

/// A fix in the tracker's plane.
#[derive(Debug, Clone, Copy)]
struct SeenFix {
    time: Timestamp,
    position: EastNorth,
    stated_variance_m2: Option<f64>,
}

/// The latest positions of a site's tracks and fixes of its receivers, and who carries what by the latest round.
#[derive(Debug, Clone)]
pub struct WorldReceiverWindow {
    settings: LiveMatchSettings,
    tracks: BTreeMap<WorldTrackId, VecDeque<SeenPoint>>,
    fixes: BTreeMap<ReceiverId, VecDeque<SeenFix>>,
    /// Time of the latest frame.
    latest: Option<Timestamp>,
    receivers: WorldReceivers,
    clocks: ReceiverClocks,
}

impl WorldReceiverWindow {
    /// Without tracks and fixes.
    #[must_use]
    pub const fn new(settings: LiveMatchSettings) -> Self {
        Self {
            settings,
            tracks: BTreeMap::new(),
            fixes: BTreeMap::new(),
            latest: None,
            receivers: WorldReceivers::new(),
            clocks: ReceiverClocks { by_receiver: BTreeMap::new(), common: None },
        }
    }

    /// Takes the tracks in that a camera's frame measured. Tracks that a client names need no match.
    pub fn observe(&mut self, tracker: &WorldTracker, outcome: &FrameOutcome) {
        for timed in &outcome.events {
            if let WorldEvent::Merged { track, ended } = timed.event {
                self.merge(track, ended);
            }
        }
        let measured = outcome.tracks.iter().flatten().filter_map(|id| tracker.track(*id));
        for track in measured.filter(|track| track.is_confirmed() && track.receiver().is_none()) {
            self.push(track);
        }
        if let Some(time) = tracker.time() {
            self.advance(time);
        }
    }

    /// Takes a fix in under the time that its receiver states. Before the first frame there is nothing to be matched with.
    pub fn observe_fix(
        &mut self,
        receiver_id: &ReceiverId,
        time: Timestamp,
        position: EastNorth,
        stated_variance_m2: Option<f64>,
    ) {
        let is_new = !self.fixes.contains_key(receiver_id);
        if self.latest.is_none() || is_new && self.fixes.len() >= self.settings.max_receivers {
            return;
        }
        let own = self.fixes.entry(receiver_id.clone()).or_default();
        // Gateways send the latest position again.
        let is_due = own.back().is_none_or(|last| {
            time.duration_since(last.time) >= self.settings.min_interval && position != last.position
        });
        if is_due {
            own.push_back(SeenFix { time, position, stated_variance_m2 });
        }
    }

    /// True if there is something to match.
    #[must_use]
    pub fn can_be_matched(&self) -> bool {
        !self.tracks.is_empty() && !self.fixes.is_empty()
    }

    /// The receivers by the latest round.
    #[must_use]
    pub const fn receivers(&self) -> &WorldReceivers {
        &self.receivers
    }

    /// The receivers' clocks by the latest round.
    #[must_use]
    pub const fn clocks(&self) -> &ReceiverClocks {
        &self.clocks
    }

    /// A receiver's time by the cameras' clock.
    #[must_use]
    pub fn corrected(&self, receiver: &ReceiverId, time: Timestamp) -> Timestamp {
        earlier(time, self.clocks.corrected_s(receiver))
    }

    /// The most probable receiver of each track as it is now, and the receivers' clocks.
    ///
    /// # Errors
    /// `Cancelled`.
    pub fn matched(&self, random: &mut impl Rng, cancellation: Cancellation<'_>) -> Result<MatchedReceivers> {
        let tracklets: Vec<Tracklet> = self.tracks.values().map(|own| self.tracklet(own)).collect();
        let fixes: Vec<Vec<TimedFix>> = self.fixes.values().map(|own| self.timed(own)).collect();
        let corrections_s = self.fixes.keys().map(|receiver| -self.clocks.corrected_s(receiver));
        let timed: Vec<(&[TimedFix], f64)> = fixes.iter().map(Vec::as_slice).zip(corrections_s).collect();
        let gnss = GaussMarkovNoise::PHONE.with_white_at_least(LEAST_WHITE_SIGMA_M * LEAST_WHITE_SIGMA_M);
        let model = EvidenceModel { gnss, motion: SceneMotion::of(&tracklets) };
        let posterior =
            piece_posterior(&tracklets, &timed, &model, &ChainSettings::default(), random, cancellation)?;
        let (tracks, receivers): (Vec<_>, Vec<_>) =
            (self.tracks.keys().collect(), self.fixes.keys().collect());
        // What was found before a cut is no evidence about the target after it.
        let owned: Vec<OwnedPiece> = posterior.owned().collect();
        let current = owned.iter().filter(|own| own.piece.end == tracklets[own.piece.tracklet].points.len());
        let matched = current.map(|own| {
            let receiver_id = receivers[own.receiver].clone();
            let probability = own.probability * missed_companion_factor();
            (*tracks[own.piece.tracklet], ReceiverMatch { receiver_id, probability })
        });
        let clock = |(receiver, own): (&ReceiverId, usize)| {
            let sure = owned
                .iter()
                .filter(|piece| piece.receiver == own && piece.probability >= self.settings.matched_from);
            let pieces: Vec<&[TrackPoint]> = sure
                .map(|own| &tracklets[own.piece.tracklet].points[own.piece.first..own.piece.end])
                .collect();
            let carried = CarriedFixes { pieces: &pieces, fixes: &fixes[own] };
            Some((receiver.clone(), carried.clock(&model)?))
        };
        let clocks = self.fixes.keys().zip(0..).filter_map(clock).collect();
        Ok(MatchedReceivers { receivers: matched.collect(), clocks: ReceiverClocks::new(clocks) })
    }

    /// Takes the findings of a round over: a match begins when it is sure, and stays until it is unlikely.
    pub fn accept(&mut self, MatchedReceivers { receivers: matched, clocks }: MatchedReceivers) {
        self.clocks = clocks;
        let before = std::mem::take(&mut self.receivers);
        let is_held = |id: &WorldTrackId, own: &ReceiverMatch| {
            before.get(id).is_some_and(|held| held.receiver_id == own.receiver_id)
        };
        let LiveMatchSettings { matched_from, unmatched_below, .. } = self.settings;
        let holds = |(id, own): &(WorldTrackId, ReceiverMatch)| {
            own.probability >= if is_held(id, own) { unmatched_below } else { matched_from }
        };
        self.receivers = matched.into_iter().filter(holds).collect();
    }

    fn push(&mut self, track: &WorldTrack) {
        let (state, lasting_m2) = (track.state(), track.lasting_covariance().per_axis_m2());
        let own = self.tracks.entry(track.id()).or_default();
        let time = track.time();
        if own.back().is_none_or(|last| time.duration_since(last.time) >= self.settings.min_interval) {
            let noise_m2 = (state.covariance_m2.per_axis_m2() - lasting_m2).max(0.0);
            own.push_back(SeenPoint { time, position: state.position, noise_m2, lasting_m2 });
        }
    }

    /// The track that goes on has the past of the one that ends.
    fn merge(&mut self, track: WorldTrackId, ended: WorldTrackId) {
        if let Some(past) = self.tracks.remove(&ended) {
            let own = self.tracks.entry(track).or_default();
            own.extend(past);
            own.make_contiguous().sort_by_key(|point| point.time);
        }
        if let Some(receiver) = self.receivers.remove(&ended) {
            self.receivers.entry(track).or_insert(receiver);
        }
    }

    /// Moves the window on; drops what is older once a second.
    fn advance(&mut self, time: Timestamp) {
        let before = self.latest.map(Timestamp::as_second);
        let latest = self.latest.map_or(time, |latest| latest.max(time));
        self.latest = Some(latest);
        if before != Some(latest.as_second()) {
            let oldest = latest.checked_sub(self.settings.window).unwrap_or(Timestamp::MIN);
            self.drop_before(oldest.max(self.oldest_of_most_rows()));
        }
    }

    /// The oldest time of as many positions as the window may have.
    fn oldest_of_most_rows(&self) -> Timestamp {
        let mut times: Vec<Timestamp> = self.tracks.values().flatten().map(|point| point.time).collect();
        match times.len().checked_sub(self.settings.max_rows) {
            Some(surplus) if surplus > 0 => *times.select_nth_unstable(surplus).1,
            _ => Timestamp::MIN,
        }
    }

    fn drop_before(&mut self, oldest: Timestamp) {
        for own in self.tracks.values_mut() {
            own.drain(..own.partition_point(|point| point.time < oldest));
        }
        for own in self.fixes.values_mut() {
            own.drain(..own.partition_point(|fix| fix.time < oldest));
        }
        self.tracks.retain(|_, own| !own.is_empty());
        self.fixes.retain(|_, own| !own.is_empty());
    }

    /// Seconds since the window's end; negative before it.
    fn seconds(&self, time: Timestamp) -> f64 {
        self.latest.map_or(SignedDuration::ZERO, |latest| time.duration_since(latest)).as_secs_f64()
    }

    fn tracklet(&self, own: &VecDeque<SeenPoint>) -> Tracklet {
        let point = |seen: &SeenPoint| TrackPoint {
            time_s: self.seconds(seen.time),
            position: seen.position,
            box_variance_m2: seen.noise_m2,
            map_variance_m2: seen.lasting_m2,
        };
        Tracklet { points: own.iter().map(point).collect() }
    }

    fn timed(&self, own: &VecDeque<SeenFix>) -> Vec<TimedFix> {
        let fix = |seen: &SeenFix| TimedFix {
            time_s: self.seconds(seen.time),
            position: seen.position,
            stated_variance_m2: seen.stated_variance_m2,
        };
        own.iter().map(fix).collect()
    }
}

#[cfg(test)]
mod tests {
    use rand_chacha::ChaCha8Rng;

    use super::*;
    use crate::domain::CameraId;
    use crate::geo::{LocalPlane, PlaneCovariance, Position};
    use crate::simulation::{SimulatedReceiver, standard_normal, stream};
    use crate::world::{CameraFrame, WorldDetection, WorldTrackSettings};

    /// Walkers on circles of their own, of whom the first ones carry phones.
    const WALKERS: usize = 6;
    const PHONES: usize = 2;

    fn at_s(seconds: f64) -> Timestamp {
        Timestamp::from_microsecond(1_767_600_000_000_000 + (seconds * 1e6) as i64).expect("within range")
    }

    fn position(walker: usize, seconds: f64) -> EastNorth {
        let (radius_m, angle) =
            (4.0 + walker as f64, walker as f64 + 0.1 * seconds * (1.0 + 0.3 * walker as f64));
        EastNorth {
            east_m: 12.0 * walker as f64 % 25.0 + radius_m * angle.cos(),
            north_m: radius_m * angle.sin(),
        }
    }

    fn receiver_id(walker: usize) -> ReceiverId {
        ReceiverId::new(&format!("phone-{walker}")).expect("short")
    }

    /// The frame of one of two cameras, which take turns every half minute; no tracker's id is alike in both.
    fn frame(step: u32, random: &mut ChaCha8Rng) -> CameraFrame {
        let seconds = 0.5 * f64::from(step);
        let camera = if (step / 60).is_multiple_of(2) { "a" } else { "b" };
        let detections = (0..WALKERS).map(|walker| {
            let noise = [0; 2].map(|_| 0.1 * standard_normal(random));
            let at = position(walker, seconds);
            WorldDetection {
                tracker_id: None,
                receiver: None,
                position: EastNorth { east_m: at.east_m + noise[0], north_m: at.north_m + noise[1] },
                covariance_m2: PlaneCovariance::isotropic(0.02),
                offset_covariance_m2: PlaneCovariance::isotropic(0.01),
                common_covariance_m2: PlaneCovariance::isotropic(0.25),
            }
        });
        let camera = CameraId::new(camera).expect("a slug");
        CameraFrame { camera, time: at_s(seconds), detections: detections.collect() }
    }

    /// A tracker and a window after two minutes of walking, with phones whose times are late by so much, s; and the last frame's
    /// tracks.
    fn walked(late_s: &[f64], seed: u64) -> (WorldTracker, WorldReceiverWindow, FrameOutcome) {
        let origin = Position::new(11.0, 48.0).expect("within range");
        let mut tracker = WorldTracker::new(LocalPlane::new(origin), WorldTrackSettings::default());
        let mut window = WorldReceiverWindow::new(LiveMatchSettings::of_site());
        let phone = |own: usize| SimulatedReceiver::seeded(GaussMarkovNoise::PHONE, seed, own as u64);
        let mut phones: Vec<SimulatedReceiver> = (0..late_s.len()).map(phone).collect();
        let (mut random, mut last) = (stream(seed, 1_000), FrameOutcome::default());
        for step in 0..240 {
            last = tracker.observe(&frame(step, &mut random));
            window.observe(&tracker, &last);
            if step % 20 == 0 {
                let matched = window.matched(&mut random, Cancellation::NEVER).expect("never cancelled");
                window.accept(matched);
            }
            for (walker, phone) in phones.iter_mut().enumerate().filter(|_| step % 2 == 0) {
                let seconds = 0.5 * f64::from(step);
                let measured = phone.measure(position(walker, seconds - late_s[walker]), 1.0);
                window.observe_fix(&receiver_id(walker), at_s(seconds), measured, None);
            }
        }
        tracker.set_receiver_matches(window.receivers());
        (tracker, window, last)
    }

    #[test]
    fn world_tracks_are_matched_with_the_receivers_of_their_targets() {
        let (tracker, _, last) = walked(&[0.0; PHONES], 7);
        for (walker, track) in last.tracks.iter().enumerate() {
            let track = tracker.track(track.expect("assigned")).expect("live");
            let found = track.receiver_match().map(|own| own.receiver_id.clone());
            assert_eq!(found, (walker < PHONES).then(|| receiver_id(walker)), "walker {walker}");
        }
    }

    #[test]
    fn clocks_are_found_late_as_far_as_walks_tell_and_what_all_have_in_common_is_the_cameras() {
        let (mut squares, mut count) = (0.0, 0.0);
        for seed in 1..=3 {
            for (late_s, is_common) in
                [([0.0; 5], false), ([0.0, 0.0, 0.0, 0.0, 1.5], false), ([-2.0; 5], true)]
            {
                let (_, window, _) = walked(&late_s, seed);
                let clocks = window.clocks();
                for (walker, late_s) in late_s.iter().enumerate() {
                    let own = clocks.by_receiver[&receiver_id(walker)];
                    squares += ((own.offset_s - late_s) / own.sigma_s).powi(2);
                    count += 1.0;
                    let corrected_s = clocks.corrected_s(&receiver_id(walker));
                    assert!((corrected_s - late_s).abs() < 0.5, "{seed}, {walker}: {own:?}, {corrected_s}");
                }
                assert_eq!(clocks.common.is_some_and(|common| common.is_wrong()), is_common, "{seed}");
            }
        }
        let in_sigmas: f64 = (squares / count).sqrt();
        assert!((0.7..1.3).contains(&in_sigmas), "{in_sigmas}");
    }

    #[test]
    fn a_window_is_bounded_in_time_and_number() {
        let origin = Position::new(11.0, 48.0).expect("within range");
        let mut tracker = WorldTracker::new(LocalPlane::new(origin), WorldTrackSettings::default());
        let settings = LiveMatchSettings { max_rows: 100, max_receivers: 1, ..LiveMatchSettings::of_site() };
        let (mut window, mut random) = (WorldReceiverWindow::new(settings), stream(5, 0));
        for step in 0..1_000 {
            let outcome = tracker.observe(&frame(step, &mut random));
            window.observe(&tracker, &outcome);
            for walker in 0..2 {
                let time = at_s(0.5 * f64::from(step));
                window.observe_fix(&receiver_id(walker), time, position(walker, f64::from(step)), None);
            }
        }
        let points = window.tracks.values().map(VecDeque::len).sum::<usize>();
        // Those of one instant stay together, and older ones are dropped once a second.
        assert!((50..=100 + 2 * WALKERS).contains(&points), "{points}");
        assert_eq!(window.fixes.len(), 1);
        assert!(window.fixes.values().all(|own| own.len() <= 100));
    }
}
