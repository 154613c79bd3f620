//! `/v1/cameras/{camera}/tracks`: where targets go; `/v1/cameras/{camera}/events`: live, as events.

use std::convert::Infallible;
use std::sync::Arc;
use std::time::Duration;

use axum::extract::State;
use axum::response::IntoResponse as _;
use axum::response::sse::{Event, KeepAlive, Sse};
use futures_util::{StreamExt as _, stream};
use hyper::Uri;
use jiff::Timestamp;
use serde::Serialize;
use utoipa::openapi::schema::{AnyOfBuilder, Schema};
use utoipa::openapi::{Ref, RefOr};
use utoipa::{PartialSchema, ToSchema};
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use super::cameras::CameraMoved;
use super::fusions::{FusionRequest, observations};
use crate::app::{
    Acknowledgement, CameraEvent, EventId, ItemResult, LiveStream, LostEvents, NotStoredReason, TargetUpdate,
    TrackPoint, UnplacedBox,
};
use crate::domain::{self, Error, Result, Score, TargetClass, TargetId, TrackerId};
use crate::exchange::{MovingFeature, MovingFeatures, MovingTarget, PathPoint, wire};
use crate::fusion::track;
use crate::geo::Position;
use crate::http::plumbing::access::CallerApp;
use crate::http::plumbing::extract::{CameraPath, Client, JsonBody, LastEventId, Params, TargetPath};
use crate::http::plumbing::problem::{ApiResult, Problem};
use crate::http::plumbing::state::Rest;
use crate::http::plumbing::wire::{Durability, geojson, json_of_about};

/// Interval of the keep-alive comments of a silent event stream.
pub(super) const KEEP_ALIVE: Duration = Duration::from_secs(15);
/// Typical size of a followed observation as JSON, to reserve memory.
const ITEM_BYTES: usize = 1_024;

pub(super) fn routes() -> OpenApiRouter<Rest> {
    OpenApiRouter::new()
        .routes(routes!(list_tracks, follow))
        .routes(routes!(get_track))
        .routes(routes!(watch_camera))
}

/// Why a measured position was not used.
#[derive(Serialize, ToSchema)]
#[serde(rename_all = "snake_case")]
enum RejectionReason {
    /// Too far from where the track expects it, by the chi-square gate.
    OutsideGate,
    /// Older than the window of late items.
    TooLate,
    /// A measurement of the same source and instant was used before.
    Duplicate,
    /// Its error variance is not positive, or its error is as large as the camera's scene.
    UnusableVariance,
    /// Farther than 20 km from the origin of the track's plane.
    OutOfRange,
    /// The target's boxes have been the same to the pixel for longer than a standing target shows.
    Frozen,
    /// Boxes and fixes differ by more than chance explains, and those of this source are not the positions of
    /// a moving target.
    Implausible,
}

impl From<track::RejectionReason> for RejectionReason {
    fn from(reason: track::RejectionReason) -> Self {
        match reason {
            track::RejectionReason::OutsideGate => Self::OutsideGate,
            track::RejectionReason::TooLate => Self::TooLate,
            track::RejectionReason::Duplicate => Self::Duplicate,
            track::RejectionReason::UnusableVariance => Self::UnusableVariance,
            track::RejectionReason::OutOfRange => Self::OutOfRange,
            track::RejectionReason::Frozen => Self::Frozen,
            track::RejectionReason::Implausible => Self::Implausible,
        }
    }
}

/// Where a measured position came from.
#[derive(Serialize, ToSchema)]
#[serde(rename_all = "snake_case")]
enum Source {
    /// The box, through the camera's model.
    Regressed,
    /// The receiver.
    Fix,
}

/// A measured position that a track did not use.
#[derive(Serialize, ToSchema)]
struct Rejection {
    /// Box or fix.
    source: Source,
    /// The cause.
    reason: RejectionReason,
    /// Squared Mahalanobis length of its innovation, where one was computed.
    #[serde(skip_serializing_if = "Option::is_none")]
    nis: Option<f64>,
}

impl From<&track::Rejection> for Rejection {
    fn from(rejection: &track::Rejection) -> Self {
        let source = match rejection.source {
            track::MeasurementSource::Regressed => Source::Regressed,
            track::MeasurementSource::Fix => Source::Fix,
        };
        Self { source, reason: rejection.reason.into(), nis: rejection.nis }
    }
}

/// The state of a track at one instant.
#[derive(Serialize, ToSchema)]
struct TrackState {
    /// The target's id.
    target_id: String,
    /// The receiver that the target carries, where only its tracker's id is known and it was matched.
    #[serde(skip_serializing_if = "Option::is_none")]
    receiver_match: Option<ReceiverMatch>,
    /// The latest instant measured.
    #[schema(value_type = String, format = DateTime)]
    time: Timestamp,
    /// Velocity towards east, m/s.
    velocity_east_m_s: f64,
    /// Velocity towards north, m/s.
    velocity_north_m_s: f64,
    #[serde(flatten)]
    motion: wire::Motion,
    /// Radius about the position that holds the true one with 95 % probability, m.
    r95_m: f64,
    /// Covariance of the normal distribution about the position that has this radius: its 95 % ellipse.
    covariance: wire::PlaneCovariance,
    /// Normalised innovation squared of what was used; 2 on average for each of box and fix.
    #[serde(skip_serializing_if = "Option::is_none")]
    nis: Option<f64>,
    /// The positions that were not used.
    rejections: Vec<Rejection>,
    /// True if the track was restarted at this measurement.
    restarted: bool,
    /// True if boxes and fixes have lately differed by more than chance explains; `r95_m` then holds the true
    /// position whichever of them is right, or one of them is not used.
    sources_disagree: bool,
}

impl From<&TrackPoint> for TrackState {
    fn from(point: &TrackPoint) -> Self {
        let state = &point.state;
        Self {
            target_id: point.target_id.as_str().to_owned(),
            receiver_match: point.receiver_match.as_ref().map(Into::into),
            time: state.time,
            velocity_east_m_s: state.velocity.east_m_s,
            velocity_north_m_s: state.velocity.north_m_s,
            motion: state.motion().into(),
            r95_m: state.r95_m,
            covariance: state.normal_covariance().into(),
            nis: state.nis,
            rejections: state.rejected.iter().map(Into::into).collect(),
            restarted: state.restarted,
            sources_disagree: state.sources_disagree,
        }
    }
}

/// The GeoJSON geometry of a position (RFC 7946).
#[derive(Serialize, ToSchema)]
pub(super) struct PointGeometry {
    /// `Point`.
    #[schema(example = "Point")]
    r#type: &'static str,
    /// Longitude and latitude in degrees, WGS 84.
    coordinates: [f64; 2],
}

impl From<Position> for PointGeometry {
    fn from(position: Position) -> Self {
        // A centimetre is the seventh decimal; more would only look precise.
        let rounded = |degrees: f64| (degrees * 1e7).round() / 1e7;
        let coordinates = [rounded(position.longitude_deg()), rounded(position.latitude_deg())];
        Self { r#type: "Point", coordinates }
    }
}

/// A position of a target as a GeoJSON feature.
#[derive(Serialize, ToSchema)]
struct TrackFeature {
    /// `Feature`.
    #[schema(example = "Feature")]
    r#type: &'static str,
    /// The position.
    geometry: PointGeometry,
    /// Time, error and motion.
    properties: TrackState,
}

impl From<&TrackPoint> for TrackFeature {
    fn from(point: &TrackPoint) -> Self {
        Self { r#type: "Feature", geometry: point.position.into(), properties: point.into() }
    }
}

/// Positions as a GeoJSON feature collection (RFC 7946).
#[derive(Serialize, ToSchema)]
struct TrackFeatures {
    /// `FeatureCollection`.
    #[schema(example = "FeatureCollection")]
    r#type: &'static str,
    /// One per position.
    features: Vec<TrackFeature>,
}

/// Positions as features, or as moving features: `anyOf`, since a collection without features is either.
struct TracksOrHistories;

impl PartialSchema for TracksOrHistories {
    fn schema() -> RefOr<Schema> {
        let any_of = AnyOfBuilder::new()
            .item(Ref::from_schema_name(TrackFeatures::name()))
            .item(Ref::from_schema_name(MovingFeatures::name()))
            .description(Some("Positions as features, or as moving features."));
        Schema::AnyOf(any_of.build()).into()
    }
}

impl ToSchema for TracksOrHistories {
    fn schemas(schemas: &mut Vec<(String, RefOr<Schema>)>) {
        schemas.push((TrackFeatures::name().into_owned(), TrackFeatures::schema()));
        schemas.push((MovingFeatures::name().into_owned(), MovingFeatures::schema()));
        TrackFeatures::schemas(schemas);
        MovingFeatures::schemas(schemas);
    }
}

fn track_features(points: &[Arc<TrackPoint>]) -> Result<axum::response::Response> {
    let features = points.iter().map(|point| point.as_ref().into()).collect();
    geojson(&TrackFeatures { r#type: "FeatureCollection", features })
}

/// The format of a history.
#[derive(Clone, Copy, PartialEq, Eq, Serialize, ToSchema)]
#[serde(rename_all = "snake_case")]
enum HistoryForm {
    /// A GeoJSON feature per position.
    #[serde(rename = "geojson")]
    GeoJson,
    /// A moving feature per target.
    MovingFeatures,
}

impl HistoryForm {
    fn of(uri: &Uri) -> Result<Self> {
        let mut params = Params::of(uri)?;
        let form = params.take("form", |text| match text {
            "geojson" => Ok(Self::GeoJson),
            "moving_features" => Ok(Self::MovingFeatures),
            _ => Err(Error::invalid("form", "must be geojson or moving_features")),
        })?;
        params.end()?;
        Ok(form.unwrap_or(Self::GeoJson))
    }
}

fn moving_features<'a>(
    histories: impl Iterator<Item = &'a [Arc<TrackPoint>]>,
) -> Result<axum::response::Response> {
    geojson(&MovingFeatures::of(histories.filter_map(moving_feature)))
}

fn moving_feature(history: &[Arc<TrackPoint>]) -> Option<MovingFeature> {
    let target_id = history.last()?.target_id.to_string();
    let points = history.iter().map(|point| PathPoint {
        time: point.state.time,
        position: point.position,
        r95_m: point.state.r95_m,
    });
    let target = MovingTarget { target_id: Some(target_id.clone()), ..MovingTarget::default() };
    MovingFeature::new(target_id, target, &points.collect::<Vec<_>>())
}

/// All that a track states, as the properties of a GeoJSON feature.
pub(super) fn track_properties(point: &TrackPoint) -> impl Serialize + use<> {
    TrackState::from(point)
}

/// List the targets that are followed, with their latest positions
///
/// A target that was not measured for a minute is left out. With `form=moving_features` each target comes with its
/// history, as OGC Moving Features JSON (19-045r3).
#[utoipa::path(
    get, path = "/v1/cameras/{camera}/tracks", tag = "tracks",
    params(
        ("camera" = String, Path, description = "The camera's id"),
        ("form" = inline(Option<HistoryForm>), Query, description = "`geojson` (if left out) or `moving_features`"),
    ),
    responses((status = 200, description = "Positions, by target", body = TracksOrHistories, content_type = "application/geo+json"))
)]
async fn list_tracks(CallerApp(app): CallerApp, CameraPath(id): CameraPath, uri: Uri) -> ApiResult {
    if HistoryForm::of(&uri)? == HistoryForm::GeoJson {
        return Ok(track_features(&app.live().tracks(&id).await?)?);
    }
    let histories = app.live().track_histories(&id).await?;
    Ok(moving_features(histories.iter().map(Vec::as_slice))?)
}

/// Read where a target was
///
/// Oldest first, as far back as the history reaches. With `form=moving_features` as one feature of OGC Moving
/// Features JSON (19-045r3).
#[utoipa::path(
    get, path = "/v1/cameras/{camera}/tracks/{target}", tag = "tracks",
    params(("camera" = String, Path, description = "The camera's id"), ("target" = String, Path, description = "The target's id"), ("form" = inline(Option<HistoryForm>), Query, description = "`geojson` (if left out) or `moving_features`")),
    responses((status = 200, description = "Positions, oldest first", body = TracksOrHistories, content_type = "application/geo+json"))
)]
async fn get_track(CallerApp(app): CallerApp, TargetPath(id, target): TargetPath, uri: Uri) -> ApiResult {
    let form = HistoryForm::of(&uri)?;
    let history = app.live().track_history(&id, &target).await?;
    Ok(match form {
        HistoryForm::GeoJson => track_features(&history)?,
        HistoryForm::MovingFeatures => moving_features(std::iter::once(&history[..]))?,
    })
}

/// One observation's own position, and its target's track with it.
#[derive(Serialize, ToSchema)]
struct FollowedObservation<'a> {
    /// The observation's own position; missing for a box while the camera has no model.
    #[serde(skip_serializing_if = "Option::is_none")]
    fused: Option<wire::FusedFix<'a>>,
    /// The track's position, the best there is; missing without a target.
    #[serde(skip_serializing_if = "Option::is_none")]
    track: Option<TrackFeature>,
    /// The target's world track in the camera's site, as of the latest frame that was tracked there.
    #[serde(skip_serializing_if = "Option::is_none")]
    world_track_id: Option<String>,
    /// The receiver that the target of the box carries, where the observation has a `tracker_id` and was matched.
    #[serde(skip_serializing_if = "Option::is_none")]
    receiver_match: Option<ReceiverMatch>,
}

/// The receiver that the target of a box carries.
#[derive(Serialize, ToSchema)]
pub(super) struct ReceiverMatch {
    /// The receiver: the target of its fixes.
    receiver_id: String,
    /// Posterior probability, 0 to 1.
    probability: f64,
}

impl From<&domain::ReceiverMatch> for ReceiverMatch {
    fn from(own: &domain::ReceiverMatch) -> Self {
        Self { receiver_id: own.receiver_id.as_str().to_owned(), probability: own.probability }
    }
}

impl<'a> From<&'a ItemResult> for FollowedObservation<'a> {
    fn from(followed: &'a ItemResult) -> Self {
        Self {
            fused: followed.fused.as_ref().map(Into::into),
            track: followed.track.as_ref().map(|point| point.as_ref().into()),
            world_track_id: followed.world_track.map(|id| id.to_string()),
            receiver_match: followed.receiver_match.as_ref().map(Into::into),
        }
    }
}

/// A measured target: the GeoJSON feature of its track, and the observation that updated it.
#[derive(Serialize, ToSchema)]
struct TrackUpdate<'a> {
    #[serde(flatten)]
    feature: TrackFeature,
    /// The observation's box.
    #[serde(skip_serializing_if = "Option::is_none")]
    bounding_box: Option<wire::BoundingBox>,
    /// The observation's own position; missing for a box while the camera has no model.
    #[serde(skip_serializing_if = "Option::is_none")]
    fused: Option<wire::FusedFix<'a>>,
}

impl<'a> From<&'a TargetUpdate> for TrackUpdate<'a> {
    fn from(update: &'a TargetUpdate) -> Self {
        Self {
            feature: update.point.as_ref().into(),
            bounding_box: update.bounding_box.map(Into::into),
            fused: update.fused.as_ref().map(Into::into),
        }
    }
}

/// A box of a live stream or a source that has no position, since the camera has no model.
#[derive(Serialize, ToSchema)]
struct SeenBox<'a> {
    /// Time of the frame.
    #[schema(value_type = String, format = DateTime)]
    time: Timestamp,
    /// The target, where the detector knows it.
    #[serde(skip_serializing_if = "Option::is_none")]
    target_id: Option<&'a str>,
    /// The id that the camera's tracker gave it.
    #[serde(skip_serializing_if = "Option::is_none")]
    tracker_id: Option<&'a str>,
    /// The box.
    bounding_box: wire::BoundingBox,
    /// Class reported by the detector.
    #[serde(skip_serializing_if = "Option::is_none")]
    class: Option<&'a str>,
    /// Confidence score of the detector.
    #[serde(skip_serializing_if = "Option::is_none")]
    score: Option<f64>,
}

impl<'a> From<&'a UnplacedBox> for SeenBox<'a> {
    fn from(seen: &'a UnplacedBox) -> Self {
        Self {
            time: seen.time,
            target_id: seen.target_id.as_ref().map(TargetId::as_str),
            tracker_id: seen.tracker_id.as_ref().map(TrackerId::as_str),
            bounding_box: seen.bounding_box.into(),
            class: seen.class.as_ref().map(TargetClass::as_str),
            score: seen.score.map(Score::value),
        }
    }
}

/// One answer per observation, in their order.
#[derive(Serialize, ToSchema)]
struct FollowedObservations<'a> {
    /// The answers, in the order of the observations.
    items: Vec<FollowedObservation<'a>>,
    /// The counts of stored observations, if storage was requested.
    #[serde(skip_serializing_if = "Option::is_none")]
    stored: Option<StoredObservations>,
}

/// Counts of observations that were to be stored.
#[derive(Default, Serialize, ToSchema)]
struct StoredObservations {
    /// Boxes and fixes that are part of a stored sample.
    in_samples: u64,
    /// Those that name neither target nor receiver.
    no_target: u64,
    /// Those for which no partner came within the pairing window.
    unpaired: u64,
    /// Those that came after the pairing of their instant had been decided.
    too_late: u64,
    /// Those of which the same target and instant was there before.
    duplicate: u64,
    /// Boxes with only a tracker's id whose receiver is not sure enough.
    unmatched: u64,
}

impl From<Acknowledgement> for StoredObservations {
    fn from(acknowledgement: Acknowledgement) -> Self {
        let count = |reason| {
            let of_reason = acknowledgement.not_stored.iter().filter(|it| it.reason == reason);
            of_reason.map(|it| it.count).sum()
        };
        Self {
            in_samples: acknowledgement.stored,
            no_target: count(NotStoredReason::NoTarget),
            unpaired: count(NotStoredReason::Unpaired),
            too_late: count(NotStoredReason::TooLate),
            duplicate: count(NotStoredReason::Duplicate),
            unmatched: count(NotStoredReason::Unmatched),
        }
    }
}

/// Follow targets
///
/// Takes what `fusions` takes, box and fix together or apart, and feeds each observation to the
/// track of its target.
///
/// With `store_samples` boxes and fixes are paired with those of all live streams of the camera that store
/// samples, and stored. The answer then comes when it is decided what becomes of each observation, some seconds
/// later: a client that sends as it measures has several requests open.
#[utoipa::path(
    post, path = "/v1/cameras/{camera}/tracks", tag = "tracks",
    params(
        ("camera" = String, Path, description = "The camera's id"),
        ("store_samples" = Option<bool>, Query, description = "Pair boxes and fixes by target and time, and store the samples"),
        ("durability" = inline(Option<Durability>), Query, description = "When samples are acknowledged: `synced` (if left out), after they have been flushed to the disk; `relaxed`, after their commit, which a power cut may undo"),
    ),
    request_body = FusionRequest,
    responses(
        (status = 200, description = "Positions and tracks", body = FollowedObservations<'static>),
        (status = 307, description = "Another node has the camera's live state; `location` is the same at that node", body = Problem, content_type = "application/problem+json"),
        (status = 503, description = "The camera follows as many targets as it may", body = Problem, content_type = "application/problem+json"),
    )
)]
async fn follow(
    CallerApp(app): CallerApp,
    CameraPath(id): CameraPath,
    Client(client): Client,
    uri: Uri,
    body: JsonBody,
) -> ApiResult {
    let mut params = Params::of(&uri)?;
    let stores_samples = params.flag("store_samples")?.unwrap_or(false);
    let durability = params.durability()?;
    params.end()?;
    let (camera, lease) = app.nodes().own_camera(&id).await?;
    // Times ahead of the clock are refused before any track has changed.
    let observations = observations(&app, &body.read()?, &app.live().rules(&camera), &camera.receivers)?;
    app.limits.check_batch(observations.len())?;
    let (followed, stored) = if stores_samples {
        let (followed, acknowledgement) =
            LiveStream::follow_and_store(&app, &camera, observations, client, durability).await?;
        (followed, Some(StoredObservations::from(acknowledgement)))
    } else {
        let follow = |observation| app.live().follow((&camera, &lease), observation);
        (observations.into_iter().map(follow).collect::<Result<Vec<_>>>()?, None)
    };
    let items = followed.iter().map(Into::into).collect();
    Ok(json_of_about(&FollowedObservations { items, stored }, 64 + ITEM_BYTES * followed.len())?)
}

/// The bodies of a camera's events, by the event's name.
#[derive(ToSchema)]
#[serde(untagged)]
#[expect(dead_code, clippy::large_enum_variant, reason = "the shapes of events, for the description alone")]
enum CameraEventBody<'a> {
    /// `track`.
    Track(TrackUpdate<'a>),
    /// `box`.
    Box(SeenBox<'a>),
    /// `camera_moved`.
    Moved(CameraMoved),
    /// `lost`: the number of lost events, null where it is not known.
    Lost(Option<u64>),
}

/// Watch a camera
///
/// Server-sent events from now on: `track` with a position as GeoJSON whenever a target was
/// measured, `box` with a box of a stream or a source while the camera has no model, `camera_moved` when the
/// camera's pose is found to have changed, and `lost` with the number of events that were lost because
/// the client read too slowly. They end when the camera is deleted.
///
/// A client that comes back with the `last-event-id` of an event goes on after it. The latest 1,024 events are
/// kept, up to a minute without a client; of those that are not kept any more, `lost` tells the number, or
/// `null` where it is not known.
#[utoipa::path(
    get, path = "/v1/cameras/{camera}/events", tag = "tracks",
    params(
        ("camera" = String, Path, description = "The camera's id"),
        ("last-event-id" = Option<String>, Header, description = "The id of the last event that the client has seen"),
        ("last_event_id" = Option<String>, Query, description = "The same, for a page that cannot send the header"),
    ),
    responses((status = 200, description = "Events", body = CameraEventBody<'static>, content_type = "text/event-stream"))
)]
async fn watch_camera(
    State(rest): State<Rest>,
    CallerApp(app): CallerApp,
    CameraPath(id): CameraPath,
    Client(client): Client,
    LastEventId(last_seen): LastEventId,
) -> ApiResult {
    let lease = app.quotas.event_streams.try_acquire(client, 1)?;
    // A text that is no id of ours names no known event.
    let last_seen = last_seen.map(|text| text.parse().unwrap_or(EventId::UNKNOWN));
    let events = app.live().camera_events(&id, last_seen).await?;
    let shutdown = rest.shutdown.clone();
    let sent = stream::unfold(events, |mut events| async move {
        let (id, event) = match events.next().await? {
            Ok((id, event)) => (id, camera_event(&event)),
            Err(LostEvents { count, id }) => (id, event_of("lost", &count)),
        };
        Some((event.id(id.to_string()), events))
    });
    let sent = sent.take_until(async move { shutdown.draining().await }).map(move |event| {
        let _held = &lease; // until the stream is dropped
        Ok::<_, Infallible>(event)
    });
    Ok(Sse::new(sent).keep_alive(KeepAlive::new().interval(KEEP_ALIVE)).into_response())
}

fn camera_event(event: &CameraEvent) -> Event {
    match event {
        CameraEvent::Track(update) => event_of("track", &TrackUpdate::from(&**update)),
        CameraEvent::Box(seen) => event_of("box", &SeenBox::from(&**seen)),
        CameraEvent::Moved(moved) => event_of("camera_moved", &CameraMoved::from(&**moved)),
    }
}

pub(super) fn event_of(name: &str, value: &impl Serialize) -> Event {
    Event::default().event(name).json_data(value).unwrap_or_else(|error| {
        tracing::error!(%error, "an event cannot be written");
        Event::default().event("error").data("the server failed")
    })
}
