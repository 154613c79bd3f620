//! `/v1/sites/{site}/training-runs`: background fits of all cameras of a site together.

use hyper::Uri;
use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use super::runs;
use crate::app::SiteRunRequest;
use crate::domain::{self, Error, Result, RunProgress, SiteId, SiteTrainingReport};
use crate::http::plumbing::access::CallerApp;
use crate::http::plumbing::extract::{JsonBody, SitePath, SiteRunPath};
use crate::http::plumbing::idempotency::Idempotent;
use crate::http::plumbing::problem::{ApiResult, Problem};
use crate::http::plumbing::state::Rest;
use crate::http::plumbing::wire::{JobState, instant, json};

pub(super) fn routes() -> OpenApiRouter<Rest> {
    OpenApiRouter::new()
        .routes(routes!(start_site_training_run, list_site_training_runs))
        .routes(routes!(get_site_training_run))
        .routes(routes!(cancel_site_training_run))
}

/// The options of a fit; all of them may be left out.
#[derive(Default, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
struct SiteRunDraft {
    /// Everything random in the run comes from it; 0 if left out.
    seed: Option<u64>,
    /// Only samples from this instant on (RFC 3339).
    #[schema(format = DateTime)]
    from: Option<String>,
    /// Only samples before this instant (RFC 3339).
    #[schema(format = DateTime)]
    until: Option<String>,
}

impl TryFrom<SiteRunDraft> for SiteRunRequest {
    type Error = Error;

    fn try_from(draft: SiteRunDraft) -> Result<Self> {
        Ok(Self {
            seed: draft.seed,
            from: instant("from", draft.from.as_deref())?,
            until: instant("until", draft.until.as_deref())?,
        })
    }
}

/// A training run of a site.
#[derive(Serialize, ToSchema)]
struct SiteTrainingRun {
    /// A UUID of version 7.
    #[schema(format = "uuid")]
    id: String,
    /// Whose cameras are fitted together.
    site_id: String,
    /// Everything random in the run comes from it.
    seed: u64,
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
    /// How far it has come; its epochs count fits of all cameras and epochs of networks.
    progress: RunProgress,
    /// Times a worker has claimed it without returning it to the queue in order.
    attempt: u32,
    /// The run's findings, once it has succeeded: the version of each camera, and its gain from the other cameras.
    #[serde(skip_serializing_if = "Option::is_none")]
    report: Option<SiteTrainingReport>,
    /// The report as lines of text.
    #[serde(skip_serializing_if = "Option::is_none")]
    report_text: Option<String>,
    /// Says if the versions became active, and why or why not, or why the run failed.
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

impl From<domain::TrainingRun<SiteId>> for SiteTrainingRun {
    fn from(run: domain::TrainingRun<SiteId>) -> Self {
        Self {
            id: run.id.to_string(),
            site_id: run.subject.as_str().to_owned(),
            seed: run.options.seed,
            from: run.options.from,
            until: run.options.until,
            state: run.state.into(),
            progress: run.progress,
            attempt: run.attempt,
            report_text: run.report.as_ref().map(ToString::to_string),
            report: run.report,
            outcome: run.outcome,
            created_at: run.created_at,
            started_at: run.started_at,
            ended_at: run.ended_at,
        }
    }
}

/// A page of training runs of a site, newest first.
#[derive(Serialize, ToSchema)]
struct SiteRunPage {
    /// A page of runs.
    items: Vec<SiteTrainingRun>,
    /// Asks for the next page; missing on the last.
    #[serde(skip_serializing_if = "Option::is_none")]
    next_cursor: Option<String>,
}

/// Train all cameras of a site together
///
/// The run waits in a queue and is fitted in the background; the answer comes at once. The versions of all cameras
/// become active together, or none does.
#[utoipa::path(
    post, path = "/v1/sites/{site}/training-runs", tag = "sites",
    params(
        ("site" = String, Path, description = "The site's id"),
        ("idempotency-key" = Option<String>, Header, description = "1 to 255 visible ASCII characters: a request that is sent again under the same key gets the run of the first; for a day"),
    ),
    request_body = Option<SiteRunDraft>,
    responses(
        (status = 202, description = "The queued run", body = SiteTrainingRun, headers(("location" = String, description = "Its path"))),
        (status = 409, description = "The site has a live run, whose id is `conflicting_id`", body = Problem, content_type = "application/problem+json"),
    )
)]
async fn start_site_training_run(
    CallerApp(app): CallerApp,
    SitePath(id): SitePath,
    uri: Uri,
    Idempotent(idempotent): Idempotent,
    body: JsonBody,
) -> ApiResult {
    runs::start::<SiteTrainingRun, SiteRunDraft, _>(&app, &id, &uri, idempotent, &body).await
}

/// List training runs of a site, newest first
#[utoipa::path(
    get, path = "/v1/sites/{site}/training-runs", tag = "sites",
    params(
        ("site" = String, Path, description = "The site's id"),
        ("limit" = Option<u32>, Query, description = "Items on a page, 100 if left out"),
        ("cursor" = Option<String>, Query, description = "`next_cursor` of the page before"),
    ),
    responses((status = 200, description = "A page of runs", body = SiteRunPage))
)]
async fn list_site_training_runs(CallerApp(app): CallerApp, SitePath(id): SitePath, uri: Uri) -> ApiResult {
    let (items, next_cursor) = runs::page(&app, &id, &uri).await?;
    Ok(json(&SiteRunPage { items, next_cursor })?)
}

/// Read a training run of a site
#[utoipa::path(
    get, path = "/v1/sites/{site}/training-runs/{run}", tag = "sites",
    params(("site" = String, Path, description = "The site's id"), ("run" = String, Path, pattern = "^[0-9a-f-]{36}$", description = "The run's id")),
    responses((status = 200, description = "The run", body = SiteTrainingRun))
)]
async fn get_site_training_run(CallerApp(app): CallerApp, SiteRunPath(id, run): SiteRunPath) -> ApiResult {
    Ok(json(&SiteTrainingRun::from(app.training().get(&id, run).await?))?)
}

/// Cancel a training run of a site
///
/// At once if it waits, at its next step if it runs. No version is stored then.
#[utoipa::path(
    post, path = "/v1/sites/{site}/training-runs/{run}/cancel", tag = "sites",
    params(("site" = String, Path, description = "The site's id"), ("run" = String, Path, pattern = "^[0-9a-f-]{36}$", description = "The run's id")),
    responses(
        (status = 200, description = "The run in its present state", body = SiteTrainingRun),
        (status = 409, description = "The run has ended", body = Problem, content_type = "application/problem+json"),
    )
)]
async fn cancel_site_training_run(CallerApp(app): CallerApp, SiteRunPath(id, run): SiteRunPath) -> ApiResult {
    Ok(json(&SiteTrainingRun::from(app.training().cancel(&id, run).await?))?)
}
