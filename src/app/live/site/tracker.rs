//! Frames of a site's cameras through the world tracker, and what is published of it.

use std::collections::hash_map::Entry;
use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::sync::Arc;
use std::time::Duration;

use jiff::{SignedDuration, Timestamp};

use super::clocks::{ClockHistories, SiteClocks};
use super::events::{SiteEvent, SiteEventKind};
use super::item::{ItemSource, SiteItem};
use super::places::SitePlaces;
use super::published::{WorldSighting, WorldTrackPoint};
use super::state::SiteLive;
use crate::app::history::path::{FinishedTrack, RecordedState};
use crate::app::history::queue::HistoryQueue;
use crate::app::history::recorder::TrackRecorder;
use crate::app::live::alarms::Finding;
use crate::app::live::sync::lock;
use crate::config::Limits;
use crate::domain::{CameraId, CameraMoved, LiveId, ReceiverId, RunId, TargetClass, TargetId};
use crate::fusion::association::{LiveMatchSettings, MatchedReceivers, WorldReceiverWindow};
use crate::fusion::frame_assembler::{AssembledFrame, FrameAssembler, FrameLimits, PushOutcome};
use crate::fusion::smoother::FilterMoments;
use crate::fusion::world::{
    CameraFrame, MovedCamera, TimedEvent, WorldDetection, WorldEvent, WorldTrack, WorldTrackId,
    WorldTrackSettings, WorldTracker,
};
use crate::geo::{LocalPlane, PlaneCovariance};
use crate::telemetry::{Metrics, SiteItemOutcome};

/// Positions of a track are announced at least this far apart in time; readers follow people, not frames.
const ANNOUNCE_STEP: SignedDuration = SignedDuration::from_millis(200);
/// A target counts as the carrier of a receiver until this long after its latest fix.
const CARRIER_FOR: Duration = Duration::from_secs(60);
/// A camera counts as one of the site's until this long after its latest box.
const CAMERA_FOR: Duration = Duration::from_secs(60);

/// Where frames come from. Cameras sort before receivers, so that a box is tracked before the fix of its instant.
#[derive(Debug, Clone, PartialEq, Eq, Hash, PartialOrd, Ord)]
enum Source {
    Camera(CameraId),
    Receiver(TargetId),
}

/// The tracker of one site.
pub(super) struct SiteTracker {
    live: Arc<SiteLive>,
    limits: Limits,
    metrics: Metrics,
    /// Where measured tracks are evaluated.
    places: Option<SitePlaces>,
    frames: FrameAssembler<Source, SiteItem>,
    /// Time by which a fix may be older than the latest frame.
    fix_lateness: SignedDuration,
    active: Option<ActiveTracker>,
    /// Added to the numbers of the tracker's tracks, so that none is announced twice when it starts again.
    number_offset: u64,
    /// The highest number that was announced.
    highest_number: u64,
    /// The cameras of which boxes came lately.
    cameras: HashMap<CameraId, SeenModel>,
    /// Targets of which fixes came.
    carriers: HashMap<TargetId, Carrier>,
    /// The tracks whose start was announced and whose end was not, each with the latest instant at which its
    /// position was announced.
    announced: HashMap<LiveId, Option<Timestamp>>,
    /// Those of them that are recorded, if the site has a history.
    recorders: HashMap<LiveId, TrackRecorder>,
    history: HistoryQueue,
    /// Cameras that were moved, as far as nobody has taken them.
    findings: Vec<Finding>,
    /// A clock is the same when the tracker starts again.
    clock_histories: ClockHistories,
}

/// The model by which a camera's boxes were located.
struct SeenModel {
    /// The run that trained it together with other cameras, if one did.
    joint_run: Option<RunId>,
    /// Reading of the monotonic clock when its latest box came.
    noted_at: Duration,
}

/// A target that carries a receiver.
struct Carrier {
    /// Time of its latest fix; the same one may come again with the boxes of another camera.
    fixed_at: Timestamp,
    /// Reading of the monotonic clock when it came.
    noted_at: Duration,
    /// The cameras through which its fixes came: a box of theirs with the target's id is of this target.
    cameras: BTreeSet<CameraId>,
}

/// A world tracker with its plane.
struct ActiveTracker {
    tracker: WorldTracker,
    /// True if the plane is that of the operator or of a model; a fix alone may be anywhere.
    has_trusted_plane: bool,
    /// Reading of the monotonic clock when a frame was tracked last.
    tracked_at: Duration,
    /// The latest time of a frame.
    latest: Timestamp,
    /// The version of each camera's model whose boxes came last.
    model_versions: BTreeMap<CameraId, u32>,
    /// Positions of its tracks and fixes of its receivers, and who carries what.
    window: WorldReceiverWindow,
}

impl SiteTracker {
    pub(super) fn new(
        live: Arc<SiteLive>,
        limits: Limits,
        metrics: Metrics,
        places: Option<SitePlaces>,
        history: HistoryQueue,
    ) -> Self {
        let max_late_s = WorldTrackSettings::default().max_late_s;
        let fix_lateness = SignedDuration::try_from_secs_f64(max_late_s).unwrap_or_default();
        let frames = FrameAssembler::new(FrameLimits {
            wait: Duration::from_millis(limits.site_wait_ms),
            lateness: fix_lateness,
            frames: limits.site_frames,
            items_per_frame: limits.boxes_per_frame,
        });
        Self {
            live,
            limits,
            metrics,
            places,
            frames,
            fix_lateness,
            active: None,
            number_offset: 0,
            highest_number: 0,
            cameras: HashMap::new(),
            carriers: HashMap::new(),
            announced: HashMap::new(),
            recorders: HashMap::new(),
            history,
            findings: Vec::new(),
            clock_histories: ClockHistories::default(),
        }
    }

    /// The cameras that were found to have been moved since the last call.
    pub(super) fn take_findings(&mut self) -> Vec<Finding> {
        std::mem::take(&mut self.findings)
    }

    /// Takes an item; [`Self::advance`] tracks what is complete.
    pub(super) fn push(&mut self, item: SiteItem, now: Duration) {
        let (source, is_pacing) = match (&item.source, &item.target_id) {
            (ItemSource::Box { joint, .. }, _) => {
                let seen = SeenModel { joint_run: joint.map(|joint| joint.run), noted_at: now };
                self.cameras.insert(item.camera.clone(), seen);
                (Source::Camera(item.camera.clone()), true)
            }
            (ItemSource::Fix { .. }, Some(target_id)) => {
                if !self.note_carrier(&item.camera, target_id, item.time, now) {
                    return;
                }
                (Source::Receiver(target_id.clone()), false)
            }
            (ItemSource::Fix { .. }, None) => return,
        };
        let time = match (&source, &self.active) {
            (Source::Camera(camera), Some(active)) => active.tracker.corrected(camera, item.time),
            (Source::Receiver(target_id), Some(active)) => {
                active.window.corrected(&ReceiverId::from(target_id.clone()), item.time)
            }
            (_, None) => item.time,
        };
        match self.frames.push(&source, is_pacing, time, item, now) {
            PushOutcome::Waiting => {}
            PushOutcome::Late => self.metrics.site_item(SiteItemOutcome::Late),
            PushOutcome::FrameFull => self.metrics.site_item(SiteItemOutcome::Overflow),
        }
    }

    /// Notes a fix of a target; whether it is a new one.
    fn note_carrier(
        &mut self,
        camera: &CameraId,
        target_id: &TargetId,
        time: Timestamp,
        now: Duration,
    ) -> bool {
        if let Some(carrier) = self.carriers.get_mut(target_id) {
            carrier.cameras.insert(camera.clone());
            carrier.noted_at = now;
            // The times of a recording that is played again are much earlier.
            let lag = carrier.fixed_at.duration_since(time);
            let is_new = lag.is_negative() || lag > self.fix_lateness;
            if is_new {
                carrier.fixed_at = time;
            }
            return is_new;
        }
        if self.carriers.len() >= self.limits.tracks_per_site {
            self.carriers.retain(|_, carrier| !carrier.is_outdated(now));
        }
        if self.carriers.len() < self.limits.tracks_per_site {
            let carrier = Carrier { fixed_at: time, noted_at: now, cameras: [camera.clone()].into() };
            self.carriers.insert(target_id.clone(), carrier);
        }
        true
    }

    /// True if time changes anything: frames wait, or tracks may end.
    pub(super) fn is_busy(&self) -> bool {
        !self.frames.is_empty() || self.active.as_ref().is_some_and(|it| it.tracker.tracks().next().is_some())
    }

    /// Tracks the frames that are complete. Where none came for a while, the time of the cameras goes on by the
    /// monotonic clock, so that tracks end.
    pub(super) fn advance(&mut self, now: Duration) {
        self.follow_origin();
        while let Some(frame) = self.frames.release(now) {
            self.track(frame, now);
        }
        let wait = Duration::from_millis(self.limits.site_wait_ms);
        let Some(active) = &mut self.active else { return };
        let idle = now.saturating_sub(active.tracked_at);
        if idle > wait
            && self.frames.is_empty()
            && let Ok(idle) = SignedDuration::try_from(idle)
            && let Ok(time) = active.latest.checked_add(idle)
        {
            let events = active.tracker.advance(time);
            self.announce(events);
        }
    }

    /// The input of a round of matching, if there is anything to match.
    pub(super) fn window(&self) -> Option<(u64, WorldReceiverWindow)> {
        let window = self.active.as_ref().map(|active| &active.window)?;
        window.can_be_matched().then(|| (self.number_offset, window.clone()))
    }

    /// Takes the findings of a round over, unless the tracker has started again since the round began with that offset of
    /// its numbers.
    pub(super) fn accept(&mut self, number_offset: u64, found: MatchedReceivers) {
        let Some(active) = self.active.as_mut().filter(|_| self.number_offset == number_offset) else {
            return;
        };
        active.window.accept(found);
        let mut clocks = active.window.clocks().clone();
        self.clock_histories.note_receivers(active.latest, &mut clocks);
        let wrong = lock(&self.live.clocks).set_receivers(clocks);
        self.metrics.clocks_wrong(wrong);
        let events = active.tracker.set_receiver_matches(active.window.receivers());
        self.announce(events);
    }

    /// Ends all tracks, for the site has ended, and returns those that were recorded.
    pub(super) fn end(&mut self) -> Vec<FinishedTrack> {
        let finished = self.recorders.drain().filter_map(|(_, recorder)| recorder.finish()).collect();
        self.restart();
        finished
    }

    /// Starts again where the operator has moved the origin.
    fn follow_origin(&mut self) {
        let Some(origin) = *lock(&self.live.origin) else { return };
        if self.active.as_ref().is_some_and(|active| active.tracker.plane().origin() != origin) {
            self.restart();
        }
    }

    /// Ends the tracker and its tracks; the next frame starts another.
    fn restart(&mut self) {
        let Some(active) = self.active.take() else { return };
        let tracks: Vec<LiveId> = self.announced.keys().copied().collect();
        for track in tracks {
            self.announce_end(track, active.latest, SiteEventKind::Ended(track));
        }
        self.number_offset = self.highest_number;
        // The next tracker knows of no clock.
        *lock(&self.live.clocks) = SiteClocks::default();
    }

    fn track(&mut self, frame: AssembledFrame<Source, SiteItem>, now: Duration) {
        let is_rewound = self.active.as_ref().is_some_and(|active| {
            let late = active.latest.duration_since(frame.time);
            late.as_secs_f64() > active.tracker.settings().max_late_s
        });
        if is_rewound {
            // The assembler releases such a frame only after the clock of the sources went back.
            self.restart();
        }
        if !self.prepare(&frame.items) {
            let dropped = frame.items.len();
            (0..dropped).for_each(|_| self.metrics.site_item(SiteItemOutcome::OutOfRange));
            return;
        }
        let Some(active) = &mut self.active else { return };
        active.tracked_at = now;
        active.latest = active.latest.max(frame.time);
        match frame.source {
            Source::Camera(camera) => self.track_boxes(camera, frame.time, &frame.items),
            Source::Receiver(target_id) => self.track_fix(&target_id, frame.time, &frame.items),
        }
    }

    /// Makes sure that there is a tracker whose plane holds the first of these; false if none can.
    fn prepare(&mut self, items: &[SiteItem]) -> bool {
        let Some(first) = items.first() else { return false };
        let model_origin = match &first.source {
            ItemSource::Box { model_origin, .. } => Some(*model_origin),
            ItemSource::Fix { .. } => None,
        };
        let holds =
            |active: &ActiveTracker| active.tracker.plane().to_plane_within_range(first.position).is_some();
        match &self.active {
            Some(active) if holds(active) => return true,
            // A fix that was wrong by far must not keep the boxes out.
            Some(active) if !active.has_trusted_plane && model_origin.is_some() => self.restart(),
            Some(_) => return false,
            None => {}
        }
        let stated = *lock(&self.live.origin);
        let origin = stated.or(model_origin).unwrap_or(first.position);
        let settings = WorldTrackSettings {
            max_tracks: self.limits.tracks_per_site,
            max_detections: self.limits.boxes_per_frame,
            ..WorldTrackSettings::default()
        };
        let active = ActiveTracker {
            tracker: WorldTracker::new(LocalPlane::new(origin), settings),
            has_trusted_plane: stated.or(model_origin).is_some(),
            tracked_at: Duration::ZERO,
            latest: first.time,
            model_versions: BTreeMap::new(),
            window: WorldReceiverWindow::new(LiveMatchSettings::of_site()),
        };
        let is_held = holds(&active);
        self.active = Some(active);
        is_held
    }

    /// The run that trained the models of all cameras together of which boxes came lately.
    fn joint_run(&mut self, now: Duration) -> Option<RunId> {
        self.cameras.retain(|_, seen| now.saturating_sub(seen.noted_at) < CAMERA_FOR);
        let mut runs = self.cameras.values().map(|seen| seen.joint_run);
        let first = runs.next()??;
        runs.all(|run| run == Some(first)).then_some(first)
    }

    fn track_boxes(&mut self, camera: CameraId, time: Timestamp, items: &[SiteItem]) {
        let Some(now) = self.active.as_ref().map(|active| active.tracked_at) else { return };
        let joint_run = self.joint_run(now);
        let Some(active) = &mut self.active else { return };
        let plane = *active.tracker.plane();
        let carries = |camera: &CameraId, target_id: &TargetId| {
            let carrier = self.carriers.get(target_id).filter(|carrier| !carrier.is_outdated(now));
            carrier.is_some_and(|carrier| carrier.cameras.contains(camera))
        };
        let (mut detections, mut classes) =
            (Vec::with_capacity(items.len()), Vec::with_capacity(items.len()));
        let settings = active.tracker.settings();
        for item in items {
            let detection = detection_of(item, &plane, settings, joint_run, carries);
            self.metrics.site_item(detection.as_ref().err().copied().unwrap_or(SiteItemOutcome::Tracked));
            if let Ok(detection) = detection {
                detections.push(detection);
                classes.push(item.class.clone());
            }
        }
        active.follow_model(&camera, items);
        let outcome = active.tracker.observe(&CameraFrame { camera, time, detections });
        self.findings.extend(outcome.moved.as_ref().and_then(|moved| active.finding(moved)));
        if outcome.has_new_clocks {
            let mut clocks = active.tracker.clocks().clone();
            self.clock_histories.note_cameras(time, &mut clocks);
            let wrong = lock(&self.live.clocks).set_cameras(clocks);
            self.metrics.clocks_wrong(wrong);
        }
        active.window.observe(&active.tracker, &outcome);
        self.announce(outcome.events);
        let tracked = outcome.tracks.into_iter().zip(classes);
        let classes: BTreeMap<WorldTrackId, _> =
            tracked.filter_map(|(track, class)| Some((track?, class))).collect();
        for (track, class) in classes {
            self.publish(track, class, true);
        }
    }

    fn track_fix(&mut self, target_id: &TargetId, time: Timestamp, items: &[SiteItem]) {
        let (Some(active), Some(item)) = (&mut self.active, items.first()) else { return };
        let ItemSource::Fix { variance_m2 } = item.source else { return };
        let position = active.tracker.plane().to_plane(item.position);
        self.metrics.site_item(SiteItemOutcome::Tracked);
        let receiver = ReceiverId::from(target_id.clone());
        active.window.observe_fix(&receiver, item.time, position, Some(variance_m2));
        let outcome = active.tracker.observe_fix(&receiver, time, position, variance_m2.sqrt());
        self.announce(outcome.events);
        if let Some(track) = outcome.track {
            self.publish(track, None, false);
        }
    }

    /// Publishes and records a track that was measured by a box, or else by a fix, and announces its position from time to
    /// time.
    fn publish(&mut self, track: WorldTrackId, class: Option<TargetClass>, has_box: bool) {
        let Some(active) = &self.active else { return };
        let Some(track) = active.tracker.track(track) else { return };
        let point = Arc::new(self.point_of(track, active.tracker.plane()));
        if self.announced.contains_key(&point.id) {
            let (velocity_covariance, moments) =
                (track.state().velocity_covariance, track.moments(active.tracker.settings()));
            self.record(&point, class.as_ref(), velocity_covariance, moments);
        }
        let Some(announced_at) = self.announced.get_mut(&point.id) else { return };
        lock(&self.live.tracks).publish(&point, self.limits.track_points);
        if let Some(places) = &self.places {
            places.measured(&point, class, has_box);
        }
        if announced_at.is_none_or(|last| point.time.duration_since(last).abs() >= ANNOUNCE_STEP) {
            *announced_at = Some(point.time);
            self.live.events.push(SiteEvent { time: point.time, kind: SiteEventKind::Measured(point) });
        }
    }

    fn record(
        &mut self,
        point: &WorldTrackPoint,
        class: Option<&TargetClass>,
        velocity_covariance: PlaneCovariance,
        moments: FilterMoments,
    ) {
        let Some((scope, settings)) = lock(&self.live.history).clone() else {
            self.recorders.clear();
            return;
        };
        let recorder = self
            .recorders
            .entry(point.id)
            .or_insert_with(|| TrackRecorder::new(self.history.clone(), scope, settings));
        recorder.push(&RecordedState {
            track: Some(point.id.to_string()),
            target: point.target_id.as_ref(),
            class,
            time: point.time,
            position: point.position,
            velocity: point.velocity,
            covariance: point.covariance_m2,
            velocity_covariance,
            stationary_probability: point.motion.stationary_probability,
            moments,
            is_restarted: false,
        });
    }

    fn point_of(&self, track: &WorldTrack, plane: &LocalPlane) -> WorldTrackPoint {
        let state = track.state();
        let matched = track.receiver_match().map(|own| &own.receiver_id);
        let receiver = track.receiver().or(matched);
        let current = track
            .sightings()
            .iter()
            .filter(|sighting| WorldSighting::is_current(sighting.last_seen, track.last_seen()));
        WorldTrackPoint {
            id: self.id_of(track.id()),
            target_id: receiver.cloned().map(TargetId::from),
            receiver_match: track.receiver_match().cloned(),
            time: track.last_seen(),
            started_at: track.born(),
            position: plane.to_position(state.position),
            velocity: state.velocity,
            motion: state.motion(),
            covariance_m2: state.covariance_m2,
            velocity_covariance_m2_s2: state.velocity_covariance,
            sightings: current
                .map(|sighting| WorldSighting {
                    camera_id: sighting.camera.clone(),
                    tracker_id: sighting.tracker_id.clone(),
                    last_seen_at: sighting.last_seen,
                })
                .collect(),
        }
    }

    fn id_of(&self, track: WorldTrackId) -> LiveId {
        self.live.id_of(self.number_offset + track.0)
    }

    fn announce(&mut self, events: Vec<TimedEvent>) {
        for TimedEvent { time, event } in events {
            let kind = match event {
                WorldEvent::Born { track } => {
                    self.announce_start(self.id_of(track), time);
                    continue;
                }
                // Nobody knows of a track that is not confirmed yet.
                WorldEvent::HandedOver { track, .. } | WorldEvent::Identified { track, .. }
                    if !self.announced.contains_key(&self.id_of(track)) =>
                {
                    continue;
                }
                WorldEvent::HandedOver { track, from, to } => {
                    self.metrics.handed_over();
                    SiteEventKind::HandedOver { track: self.id_of(track), from, to }
                }
                WorldEvent::Identified { track, receiver } => {
                    SiteEventKind::Identified { track: self.id_of(track), target_id: receiver.into() }
                }
                WorldEvent::Merged { track, ended } => {
                    let (track, ended) = (self.id_of(track), self.id_of(ended));
                    if let Some(places) = &self.places {
                        places.merged(track, ended);
                    }
                    if self.announced.contains_key(&ended) {
                        // A tentative track that merges a confirmed one becomes confirmed.
                        self.announce_start(track, time);
                    }
                    self.announce_end(ended, time, SiteEventKind::Merged { track, ended });
                    continue;
                }
                WorldEvent::Lost { track } => {
                    let track = self.id_of(track);
                    self.announce_end(track, time, SiteEventKind::Ended(track));
                    continue;
                }
            };
            self.live.events.push(SiteEvent { time, kind });
        }
    }

    /// Announces a track that was not announced yet.
    fn announce_start(&mut self, track: LiveId, time: Timestamp) {
        if let Entry::Vacant(entry) = self.announced.entry(track) {
            entry.insert(None);
            self.highest_number = self.highest_number.max(track.number);
            self.metrics.world_track_started();
            self.live.events.push(SiteEvent { time, kind: SiteEventKind::Started(track) });
        }
    }

    /// Nobody knows of a track that was never announced.
    fn announce_end(&mut self, track: LiveId, time: Timestamp, kind: SiteEventKind) {
        self.recorders.remove(&track);
        if self.announced.remove(&track).is_some() {
            lock(&self.live.tracks).remove(track);
            self.metrics.world_track_ended();
            self.live.events.push(SiteEvent { time, kind });
        }
    }
}

impl ActiveTracker {
    /// What a camera's boxes have shown beside those of others holds for one version of its model.
    fn follow_model(&mut self, camera: &CameraId, items: &[SiteItem]) {
        let version_of = |item: &SiteItem| match item.source {
            ItemSource::Box { model_version, .. } => Some(model_version),
            ItemSource::Fix { .. } => None,
        };
        let Some(version) = items.iter().find_map(version_of) else { return };
        let before = self.model_versions.insert(camera.clone(), version);
        if before.is_some_and(|before| before != version) {
            self.tracker.forget_comparisons(camera);
        }
    }

    fn finding(&self, found: &MovedCamera) -> Option<Finding> {
        let moved = CameraMoved {
            model_version: *self.model_versions.get(&found.camera)?,
            onset_at: found.onset_at,
            raised_at: self.latest,
            shift_east_m: found.shift.east_m,
            shift_north_m: found.shift.north_m,
            statistic: found.statistic,
            targets: u32::try_from(found.targets).unwrap_or(u32::MAX),
        };
        Some(Finding { camera: found.camera.clone(), moved })
    }
}

impl Carrier {
    fn is_outdated(&self, now: Duration) -> bool {
        now.saturating_sub(self.noted_at) >= CARRIER_FOR
    }
}

/// A box in the plane of the tracker, or why it is not tracked. `joint_run` is the run that trained all cameras together;
/// `carries` tells whether a receiver of the target is known.
fn detection_of(
    item: &SiteItem,
    plane: &LocalPlane,
    settings: &WorldTrackSettings,
    joint_run: Option<RunId>,
    carries: impl Fn(&CameraId, &TargetId) -> bool,
) -> Result<WorldDetection, SiteItemOutcome> {
    let ItemSource::Box { covariance_m2, map_covariance_m2, joint, .. } = &item.source else {
        return Err(SiteItemOutcome::OutOfRange);
    };
    let position = plane.to_plane_within_range(item.position).ok_or(SiteItemOutcome::OutOfRange)?;
    // Spread over more than the area of one new target, a box would start a track rather than join any.
    if covariance_m2.determinant().sqrt() * settings.birth_density_per_m2[0] >= 1.0 {
        return Err(SiteItemOutcome::Uncertain);
    }
    let carrier = item.target_id.clone().filter(|target_id| carries(&item.camera, target_id));
    // The error of a map does not average out over frames, nor does a part of the noise. Without a joint run it is unknown
    // how much of it other cameras share: all of it is the camera's own then, and all of it is stated.
    let (common_m2, lasting_noise_m2) = match joint {
        Some(joint) if Some(joint.run) == joint_run => (joint.common_m2, joint.lasting_noise_m2),
        _ => (PlaneCovariance::default(), PlaneCovariance::default()),
    };
    let noise_m2 = covariance_m2.minus(*map_covariance_m2).minus(lasting_noise_m2);
    Ok(WorldDetection {
        tracker_id: item.tracked_as.clone(),
        receiver: carrier.map(ReceiverId::from),
        position,
        covariance_m2: noise_m2,
        offset_covariance_m2: map_covariance_m2.minus(common_m2).plus(lasting_noise_m2),
        common_covariance_m2: common_m2,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::app::history::queue::ArchivedHistory;
    use crate::geo::Position;

    const START_S: i64 = 1_800_000_000;

    struct Site {
        live: Arc<SiteLive>,
        tracker: SiteTracker,
        now: Duration,
        box_variance_m2: f64,
    }

    impl Site {
        fn new() -> Self {
            let live = SiteLive::new(1, 100);
            let tracker = SiteTracker::new(
                live.clone(),
                Limits::default(),
                Metrics::new(),
                None,
                ArchivedHistory::new(&Limits::default(), Metrics::new()).0.queue().clone(),
            );
            Self { live, tracker, now: Duration::ZERO, box_variance_m2: 0.25 }
        }

        /// A box of a target at the origin of its camera's model, each a tenth of a second after the one before.
        fn see(&mut self, tracker_id: &str, ms: i64) {
            self.now += Duration::from_millis(100);
            let origin = Position::new(8.0, 47.0).expect("valid");
            let item = SiteItem {
                camera: CameraId::new("a").expect("a slug"),
                time: Timestamp::from_millisecond(1_000 * START_S + ms).expect("in range"),
                target_id: Some(TargetId::new(tracker_id).expect("a name")),
                tracked_as: Some(TargetId::new(tracker_id).expect("a name")),
                class: None,
                position: origin,
                source: ItemSource::Box {
                    model_version: 1,
                    covariance_m2: PlaneCovariance::isotropic(self.box_variance_m2),
                    map_covariance_m2: PlaneCovariance::isotropic(0.16),
                    joint: None,
                    model_origin: origin,
                },
            };
            self.tracker.push(item, self.now);
            self.tracker.advance(self.now);
        }

        fn numbers(&self) -> Vec<u64> {
            lock(&self.live.tracks).latest().iter().map(|point| point.id.number).collect()
        }

        fn wait(&mut self, time: Duration) {
            self.now += time;
            self.tracker.advance(self.now);
        }
    }

    #[test]
    fn a_track_ends_by_the_monotonic_clock_where_nothing_comes() {
        let mut site = Site::new();
        (0..10).for_each(|frame| site.see("7", 100 * frame));
        assert_eq!(site.numbers(), [1]);
        site.wait(Duration::from_secs(1));
        assert_eq!(site.numbers(), [1], "it may be seen again");
        assert!(site.tracker.is_busy());
        site.wait(Duration::from_secs(3));
        assert!(site.numbers().is_empty() && !site.tracker.is_busy());
    }

    #[test]
    fn tracks_start_again_with_other_numbers_when_the_origin_is_changed() {
        let mut site = Site::new();
        (0..10).for_each(|frame| site.see("7", 100 * frame));
        site.live.set_origin(Some(Position::new(8.001, 47.0).expect("valid")));
        (10..20).for_each(|frame| site.see("7", 100 * frame));
        assert_eq!(site.numbers(), [2], "a number names one track only");
        site.live.set_origin(Some(Position::new(9.0, 48.0).expect("valid")));
        (20..30).for_each(|frame| site.see("7", 100 * frame));
        assert!(site.numbers().is_empty(), "the camera is out of the plane's range");
    }

    #[test]
    fn tracks_start_again_where_a_recording_is_played_again() {
        let mut site = Site::new();
        (0..100).for_each(|frame| site.see("7", 100 * frame));
        assert_eq!(site.numbers(), [1]);
        // Late for five seconds, then the recording is taken to have begun again.
        (0..100).for_each(|frame| site.see("7", 100 * frame));
        assert_eq!(site.numbers(), [2]);
    }

    #[test]
    fn a_box_is_of_the_target_whose_fixes_came_through_its_camera() {
        let mut site = Site::new();
        let fix = SiteItem {
            camera: CameraId::new("a").expect("a slug"),
            time: Timestamp::from_second(START_S).expect("in range"),
            target_id: Some(TargetId::new("walker").expect("a name")),
            tracked_as: None,
            class: None,
            position: Position::new(8.0, 47.0).expect("valid"),
            source: ItemSource::Fix { variance_m2: 4.0 },
        };
        site.tracker.push(fix, site.now);
        (1..10).for_each(|frame| site.see("walker", 100 * frame));
        let points = lock(&site.live.tracks).latest();
        let identity = points[0].target_id.as_ref().map(TargetId::as_str);
        assert_eq!((points.len(), identity), (1, Some("walker")));
        let camera = &points[0].sightings[0];
        assert_eq!(camera.tracker_id.as_ref().map(TargetId::as_str), Some("walker"));
    }

    #[test]
    fn a_box_that_may_be_anywhere_starts_no_track() {
        let mut site = Site::new();
        site.box_variance_m2 = 400.0;
        (0..20).for_each(|frame| site.see("7", 100 * frame));
        assert!(site.numbers().is_empty());
        site.box_variance_m2 = 0.25;
        (20..40).for_each(|frame| site.see("7", 100 * frame));
        assert_eq!(site.numbers().len(), 1);
    }

    #[test]
    fn a_track_is_announced_before_anything_else_of_it_and_published_only_then() {
        let mut site = Site::new();
        (0..3).for_each(|frame| site.see("7", 100 * frame));
        let time = Timestamp::from_second(START_S).expect("in range");
        let [announced, unconfirmed] = [WorldTrackId(1), WorldTrackId(9)];
        let handed_over = |track| {
            let camera = |name: &str| CameraId::new(name).expect("a slug");
            WorldEvent::HandedOver { track, from: camera("a"), to: camera("b") }
        };
        let merged = WorldEvent::Merged { track: unconfirmed, ended: announced };
        let events = [handed_over(unconfirmed), merged, handed_over(unconfirmed)];
        let before = site.live.events.latest();
        site.tracker.announce(events.map(|event| TimedEvent { time, event }).into());
        // Its start, the merger, and the second hand-over.
        assert_eq!(site.live.events.latest() - before, 3);
        assert!(site.numbers().is_empty(), "the first track has ended");
        site.tracker.announce(vec![TimedEvent { time, event: WorldEvent::Lost { track: unconfirmed } }]);
        assert!(site.tracker.announced.is_empty());
    }
}
