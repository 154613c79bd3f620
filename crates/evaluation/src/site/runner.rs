//! Trains the maps of a recorded site, tracks its targets, and scores the tracks.

use std::collections::{BTreeMap, BTreeSet};

use jiff::Timestamp;

use super::box_figures::{BoxFigures, BoxRecord};
use super::clock_figures::ClockFigures;
use super::crossing_figures::{CrossingFigures, CrossingRecorder, PlaceCounts};
use super::receiver_feed::{NamedFigures, ReceiverFeed};
use super::recording::{LabelledBox, RecordedFix, SiteRecording};
use super::world_figures::{PositionFigures, ReportedTrack, WorldFigures, WorldInstant};
use crate::domain::{BoundingBox, CameraId, ImageSize, ReceiverId};
use crate::fusion::world::{CameraFrame, WorldDetection, WorldTrack, WorldTrackSettings, WorldTracker};
use crate::geo::PlaneCovariance;
use crate::model::{
    RECEIVER_CORRELATION, SiteFitError, SiteFitInput, SiteFix, SiteKnownPoint, SiteMaps, SitePair,
    SitePosition, box_at, fit_site,
};

/// A track is reported at an instant if a camera measured it within this time, s.
const REPORTED_WITHIN_S: f64 = 0.05;

/// How the cameras' maps are trained.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SiteTraining {
    /// All cameras in one problem, held to each other where they see one target at one time.
    Together,
    /// Each camera on the fixes of the receivers that it sees.
    Apart,
}

/// Who says which boxes belong together.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Identities {
    /// The tracker.
    Tracked,
    /// The truth: every box names its target. What remains is the maps' error.
    Oracle,
}

/// The maps of a site's cameras.
pub struct TrainedSite {
    maps: Vec<SiteMaps>,
    training: SiteTraining,
}

/// The tracks of a recording and their figures.
#[derive(Debug, Clone)]
pub struct SiteOutcome {
    /// Identity of the boxes.
    pub boxes: BoxFigures,
    /// Positions within 1 m.
    pub world: WorldFigures,
    /// Crossings of lines over the area.
    pub crossings: Option<CrossingFigures>,
    /// Counts of lines over the area and of its middle.
    pub counts: Vec<PlaceCounts>,
    /// The receivers of tracks, where fixes came.
    pub named: Option<NamedFigures>,
    /// The clocks of receivers at the end, likewise.
    pub receiver_clocks: Option<ClockFigures>,
    /// Errors of the positions.
    pub positions: Option<PositionFigures>,
    /// The same of the targets that one camera of the recording sees, by camera.
    pub positions_in_view: Vec<Option<PositionFigures>>,
    /// The cameras whose clocks were found to be wrong, in the order in which they were found.
    pub wrong_clocks: Vec<FoundCamera>,
    /// The cameras that were found to have been moved, likewise.
    pub moved: Vec<FoundCamera>,
    /// Time of the first box.
    pub started_at: Timestamp,
}

impl SiteOutcome {
    /// Counts the times to findings of moved cameras from that instant on; one that is negative was found before.
    pub fn count_moves_from(&mut self, knocked_at: Timestamp) {
        let before_s = knocked_at.duration_since(self.started_at).as_secs_f64();
        self.moved.iter_mut().for_each(|found| found.after_s -= before_s);
    }
}

/// A camera of which something was found.
#[derive(Debug, Clone, PartialEq)]
pub struct FoundCamera {
    /// The camera.
    pub camera: CameraId,
    /// Time from the first box to the finding, s ([`SiteOutcome::count_moves_from`]).
    pub after_s: f64,
}

/// Trains the maps with the known identities of the receivers' carriers.
///
/// # Errors
/// A camera has too few rows, or there is no solution.
pub fn train_site(recording: &SiteRecording, training: SiteTraining) -> Result<TrainedSite, SiteFitError> {
    let (fixes, pairs) = site_fit_rows(recording);
    let maps = match training {
        SiteTraining::Together => {
            let image_sizes = vec![recording.image_size; recording.cameras.len()];
            vec![fit(&image_sizes, &fixes, &pairs, &recording.known_points)?]
        }
        SiteTraining::Apart => (0..recording.cameras.len())
            .map(|camera| {
                let own: Vec<SiteFix> = fixes.iter().filter_map(|fix| fix.seen_by(camera)).collect();
                let known = recording.known_points.iter().filter(|point| point.camera == camera);
                let known: Vec<_> = known.map(|point| SiteKnownPoint { camera: 0, ..*point }).collect();
                fit(&[recording.image_size], &own, &[], &known).map_err(|error| match error {
                    SiteFitError::TooFewRows { .. } => SiteFitError::TooFewRows { camera },
                    other => other,
                })
            })
            .collect::<Result<_, _>>()?,
    };
    Ok(TrainedSite { maps, training })
}

fn fit(
    image_sizes: &[Option<ImageSize>],
    fixes: &[SiteFix],
    pairs: &[SitePair],
    known_points: &[SiteKnownPoint],
) -> Result<SiteMaps, SiteFitError> {
    fit_site(&SiteFitInput { image_sizes, fixes, pairs, known_points, correlation: RECEIVER_CORRELATION })
}

impl TrainedSite {
    /// A box as a detection of the world. Maps trained apart do not know what they have in common: all of their
    /// error then counts as the camera's own.
    fn locate(&self, camera: usize, bounding_box: &BoundingBox) -> SitePosition {
        match self.training {
            SiteTraining::Together => self.maps[0].locate(camera, bounding_box),
            SiteTraining::Apart => {
                let located = self.maps[camera].locate(0, bounding_box);
                let relative_m2 = located.relative_m2.plus(located.common_m2);
                SitePosition { relative_m2, common_m2: PlaneCovariance::default(), ..located }
            }
        }
    }
}

/// The training rows of a recording: every fix with its carrier's boxes at that instant, and the carriers in two
/// cameras at one time. Only targets with a receiver are known by name.
#[must_use]
pub fn site_fit_rows(recording: &SiteRecording) -> (Vec<SiteFix>, Vec<SitePair>) {
    let carriers: BTreeSet<usize> = recording.receivers.iter().map(|(_, target)| *target).collect();
    let mut by_camera: Vec<BTreeMap<usize, Vec<&LabelledBox>>> =
        vec![BTreeMap::new(); recording.cameras.len()];
    for (camera, own) in recording.cameras.iter().enumerate() {
        for labelled in &own.boxes {
            if let Some(target) = labelled.target.filter(|target| carriers.contains(target)) {
                by_camera[camera].entry(target).or_default().push(labelled);
            }
        }
    }
    let start = recording.fixes.first().map(|fix| fix.time).unwrap_or_default();
    let site_fix = |fix: &RecordedFix| {
        let target = recording.receivers[fix.receiver].1;
        let boxes: Vec<(usize, BoundingBox)> = by_camera
            .iter()
            .enumerate()
            .filter_map(|(camera, targets)| Some((camera, labelled_box_at(targets.get(&target)?, fix.time)?)))
            .collect();
        (!boxes.is_empty()).then(|| SiteFix {
            receiver: fix.receiver as u32,
            time_s: fix.time.duration_since(start).as_secs_f64(),
            position: fix.position,
            boxes,
        })
    };
    let mut at_once: BTreeMap<(Timestamp, usize), Vec<(usize, BoundingBox)>> = BTreeMap::new();
    for (camera, targets) in by_camera.iter().enumerate() {
        for (target, boxes) in targets {
            for labelled in boxes {
                at_once.entry((labelled.time, *target)).or_default().push((camera, labelled.bounding_box));
            }
        }
    }
    let pairs = at_once.iter().flat_map(|((time, target), seen)| {
        let time_s = time.duration_since(start).as_secs_f64();
        let pair = move |one: &(usize, BoundingBox), other: &(usize, BoundingBox)| SitePair {
            target: *target as u32,
            time_s,
            cameras: [one.0, other.0],
            boxes: [one.1, other.1],
        };
        seen.iter()
            .enumerate()
            .flat_map(move |(index, one)| seen[index + 1..].iter().map(move |other| pair(one, other)))
    });
    (recording.fixes.iter().filter_map(site_fix).collect(), pairs.collect())
}

fn labelled_box_at(boxes: &[&LabelledBox], time: Timestamp) -> Option<BoundingBox> {
    box_at(boxes, |labelled| (labelled.time, labelled.bounding_box), time)
}

/// Tracks the boxes of some cameras and scores the tracks against the truth; `visible` is the recording whose boxes
/// say which targets can be seen at all. With `fixes`, those of the recording are matched with the tracks as in the
/// service.
#[must_use]
pub fn track_site(
    recording: &SiteRecording,
    visible: &SiteRecording,
    trained: &TrainedSite,
    identities: Identities,
    cameras: &[usize],
    fixes: bool,
) -> SiteOutcome {
    let mut frames = CameraFrames::new(recording, cameras);
    let in_view = visible.visible_to(cameras);
    let visits = visible.visits();
    let views: Vec<_> = (0..visible.cameras.len()).map(|camera| visible.visible_to(&[camera])).collect();
    let mut instants_in_view: Vec<Vec<WorldInstant>> = vec![Vec::new(); views.len()];
    let mut tracker = WorldTracker::new(recording.plane, WorldTrackSettings::default());
    let mut crossings = CrossingRecorder::over(recording.plane, recording.truth.values().copied());
    let (mut records, mut instants) = (Vec::new(), Vec::new());
    let mut receivers = fixes.then(|| ReceiverFeed::new(recording));
    let (mut start, mut wrong_clocks, mut moved) = (None, Vec::new(), Vec::new());
    // What the move of a camera adds to the error of its map, as in the service, m2.
    let mut added_m2 = vec![0.0; recording.cameras.len()];
    while let Some((time, by_camera)) = frames.next(&tracker) {
        let first = records.len();
        let after_s = time.duration_since(*start.get_or_insert(time)).as_secs_f64();
        if let Some(receivers) = &mut receivers {
            receivers.advance(&mut tracker, time);
        }
        for (camera, boxes) in by_camera {
            let detections = boxes
                .iter()
                .map(|labelled| {
                    let located = detection(recording, trained, identities, camera, labelled);
                    let added_m2 = PlaneCovariance::isotropic(added_m2[camera]);
                    let offset_covariance_m2 = located.offset_covariance_m2.plus(added_m2);
                    WorldDetection { offset_covariance_m2, ..located }
                })
                .collect();
            let id = recording.cameras[camera].id.clone();
            let outcome = tracker.observe(&CameraFrame { camera: id, time, detections });
            if let Some(receivers) = &mut receivers {
                receivers.observe(&tracker, &outcome, &boxes);
            }
            if let Some(found) = outcome.moved {
                let at = recording.cameras.iter().position(|own| own.id == found.camera);
                at.into_iter().for_each(|at| added_m2[at] = found.change_variance_m2());
                moved.push(FoundCamera { camera: found.camera, after_s });
            }
            records.extend(boxes.iter().zip(outcome.tracks).map(|(labelled, track)| BoxRecord {
                camera,
                time,
                target: labelled.target.and_then(|target| visits.at(target, time)),
                track,
            }));
        }
        note_wrong_clocks(&mut wrong_clocks, &tracker, after_s);
        // The truth is known at the times of frames; the corrected time of a clock that is wrong lies between two of them.
        if recording.truth.range((time, 0)..=(time, usize::MAX)).next().is_none() {
            continue;
        }
        let position =
            |target: &usize| Some((visits.at(*target, time)?, *recording.truth.get(&(time, *target))?));
        let tracks = reported(&tracker, time, &records[first..]);
        for (view, instants) in views.iter().zip(&mut instants_in_view) {
            let targets = view.get(&time).into_iter().flatten().filter_map(position).collect();
            instants.push(WorldInstant { targets, tracks: tracks.clone() });
        }
        let targets: Vec<_> = in_view.get(&time).into_iter().flatten().filter_map(position).collect();
        if let Some(crossings) = &mut crossings {
            crossings.observe(time, measured(&tracker, time), &targets);
        }
        instants.push(WorldInstant { targets, tracks });
    }
    let first_fix = |of: &SiteRecording| of.fixes.first().map(|fix| fix.time);
    let late = first_fix(recording).zip(first_fix(visible)).map(|(own, visible)| own.duration_since(visible));
    let late_s = late.unwrap_or_default().as_secs_f64();
    let (crossings, counts) = crossings.map(CrossingRecorder::figures).unwrap_or_default();
    SiteOutcome {
        boxes: BoxFigures::of(&records),
        world: WorldFigures::of(&instants),
        crossings,
        counts,
        receiver_clocks: receivers.as_ref().map(|receivers| receivers.clock_figures(late_s)),
        named: receivers.map(ReceiverFeed::figures),
        positions: PositionFigures::of(&instants),
        positions_in_view: instants_in_view.iter().map(|own| PositionFigures::of(own)).collect(),
        wrong_clocks,
        moved,
        started_at: start.unwrap_or_default(),
    }
}

fn note_wrong_clocks(found: &mut Vec<FoundCamera>, tracker: &WorldTracker, after_s: f64) {
    for (camera, _) in tracker.clocks().iter().filter(|(_, clock)| clock.is_wrong()) {
        if found.iter().all(|known| known.camera != *camera) {
            found.push(FoundCamera { camera: camera.clone(), after_s });
        }
    }
}

/// The boxes of an instant by camera.
type BoxesByCamera<'a> = BTreeMap<usize, Vec<&'a LabelledBox>>;

/// The frames of some cameras, in the order of their times as the tracker corrects them.
struct CameraFrames<'a> {
    recording: &'a SiteRecording,
    /// By camera and stated time.
    waiting: BTreeMap<usize, BTreeMap<Timestamp, Vec<&'a LabelledBox>>>,
}

impl<'a> CameraFrames<'a> {
    fn new(recording: &'a SiteRecording, cameras: &[usize]) -> Self {
        let mut waiting: BTreeMap<usize, BTreeMap<Timestamp, Vec<&LabelledBox>>> = BTreeMap::new();
        for &camera in cameras {
            for labelled in &recording.cameras[camera].boxes {
                waiting.entry(camera).or_default().entry(labelled.time).or_default().push(labelled);
            }
        }
        Self { recording, waiting }
    }

    /// The next instant.
    fn next(&mut self, tracker: &WorldTracker) -> Option<(Timestamp, BoxesByCamera<'a>)> {
        let corrected = |camera: usize, time| tracker.corrected(&self.recording.cameras[camera].id, time);
        let next = |(camera, frames): (&usize, &BTreeMap<Timestamp, _>)| {
            Some((*camera, corrected(*camera, *frames.first_key_value()?.0)))
        };
        let next: Vec<(usize, Timestamp)> = self.waiting.iter().filter_map(next).collect();
        let time = next.iter().map(|(_, time)| *time).min()?;
        let mut boxes = BTreeMap::new();
        for (camera, _) in next.into_iter().filter(|(_, own)| *own == time) {
            let first = self.waiting.get_mut(&camera).and_then(BTreeMap::pop_first);
            boxes.extend(first.map(|(_, own)| (camera, own)));
        }
        Some((time, boxes))
    }
}

fn detection(
    recording: &SiteRecording,
    trained: &TrainedSite,
    identities: Identities,
    camera: usize,
    labelled: &LabelledBox,
) -> WorldDetection {
    let located = trained.locate(camera, &labelled.bounding_box);
    let named = labelled.target.filter(|_| identities == Identities::Oracle);
    WorldDetection {
        tracker_id: Some(labelled.tracker_id.clone()),
        receiver: named.and_then(|target| ReceiverId::new(recording.targets[target].as_str()).ok()),
        position: located.position,
        covariance_m2: located.box_noise_m2,
        offset_covariance_m2: located.relative_m2.plus(located.lasting_noise_m2),
        common_covariance_m2: located.common_m2,
    }
}

/// The confirmed tracks that a camera measured at an instant; those of fixes alone are no findings of the cameras.
fn measured(tracker: &WorldTracker, time: Timestamp) -> impl Iterator<Item = &WorldTrack> {
    let is_measured =
        move |last_seen: Timestamp| time.duration_since(last_seen).as_secs_f64() <= REPORTED_WITHIN_S;
    let is_seen = |track: &WorldTrack| track.is_confirmed() && !track.sightings().is_empty();
    tracker.tracks().filter(move |track| is_seen(track) && is_measured(track.last_seen()))
}

/// The same, each with the target of most of its boxes.
fn reported(tracker: &WorldTracker, time: Timestamp, records: &[BoxRecord]) -> Vec<ReportedTrack> {
    measured(tracker, time)
        .map(|track| {
            let mut boxes: BTreeMap<usize, usize> = BTreeMap::new();
            for target in records.iter().filter(|it| it.track == Some(track.id())).filter_map(|it| it.target)
            {
                *boxes.entry(target).or_default() += 1;
            }
            let state = track.state();
            ReportedTrack {
                track: track.id(),
                position: state.position,
                r95_m: state.covariance_m2.r95_m(),
                target: boxes.into_iter().max_by_key(|(_, count)| *count).map(|(target, _)| target),
            }
        })
        .collect()
}
