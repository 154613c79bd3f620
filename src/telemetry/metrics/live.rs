//! Live streams, tracks of cameras and world tracks of sites.

use metrics::{Counter, Gauge, Histogram};

use crate::fusion::track::RejectionReason;
use crate::telemetry::registry::Registry;

#[derive(Clone)]
pub(super) struct LiveMetrics {
    pub(super) track_nis: Histogram,
    pub(super) track_rejections: [(RejectionReason, Counter); RejectionReason::ALL.len()],
    pub(super) streams: Gauge,
    pub(super) items: Counter,
    pub(super) item_errors: Counter,
    pub(super) answers_lost: Counter,
    pub(super) cameras_moved: Counter,
    pub(super) clocks_wrong: Counter,
    pub(super) place_measurements_dropped: Counter,
    pub(super) place_messages_dropped: Counter,
    pub(super) finished_tracks_dropped: Counter,
}

#[derive(Clone)]
pub(super) struct SiteMetrics {
    pub(super) items: [(SiteItemOutcome, Counter); SiteItemOutcome::ALL.len()],
    pub(super) tracks: Gauge,
    pub(super) tracks_started: Counter,
    pub(super) handovers: Counter,
    pub(super) events_lost: Counter,
}

/// The outcome of a box or fix that was handed to the tracker of a site.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SiteItemOutcome {
    /// It went into the tracker.
    Tracked,
    /// A later frame had been tracked before.
    Late,
    /// The queue, or its frame, was full.
    Overflow,
    /// It is beyond the range of the site's plane.
    OutOfRange,
    /// Its position is too uncertain to tell targets apart.
    Uncertain,
}

impl SiteItemOutcome {
    /// All of them.
    pub const ALL: [Self; 5] = [Self::Tracked, Self::Late, Self::Overflow, Self::OutOfRange, Self::Uncertain];

    /// The label in the metrics.
    #[must_use]
    pub const fn as_str(self) -> &'static str {
        match self {
            Self::Tracked => "tracked",
            Self::Late => "late",
            Self::Overflow => "overflow",
            Self::OutOfRange => "out_of_range",
            Self::Uncertain => "uncertain",
        }
    }
}

impl LiveMetrics {
    pub(super) fn register(registry: &Registry) -> Self {
        let rejections = |reason: RejectionReason| {
            let help = "Measured positions that tracks rejected, by reason";
            let name = "sightfix_track_rejections_total";
            (reason, registry.counter(name, help, &[("reason", reason.as_str())]))
        };
        Self {
            track_nis: registry.histogram(
                "sightfix_track_nis",
                "Normalised innovation squared of tracks, 2 degrees of freedom each; mean 2 if consistent",
                &[],
            ),
            track_rejections: RejectionReason::ALL.map(rejections),
            streams: registry.gauge("sightfix_live_streams", "Open live streams", &[]),
            items: registry.counter(
                "sightfix_live_items_total",
                "Items of live streams that were accepted",
                &[],
            ),
            item_errors: registry.counter(
                "sightfix_live_item_errors_total",
                "Items of live streams that were refused",
                &[],
            ),
            answers_lost: registry.counter(
                "sightfix_live_answers_lost_total",
                "Answers of live streams that slow readers lost",
                &[],
            ),
            cameras_moved: registry.counter(
                "sightfix_cameras_moved_total",
                "Alarms that a camera was moved",
                &[],
            ),
            clocks_wrong: registry.counter(
                "sightfix_clocks_wrong_total",
                "Clocks of cameras and receivers of sites that were found to be wrong",
                &[],
            ),
            finished_tracks_dropped: registry.counter(
                "sightfix_finished_tracks_dropped_total",
                "Finished tracks that the history does not have, for too many waited for the archive",
                &[],
            ),
            place_measurements_dropped: registry.counter(
                "sightfix_place_measurements_dropped_total",
                "Measurements of tracks that were not compared with places, for too many waited",
                &[],
            ),
            place_messages_dropped: registry.counter(
                "sightfix_place_messages_dropped_total",
                "Messages of place events that no sink delivers, for too many waited in its outbox",
                &[],
            ),
        }
    }
}

impl SiteMetrics {
    pub(super) fn register(registry: &Registry) -> Self {
        let items = |outcome: SiteItemOutcome| {
            let help = "Boxes and fixes handed to the trackers of sites, by outcome";
            (outcome, registry.counter("sightfix_site_items_total", help, &[("outcome", outcome.as_str())]))
        };
        Self {
            items: SiteItemOutcome::ALL.map(items),
            tracks: registry.gauge("sightfix_world_tracks", "Confirmed world tracks of all sites", &[]),
            tracks_started: registry.counter(
                "sightfix_world_tracks_started_total",
                "World tracks that were confirmed",
                &[],
            ),
            handovers: registry.counter(
                "sightfix_world_track_handovers_total",
                "Targets handed over from camera to camera",
                &[],
            ),
            events_lost: registry.counter(
                "sightfix_site_events_lost_total",
                "Events of sites that slow readers lost",
                &[],
            ),
        }
    }
}
