//! `TrackService`: tracks of the targets of one camera, and the camera's events.

use std::pin::Pin;

use futures_util::{Stream, StreamExt as _, stream};
use tonic::Status;

use super::convert::{camera_id, timestamp};
use super::proto;
use super::proto::track_service_server::TrackService;
use super::proto::watch_camera_response::Event;
use super::statuses::{Reply, answer, context, to_status};
use crate::admission::Lease;
use crate::app::{App, CameraEvent, CameraEvents, EventId, LostEvents, TargetUpdate, UnplacedBox};
use crate::domain::{CameraId, Error, ErrorKind, Score, TargetId};
use crate::shutdown::Shutdown;
use crate::telemetry::RequestId;

pub(super) struct Tracks {
    app: App,
    shutdown: Shutdown,
}

impl Tracks {
    pub(super) fn new(app: &App, shutdown: &Shutdown) -> Self {
        Self { app: app.clone(), shutdown: shutdown.clone() }
    }
}

#[tonic::async_trait]
impl TrackService for Tracks {
    async fn list_tracks(
        &self,
        request: tonic::Request<proto::ListTracksRequest>,
    ) -> Reply<proto::ListTracksResponse> {
        answer(&self.app, request, |app, asked| async move {
            let tracks = app.live().tracks(&camera_id(&asked.camera_id)?).await?;
            let tracks = tracks.iter().map(|point| point.as_ref().into()).collect();
            Ok(proto::ListTracksResponse { tracks })
        })
        .await
    }

    async fn get_track(
        &self,
        request: tonic::Request<proto::GetTrackRequest>,
    ) -> Reply<proto::GetTrackResponse> {
        answer(&self.app, request, |app, asked| async move {
            let camera = camera_id(&asked.camera_id)?;
            let target = TargetId::new(&asked.target_id)
                .map_err(|_| Error::refused(ErrorKind::TrackNotFound, "that is not the id of a target"))?;
            let history = app.live().track_history(&camera, &target).await?;
            let points = history.iter().map(|point| point.as_ref().into()).collect();
            Ok(proto::GetTrackResponse { points })
        })
        .await
    }

    type WatchCameraStream = Events;

    async fn watch_camera(&self, request: tonic::Request<proto::WatchCameraRequest>) -> Reply<Events> {
        let context = context(request.extensions())?;
        let (id, client) = (context.id().clone(), context.client());
        answer(&self.app, request, |app, asked| async move {
            let lease = app.quotas.event_streams.try_acquire(client, 1)?;
            let camera = camera_id(&asked.camera_id)?;
            // A text that is no id of ours names no known event.
            let after = Some(asked.resume_after.as_str())
                .filter(|text| !text.is_empty())
                .map(|text| text.parse().unwrap_or(EventId::UNKNOWN));
            let source = app.live().camera_events(&camera, after).await?;
            Ok(events(source, camera, lease, self.shutdown.clone(), id))
        })
        .await
    }
}

/// The events of a camera.
type Events = Pin<Box<dyn Stream<Item = std::result::Result<proto::WatchCameraResponse, Status>> + Send>>;

/// Ends with the camera or with the server, each reported as an error, so that nobody takes the camera for
/// quiet.
fn events(source: CameraEvents, camera: CameraId, lease: Lease, shutdown: Shutdown, id: RequestId) -> Events {
    stream::unfold(Some((source, lease)), move |watched| {
        let (camera, shutdown, id) = (camera.clone(), shutdown.clone(), id.clone());
        async move {
            let (mut source, lease) = watched?;
            let next = tokio::select! {
                biased;
                () = shutdown.draining() => Err(ending()),
                next = source.next() => next.ok_or_else(|| ended(&source, &camera)),
            };
            Some(match next {
                Ok(Ok((id, event))) => (Ok(response(id, (&*event).into())), Some((source, lease))),
                Ok(Err(LostEvents { count, id })) => {
                    let lost = Event::Lost(proto::LostCameraEvents { events: count });
                    (Ok(response(id, lost)), Some((source, lease)))
                }
                Err(error) => (Err(to_status(&error, &id)), None),
            })
        }
    })
    .boxed()
}

fn response(id: EventId, event: Event) -> proto::WatchCameraResponse {
    proto::WatchCameraResponse { event_id: id.to_string(), event: Some(event) }
}

fn ended(source: &CameraEvents, camera: &CameraId) -> Error {
    if source.continue_elsewhere() {
        let message = format!("camera {camera} has gone to another node; watch it again");
        return Error::refused(ErrorKind::CameraBetweenNodes, message);
    }
    Error::refused(ErrorKind::CameraNotFound, format!("camera {camera} was deleted"))
}

fn ending() -> Error {
    Error::refused(ErrorKind::ShuttingDown, "the server is ending; tracks start again when it is back")
}

impl From<&CameraEvent> for Event {
    fn from(event: &CameraEvent) -> Self {
        match event {
            CameraEvent::Track(update) => Self::Track(update.as_ref().into()),
            CameraEvent::Box(seen) => Self::Box(seen.as_ref().into()),
            CameraEvent::Moved(moved) => Self::CameraMoved(moved.as_ref().clone().into()),
        }
    }
}

impl From<&TargetUpdate> for proto::CameraTrackUpdate {
    fn from(update: &TargetUpdate) -> Self {
        Self {
            track: Some(update.point.as_ref().into()),
            bounding_box: update.bounding_box.map(Into::into),
            fused: update.fused.clone().map(Into::into),
        }
    }
}

impl From<&UnplacedBox> for proto::CameraBox {
    fn from(seen: &UnplacedBox) -> Self {
        Self {
            time: Some(timestamp(seen.time)),
            target_id: seen.target_id.as_ref().map(|id| id.as_str().to_owned()),
            tracker_id: seen.tracker_id.as_ref().map(|id| id.as_str().to_owned()),
            bounding_box: Some(seen.bounding_box.into()),
            class: seen.class.as_ref().map(|class| class.as_str().to_owned()),
            score: seen.score.map(Score::value),
        }
    }
}
