//! One target of a site: its state, its identity, and the cameras that see it.

use jiff::Timestamp;

use super::camera_offset::CameraOffset;
use super::constant_velocity::ConstantVelocityFilter;
use super::frame::{CameraFrame, WorldDetection, WorldTrackId};
use super::settings::WorldTrackSettings;
use crate::domain::{CameraId, Motion, ReceiverId, ReceiverMatch, TargetId, Velocity};
use crate::geo::{EastNorth, PlaneCovariance};
use crate::smoother::FilterMoments;

/// States if a track is reported.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TrackStatus {
    /// Too few detections so far: it may be a false detection.
    Tentative,
    /// Measured at its latest chance.
    Confirmed,
    /// Confirmed, and not measured since [`WorldTrackSettings::unconfirmed_coast_s`].
    Coasting,
}

/// A camera that has seen a track.
#[derive(Debug, Clone, PartialEq)]
pub struct Sighting {
    /// The camera.
    pub camera: CameraId,
    /// The id that its tracker gave the target last.
    pub tracker_id: Option<TargetId>,
    /// When it saw the target last.
    pub last_seen: Timestamp,
    /// Its offset from the track then.
    pub(super) offset: CameraOffset,
    /// The position by its own detection then, m.
    pub(super) position: EastNorth,
}

/// The estimated state of a target at one instant.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct WorldState {
    /// Position in the site's plane, m.
    pub position: EastNorth,
    /// Velocity in that plane.
    pub velocity: Velocity,
    /// Covariance of its error, m2/s2.
    pub velocity_covariance: PlaneCovariance,
    /// Probability that the target is stationary, 0 to 1.
    pub stationary_probability: f64,
    /// Covariance of the position's error, with the part that all cameras have in common, m2.
    pub covariance_m2: PlaneCovariance,
}

impl WorldState {
    /// Speed and course with their intervals.
    #[must_use]
    pub fn motion(&self) -> Motion {
        Motion::of(self.velocity, self.velocity_covariance, self.stationary_probability)
    }
}

/// A track of the world.
#[derive(Debug, Clone)]
pub struct WorldTrack {
    pub(super) id: WorldTrackId,
    pub(super) filter: ConstantVelocityFilter,
    /// Instant of the filter's state.
    pub(super) time: Timestamp,
    /// Covariance of the lasting error of the camera that measured it last, m2.
    pub(super) offset_covariance_m2: PlaneCovariance,
    /// Covariance of the error that the latest measurements have in common, m2.
    common_covariance_m2: PlaneCovariance,
    /// True if the latest measurement was a fix.
    measured_by_receiver: bool,
    pub(super) born: Timestamp,
    pub(super) last_seen: Timestamp,
    pub(super) detections: u32,
    confirmed: bool,
    /// By its name, which a client states.
    pub(super) receiver: Option<ReceiverId>,
    /// By association.
    pub(super) receiver_match: Option<ReceiverMatch>,
    sightings: Vec<Sighting>,
}

impl WorldTrack {
    /// Starts at a detection.
    pub(super) fn from_detection(
        id: WorldTrackId,
        camera: &CameraId,
        time: Timestamp,
        detection: &WorldDetection,
        settings: &WorldTrackSettings,
    ) -> Self {
        let covariance_m2 = settings.measurement_covariance(detection);
        let mut track = Self::at(id, time, detection.position, covariance_m2, settings);
        track.receiver.clone_from(&detection.receiver);
        track.offset_covariance_m2 = detection.offset_covariance_m2;
        track.common_covariance_m2 = detection.common_covariance_m2;
        track.detections = 1;
        // The track is where this camera sees the target: its offset is known to be 0.
        track.record_sighting(camera, time, detection, CameraOffset::default());
        track
    }

    /// Starts at a fix; a receiver needs no confirmation.
    pub(super) fn from_fix(
        id: WorldTrackId,
        receiver: &ReceiverId,
        time: Timestamp,
        position: EastNorth,
        variance_m2: f64,
        settings: &WorldTrackSettings,
    ) -> Self {
        let white_m2 = settings.receiver_white_share * variance_m2;
        let mut track = Self::at(id, time, position, PlaneCovariance::isotropic(white_m2), settings);
        track.common_covariance_m2 = PlaneCovariance::isotropic(variance_m2 - white_m2);
        track.receiver = Some(receiver.clone());
        track.measured_by_receiver = true;
        track.confirmed = true;
        track
    }

    fn at(
        id: WorldTrackId,
        time: Timestamp,
        position: EastNorth,
        covariance_m2: PlaneCovariance,
        settings: &WorldTrackSettings,
    ) -> Self {
        Self {
            id,
            filter: ConstantVelocityFilter::new(position, covariance_m2, settings.birth_speed_sigma_m_s),
            time,
            offset_covariance_m2: PlaneCovariance::default(),
            common_covariance_m2: PlaneCovariance::default(),
            measured_by_receiver: false,
            born: time,
            last_seen: time,
            detections: 0,
            confirmed: false,
            receiver: None,
            receiver_match: None,
            sightings: Vec::new(),
        }
    }

    /// Its number.
    #[must_use]
    pub const fn id(&self) -> WorldTrackId {
        self.id
    }

    /// Time of its first measurement.
    #[must_use]
    pub const fn born(&self) -> Timestamp {
        self.born
    }

    /// Time of its latest measurement.
    #[must_use]
    pub const fn last_seen(&self) -> Timestamp {
        self.last_seen
    }

    /// Instant of [`Self::state`].
    #[must_use]
    pub const fn time(&self) -> Timestamp {
        self.time
    }

    /// The receiver that the target carries, if a client names it or only its fixes measure the track.
    #[must_use]
    pub const fn receiver(&self) -> Option<&ReceiverId> {
        self.receiver.as_ref()
    }

    /// The receiver that the target carries with some probability, by association.
    #[must_use]
    pub const fn receiver_match(&self) -> Option<&ReceiverMatch> {
        self.receiver_match.as_ref()
    }

    pub(super) fn is_matched_with(&self, receiver: &ReceiverId) -> bool {
        self.receiver_match.as_ref().is_some_and(|own| own.receiver_id == *receiver)
    }

    /// The cameras that have seen it, in the order in which they first did.
    #[must_use]
    pub fn sightings(&self) -> &[Sighting] {
        &self.sightings
    }

    /// True if the camera's tracker gave the track that number last.
    pub(super) fn has_tracker_id(&self, camera: &CameraId, tracker_id: Option<&TargetId>) -> bool {
        let sighting = self.sightings.iter().find(|sighting| sighting.camera == *camera);
        tracker_id.is_some() && sighting.is_some_and(|sighting| sighting.tracker_id.as_ref() == tracker_id)
    }

    /// The cameras that see it: those that saw it within that time (s) before its latest measurement.
    pub fn cameras_within(&self, seconds: f64) -> impl Iterator<Item = &CameraId> {
        let recent = move |sighting: &&Sighting| seconds_from(sighting.last_seen, self.last_seen) <= seconds;
        self.sightings.iter().filter(recent).map(|sighting| &sighting.camera)
    }

    /// Returns the track's status at the tracker's time.
    #[must_use]
    pub fn status(&self, now: Timestamp, settings: &WorldTrackSettings) -> TrackStatus {
        if !self.confirmed {
            TrackStatus::Tentative
        } else if seconds_from(self.last_seen, now) <= settings.unconfirmed_coast_s {
            TrackStatus::Confirmed
        } else {
            TrackStatus::Coasting
        }
    }

    /// True if the track has been confirmed.
    #[must_use]
    pub const fn is_confirmed(&self) -> bool {
        self.confirmed
    }

    /// The state at [`Self::time`].
    #[must_use]
    pub fn state(&self) -> WorldState {
        WorldState {
            position: self.filter.position(),
            velocity: self.filter.velocity(),
            velocity_covariance: self.filter.velocity_covariance(),
            stationary_probability: self.filter.stationary_probability(),
            covariance_m2: self.filter.position_covariance().plus(self.lasting_covariance()),
        }
    }

    /// The part of the state's covariance that does not average out over some seconds: the camera's own and what all
    /// cameras have in common, m2.
    #[must_use]
    pub fn lasting_covariance(&self) -> PlaneCovariance {
        self.offset_covariance_m2.plus(self.common_covariance_m2)
    }

    /// What a smoother needs beside the state.
    #[must_use]
    pub fn moments(&self, settings: &WorldTrackSettings) -> FilterMoments {
        self.filter.moments(settings)
    }

    /// The state predicted to another instant.
    #[must_use]
    pub fn state_at(&self, time: Timestamp, settings: &WorldTrackSettings) -> WorldState {
        let mut predicted = self.clone();
        predicted.predict(time, settings);
        predicted.state()
    }

    pub(super) fn predict(&mut self, time: Timestamp, settings: &WorldTrackSettings) {
        if time > self.time {
            self.filter.predict(seconds_from(self.time, time), settings);
            self.time = time;
        }
    }

    /// True if its position is that of its receiver: no camera sees it.
    pub(super) const fn is_measured_by_receiver(&self) -> bool {
        self.measured_by_receiver
    }

    /// Covariance of the filter's position and of the errors that a camera's detection does not share with the
    /// latest measurement.
    pub(super) fn gating_covariance(&self) -> PlaneCovariance {
        let filtered = self.filter.position_covariance();
        if self.measured_by_receiver { filtered.plus(self.common_covariance_m2) } else { filtered }
    }

    /// Takes a detection in, which is expected to have that offset; the state is at the frame's time, or later than a
    /// late frame. Returns the camera that saw the target last, if this is another one's first sight of it since.
    pub(super) fn observe(
        &mut self,
        frame: &CameraFrame,
        detection: &WorldDetection,
        offset: CameraOffset,
        settings: &WorldTrackSettings,
    ) -> Option<CameraId> {
        let CameraFrame { camera, time, .. } = frame;
        let time = *time;
        if self.measured_by_receiver {
            self.filter.inflate_position(self.common_covariance_m2);
            self.measured_by_receiver = false;
        }
        let position = offset.removed_from(self.moved_to_state_time(detection.position, time));
        let r = settings.measurement_covariance(detection).plus(offset.covariance_m2);
        let s = self.filter.position_covariance().plus(r);
        let offset = offset.updated(position.minus(self.filter.position()), s);
        self.filter.update(position, r);
        self.offset_covariance_m2 = detection.offset_covariance_m2;
        self.common_covariance_m2 = detection.common_covariance_m2;
        self.detections += 1;
        let from = self.handed_over_from(camera, time, settings);
        self.last_seen = self.last_seen.max(time);
        self.record_sighting(camera, time, detection, offset);
        from
    }

    /// A position measured before the state's time, moved on with the estimated velocity.
    pub(super) fn moved_to_state_time(&self, position: EastNorth, time: Timestamp) -> EastNorth {
        let late_s = seconds_from(time, self.time).max(0.0);
        let Velocity { east_m_s, north_m_s } = self.filter.velocity();
        position.plus(EastNorth { east_m: late_s * east_m_s, north_m: late_s * north_m_s })
    }

    /// Takes a fix in. While cameras see the target, they determine its position: a receiver's error lasts for
    /// as long as its correlation time, so a fix adds little, and would add its bias.
    pub(super) fn observe_fix(
        &mut self,
        time: Timestamp,
        position: EastNorth,
        variance_m2: f64,
        settings: &WorldTrackSettings,
    ) {
        let seen_by_camera =
            self.sightings.iter().any(|it| seconds_from(it.last_seen, time) <= settings.coast_s);
        if !seen_by_camera {
            if !self.measured_by_receiver {
                self.filter.inflate_position(self.common_covariance_m2);
            }
            let white = PlaneCovariance::isotropic(settings.receiver_white_share * variance_m2);
            let coloured = PlaneCovariance::isotropic(variance_m2).minus(white);
            // The first fix after a camera meets a state without the receiver's bias.
            let r = if self.measured_by_receiver { white } else { white.plus(coloured) };
            self.filter.update(position, r);
            self.offset_covariance_m2 = PlaneCovariance::default();
            self.common_covariance_m2 = coloured;
            self.measured_by_receiver = true;
        }
        self.last_seen = self.last_seen.max(time);
    }

    /// Confirms the track if it has enough detections; whether it was confirmed by this.
    pub(super) const fn confirm(&mut self, settings: &WorldTrackSettings) -> bool {
        let confirms = !self.confirmed && self.detections >= settings.confirming_detections;
        self.confirmed |= confirms;
        confirms
    }

    /// True if the track ends because it has had no measurement until now.
    pub(super) fn is_expired(&self, now: Timestamp, settings: &WorldTrackSettings) -> bool {
        let allowed_s = if !self.confirmed {
            settings.unconfirmed_coast_s
        } else if self.receiver.is_some() && self.measured_by_receiver {
            settings.receiver_time_constant_s
        } else {
            settings.coast_s
        };
        seconds_from(self.last_seen, now) > allowed_s
    }

    /// Takes over what another track of the same target knows.
    pub(super) fn absorb(&mut self, mut other: Self) {
        let apart = other.filter.position().minus(self.filter.position());
        let apart_m2 = other.gating_covariance().plus(self.gating_covariance());
        if other.last_seen > self.last_seen {
            let back = EastNorth::default().minus(apart);
            self.sightings.iter_mut().for_each(|it| it.offset = it.offset.on_other_track(back, apart_m2));
            self.filter = other.filter;
            self.time = other.time;
            self.offset_covariance_m2 = other.offset_covariance_m2;
            self.common_covariance_m2 = other.common_covariance_m2;
            self.measured_by_receiver = other.measured_by_receiver;
            self.last_seen = other.last_seen;
        } else {
            other.sightings.iter_mut().for_each(|it| it.offset = it.offset.on_other_track(apart, apart_m2));
        }
        self.born = self.born.min(other.born);
        self.detections += other.detections;
        self.confirmed |= other.confirmed;
        self.receiver = self.receiver.take().or(other.receiver);
        self.receiver_match = self.receiver_match.take().or(other.receiver_match);
        for sighting in other.sightings {
            match self.sightings.iter_mut().find(|own| own.camera == sighting.camera) {
                Some(own) if own.last_seen >= sighting.last_seen => {}
                Some(own) => *own = sighting,
                None => self.sightings.push(sighting),
            }
        }
    }

    fn handed_over_from(
        &self,
        camera: &CameraId,
        time: Timestamp,
        settings: &WorldTrackSettings,
    ) -> Option<CameraId> {
        let latest = self.sightings.iter().max_by_key(|it| it.last_seen)?;
        let sees_it =
            |it: &Sighting| it.camera == *camera && seconds_from(it.last_seen, time) <= settings.coast_s;
        let is_new = !self.sightings.iter().any(sees_it);
        (is_new && latest.camera != *camera).then(|| latest.camera.clone())
    }

    fn record_sighting(
        &mut self,
        camera: &CameraId,
        time: Timestamp,
        WorldDetection { tracker_id, position, .. }: &WorldDetection,
        offset: CameraOffset,
    ) {
        match self.sightings.iter_mut().find(|it| it.camera == *camera) {
            Some(own) => {
                own.last_seen = own.last_seen.max(time);
                own.tracker_id.clone_from(tracker_id);
                own.offset = offset;
                own.position = *position;
            }
            None => {
                let (camera, tracker_id, position) = (camera.clone(), tracker_id.clone(), *position);
                self.sightings.push(Sighting { camera, tracker_id, last_seen: time, offset, position });
            }
        }
    }
}

/// Seconds from one instant to another; negative if that is the earlier one.
pub(super) fn seconds_from(from: Timestamp, to: Timestamp) -> f64 {
    to.duration_since(from).as_secs_f64()
}
