//! Samples of several cameras as rows of one fit: fixes with the boxes of their carriers in all cameras, and the pairs
//! of such boxes.

use std::collections::BTreeMap;

use jiff::Timestamp;

use super::input::{SiteFix, SitePair};
use crate::domain::{BoundingBox, Sample, TargetId};
use crate::geo::LocalPlane;

/// Boxes on both sides of an instant are joined by a line over at most this long a gap, s.
const LONGEST_BOX_GAP_S: f64 = 1.1;

/// Boxes of one camera in the order of time, by receiver.
type BoxesByReceiver = BTreeMap<u32, Vec<(Timestamp, BoundingBox)>>;

/// The samples of all cameras of a site.
pub(crate) struct SiteRows<'a> {
    /// Number of each target: samples of one target in several cameras have one receiver.
    pub(crate) receivers: BTreeMap<&'a TargetId, u32>,
    /// By receiver and time.
    pub(crate) fixes: Vec<SiteFix>,
    /// In the same order.
    pub(crate) pairs: Vec<SitePair>,
    /// Instant at which the time of fixes and pairs is 0.
    pub(crate) start: Timestamp,
}

impl<'a> SiteRows<'a> {
    /// Joins the samples of the cameras by target and time. A fix that was stored for two cameras counts once.
    pub(crate) fn new(cameras: &[&'a [Sample]], plane: &LocalPlane) -> Self {
        let samples = || cameras.iter().flat_map(|samples| samples.iter());
        let start = samples().map(|sample| sample.time).min().unwrap_or_default();
        let mut receivers: BTreeMap<&TargetId, u32> =
            samples().map(|sample| (&sample.target_id, 0)).collect();
        receivers.values_mut().zip(0..).for_each(|(number, next)| *number = next);
        let mut instants = BTreeMap::new();
        let mut boxes = vec![BoxesByReceiver::new(); cameras.len()];
        for (samples, own) in cameras.iter().zip(&mut boxes) {
            for sample in *samples {
                let receiver = receivers[&sample.target_id];
                own.entry(receiver).or_default().push((sample.time, sample.bounding_box));
                instants.entry((receiver, sample.time)).or_insert(sample.fix.position);
            }
            own.values_mut().for_each(|boxes| boxes.sort_by_key(|(time, _)| *time));
        }
        let mut rows =
            Self { receivers, fixes: Vec::with_capacity(instants.len()), pairs: Vec::new(), start };
        for ((receiver, time), position) in instants {
            let of_camera = |(camera, own): (usize, &BoxesByReceiver)| {
                Some((camera, box_at(own.get(&receiver)?, |timed| *timed, time)?))
            };
            let seen: Vec<(usize, BoundingBox)> = boxes.iter().enumerate().filter_map(of_camera).collect();
            let time_s = rows.seconds(time);
            for (index, (camera, own)) in seen.iter().enumerate() {
                for (other_camera, other) in &seen[index + 1..] {
                    let (cameras, boxes) = ([*camera, *other_camera], [*own, *other]);
                    rows.pairs.push(SitePair { target: receiver, time_s, cameras, boxes });
                }
            }
            rows.fixes.push(SiteFix { receiver, time_s, position: plane.to_plane(position), boxes: seen });
        }
        rows
    }

    /// Seconds since the first sample.
    pub(crate) fn seconds(&self, time: Timestamp) -> f64 {
        time.duration_since(self.start).as_secs_f64()
    }
}

/// The box of a target at an instant, on the line between those before and after; `None` where these are too far apart.
/// The boxes are in the order of time.
pub fn box_at<T>(
    boxes: &[T],
    of: impl Fn(&T) -> (Timestamp, BoundingBox),
    time: Timestamp,
) -> Option<BoundingBox> {
    let next = boxes.partition_point(|timed| of(timed).0 < time);
    let (later, after) = of(boxes.get(next)?);
    if later == time {
        return Some(after);
    }
    let (earlier, before) = of(boxes.get(next.checked_sub(1)?)?);
    let gap_s = later.duration_since(earlier).as_secs_f64();
    if gap_s > LONGEST_BOX_GAP_S {
        return None;
    }
    let part = time.duration_since(earlier).as_secs_f64() / gap_s;
    let (from, to) = (before.sides_px(), after.sides_px());
    let [left_px, top_px, width_px, height_px] =
        std::array::from_fn(|side| from[side] + part * (to[side] - from[side]));
    BoundingBox::new(left_px, top_px, width_px, height_px).ok()
}
