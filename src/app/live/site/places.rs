//! World tracks on their way to the places of their site.

use std::sync::Arc;

use super::published::WorldTrackPoint;
use crate::app::PlaceMonitor;
use crate::domain::{LiveId, SiteId, TargetClass};

/// The places of one site.
pub(super) struct SitePlaces {
    pub(super) site: SiteId,
    pub(super) monitor: Arc<PlaceMonitor>,
}

impl SitePlaces {
    /// A target was measured by a box, or else by a fix.
    pub(super) fn measured(&self, point: &Arc<WorldTrackPoint>, class: Option<TargetClass>, has_box: bool) {
        self.monitor.measured_at_site(&self.site, point, class, has_box);
    }

    /// Two tracks were of one target.
    pub(super) fn merged(&self, track: LiveId, ended: LiveId) {
        self.monitor.merged_at_site(&self.site, track, ended);
    }
}
