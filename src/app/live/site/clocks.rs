//! The clocks of a site's cameras and receivers as they are published.

use std::collections::BTreeMap;
use std::fmt::Display;

use jiff::Timestamp;

use crate::domain::{CameraId, ReceiverId};
use crate::fusion::association::ReceiverClocks;
use crate::fusion::clock_drift::ClockHistory;
use crate::fusion::clock_estimate::ClockEstimate;

/// Cameras, and receivers, of a site whose clocks are followed over hours.
const MOST_FOLLOWED: usize = 256;

/// How late the clocks of a site are.
#[derive(Debug, Clone, Default)]
pub struct SiteClocks {
    /// The cameras beside each other, where crossings tell.
    pub cameras: BTreeMap<CameraId, ClockEstimate>,
    /// The receivers beside the cameras, where tracks of their carriers tell.
    pub receivers: ReceiverClocks,
}

impl SiteClocks {
    /// Takes new estimates of the cameras' clocks; how many have become wrong.
    pub(super) fn set_cameras(&mut self, found: BTreeMap<CameraId, ClockEstimate>) -> usize {
        let before = std::mem::replace(&mut self.cameras, found);
        changed("camera", &before, &self.cameras)
    }

    /// The same of the receivers' clocks.
    pub(super) fn set_receivers(&mut self, found: ReceiverClocks) -> usize {
        let before = std::mem::replace(&mut self.receivers, found);
        let common = |clocks: &ReceiverClocks| clocks.common.map(|own| ("all", own)).into_iter().collect();
        changed("receiver", &before.by_receiver, &self.receivers.by_receiver)
            + changed("receivers", &common(&before), &common(&self.receivers))
    }
}

/// The offsets of a site's clocks over hours, which tell how fast the clocks are.
#[derive(Default)]
pub(super) struct ClockHistories {
    cameras: BTreeMap<CameraId, ClockHistory>,
    receivers: BTreeMap<ReceiverId, ClockHistory>,
}

impl ClockHistories {
    /// Notes the estimates of cameras, and adds their drifts.
    pub(super) fn note_cameras(&mut self, now: Timestamp, found: &mut BTreeMap<CameraId, ClockEstimate>) {
        note(&mut self.cameras, now, found);
    }

    /// The same of receivers.
    pub(super) fn note_receivers(&mut self, now: Timestamp, found: &mut ReceiverClocks) {
        note(&mut self.receivers, now, &mut found.by_receiver);
    }
}

fn note<K: Ord + Clone>(
    histories: &mut BTreeMap<K, ClockHistory>,
    now: Timestamp,
    found: &mut BTreeMap<K, ClockEstimate>,
) {
    histories.retain(|_, history| !history.is_outdated(now));
    for (name, clock) in found {
        if histories.len() < MOST_FOLLOWED || histories.contains_key(name) {
            let history = histories.entry(name.clone()).or_default();
            history.note(now, *clock);
            clock.drift = history.drift();
        }
    }
}

/// Logs which clocks are wrong, or right again, since the last time, and returns how many have become wrong.
fn changed<K: Ord + Display>(
    of: &str,
    before: &BTreeMap<K, ClockEstimate>,
    found: &BTreeMap<K, ClockEstimate>,
) -> usize {
    let mut wrong = 0;
    for (name, clock) in found {
        let ClockEstimate { offset_s, sigma_s, .. } = clock;
        match (before.get(name).is_some_and(ClockEstimate::is_wrong), clock.is_wrong()) {
            (false, true) => {
                wrong += 1;
                tracing::warn!(of, %name, offset_s, sigma_s, "a clock is wrong beside those of the site's cameras");
            }
            (true, false) => tracing::info!(of, %name, offset_s, sigma_s, "a clock is right again"),
            _ => {}
        }
    }
    wrong
}

#[cfg(test)]
mod tests {
    use jiff::SignedDuration;

    use super::*;

    #[test]
    fn clocks_that_are_followed_for_hours_have_drifts_and_are_not_too_many() {
        let mut histories = ClockHistories::default();
        let ids: Vec<CameraId> =
            (0..=MOST_FOLLOWED).map(|at| CameraId::new(&format!("c{at}")).expect("a slug")).collect();
        let mut clocks = BTreeMap::new();
        for minutes in 0..180 {
            let offset_s = 0.5 + 20e-6 * 60.0 * minutes as f64;
            let estimate = ClockEstimate { offset_s, sigma_s: 0.02, drift: None };
            clocks = ids.iter().map(|id| (id.clone(), estimate)).collect();
            histories.note_cameras(Timestamp::UNIX_EPOCH + SignedDuration::from_mins(minutes), &mut clocks);
        }
        let drifts: Vec<_> = clocks.values().filter_map(|clock| clock.drift).collect();
        assert_eq!(drifts.len(), MOST_FOLLOWED);
        assert!(drifts.iter().all(|drift| (drift.ppm - 20.0).abs() < 0.1), "{:?}", drifts[0]);
        // Those of which nothing was heard for a day make place for others.
        let [first, .., last] = &ids[..] else { panic!("some cameras") };
        let mut clocks: BTreeMap<_, _> = [first, last].map(|id| (id.clone(), clocks[id])).into();
        histories.note_cameras(Timestamp::UNIX_EPOCH + SignedDuration::from_hours(48), &mut clocks);
        assert_eq!(histories.cameras.len(), 2);
    }
}
