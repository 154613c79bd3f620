//! The clocks of a site's cameras and receivers as they are published.

use std::collections::BTreeMap;
use std::fmt::Display;

use crate::domain::CameraId;
use crate::fusion::association::ReceiverClocks;
use crate::fusion::clock_estimate::ClockEstimate;

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

/// Logs which clocks are wrong, or right again, since the last time, and returns how many have become wrong.
fn changed<K: Ord + Display>(
    of: &str,
    before: &BTreeMap<K, ClockEstimate>,
    found: &BTreeMap<K, ClockEstimate>,
) -> usize {
    let mut wrong = 0;
    for (name, clock) in found {
        let ClockEstimate { offset_s, sigma_s } = clock;
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
