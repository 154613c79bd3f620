//! `/v1/cameras/{camera}/training-runs`: background fits, and their progress as events.

use std::convert::Infallible;
use std::time::Duration;

use axum::extract::State;
use axum::response::IntoResponse as _;
use axum::response::sse::{Event, KeepAlive, Sse};
use futures_util::StreamExt as _;
use hyper::Uri;
use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use sha2::{Digest as _, Sha256};
use utoipa::ToSchema;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use super::runs;
use crate::app::RunRequest;
use crate::domain::{self, CameraId, EpochReport, Error, Recipe, Result, RunProgress, TrainingReport};
use crate::http::plumbing::access::CallerApp;
use crate::http::plumbing::extract::{CameraPath, Client, JsonBody, LastEventId, RunPath};
use crate::http::plumbing::idempotency::Idempotent;
use crate::http::plumbing::problem::{ApiResult, Problem};
use crate::http::plumbing::state::Rest;
use crate::http::plumbing::wire::{JobState, empty, instant, json};

/// How often a silent event stream says that it is still there.
const KEEP_ALIVE: Duration = Duration::from_secs(15);
/// Id of the last event of a run.
const ENDED: &str = "ended";

pub(super) fn routes() -> OpenApiRouter<Rest> {
    OpenApiRouter::new()
        .routes(routes!(start_training_run, list_training_runs))
        .routes(routes!(get_training_run, delete_training_run))
        .routes(routes!(cancel_training_run))
        .routes(routes!(watch_training_run))
        .routes(routes!(get_training_log))
        .routes(routes!(get_training_curve))
}

/// The options of a fit; all of them may be left out.
#[derive(Default, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
struct RunDraft {
    /// The profile's recipe if left out.
    recipe: Option<Recipe>,
    /// Everything random in the run comes from it; 0 if left out.
    seed: Option<u64>,
    /// Passes over the samples; the recipe's own number if left out.
    #[schema(minimum = 1)]
    epochs: Option<u32>,
    /// Only samples from this instant on (RFC 3339).
    #[schema(format = DateTime)]
    from: Option<String>,
    /// Only samples before this instant (RFC 3339).
    #[schema(format = DateTime)]
    until: Option<String>,
}

impl TryFrom<RunDraft> for RunRequest {
    type Error = Error;

    fn try_from(draft: RunDraft) -> Result<Self> {
        Ok(Self {
            recipe: draft.recipe,
            seed: draft.seed,
            epochs: draft.epochs,
            from: instant("from", draft.from.as_deref())?,
            until: instant("until", draft.until.as_deref())?,
        })
    }
}

/// A training run.
#[derive(Serialize, ToSchema)]
struct TrainingRun {
    /// A UUID of version 7.
    #[schema(format = "uuid")]
    id: String,
    /// Whose model is fitted.
    camera_id: String,
    /// How the camera is learnt.
    recipe: Recipe,
    /// Everything random in the run comes from it.
    seed: u64,
    /// Passes over the samples, if they were asked for.
    #[serde(skip_serializing_if = "Option::is_none")]
    epochs: Option<u32>,
    /// Only samples from this instant on.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(value_type = Option<String>, format = DateTime)]
    from: Option<Timestamp>,
    /// Only samples before this instant.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(value_type = Option<String>, format = DateTime)]
    until: Option<Timestamp>,
    /// State of the run.
    state: JobState,
    /// How far it has come.
    progress: RunProgress,
    /// Times a worker has claimed it without returning it to the queue in order.
    attempt: u32,
    /// The version it yielded.
    #[serde(skip_serializing_if = "Option::is_none")]
    model_version: Option<u32>,
    /// The run's findings: its candidates, and advice.
    #[serde(skip_serializing_if = "Option::is_none")]
    report: Option<TrainingReport>,
    /// The report as lines of text.
    #[serde(skip_serializing_if = "Option::is_none")]
    report_text: Option<String>,
    /// Says if that version became active, and why or why not, or why the run failed.
    #[serde(skip_serializing_if = "Option::is_none")]
    outcome: Option<String>,
    /// When it was asked for.
    #[schema(value_type = String, format = DateTime)]
    created_at: Timestamp,
    /// When a worker claimed it last.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(value_type = Option<String>, format = DateTime)]
    started_at: Option<Timestamp>,
    /// When it ended.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(value_type = Option<String>, format = DateTime)]
    ended_at: Option<Timestamp>,
}

impl From<domain::TrainingRun<CameraId>> for TrainingRun {
    fn from(run: domain::TrainingRun<CameraId>) -> Self {
        Self {
            id: run.id.to_string(),
            camera_id: run.subject.as_str().to_owned(),
            recipe: run.options.recipe,
            seed: run.options.seed,
            epochs: run.options.epochs,
            from: run.options.from,
            until: run.options.until,
            state: run.state.into(),
            progress: run.progress,
            attempt: run.attempt,
            model_version: run.model_version,
            report_text: run.report.as_ref().map(ToString::to_string),
            report: run.report,
            outcome: run.outcome,
            created_at: run.created_at,
            started_at: run.started_at,
            ended_at: run.ended_at,
        }
    }
}

/// A page of training runs, newest first.
#[derive(Serialize, ToSchema)]
struct RunPage {
    /// A page of runs.
    items: Vec<TrainingRun>,
    /// Asks for the next page; missing on the last.
    #[serde(skip_serializing_if = "Option::is_none")]
    next_cursor: Option<String>,
}

/// Start a training run
///
/// The run waits in a queue and is fitted in the background; the answer comes at once.
#[utoipa::path(
    post, path = "/v1/cameras/{camera}/training-runs", tag = "training",
    params(
        ("camera" = String, Path, description = "The camera's id"),
        ("idempotency-key" = Option<String>, Header, description = "1 to 255 visible ASCII characters: a request that is sent again under the same key gets the run of the first; for a day"),
    ),
    request_body = Option<RunDraft>,
    responses(
        (status = 202, description = "The queued run", body = TrainingRun, headers(("location" = String, description = "Its path"))),
        (status = 409, description = "The camera has a live run, whose id is `conflicting_id`", body = Problem, content_type = "application/problem+json"),
    )
)]
async fn start_training_run(
    CallerApp(app): CallerApp,
    CameraPath(id): CameraPath,
    uri: Uri,
    Idempotent(idempotent): Idempotent,
    body: JsonBody,
) -> ApiResult {
    runs::start::<TrainingRun, RunDraft, _>(&app, &id, &uri, idempotent, &body).await
}

/// List training runs, newest first
#[utoipa::path(
    get, path = "/v1/cameras/{camera}/training-runs", tag = "training",
    params(
        ("camera" = String, Path, description = "The camera's id"),
        ("limit" = Option<u32>, Query, description = "Items on a page, 100 if left out"),
        ("cursor" = Option<String>, Query, description = "`next_cursor` of the page before"),
    ),
    responses((status = 200, description = "A page of runs", body = RunPage))
)]
async fn list_training_runs(CallerApp(app): CallerApp, CameraPath(id): CameraPath, uri: Uri) -> ApiResult {
    let (items, next_cursor) = runs::page(&app, &id, &uri).await?;
    Ok(json(&RunPage { items, next_cursor })?)
}

/// Read a training run
#[utoipa::path(
    get, path = "/v1/cameras/{camera}/training-runs/{run}", tag = "training",
    params(("camera" = String, Path, description = "The camera's id"), ("run" = String, Path, pattern = "^[0-9a-f-]{36}$", description = "The run's id")),
    responses((status = 200, description = "The run", body = TrainingRun))
)]
async fn get_training_run(CallerApp(app): CallerApp, RunPath(id, run): RunPath) -> ApiResult {
    Ok(json(&TrainingRun::from(app.training().get(&id, run).await?))?)
}

/// Delete a training run
///
/// With its log and its curve. The model version that it yielded stays. A run that has not ended must
/// be cancelled first.
#[utoipa::path(
    delete, path = "/v1/cameras/{camera}/training-runs/{run}", tag = "training",
    params(("camera" = String, Path, description = "The camera's id"), ("run" = String, Path, pattern = "^[0-9a-f-]{36}$", description = "The run's id")),
    responses(
        (status = 204, description = "It is deleted"),
        (status = 409, description = "The run has not ended", body = Problem, content_type = "application/problem+json"),
    )
)]
async fn delete_training_run(CallerApp(app): CallerApp, RunPath(id, run): RunPath) -> ApiResult {
    app.training().delete(&id, run).await?;
    Ok(empty())
}

/// Cancel a training run
///
/// At once if it waits, at its next step if it runs.
#[utoipa::path(
    post, path = "/v1/cameras/{camera}/training-runs/{run}/cancel", tag = "training",
    params(("camera" = String, Path, description = "The camera's id"), ("run" = String, Path, pattern = "^[0-9a-f-]{36}$", description = "The run's id")),
    responses(
        (status = 200, description = "The run in its present state", body = TrainingRun),
        (status = 409, description = "The run has ended", body = Problem, content_type = "application/problem+json"),
    )
)]
async fn cancel_training_run(CallerApp(app): CallerApp, RunPath(id, run): RunPath) -> ApiResult {
    Ok(json(&TrainingRun::from(app.training().cancel(&id, run).await?))?)
}

/// Watch a training run
///
/// Server-sent events `run`, each with the whole run as JSON: now, at each change, and the last
/// one, with the id `ended`, when it has ended. A client that comes back with the `last-event-id` of an event
/// gets the run when it is another than it was then, and 204 after the last event.
#[utoipa::path(
    get, path = "/v1/cameras/{camera}/training-runs/{run}/events", tag = "training",

    params(
        ("camera" = String, Path, description = "The camera's id"),
        ("run" = String, Path, pattern = "^[0-9a-f-]{36}$", description = "The run's id"),
        ("last-event-id" = Option<String>, Header, description = "The id of the last event that the client has seen"),
        ("last_event_id" = Option<String>, Query, description = "The same, for a page that cannot send the header"),
    ),
    responses(
        (status = 200, description = "Events", body = TrainingRun, content_type = "text/event-stream"),
        (status = 204, description = "The client has seen the last event"),
    )
)]
async fn watch_training_run(
    State(rest): State<Rest>,
    CallerApp(app): CallerApp,
    RunPath(id, run): RunPath,
    Client(client): Client,
    LastEventId(last_seen): LastEventId,
) -> ApiResult {
    if last_seen.as_deref() == Some(ENDED) {
        return Ok(empty());
    }
    let lease = app.quotas.event_streams.try_acquire(client, 1)?;
    let changes = app.training().watch(&id, run).await?;
    let shutdown = rest.shutdown.clone();
    let events = changes.take_until(async move { shutdown.draining().await }).filter_map(move |change| {
        let _held = &lease; // until the stream is dropped
        std::future::ready(event_of(change, last_seen.as_deref()).map(Ok::<_, Infallible>))
    });
    Ok(Sse::new(events).keep_alive(KeepAlive::new().interval(KEEP_ALIVE)).into_response())
}

/// The event of a change; `None` for what the client has seen last.
fn event_of(change: Result<domain::TrainingRun<CameraId>>, last_seen: Option<&str>) -> Option<Event> {
    let event = change.and_then(|run| {
        let has_ended = run.state.has_ended();
        let json = serde_json::to_string(&TrainingRun::from(run)).map_err(Error::fault)?;
        // The event is the whole run, so what it says is all that tells two of them apart.
        let id = if has_ended { ENDED.to_owned() } else { content_id(json.as_bytes()) };
        Ok((last_seen != Some(id.as_str())).then(|| Event::default().id(id).event("run").data(json)))
    });
    event.unwrap_or_else(|error| {
        tracing::error!(%error, "a watched run cannot be read");
        Some(Event::default().event("error").data("the server failed; read the run again"))
    })
}

/// The beginning of the content's SHA-256.
fn content_id(content: &[u8]) -> String {
    Sha256::digest(content).iter().take(8).map(|byte| format!("{byte:02x}")).collect()
}

/// A line of a run's log.
#[derive(Serialize, ToSchema)]
struct LogLine {
    /// When it was written.
    #[schema(value_type = String, format = DateTime)]
    time: Timestamp,
    /// The event, in words.
    text: String,
}

/// A run's log, oldest line first.
#[derive(Serialize, ToSchema)]
struct TrainingLog {
    /// A page of lines.
    items: Vec<LogLine>,
}

/// Read a training run's log
#[utoipa::path(
    get, path = "/v1/cameras/{camera}/training-runs/{run}/log", tag = "training",
    params(("camera" = String, Path, description = "The camera's id"), ("run" = String, Path, pattern = "^[0-9a-f-]{36}$", description = "The run's id")),
    responses((status = 200, description = "The log", body = TrainingLog))
)]
async fn get_training_log(CallerApp(app): CallerApp, RunPath(id, run): RunPath) -> ApiResult {
    let lines = app.training().log(&id, run).await?;
    Ok(json(&TrainingLog { items: lines.into_iter().map(|(time, text)| LogLine { time, text }).collect() })?)
}

/// A run's curve: one point per epoch of the final fit.
#[derive(Serialize, ToSchema)]
struct TrainingCurve {
    /// Epochs in their order.
    items: Vec<EpochReport>,
}

/// Read a training run's curve
#[utoipa::path(
    get, path = "/v1/cameras/{camera}/training-runs/{run}/curve", tag = "training",
    params(("camera" = String, Path, description = "The camera's id"), ("run" = String, Path, pattern = "^[0-9a-f-]{36}$", description = "The run's id")),
    responses((status = 200, description = "The curve", body = TrainingCurve))
)]
async fn get_training_curve(CallerApp(app): CallerApp, RunPath(id, run): RunPath) -> ApiResult {
    Ok(json(&TrainingCurve { items: app.training().epochs(&id, run).await? })?)
}
