//! A recorded or simulated site with its truth.

use std::collections::{BTreeMap, BTreeSet};

use jiff::Timestamp;

use crate::domain::{BoundingBox, CameraId, GaussMarkovNoise, ImageSize, ReceivedFix, ReceiverId, TargetId};
use crate::geo::{EastNorth, LocalPlane};
use crate::simulation::{SimulatedReceiver, SimulatedSite};

/// A target that no camera sees for longer than this begins another visit, s.
const VISIT_GAP_S: f64 = 5.0;

/// A detection with the target that it is of.
#[derive(Debug, Clone, PartialEq)]
pub struct LabelledBox {
    /// The instant of the detection.
    pub time: Timestamp,
    /// The id by the camera's tracker.
    pub tracker_id: TargetId,
    /// The box.
    pub bounding_box: BoundingBox,
    /// Index of the target; `None` for a false detection.
    pub target: Option<usize>,
}

/// The detections of one camera.
#[derive(Debug, Clone, PartialEq)]
pub struct RecordedCamera {
    /// The id of the camera.
    pub id: CameraId,
    /// In the order of time.
    pub boxes: Vec<LabelledBox>,
}

/// A fix with its receiver.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RecordedFix {
    /// Index of the receiver.
    pub receiver: usize,
    /// When, by the cameras' clock.
    pub time: Timestamp,
    /// In the site's plane, m.
    pub position: EastNorth,
}

/// Cameras, receivers and the truth.
#[derive(Debug, Clone)]
pub struct SiteRecording {
    /// Plane of all positions.
    pub plane: LocalPlane,
    /// Size of all images, if known.
    pub image_size: Option<ImageSize>,
    /// The cameras.
    pub cameras: Vec<RecordedCamera>,
    /// In the order of time.
    pub fixes: Vec<RecordedFix>,
    /// Each receiver with the index of the target that carries it.
    pub receivers: Vec<(ReceiverId, usize)>,
    /// Names of the targets.
    pub targets: Vec<TargetId>,
    /// True positions by instant and target, m.
    pub truth: BTreeMap<(Timestamp, usize), EastNorth>,
}

impl SiteRecording {
    /// The recording of a simulated site.
    #[must_use]
    pub fn simulated(site: &SimulatedSite) -> Self {
        let plane = LocalPlane::new(site.origin);
        let names: BTreeSet<&TargetId> = site.truth.iter().map(|(_, target, _)| target).collect();
        let targets: Vec<TargetId> = names.into_iter().cloned().collect();
        let index_of = |name: &TargetId| targets.binary_search(name).ok();
        let receivers: Vec<(ReceiverId, usize)> = site
            .carriers
            .iter()
            .filter_map(|(receiver, target)| Some((receiver.clone(), index_of(target)?)))
            .collect();
        let cameras = site.cameras.iter().map(|camera| RecordedCamera {
            id: camera.id.clone(),
            boxes: camera
                .detections
                .iter()
                .map(|labelled| LabelledBox {
                    time: labelled.detection.time,
                    tracker_id: labelled.detection.target_id.clone(),
                    bounding_box: labelled.detection.bounding_box,
                    target: labelled.target.as_ref().and_then(index_of),
                })
                .collect(),
        });
        let recorded_fix = |fix: &ReceivedFix| {
            let receiver = receivers.iter().position(|(id, _)| Some(id) == fix.receiver_id.as_ref())?;
            Some(RecordedFix { receiver, time: fix.time, position: plane.to_plane(fix.fix.position) })
        };
        Self {
            plane,
            image_size: Some(site.image_size),
            cameras: cameras.collect(),
            fixes: site.fixes.iter().filter_map(recorded_fix).collect(),
            truth: site
                .truth
                .iter()
                .filter_map(|(time, name, at)| Some(((*time, index_of(name)?), plane.to_plane(*at))))
                .collect(),
            receivers,
            targets,
        }
    }

    /// The targets that the boxes of some cameras show, by instant.
    #[must_use]
    pub fn visible_to(&self, cameras: &[usize]) -> BTreeMap<Timestamp, BTreeSet<usize>> {
        let mut visible: BTreeMap<Timestamp, BTreeSet<usize>> = BTreeMap::new();
        for labelled in cameras.iter().flat_map(|&camera| &self.cameras[camera].boxes) {
            let at = visible.entry(labelled.time).or_default();
            at.extend(labelled.target.filter(|target| self.truth.contains_key(&(labelled.time, *target))));
        }
        visible
    }

    /// The visits of all targets: a target that no camera saw for longer than [`VISIT_GAP_S`] comes back as another
    /// one, for no tracker that knows positions alone could recognise it.
    #[must_use]
    pub fn visits(&self) -> Visits {
        let all: Vec<usize> = (0..self.cameras.len()).collect();
        let mut by_target: BTreeMap<usize, Vec<Timestamp>> = BTreeMap::new();
        for (time, targets) in self.visible_to(&all) {
            for target in targets {
                by_target.entry(target).or_default().push(time);
            }
        }
        let mut visits = Visits::default();
        let mut count = 0;
        for (target, times) in by_target {
            let gap_s = |pair: &[Timestamp]| pair[1].duration_since(pair[0]).as_secs_f64();
            let returns = times.windows(2).filter(|pair| gap_s(pair) > VISIT_GAP_S).map(|pair| pair[1]);
            for begin in times.first().copied().into_iter().chain(returns) {
                visits.begins.insert((target, begin), count);
                count += 1;
            }
        }
        visits
    }

    /// The same fixes with other errors: those of receivers of that noise, drawn from a seed, at the true
    /// positions of their carriers.
    #[must_use]
    pub fn with_redrawn_fixes(&self, noise: GaussMarkovNoise, seed: u64) -> Self {
        let mut by_target: BTreeMap<usize, Vec<(Timestamp, EastNorth)>> = BTreeMap::new();
        for ((time, target), position) in &self.truth {
            by_target.entry(*target).or_default().push((*time, *position));
        }
        let mut drawn: BTreeMap<usize, (SimulatedReceiver, Timestamp)> = BTreeMap::new();
        let mut redrawn = self.clone();
        redrawn.fixes.retain_mut(|fix| {
            let target = self.receivers[fix.receiver].1;
            let Some(truth) = by_target.get(&target).and_then(|path| interpolated(path, fix.time)) else {
                return false;
            };
            let (receiver, latest) = drawn
                .entry(fix.receiver)
                .or_insert_with(|| (SimulatedReceiver::seeded(noise, seed, fix.receiver as u64), fix.time));
            let since_s = fix.time.duration_since(*latest).as_secs_f64();
            *latest = fix.time;
            fix.position = receiver.measure(truth, since_s);
            true
        });
        redrawn
    }
}

/// The visits of targets, numbered.
#[derive(Debug, Clone, Default)]
pub struct Visits {
    /// Number of the visit by target and first instant.
    begins: BTreeMap<(usize, Timestamp), usize>,
}

impl Visits {
    /// The visit of a target at an instant.
    #[must_use]
    pub fn at(&self, target: usize, time: Timestamp) -> Option<usize> {
        let earlier = self.begins.range((target, Timestamp::MIN)..=(target, time));
        earlier.map(|(_, number)| *number).next_back()
    }
}

/// A position on a path in the order of time; `None` beyond its ends.
fn interpolated(path: &[(Timestamp, EastNorth)], time: Timestamp) -> Option<EastNorth> {
    let next = path.partition_point(|(at, _)| *at < time);
    let (next_time, to) = *path.get(next)?;
    if next_time == time {
        return Some(to);
    }
    let (previous_time, from) = path[next.checked_sub(1)?];
    let part = time.duration_since(previous_time).as_secs_f64()
        / next_time.duration_since(previous_time).as_secs_f64();
    Some(EastNorth {
        east_m: from.east_m + part * (to.east_m - from.east_m),
        north_m: from.north_m + part * (to.north_m - from.north_m),
    })
}
