//! World tracks and events of sites as messages.

use std::pin::Pin;

use futures_util::{Stream, StreamExt as _, stream};
use tonic::Status;

use super::convert::timestamp;
use super::proto;
use super::proto::watch_tracks_response::Event;
use super::statuses::to_status;
use crate::admission::Lease;
use crate::app::{LossReason, LostSiteEvents, SiteEventKind, SiteEvents, StoredSiteEvent, WorldTrackPoint};
use crate::domain::{CameraId, Error, ErrorKind, ReceiverId, SiteId};
use crate::fusion::clock_estimate::{ClockDrift, ClockEstimate};
use crate::shutdown::Shutdown;
use crate::telemetry::RequestId;

/// Ids of tracks and events that requests name.
pub(super) mod live_id {
    use crate::domain::{Error, ErrorKind, LiveId, Result};

    /// A text that is no id of a track names a track that does not exist.
    pub(in crate::grpc) fn of_track(text: &str) -> Result<LiveId> {
        text.parse().map_err(|_: Error| {
            Error::refused(ErrorKind::TrackNotFound, "that is not the id of a world track")
        })
    }

    /// The event to continue after, if one is named.
    pub(in crate::grpc) fn to_resume_after(text: &str) -> Result<Option<LiveId>> {
        if text.is_empty() {
            return Ok(None);
        }
        text.parse().map(Some).map_err(|error: Error| error.at("resume_after"))
    }
}

/// The events of a site.
pub(super) type Events =
    Pin<Box<dyn Stream<Item = std::result::Result<proto::WatchTracksResponse, Status>> + Send>>;

/// Ends with the site or with the server, each reported as an error, so that nobody takes the site for quiet.
pub(super) fn events(
    source: SiteEvents,
    site: SiteId,
    lease: Lease,
    shutdown: Shutdown,
    id: RequestId,
) -> Events {
    stream::unfold(Some((source, lease)), move |watched| {
        let (site, shutdown, id) = (site.clone(), shutdown.clone(), id.clone());
        async move {
            let (mut source, lease) = watched?;
            let next = tokio::select! {
                biased;
                () = shutdown.draining() => Err(ending()),
                next = source.next() => next.ok_or_else(|| ended(&source, &site)),
            };
            Some(match next {
                Ok(Ok(event)) => (Ok(event.into()), Some((source, lease))),
                Ok(Err(lost)) => (Ok(lost.into()), Some((source, lease))),
                Err(error) => (Err(to_status(&error, &id)), None),
            })
        }
    })
    .boxed()
}

fn ended(source: &SiteEvents, site: &SiteId) -> Error {
    if source.continue_elsewhere() {
        let message = format!("site {site} has gone to another node; watch it again");
        return Error::refused(ErrorKind::CameraBetweenNodes, message);
    }
    Error::refused(ErrorKind::SiteNotFound, format!("site {site} was deleted"))
}

fn ending() -> Error {
    Error::refused(ErrorKind::ShuttingDown, "the server is ending; tracks start again when it is back")
}

impl From<StoredSiteEvent> for proto::WatchTracksResponse {
    fn from(stored: StoredSiteEvent) -> Self {
        let event = match &stored.event.kind {
            SiteEventKind::Measured(point) => Event::Track(point.as_ref().into()),
            SiteEventKind::Started(track) => {
                Event::Started(proto::WorldTrackStarted { track_id: track.to_string() })
            }
            SiteEventKind::HandedOver { track, from, to } => Event::HandedOver(proto::WorldTrackHandedOver {
                track_id: track.to_string(),
                from_camera_id: from.to_string(),
                to_camera_id: to.to_string(),
            }),
            SiteEventKind::Identified { track, target_id } => {
                Event::Identified(proto::WorldTrackIdentified {
                    track_id: track.to_string(),
                    target_id: target_id.to_string(),
                })
            }
            SiteEventKind::Merged { track, ended } => Event::Merged(proto::WorldTrackMerged {
                track_id: track.to_string(),
                ended_track_id: ended.to_string(),
            }),
            SiteEventKind::Ended(track) => {
                Event::Ended(proto::WorldTrackEnded { track_id: track.to_string() })
            }
        };
        Self { event_id: stored.id.to_string(), time: Some(timestamp(stored.event.time)), event: Some(event) }
    }
}

impl From<LostSiteEvents> for proto::WatchTracksResponse {
    fn from(lost: LostSiteEvents) -> Self {
        use proto::lost_events::Reason;
        let reason = match lost.reason {
            LossReason::TooOld => Reason::TooOld,
            LossReason::Restarted => Reason::Restarted,
            LossReason::TooSlow => Reason::TooSlow,
        };
        let event = Event::Lost(proto::LostEvents { reason: reason.into(), events: lost.events });
        Self { event_id: lost.id.to_string(), time: None, event: Some(event) }
    }
}

impl From<ClockDrift> for proto::ClockDrift {
    fn from(drift: ClockDrift) -> Self {
        Self { ppm: drift.ppm, sigma_ppm: drift.sigma_ppm }
    }
}

impl From<(&CameraId, &ClockEstimate)> for proto::CameraClock {
    fn from((camera, clock): (&CameraId, &ClockEstimate)) -> Self {
        Self {
            camera_id: camera.to_string(),
            offset_s: clock.offset_s,
            sigma_s: clock.sigma_s,
            is_wrong: clock.is_wrong(),
            drift: clock.drift.map(Into::into),
        }
    }
}

impl From<(&ReceiverId, &ClockEstimate)> for proto::ReceiverClock {
    fn from((receiver, clock): (&ReceiverId, &ClockEstimate)) -> Self {
        Self {
            receiver_id: receiver.to_string(),
            offset_s: clock.offset_s,
            sigma_s: clock.sigma_s,
            is_wrong: clock.is_wrong(),
            drift: clock.drift.map(Into::into),
        }
    }
}

impl From<ClockEstimate> for proto::CommonClock {
    fn from(clock: ClockEstimate) -> Self {
        Self { offset_s: clock.offset_s, sigma_s: clock.sigma_s, is_wrong: clock.is_wrong() }
    }
}

impl From<&WorldTrackPoint> for proto::WorldTrackPoint {
    fn from(point: &WorldTrackPoint) -> Self {
        Self {
            id: point.id.to_string(),
            target_id: point.target_id.as_ref().map(ToString::to_string),
            time: Some(timestamp(point.time)),
            started_at: Some(timestamp(point.started_at)),
            position: Some(point.position.into()),
            velocity_east_m_s: point.velocity.east_m_s,
            velocity_north_m_s: point.velocity.north_m_s,
            motion: Some(point.motion.into()),
            covariance: Some(point.covariance_m2.into()),
            r95_m: point.r95_m(),
            receiver_match: point.receiver_match.as_ref().map(Into::into),
            sightings: point
                .sightings
                .iter()
                .map(|sighting| proto::WorldSighting {
                    camera_id: sighting.camera_id.to_string(),
                    tracker_id: sighting.tracker_id.as_ref().map(|id| id.as_sent().to_owned()),
                    last_seen_at: Some(timestamp(sighting.last_seen_at)),
                })
                .collect(),
        }
    }
}
