//! Detections and received fixes as tracklets and receivers in one plane.

use std::collections::BTreeMap;

use jiff::Timestamp;

use super::cancellation::Cancellation;
use super::tracklet::{TimedFix, TrackPoint, Tracklet};
use crate::domain::{BoundingBox, Detection, ReceivedFix, ReceiverId, Receivers, TargetId};
use crate::geo::{EastNorth, LocalPlane};
use crate::model::Regressor;

/// A gap between two boxes of one id that begins a new tracklet, s: trackers use ids again.
pub(super) const TRACKLET_GAP_S: f64 = 3.0;

/// Detections by tracklet.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct SeenTracklet {
    pub(super) tracker_id: TargetId,
    /// Indices of detections, in order of time.
    pub(super) detections: Vec<usize>,
}

/// The input of a match.
#[derive(Debug, Clone)]
pub(super) struct Scene<'a> {
    pub(super) detections: &'a [Detection],
    pub(super) tracklets: Vec<SeenTracklet>,
    pub(super) receiver_ids: Vec<ReceiverId>,
    fixes: Vec<Vec<&'a ReceivedFix>>,
    pub(super) receivers: &'a Receivers,
    pub(super) received: &'a [ReceivedFix],
    origin: Timestamp,
    pub(super) cancellation: Cancellation<'a>,
}

impl<'a> Scene<'a> {
    /// Fixes that name no receiver, and those that repeat the position before them, are left out: many
    /// receivers and gateways send the latest position again.
    pub(super) fn new(
        detections: &'a [Detection],
        fixes: &'a [ReceivedFix],
        receivers: &'a Receivers,
        cancellation: Cancellation<'a>,
    ) -> Self {
        let origin = detections.iter().map(|own| own.time).min().unwrap_or(Timestamp::UNIX_EPOCH);
        let mut by_target: BTreeMap<&TargetId, Vec<usize>> = BTreeMap::new();
        for (at, own) in detections.iter().enumerate() {
            by_target.entry(&own.target_id).or_default().push(at);
        }
        let mut tracklets = Vec::with_capacity(by_target.len());
        for (tracker_id, mut own) in by_target {
            own.sort_by_key(|at| detections[*at].time);
            own.dedup_by_key(|at| detections[*at].time);
            let goes_on = |one: &usize, next: &usize| {
                let gap = detections[*next].time.duration_since(detections[*one].time);
                gap.as_secs_f64() <= TRACKLET_GAP_S
            };
            let parts = own.chunk_by(goes_on);
            tracklets.extend(
                parts.map(|part| SeenTracklet { tracker_id: tracker_id.clone(), detections: part.to_vec() }),
            );
        }
        let mut by_receiver: BTreeMap<&ReceiverId, Vec<&ReceivedFix>> = BTreeMap::new();
        for own in fixes {
            if let Some(receiver_id) = &own.receiver_id {
                by_receiver.entry(receiver_id).or_default().push(own);
            }
        }
        for own in by_receiver.values_mut() {
            own.sort_by_key(|fix| fix.time);
            own.dedup_by(|next, before| next.time == before.time || next.fix.position == before.fix.position);
        }
        let receiver_ids = by_receiver.keys().map(|id| (*id).clone()).collect();
        Self {
            detections,
            tracklets,
            receiver_ids,
            fixes: by_receiver.into_values().collect(),
            receivers,
            received: fixes,
            origin,
            cancellation,
        }
    }

    /// Pairs of a tracklet and a fix of a receiver during it: what the evidence is made of.
    pub(super) fn comparisons(&self) -> u64 {
        let spans = self.tracklets.iter().filter_map(|own| {
            let (first, last) = (own.detections.first()?, own.detections.last()?);
            Some((self.detections[*first].time, self.detections[*last].time))
        });
        let camera_time = |(own, id): (&Vec<&ReceivedFix>, &ReceiverId)| -> Vec<Timestamp> {
            own.iter().map(|fix| self.receivers.resolve(id, fix.time).1).collect()
        };
        let times: Vec<Vec<Timestamp>> = self.fixes.iter().zip(&self.receiver_ids).map(camera_time).collect();
        let during = |(first, last): (Timestamp, Timestamp)| -> usize {
            let of_receiver = |own: &Vec<Timestamp>| {
                own.partition_point(|time| *time <= last) - own.partition_point(|time| *time < first)
            };
            times.iter().map(of_receiver).sum()
        };
        spans.map(|span| during(span) as u64).sum()
    }

    /// Time from the first to the last box, s.
    pub(super) fn length_s(&self) -> f64 {
        let last = self.detections.iter().map(|own| own.time).max();
        last.map_or(0.0, |last| self.seconds(last))
    }

    fn seconds(&self, time: Timestamp) -> f64 {
        time.duration_since(self.origin).as_secs_f64()
    }

    /// Tracklets with the positions of their boxes; boxes without a position are left out. The second part
    /// has the detections of the points.
    pub(super) fn located(
        &self,
        locate: impl Fn(&BoundingBox) -> Option<(EastNorth, f64, f64)>,
    ) -> (Vec<Tracklet>, Vec<Vec<usize>>) {
        let of = |seen: &SeenTracklet| {
            let points = seen.detections.iter().filter_map(|at| {
                let own = &self.detections[*at];
                let (position, box_variance_m2, map_variance_m2) = locate(&own.bounding_box)?;
                let time_s = self.seconds(own.time);
                Some((TrackPoint { time_s, position, box_variance_m2, map_variance_m2 }, *at))
            });
            let (points, detections) = points.unzip();
            (Tracklet { points }, detections)
        };
        self.tracklets.iter().map(of).unzip()
    }

    /// Tracklets with the positions that a model regresses, in its plane.
    pub(super) fn regressed(&self, regressor: &Regressor) -> (Vec<Tracklet>, Vec<Vec<usize>>) {
        self.located(|bounding_box| {
            let regression = regressor.regress(bounding_box, None);
            let all_m2 = regression.variance_m2();
            let box_m2 = regression.box_noise.per_axis_m2().clamp(0.0, all_m2);
            regression.regressed.is_within_range().then_some((regression.regressed, box_m2, all_m2 - box_m2))
        })
    }

    /// The fixes of each receiver by the camera's clock, without those beyond the plane.
    pub(super) fn fixes(&self, plane: &LocalPlane) -> Vec<Vec<TimedFix>> {
        let of = |(own, receiver_id): (&Vec<&ReceivedFix>, &ReceiverId)| {
            own.iter()
                .filter_map(|received| {
                    let (_, time) = self.receivers.resolve(receiver_id, received.time);
                    let fix = self.receivers.with_sigma(receiver_id, received.fix);
                    Some(TimedFix {
                        time_s: self.seconds(time),
                        position: plane.to_plane_within_range(fix.position)?,
                        stated_variance_m2: fix.sigma_m.map(|sigma| sigma.variance_m2()),
                    })
                })
                .collect()
        };
        self.fixes.iter().zip(&self.receiver_ids).map(of).collect()
    }

    /// A plane about the median fix.
    pub(super) fn plane(&self) -> Option<LocalPlane> {
        let first = self.fixes.iter().flatten().next()?;
        let plane = LocalPlane::new(first.fix.position);
        let points = || self.fixes.iter().flatten().map(|own| plane.to_plane(own.fix.position));
        let centre = EastNorth {
            east_m: crate::statistics::median(points().map(|point| point.east_m).collect()),
            north_m: crate::statistics::median(points().map(|point| point.north_m).collect()),
        };
        Some(LocalPlane::new(plane.to_position(centre)))
    }
}
