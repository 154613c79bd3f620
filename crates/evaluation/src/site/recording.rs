//! A recorded or simulated site with its truth.

use std::collections::{BTreeMap, BTreeSet};

use jiff::Timestamp;

use crate::domain::{BoundingBox, CameraId, ImageSize, ReceivedFix, ReceiverId, TargetId};
use crate::geo::{EastNorth, LocalPlane};
use crate::model::SiteKnownPoint;
use crate::simulation::SimulatedSite;

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
    /// Known points of the cameras; a recording has none of its own.
    pub known_points: Vec<SiteKnownPoint>,
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
            known_points: Vec::new(),
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
