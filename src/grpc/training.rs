//! `TrainingService`.

use std::pin::Pin;

use futures_util::{Stream, StreamExt as _, stream};
use prost::Message as _;
use tonic::Status;

use super::convert::{camera_id, instant, recipe, run_id, timestamp};
use super::idempotency::idempotent;
use super::pages;
use super::proto;
use super::proto::training_service_server::TrainingService;
use super::statuses::{Reply, answer, context, to_status};
use crate::admission::Lease;
use crate::app::{App, RunRequest};
use crate::domain::{CameraId, EpochReport, Error, ErrorKind, Result, RunId, TrainingRun};
use crate::shutdown::Shutdown;
use crate::telemetry::RequestId;

pub(super) struct Training {
    app: App,
    shutdown: Shutdown,
}

impl Training {
    pub(super) fn new(app: &App, shutdown: &Shutdown) -> Self {
        Self { app: app.clone(), shutdown: shutdown.clone() }
    }
}

#[tonic::async_trait]
impl TrainingService for Training {
    async fn start_training_run(
        &self,
        request: tonic::Request<proto::StartTrainingRunRequest>,
    ) -> Reply<proto::StartTrainingRunResponse> {
        let idempotent = idempotent(&request, "StartTrainingRun");
        answer(&self.app, request, |app, asked| async move {
            let idempotent = idempotent?;
            if let Some(request) = &idempotent {
                request.hasher.update(&asked.encode_to_vec());
            }
            let options = RunRequest {
                recipe: recipe(asked.recipe)?,
                seed: asked.seed,
                epochs: asked.epochs,
                from: instant(asked.from, "from")?,
                until: instant(asked.until, "until")?,
            };
            let run = app.training().start(&camera_id(&asked.camera_id)?, options, idempotent).await?;
            Ok(proto::StartTrainingRunResponse { run: Some(run.into()) })
        })
        .await
    }

    async fn get_training_run(
        &self,
        request: tonic::Request<proto::GetTrainingRunRequest>,
    ) -> Reply<proto::GetTrainingRunResponse> {
        answer(&self.app, request, |app, asked| async move {
            let run = app.training().get(&camera_id(&asked.camera_id)?, run_id(&asked.run_id)?).await?;
            Ok(proto::GetTrainingRunResponse { run: Some(run.into()) })
        })
        .await
    }

    async fn list_training_runs(
        &self,
        request: tonic::Request<proto::ListTrainingRunsRequest>,
    ) -> Reply<proto::ListTrainingRunsResponse> {
        answer(&self.app, request, |app, asked| async move {
            let camera = camera_id(&asked.camera_id)?;
            let size = pages::size(asked.page_size, &app.limits)?;
            let page = app.training().list(&camera, pages::cursor::<RunId>(&asked.page_token)?, size).await?;
            Ok(proto::ListTrainingRunsResponse {
                next_page_token: pages::token(page.next.as_ref()),
                runs: page.items.into_iter().map(Into::into).collect(),
            })
        })
        .await
    }

    async fn cancel_training_run(
        &self,
        request: tonic::Request<proto::CancelTrainingRunRequest>,
    ) -> Reply<proto::CancelTrainingRunResponse> {
        answer(&self.app, request, |app, asked| async move {
            let run = app.training().cancel(&camera_id(&asked.camera_id)?, run_id(&asked.run_id)?).await?;
            Ok(proto::CancelTrainingRunResponse { run: Some(run.into()) })
        })
        .await
    }

    async fn delete_training_run(
        &self,
        request: tonic::Request<proto::DeleteTrainingRunRequest>,
    ) -> Reply<proto::DeleteTrainingRunResponse> {
        answer(&self.app, request, |app, asked| async move {
            app.training().delete(&camera_id(&asked.camera_id)?, run_id(&asked.run_id)?).await?;
            Ok(proto::DeleteTrainingRunResponse {})
        })
        .await
    }

    type WatchTrainingRunStream = Changes;

    async fn watch_training_run(
        &self,
        request: tonic::Request<proto::WatchTrainingRunRequest>,
    ) -> Reply<Changes> {
        let context = context(request.extensions())?;
        let (id, client) = (context.id().clone(), context.client());
        answer(&self.app, request, |app, asked| async move {
            let lease = app.quotas.event_streams.try_acquire(client, 1)?;
            let (camera, run) = (camera_id(&asked.camera_id)?, run_id(&asked.run_id)?);
            let runs = app.training().watch(&camera, run).await?;
            Ok(changes(runs, lease, self.shutdown.clone(), id))
        })
        .await
    }

    async fn get_training_log(
        &self,
        request: tonic::Request<proto::GetTrainingLogRequest>,
    ) -> Reply<proto::GetTrainingLogResponse> {
        answer(&self.app, request, |app, asked| async move {
            let log = app.training().log(&camera_id(&asked.camera_id)?, run_id(&asked.run_id)?).await?;
            let line = |(time, text)| proto::TrainingLogLine { time: Some(timestamp(time)), text };
            Ok(proto::GetTrainingLogResponse { lines: log.into_iter().map(line).collect() })
        })
        .await
    }

    async fn get_training_curve(
        &self,
        request: tonic::Request<proto::GetTrainingCurveRequest>,
    ) -> Reply<proto::GetTrainingCurveResponse> {
        answer(&self.app, request, |app, asked| async move {
            let epochs = app.training().epochs(&camera_id(&asked.camera_id)?, run_id(&asked.run_id)?).await?;
            Ok(proto::GetTrainingCurveResponse { epochs: epochs.into_iter().map(Into::into).collect() })
        })
        .await
    }
}

/// A run after each of its changes.
pub(super) type Changes =
    Pin<Box<dyn Stream<Item = std::result::Result<proto::WatchTrainingRunResponse, Status>> + Send>>;

/// Ends with the run, with the first fault, or with the server, which is reported as an error so that
/// nobody takes the run for ended.
fn changes(
    runs: impl Stream<Item = Result<TrainingRun<CameraId>>> + Send + 'static,
    lease: Lease,
    shutdown: Shutdown,
    id: RequestId,
) -> Changes {
    let watched = Some((Box::pin(runs), lease));
    stream::unfold(watched, move |watched| {
        let (shutdown, id) = (shutdown.clone(), id.clone());
        async move {
            let (mut runs, lease) = watched?;
            let next = tokio::select! {
                biased;
                next = runs.next() => next?,
                () = shutdown.draining() => Err(ending()),
            };
            Some(match next {
                Ok(run) => {
                    (Ok(proto::WatchTrainingRunResponse { run: Some(run.into()) }), Some((runs, lease)))
                }
                Err(error) => (Err(to_status(&error, &id)), None),
            })
        }
    })
    .boxed()
}

fn ending() -> Error {
    Error::refused(ErrorKind::ShuttingDown, "the server is ending; the run goes on when it is back")
}

impl From<EpochReport> for proto::TrainingEpoch {
    fn from(epoch: EpochReport) -> Self {
        Self {
            epoch: epoch.epoch,
            loss: epoch.loss,
            reconstruction_error: epoch.reconstruction_error,
            regression_error: epoch.regression_error,
            error_scale: epoch.error_scale,
        }
    }
}
