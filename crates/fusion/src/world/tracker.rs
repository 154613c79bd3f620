//! The set of tracks of a site, camera by camera.

use std::borrow::Cow;
use std::collections::BTreeMap;

use jiff::Timestamp;

use super::assignment::{Candidate, assign};
use super::association_cost::PredictedTrack;
use super::camera_clocks::CameraClocks;
use super::camera_moves::CameraMoves;
use super::comparisons::{Comparisons, TimedPosition};
use super::frame::{
    CameraFrame, FixOutcome, FrameOutcome, TimedEvent, WorldDetection, WorldEvent, WorldTrackId,
};
use super::merging::MergeCandidates;
use super::settings::WorldTrackSettings;
use super::world_track::{Sighting, WorldTrack, seconds_from};
use crate::clock_estimate::ClockEstimate;
use crate::domain::{CameraId, ReceiverId, ReceiverMatch};
use crate::geo::{EastNorth, LocalPlane, PlaneCovariance};

/// The tracks of all targets of a site, from the detections of all its cameras and the fixes of its receivers.
#[derive(Debug, Clone)]
pub struct WorldTracker {
    plane: LocalPlane,
    settings: WorldTrackSettings,
    /// In the order of their ids.
    tracks: Vec<WorldTrack>,
    merge_candidates: MergeCandidates,
    comparisons: Comparisons,
    clocks: CameraClocks,
    moves: CameraMoves,
    next_id: u64,
    /// Time of the latest frame.
    time: Option<Timestamp>,
}

impl WorldTracker {
    /// Without tracks, in the plane of the detections.
    #[must_use]
    pub fn new(plane: LocalPlane, settings: WorldTrackSettings) -> Self {
        Self {
            plane,
            settings,
            tracks: Vec::new(),
            merge_candidates: MergeCandidates::default(),
            comparisons: Comparisons::default(),
            clocks: CameraClocks::default(),
            moves: CameraMoves::default(),
            next_id: 1,
            time: None,
        }
    }

    /// The plane of all positions.
    #[must_use]
    pub const fn plane(&self) -> &LocalPlane {
        &self.plane
    }

    /// Its settings.
    #[must_use]
    pub const fn settings(&self) -> &WorldTrackSettings {
        &self.settings
    }

    /// Time of the latest frame.
    #[must_use]
    pub const fn time(&self) -> Option<Timestamp> {
        self.time
    }

    /// How late the times of each camera are, where crossings tell.
    #[must_use]
    pub const fn clocks(&self) -> &BTreeMap<CameraId, ClockEstimate> {
        self.clocks.clocks()
    }

    /// The time of a camera's frame by the clock of most cameras.
    #[must_use]
    pub fn corrected(&self, camera: &CameraId, time: Timestamp) -> Timestamp {
        self.clocks.corrected(camera, time)
    }

    /// All tracks in the order of their ids, tentative ones too.
    pub fn tracks(&self) -> impl Iterator<Item = &WorldTrack> {
        self.tracks.iter()
    }

    /// A track by its number.
    #[must_use]
    pub fn track(&self, id: WorldTrackId) -> Option<&WorldTrack> {
        self.index_of(id).map(|index| &self.tracks[index])
    }

    /// Ends the tracks that were not measured for too long at that time.
    pub fn advance(&mut self, time: Timestamp) -> Vec<TimedEvent> {
        let now = self.time.map_or(time, |latest| latest.max(time));
        self.time = Some(now);
        let ended: Vec<WorldTrack> =
            self.tracks.extract_if(.., |track| track.is_expired(now, &self.settings)).collect();
        if !ended.is_empty() {
            self.forget_ended_pairs();
        }
        let confirmed = ended.iter().filter(|track| track.is_confirmed());
        confirmed.map(|track| TimedEvent { time: now, event: WorldEvent::Lost { track: track.id } }).collect()
    }

    /// Takes the detections of one camera at one instant in. Frames of all cameras should come in the order of
    /// their times; one that is late by at most [`WorldTrackSettings::max_late_s`] is moved on with the velocity
    /// of its targets. Times are those of [`Self::corrected`].
    ///
    /// What is found of the cameras on the way is corrected from then on: clocks that are wrong by [`Self::corrected`], the
    /// positions of a camera that was moved here.
    pub fn observe(&mut self, frame: &CameraFrame) -> FrameOutcome {
        let outcome = self.tracked(&self.moved_back(frame));
        let review = self.comparisons.advance(frame.time);
        if review.has_observations {
            self.clocks.estimate(&self.comparisons);
        }
        let moved = self.moves.review(&self.comparisons, &review.long);
        FrameOutcome { has_new_clocks: review.has_observations, moved, ..outcome }
    }

    /// A camera has another map from now on: what its boxes have shown beside those of other cameras is forgotten.
    pub fn forget_comparisons(&mut self, camera: &CameraId) {
        self.comparisons.forget(camera);
        self.moves.forget(camera);
    }

    /// The frame without the shift of its camera.
    fn moved_back<'a>(&self, frame: &'a CameraFrame) -> Cow<'a, CameraFrame> {
        let Some(shift) = self.moves.shift(&frame.camera) else { return Cow::Borrowed(frame) };
        let mut frame = frame.clone();
        for detection in &mut frame.detections {
            detection.position = detection.position.minus(shift);
        }
        Cow::Owned(frame)
    }

    fn tracked(&mut self, frame: &CameraFrame) -> FrameOutcome {
        if self.time.is_some_and(|now| seconds_from(frame.time, now) > self.settings.max_late_s) {
            let tracks = vec![None; frame.detections.len()];
            return FrameOutcome { tracks, too_late: true, ..FrameOutcome::default() };
        }
        let mut events = self.advance(frame.time);
        let now = self.time.unwrap_or(frame.time);
        for track in &mut self.tracks {
            track.predict(now, &self.settings);
        }
        let processed = frame.detections.len().min(self.settings.max_detections);
        let detections = &frame.detections[..processed];
        // A detection starts a track at the cost 0: the density of new targets is in the costs of its pairs.
        let assigned = assign(processed, &self.candidates(frame, detections), 0.0);
        let mut indexes = Vec::with_capacity(processed);
        for (detection, track) in detections.iter().zip(assigned) {
            indexes.push(match track {
                Some(index) => {
                    self.update(index, frame, detection, &mut events);
                    Some(index)
                }
                None => self.start(frame, detection),
            });
        }
        let measured: Vec<usize> = indexes.iter().copied().flatten().collect();
        for &index in &measured {
            if self.tracks[index].confirm(&self.settings) {
                events
                    .push(TimedEvent { time: now, event: WorldEvent::Born { track: self.tracks[index].id } });
            }
        }
        let mut tracks: Vec<Option<WorldTrackId>> =
            indexes.iter().map(|index| index.map(|index| self.tracks[index].id)).collect();
        let mut merged = self.identify(&frame.camera, detections, &indexes, now, &mut events);
        merged.extend(self.merge_candidates.compare(&self.tracks, &measured, &self.settings));
        self.merge(&merged, now, &mut tracks, &mut events);
        tracks.resize(frame.detections.len(), None);
        let dropped = tracks.iter().filter(|track| track.is_none()).count();
        FrameOutcome { tracks, dropped, events, ..FrameOutcome::default() }
    }

    /// Takes a fix of a receiver in: it carries on the track of that receiver where no camera sees the target, or
    /// starts one. `sigma_m` is the standard deviation per axis.
    pub fn observe_fix(
        &mut self,
        receiver: &ReceiverId,
        time: Timestamp,
        position: EastNorth,
        sigma_m: f64,
    ) -> FixOutcome {
        let is_late = |latest: Timestamp| seconds_from(time, latest) > self.settings.max_late_s;
        if self.time.is_some_and(is_late) {
            return FixOutcome::default();
        }
        let variance_m2 = sigma_m * sigma_m;
        if let Some(index) = self.tracks.iter().position(|track| track.receiver.as_ref() == Some(receiver)) {
            let track = &mut self.tracks[index];
            track.predict(time, &self.settings);
            let position = track.moved_to_state_time(position, time);
            track.observe_fix(time, position, variance_m2, &self.settings);
            return FixOutcome { track: Some(track.id), events: Vec::new() };
        }
        if self.tracks.iter().any(|track| track.is_matched_with(receiver)) {
            return FixOutcome::default();
        }
        if self.tracks.len() >= self.settings.max_tracks {
            return FixOutcome::default();
        }
        let id = self.take_id();
        self.tracks.push(WorldTrack::from_fix(id, receiver, time, position, variance_m2, &self.settings));
        let timed = |event| TimedEvent { time, event };
        let events = vec![
            timed(WorldEvent::Born { track: id }),
            timed(WorldEvent::Identified { track: id, receiver: receiver.clone() }),
        ];
        FixOutcome { track: Some(id), events }
    }

    /// Says which receivers the targets of tracks carry, by association. All other tracks carry none. A track keeps its
    /// number and its boxes whatever it carries; the track of a receiver's fixes alone ends where a camera's track is found to
    /// be of the carrier.
    pub fn set_receiver_matches(
        &mut self,
        matches: &BTreeMap<WorldTrackId, ReceiverMatch>,
    ) -> Vec<TimedEvent> {
        let Some(time) = self.time else { return Vec::new() };
        let mut events = Vec::new();
        for at in 0..self.tracks.len() {
            let track = &mut self.tracks[at];
            let own = matches.get(&track.id).filter(|_| track.receiver.is_none());
            let before = std::mem::replace(&mut track.receiver_match, own.cloned());
            let id = track.id;
            if let Some(own) = own
                && before.is_none_or(|before| before.receiver_id != own.receiver_id)
            {
                let receiver = own.receiver_id.clone();
                events.push(TimedEvent { time, event: WorldEvent::Identified { track: id, receiver } });
            }
        }
        events.extend(self.end_tracks_of_fixes(time));
        events
    }

    /// Ends the tracks of fixes whose receivers' carriers cameras see by now.
    fn end_tracks_of_fixes(&mut self, time: Timestamp) -> Vec<TimedEvent> {
        let carriers: Vec<(ReceiverId, WorldTrackId)> = self
            .tracks
            .iter()
            .filter_map(|track| Some((track.receiver_match.as_ref()?.receiver_id.clone(), track.id)))
            .collect();
        let carrier_of = |track: &WorldTrack| {
            let receiver = track.receiver.as_ref().filter(|_| track.is_measured_by_receiver())?;
            carriers.iter().find(|(carried, _)| carried == receiver).map(|(_, carrier)| *carrier)
        };
        let merged = |(ended, track): (WorldTrackId, WorldTrackId)| TimedEvent {
            time,
            event: WorldEvent::Merged { track, ended },
        };
        let ended: Vec<(WorldTrackId, WorldTrackId)> =
            self.tracks.iter().filter_map(|track| Some((track.id, carrier_of(track)?))).collect();
        self.tracks.retain(|track| ended.iter().all(|(id, _)| *id != track.id));
        self.forget_ended_pairs();
        ended.into_iter().map(merged).collect()
    }

    /// The pairs of detection and track within the gates.
    fn candidates(&self, frame: &CameraFrame, detections: &[WorldDetection]) -> Vec<Candidate> {
        let mut candidates = Vec::new();
        let births_per_m2: Vec<f64> =
            detections.iter().map(|detection| self.settings.birth_density_per_m2(detection)).collect();
        for (column, track) in self.tracks.iter().enumerate() {
            let predicted = PredictedTrack::new(track, frame, &self.settings);
            for (row, (detection, birth_per_m2)) in detections.iter().zip(&births_per_m2).enumerate() {
                if let Some(cost) = predicted.cost(detection, *birth_per_m2, &self.settings) {
                    candidates.push(Candidate { row, column, cost });
                }
            }
        }
        candidates
    }

    /// Updates a track with its detection. Only the identity of a receiver joins what the gate keeps apart: the
    /// track then starts again at the detection.
    fn update(
        &mut self,
        index: usize,
        frame: &CameraFrame,
        detection: &WorldDetection,
        events: &mut Vec<TimedEvent>,
    ) {
        let predicted = PredictedTrack::new(&self.tracks[index], frame, &self.settings);
        let offset = predicted.offset(detection);
        let (innovation, s) = predicted.innovation(detection, &offset, &self.settings);
        let track = &mut self.tracks[index];
        if s.mahalanobis_squared(innovation) > self.settings.own_id_gate {
            track.filter.inflate_position(PlaneCovariance::outer(innovation.east_m, innovation.north_m));
        }
        if let Some(from) = track.observe(frame, detection, offset, &self.settings) {
            let event = WorldEvent::HandedOver { track: track.id, from, to: frame.camera.clone() };
            events.push(TimedEvent { time: frame.time, event });
        }
        let id = track.id;
        let timed = |camera, time, position| TimedPosition {
            camera,
            time,
            corrected_s: self.clocks.corrected_s(camera),
            position,
        };
        let own = timed(&frame.camera, frame.time, detection.position);
        for Sighting { camera, last_seen, position, .. } in self.tracks[index].sightings() {
            self.comparisons.compare(id, own, timed(camera, *last_seen, *position));
        }
    }

    /// Starts a track at a detection; its index, or `None` if there are too many.
    fn start(&mut self, frame: &CameraFrame, detection: &WorldDetection) -> Option<usize> {
        if self.tracks.len() >= self.settings.max_tracks {
            return None;
        }
        let id = self.take_id();
        let now = self.time.unwrap_or(frame.time);
        let mut track = WorldTrack::from_detection(id, &frame.camera, frame.time, detection, &self.settings);
        track.predict(now, &self.settings);
        // The identity is given with those of all other detections of the frame.
        track.receiver = None;
        self.tracks.push(track);
        Some(self.tracks.len() - 1)
    }

    /// Gives tracks the identities of their detections. A receiver has one track: the one that had its identity
    /// before goes on with the detections of the other one, unless the same frame shows both.
    /// Returns the pairs to merge, the track that goes on first.
    fn identify(
        &mut self,
        camera: &CameraId,
        detections: &[WorldDetection],
        indexes: &[Option<usize>],
        now: Timestamp,
        events: &mut Vec<TimedEvent>,
    ) -> Vec<(WorldTrackId, WorldTrackId)> {
        let mut merged = Vec::new();
        for (detection, index) in detections.iter().zip(indexes) {
            let (Some(receiver), Some(index)) = (&detection.receiver, *index) else { continue };
            if self.tracks[index].receiver.as_ref() == Some(receiver) {
                // Before the receiver was known, the tracker's number was on a track of its own.
                let anonymous = self.tracks.iter().enumerate().find(|(at, track)| {
                    track.receiver.is_none()
                        && !indexes.contains(&Some(*at))
                        && track.has_tracker_id(camera, detection.tracker_id.as_ref())
                });
                merged.extend(anonymous.map(|(_, track)| (self.tracks[index].id, track.id)));
                continue;
            }
            match self.tracks.iter().position(|track| track.receiver.as_ref() == Some(receiver)) {
                Some(owner) if !indexes.contains(&Some(owner)) => {
                    merged.push((self.tracks[owner].id, self.tracks[index].id));
                    continue;
                }
                Some(owner) => self.tracks[owner].receiver = None,
                None => {}
            }
            let track = &mut self.tracks[index];
            track.receiver = Some(receiver.clone());
            let event = WorldEvent::Identified { track: track.id, receiver: receiver.clone() };
            events.push(TimedEvent { time: now, event });
        }
        merged
    }

    /// Merges pairs of tracks; a track with a receiver goes on before one without.
    fn merge(
        &mut self,
        pairs: &[(WorldTrackId, WorldTrackId)],
        now: Timestamp,
        frame_tracks: &mut [Option<WorldTrackId>],
        events: &mut Vec<TimedEvent>,
    ) {
        for &(first, second) in pairs {
            let (Some(one), Some(other)) = (self.index_of(first), self.index_of(second)) else { continue };
            let other_first = self.tracks[one].receiver.is_none() && self.tracks[other].receiver.is_some();
            let (goes_on, ends) = if other_first { (second, one) } else { (first, other) };
            let ended = self.tracks.remove(ends);
            let ended_id = ended.id;
            if let Some(index) = self.index_of(goes_on) {
                self.tracks[index].absorb(ended);
            }
            for track in frame_tracks.iter_mut().filter(|track| **track == Some(ended_id)) {
                *track = Some(goes_on);
            }
            events.push(TimedEvent {
                time: now,
                event: WorldEvent::Merged { track: goes_on, ended: ended_id },
            });
        }
        if !pairs.is_empty() {
            self.forget_ended_pairs();
        }
    }

    fn forget_ended_pairs(&mut self) {
        let tracks = &self.tracks;
        self.merge_candidates.retain(|id| tracks.binary_search_by_key(&id, |track| track.id).is_ok());
    }

    fn index_of(&self, id: WorldTrackId) -> Option<usize> {
        self.tracks.binary_search_by_key(&id, |track| track.id).ok()
    }

    fn take_id(&mut self) -> WorldTrackId {
        let id = WorldTrackId(self.next_id);
        self.next_id += 1;
        id
    }
}
