//! `/v1/sites/{site}/tracks`: where the targets of a site go; `/v1/sites/{site}/events`: live, as events.

use std::convert::Infallible;
use std::sync::Arc;
use std::time::Duration;

use axum::extract::State;
use axum::response::IntoResponse as _;
use axum::response::sse::{Event, KeepAlive, Sse};
use futures_util::{StreamExt as _, stream};
use hyper::{HeaderMap, Uri};
use jiff::Timestamp;
use serde::Serialize;
use utoipa::ToSchema;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use super::tracks::{KEEP_ALIVE, PointGeometry, ReceiverMatch, event_of};
use crate::app::{LostSiteEvents, SiteEventKind, SiteTracks, StoredSiteEvent, WorldTrackPoint};
use crate::domain::{CameraId, Error, LiveId, ReceiverId, Result, TargetId};
use crate::exchange::wire::{Motion, PlaneCovariance, Position};
use crate::fusion::clock_estimate::{self, ClockEstimate};
use crate::http::plumbing::access::CallerApp;
use crate::http::plumbing::extract::{Client, Params, SitePath, WorldTrackPath, negotiate};
use crate::http::plumbing::problem::{ApiResult, Problem};
use crate::http::plumbing::state::Rest;
use crate::http::plumbing::wire::{GEOJSON, geojson, json};

/// Header and query parameter that name the event to continue after.
const LAST_EVENT_HEADER: &str = "last-event-id";
const LAST_EVENT_PARAMETER: &str = "last_event_id";
/// How long a browser waits before it connects again.
const RECONNECT_AFTER: Duration = Duration::from_secs(2);

pub(super) fn routes() -> OpenApiRouter<Rest> {
    OpenApiRouter::new()
        .routes(routes!(list_world_tracks))
        .routes(routes!(get_world_track))
        .routes(routes!(watch_site))
}

/// A camera that sees a target.
#[derive(Serialize, ToSchema)]
struct WorldSighting {
    /// The camera's id.
    camera_id: String,
    /// The id that its tracker gives the target, if any.
    #[serde(skip_serializing_if = "Option::is_none")]
    tracker_id: Option<String>,
    /// When it saw the target last.
    #[schema(value_type = String, format = DateTime)]
    last_seen_at: Timestamp,
}

/// The state of a world track at the latest instant measured.
#[derive(Serialize, ToSchema)]
struct WorldTrackState {
    /// The track's id. It is never used again, also not after a start of the server.
    #[schema(example = "3f9a02c1-17")]
    id: String,
    /// The target, once one of its receivers is known: by its name, or by `receiver_match`.
    #[serde(skip_serializing_if = "Option::is_none")]
    target_id: Option<String>,
    /// The receiver that the target carries, where it was found by association. The track's id stays the same whatever it is.
    #[serde(skip_serializing_if = "Option::is_none")]
    receiver_match: Option<ReceiverMatch>,
    /// The latest instant measured.
    #[schema(value_type = String, format = DateTime)]
    time: Timestamp,
    /// Time of the first measurement.
    #[schema(value_type = String, format = DateTime)]
    started_at: Timestamp,
    /// Velocity towards east, m/s.
    velocity_east_m_s: f64,
    /// Velocity towards north, m/s.
    velocity_north_m_s: f64,
    #[serde(flatten)]
    motion: Motion,
    /// Covariance of the position's error.
    covariance: PlaneCovariance,
    /// Radius about the position that holds the true one with 95 % probability, m.
    r95_m: f64,
    /// The cameras that see the target at that instant.
    sightings: Vec<WorldSighting>,
}

impl From<&WorldTrackPoint> for WorldTrackState {
    fn from(point: &WorldTrackPoint) -> Self {
        Self {
            id: point.id.to_string(),
            target_id: point.target_id.as_ref().map(TargetId::to_string),
            receiver_match: point.receiver_match.as_ref().map(Into::into),
            time: point.time,
            started_at: point.started_at,
            velocity_east_m_s: point.velocity.east_m_s,
            velocity_north_m_s: point.velocity.north_m_s,
            motion: point.motion.into(),
            covariance: point.covariance_m2.into(),
            r95_m: point.r95_m(),
            sightings: point
                .sightings
                .iter()
                .map(|sighting| WorldSighting {
                    camera_id: sighting.camera_id.to_string(),
                    tracker_id: sighting.tracker_id.as_ref().map(|id| id.as_sent().to_owned()),
                    last_seen_at: sighting.last_seen_at,
                })
                .collect(),
        }
    }
}

/// Where a target is by its world track.
#[derive(Serialize, ToSchema)]
struct WorldTrack {
    #[serde(flatten)]
    state: WorldTrackState,
    /// Position at the latest instant measured.
    position: Position,
}

impl From<&WorldTrackPoint> for WorldTrack {
    fn from(point: &WorldTrackPoint) -> Self {
        Self { state: point.into(), position: point.position.into() }
    }
}

/// How fast a clock is, by a line through its offsets of up to a day; 10 millionths are 0.9 s a day.
#[derive(Serialize, ToSchema)]
struct ClockDrift {
    /// Millionths by which its seconds are too short; negative where it is slow.
    ppm: f64,
    /// Standard deviation of the estimate, millionths.
    sigma_ppm: f64,
}

impl From<clock_estimate::ClockDrift> for ClockDrift {
    fn from(drift: clock_estimate::ClockDrift) -> Self {
        Self { ppm: drift.ppm, sigma_ppm: drift.sigma_ppm }
    }
}

/// How late the times of a camera are beside those of most cameras of its site.
#[derive(Serialize, ToSchema)]
struct CameraClock {
    /// The camera's id.
    camera_id: String,
    /// Seconds by which its times are later than those of the other cameras; negative if they are earlier.
    offset_s: f64,
    /// Standard deviation of the estimate, s.
    sigma_s: f64,
    /// True if the offset is neither chance nor a difference of two maps: world tracks correct the camera's times by it, and its
    /// clock should be set.
    is_wrong: bool,
    /// How fast the clock is, where its offset was followed for an hour.
    drift: Option<ClockDrift>,
}

impl From<(&CameraId, &ClockEstimate)> for CameraClock {
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

/// How late the times of a receiver are beside those of the cameras of a site.
#[derive(Serialize, ToSchema)]
struct ReceiverClock {
    /// The receiver's id.
    receiver_id: String,
    /// Seconds by which its times, with its `clock_offset_s` added, are later than those of the cameras; negative if they are
    /// earlier.
    offset_s: f64,
    /// Standard deviation of the estimate, s.
    sigma_s: f64,
    /// True if the offset is no chance: world tracks correct the receiver's times by it. Where `common_receiver_clock` is wrong as
    /// well, the cameras' clocks should be set; else subtract it from the receiver's `clock_offset_s`.
    is_wrong: bool,
    /// How fast the clock is, where its offset was followed for an hour.
    drift: Option<ClockDrift>,
}

impl From<(&ReceiverId, &ClockEstimate)> for ReceiverClock {
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

/// How late the times of most receivers of a site are beside those of its cameras.
#[derive(Serialize, ToSchema)]
struct CommonClock {
    /// Seconds by which they are later; negative if they are earlier, so that the cameras' times are late.
    offset_s: f64,
    /// Standard deviation of the estimate, s.
    sigma_s: f64,
    /// True if the offset is no chance. Receivers have the time of GNSS: world tracks correct all of their times by it, and the
    /// cameras' clocks should be set.
    is_wrong: bool,
}

impl From<ClockEstimate> for CommonClock {
    fn from(clock: ClockEstimate) -> Self {
        Self { offset_s: clock.offset_s, sigma_s: clock.sigma_s, is_wrong: clock.is_wrong() }
    }
}

/// World tracks of a site.
#[derive(Serialize, ToSchema)]
struct WorldTracks {
    /// Tracks by id; or the points of one track, oldest first.
    items: Vec<WorldTrack>,
    /// The event after which `events` misses nothing that is not among the tracks; missing for one track.
    #[serde(skip_serializing_if = "Option::is_none")]
    last_event_id: Option<String>,
    /// How late the times of the site's cameras are, by camera, where targets that two cameras see at once tell; missing for
    /// one track.
    #[serde(skip_serializing_if = "Option::is_none")]
    clocks: Option<Vec<CameraClock>>,
    /// How late the times of receivers are beside those of the cameras, by receiver, where tracks of their carriers tell; missing
    /// for one track.
    #[serde(skip_serializing_if = "Option::is_none")]
    receiver_clocks: Option<Vec<ReceiverClock>>,
    /// The same of most receivers together; missing where fewer than three tell.
    #[serde(skip_serializing_if = "Option::is_none")]
    common_receiver_clock: Option<CommonClock>,
}

/// A position of a world track as a GeoJSON feature (RFC 7946).
#[derive(Serialize, ToSchema)]
struct WorldTrackFeature {
    /// `Feature`.
    #[schema(example = "Feature")]
    r#type: &'static str,
    /// The position.
    geometry: PointGeometry,
    /// Identity, time, error and motion.
    properties: WorldTrackState,
}

impl From<&WorldTrackPoint> for WorldTrackFeature {
    fn from(point: &WorldTrackPoint) -> Self {
        Self { r#type: "Feature", geometry: point.position.into(), properties: point.into() }
    }
}

/// Positions of world tracks as a GeoJSON feature collection (RFC 7946).
#[derive(Serialize, ToSchema)]
struct WorldTrackFeatures {
    /// `FeatureCollection`.
    #[schema(example = "FeatureCollection")]
    r#type: &'static str,
    /// One per position.
    features: Vec<WorldTrackFeature>,
}

#[derive(Clone, Copy)]
enum Form {
    Json,
    GeoJson,
}

/// The points in the form that the client accepts.
fn answer(headers: &HeaderMap, points: &[Arc<WorldTrackPoint>], of_site: Option<&SiteTracks>) -> ApiResult {
    let response = match negotiate(headers, &[("application/json", Form::Json), (GEOJSON, Form::GeoJson)])? {
        Form::Json => json(&WorldTracks {
            items: points.iter().map(|point| point.as_ref().into()).collect(),
            last_event_id: of_site.map(|tracks| tracks.last_event.to_string()),
            receiver_clocks: of_site
                .map(|tracks| tracks.clocks.receivers.by_receiver.iter().map(Into::into).collect()),
            common_receiver_clock: of_site.and_then(|tracks| tracks.clocks.receivers.common.map(Into::into)),
            clocks: of_site.map(|tracks| tracks.clocks.cameras.iter().map(Into::into).collect()),
        })?,
        Form::GeoJson => {
            let features = points.iter().map(|point| point.as_ref().into()).collect();
            geojson(&WorldTrackFeatures { r#type: "FeatureCollection", features })?
        }
    };
    Ok(response)
}

/// List the targets of a site, with their latest positions
///
/// One track per target over all cameras of the site. JSON, or GeoJSON by `accept: application/geo+json`.
#[utoipa::path(
    get, path = "/v1/sites/{site}/tracks", tag = "sites",
    params(("site" = String, Path, description = "The site's id")),
    responses((status = 200, description = "Tracks, by id", content(
        (WorldTracks = "application/json"), (WorldTrackFeatures = "application/geo+json")
    )))
)]
async fn list_world_tracks(
    CallerApp(app): CallerApp,
    SitePath(id): SitePath,
    headers: HeaderMap,
) -> ApiResult {
    let tracks = app.world_tracks().latest(&id).await?;
    answer(&headers, &tracks.points, Some(&tracks))
}

/// Read where a target of a site was
///
/// Oldest first, as far back as the history reaches, while the track lasts.
#[utoipa::path(
    get, path = "/v1/sites/{site}/tracks/{track}", tag = "sites",
    params(
        ("site" = String, Path, description = "The site's id"),
        ("track" = String, Path, description = "The track's id"),
    ),
    responses(
        (status = 200, description = "Positions, oldest first", content(
            (WorldTracks = "application/json"), (WorldTrackFeatures = "application/geo+json")
        )),
        (status = 404, description = "The track has ended, or there is none", body = Problem, content_type = "application/problem+json"),
    )
)]
async fn get_world_track(
    CallerApp(app): CallerApp,
    WorldTrackPath(id, track): WorldTrackPath,
    headers: HeaderMap,
) -> ApiResult {
    answer(&headers, &app.world_tracks().history(&id, track).await?, None)
}

/// The contents of an event besides a position.
#[derive(Serialize, ToSchema)]
struct TrackChange {
    /// The instant by the clock of the cameras.
    #[schema(value_type = String, format = DateTime)]
    time: Timestamp,
    /// The track's id.
    track_id: String,
    /// `handed_over`: the camera that saw the target last.
    #[serde(skip_serializing_if = "Option::is_none")]
    from_camera_id: Option<String>,
    /// `handed_over`: the camera that sees it now.
    #[serde(skip_serializing_if = "Option::is_none")]
    to_camera_id: Option<String>,
    /// `identified`: the target whose receiver is known.
    #[serde(skip_serializing_if = "Option::is_none")]
    target_id: Option<String>,
    /// `merged`: the track of the same target that ends.
    #[serde(skip_serializing_if = "Option::is_none")]
    ended_track_id: Option<String>,
}

impl TrackChange {
    fn of(time: Timestamp, track: LiveId) -> Self {
        Self {
            time,
            track_id: track.to_string(),
            from_camera_id: None,
            to_camera_id: None,
            target_id: None,
            ended_track_id: None,
        }
    }
}

/// Events that did not reach a reader.
#[derive(Serialize, ToSchema)]
struct LostSiteEventCount {
    /// `too_old`: the event to continue after is not kept any more; `restarted`: it is of before the start of the
    /// server; `too_slow`: the client reads too slowly.
    reason: &'static str,
    /// Number of lost events, if it is known.
    #[serde(skip_serializing_if = "Option::is_none")]
    events: Option<u64>,
}

/// The bodies of a site's events, by the event's name.
#[derive(ToSchema)]
#[serde(untagged)]
#[expect(dead_code, reason = "the shapes of events, for the description alone")]
enum SiteEventBody {
    /// `track`.
    Track(WorldTrackFeature),
    /// `track_started`, `handed_over`, `identified`, `merged`, `track_ended`.
    Change(TrackChange),
    /// `lost`.
    Lost(LostSiteEventCount),
}

/// Watch the targets of a site
///
/// Server-sent events: `track` with a position as a GeoJSON feature when a target was measured, at most five a
/// second and track; `track_started`, `handed_over` from camera to camera, `identified` by a receiver, `merged` and
/// `track_ended`. Each has an id; a client that connects again with `last-event-id`, as browsers do by themselves,
/// continues after it. `lost` counts events that are no longer stored. They end when the site is deleted.
#[utoipa::path(
    get, path = "/v1/sites/{site}/events", tag = "sites",
    params(
        ("site" = String, Path, description = "The site's id"),
        ("last-event-id" = Option<String>, Header, description = "The event to continue after; from now on if left out"),
        ("last_event_id" = Option<String>, Query, description = "The same for a first request, which a browser cannot give headers"),
    ),
    responses((status = 200, description = "Events", body = SiteEventBody, content_type = "text/event-stream"))
)]
async fn watch_site(
    State(rest): State<Rest>,
    CallerApp(app): CallerApp,
    SitePath(id): SitePath,
    Client(client): Client,
    headers: HeaderMap,
    uri: Uri,
) -> ApiResult {
    let after = last_event(&headers, &uri)?;
    let lease = app.quotas.event_streams.try_acquire(client, 1)?;
    let events = app.world_tracks().events(&id, after).await?;
    let shutdown = rest.shutdown.clone();
    let sent = stream::unfold(events, |mut events| async move {
        let event = match events.next().await? {
            Ok(stored) => site_event(&stored),
            Err(lost) => lost_event(lost),
        };
        Some((event.retry(RECONNECT_AFTER), events))
    });
    let sent = sent.take_until(async move { shutdown.draining().await }).map(move |event| {
        let _held = &lease; // until the stream is dropped
        Ok::<_, Infallible>(event)
    });
    Ok(Sse::new(sent).keep_alive(KeepAlive::new().interval(KEEP_ALIVE)).into_response())
}

/// The header wins: a browser that connects again sends it beside the parameter of its first request.
fn last_event(headers: &HeaderMap, uri: &Uri) -> Result<Option<LiveId>> {
    let mut params = Params::of(uri)?;
    let at = |field: &'static str| move |error: Error| error.at(field);
    let parameter =
        params.take(LAST_EVENT_PARAMETER, |text| text.parse().map_err(at(LAST_EVENT_PARAMETER)))?;
    params.end()?;
    let header = headers.get(LAST_EVENT_HEADER).map(|value| value.to_str().unwrap_or_default());
    let header = header.map(str::parse).transpose().map_err(at(LAST_EVENT_HEADER))?;
    Ok(header.or(parameter))
}

fn site_event(stored: &StoredSiteEvent) -> Event {
    let time = stored.event.time;
    let (name, change) = match &stored.event.kind {
        SiteEventKind::Measured(point) => {
            return event_of("track", &WorldTrackFeature::from(point.as_ref())).id(stored.id.to_string());
        }
        SiteEventKind::Started(track) => ("track_started", TrackChange::of(time, *track)),
        SiteEventKind::HandedOver { track, from, to } => {
            let (from_camera_id, to_camera_id) = (Some(from.to_string()), Some(to.to_string()));
            ("handed_over", TrackChange { from_camera_id, to_camera_id, ..TrackChange::of(time, *track) })
        }
        SiteEventKind::Identified { track, target_id } => {
            let target_id = Some(target_id.to_string());
            ("identified", TrackChange { target_id, ..TrackChange::of(time, *track) })
        }
        SiteEventKind::Merged { track, ended } => {
            let ended_track_id = Some(ended.to_string());
            ("merged", TrackChange { ended_track_id, ..TrackChange::of(time, *track) })
        }
        SiteEventKind::Ended(track) => ("track_ended", TrackChange::of(time, *track)),
    };
    event_of(name, &change).id(stored.id.to_string())
}

fn lost_event(lost: LostSiteEvents) -> Event {
    let body = LostSiteEventCount { reason: lost.reason.as_str(), events: lost.events };
    event_of("lost", &body).id(lost.id.to_string())
}
