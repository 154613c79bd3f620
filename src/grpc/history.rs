//! `HistoryService`, and the settings of a history in the profiles of cameras and sites.

use std::pin::Pin;

use futures_util::{Stream, StreamExt as _, stream};
use tonic::Status;

use super::convert::{instant, required, timestamp, track_scope};
use super::pages;
use super::proto;
use super::proto::history_service_server::HistoryService;
use super::statuses::{Reply, answer, context, to_status};
use crate::app::{App, HistoryRows, HistorySelection};
use crate::archive::BoundingArea;
use crate::domain::{
    Acceleration, ArchivedPosition, Error, ErrorKind, HistoryKey, HistorySettings, PlaceId, ReceiverId,
    Result, TargetClass, TargetId, TrackScope,
};
use crate::shutdown::Shutdown;
use crate::telemetry::RequestId;

pub(super) struct Histories {
    app: App,
    shutdown: Shutdown,
}

impl Histories {
    pub(super) fn new(app: &App, shutdown: &Shutdown) -> Self {
        Self { app: app.clone(), shutdown: shutdown.clone() }
    }
}

#[tonic::async_trait]
impl HistoryService for Histories {
    type StreamHistoryStream = Batches;

    async fn list_history(
        &self,
        request: tonic::Request<proto::ListHistoryRequest>,
    ) -> Reply<proto::ListHistoryResponse> {
        answer(&self.app, request, |app, asked| async move {
            let (scope, selection) = selection(asked.selection)?;
            let size = pages::size(asked.page_size, &app.limits)?;
            let after = pages::cursor::<HistoryKey>(&asked.page_token)?;
            let page = app.history().page(scope, selection, after, size).await?;
            Ok(proto::ListHistoryResponse {
                next_page_token: pages::token(page.next.as_ref()),
                positions: page.items.iter().map(Into::into).collect(),
            })
        })
        .await
    }

    async fn stream_history(
        &self,
        request: tonic::Request<proto::StreamHistoryRequest>,
    ) -> Reply<Self::StreamHistoryStream> {
        let id = context(request.extensions())?.id().clone();
        answer(&self.app, request, |app, asked| async move {
            let (scope, selection) = selection(asked.selection)?;
            Ok(batches(app.history().rows(scope, selection).await?, self.shutdown.clone(), id))
        })
        .await
    }

    async fn delete_history(
        &self,
        request: tonic::Request<proto::DeleteHistoryRequest>,
    ) -> Reply<proto::DeleteHistoryResponse> {
        answer(&self.app, request, |app, asked| async move {
            let (scope, selection) = selection(asked.selection)?;
            Ok(proto::DeleteHistoryResponse { deleted: app.history().delete(scope, selection).await? })
        })
        .await
    }
}

type Batches = Pin<Box<dyn Stream<Item = std::result::Result<proto::StreamHistoryResponse, Status>> + Send>>;

fn batches(rows: HistoryRows, shutdown: Shutdown, id: RequestId) -> Batches {
    stream::unfold(Some(rows), move |rows| {
        let (shutdown, id) = (shutdown.clone(), id.clone());
        async move {
            let mut rows = rows?;
            let next = tokio::select! {
                biased;
                () = shutdown.draining() => Err(ending()),
                next = rows.next() => next,
            };
            match next {
                Ok(None) => None,
                Ok(Some(batch)) => {
                    let positions = batch.iter().map(Into::into).collect();
                    Some((Ok(proto::StreamHistoryResponse { positions }), Some(rows)))
                }
                Err(error) => Some((Err(to_status(&error, &id)), None)),
            }
        }
    })
    .boxed()
}

fn ending() -> Error {
    Error::refused(ErrorKind::ShuttingDown, "the server is ending; ask again when it is back")
}

fn selection(selection: Option<proto::HistorySelection>) -> Result<(TrackScope, HistorySelection)> {
    let asked = required(selection, "selection")?;
    let scope = track_scope(asked.scope)?;
    let scope = scope.ok_or_else(|| Error::invalid("scope", "give either site_id or camera_id"))?;
    let area = |area: proto::BoundingArea| {
        BoundingArea::new([area.west_deg, area.south_deg, area.east_deg, area.north_deg])
    };
    let class = |class: String| TargetClass::new(&class).map_err(|error| error.at("class"));
    let target = |target: String| TargetId::new(&target).map_err(|error| error.at("target_id"));
    let receiver = |receiver: String| ReceiverId::new(&receiver).map_err(|error| error.at("receiver_id"));
    let selection = HistorySelection {
        from: instant(asked.from, "from")?,
        until: instant(asked.until, "until")?,
        area: asked.area.map(area).transpose()?,
        place: asked
            .place_id
            .map(|id| PlaceId::new(&id).map_err(|error| error.at("place_id")))
            .transpose()?,
        class: asked.class.map(class).transpose()?,
        target: asked.target_id.map(target).transpose()?,
        receiver: asked.receiver_id.map(receiver).transpose()?,
        track: asked.track_id,
    };
    Ok((scope, selection))
}

impl From<&ArchivedPosition> for proto::HistoryPosition {
    fn from(row: &ArchivedPosition) -> Self {
        Self {
            time: Some(timestamp(row.time)),
            track_id: row.track.clone(),
            target_id: row.target.as_ref().map(ToString::to_string),
            class: row.class.as_ref().map(ToString::to_string),
            position: Some(row.position.into()),
            covariance: Some(row.covariance_m2.into()),
            motion: Some(row.motion.into()),
            acceleration: row.acceleration.map(Into::into),
        }
    }
}

impl From<Acceleration> for proto::Acceleration {
    fn from(acceleration: Acceleration) -> Self {
        let covariance = acceleration.covariance;
        Self {
            east_mps2: acceleration.east_m_s2,
            north_mps2: acceleration.north_m_s2,
            covariance_east_m2_s4: covariance.east_m2,
            covariance_north_m2_s4: covariance.north_m2,
            covariance_east_north_m2_s4: covariance.east_north_m2,
        }
    }
}

/// # Errors
/// Names the field below `history` that is out of range.
pub(super) fn history_settings(settings: proto::HistorySettings) -> Result<HistorySettings> {
    let proto::HistorySettings { keep_days, max_bytes, coarsen_m } = settings;
    let keep_days = keep_days.unwrap_or(HistorySettings::KEEP_DAYS);
    let max_bytes = max_bytes.unwrap_or(HistorySettings::MAX_BYTES);
    HistorySettings::new(keep_days, max_bytes, coarsen_m).map_err(|error| error.under("history"))
}

impl From<HistorySettings> for proto::HistorySettings {
    fn from(settings: HistorySettings) -> Self {
        Self {
            keep_days: Some(settings.keep_days()),
            max_bytes: Some(settings.max_bytes()),
            coarsen_m: settings.coarsen_m(),
        }
    }
}
