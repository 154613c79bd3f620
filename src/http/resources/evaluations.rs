//! `/v1/evaluations`: methods side by side on stored samples, in the background.

use hyper::{StatusCode, Uri};
use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use serde_json::value::RawValue;
use utoipa::ToSchema;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use crate::app::EvaluationRequest;
use crate::domain::{self, Error, EvaluationProgress, Method, Recipe, Result, SigmaM, Truth};
use crate::evaluation::ReportWithPositions;
use crate::exchange::wire::Position;
use crate::exchange::write_cursor;
use crate::geo;
use crate::http::plumbing::access::CallerApp;
use crate::http::plumbing::extract::{EvaluationPath, JsonBody, Params, camera_of};
use crate::http::plumbing::problem::{ApiResult, Problem};
use crate::http::plumbing::state::Rest;
use crate::http::plumbing::wire::{JobState, created, empty, instant, json};

pub(super) fn routes() -> OpenApiRouter<Rest> {
    OpenApiRouter::new()
        .routes(routes!(start_evaluation, list_evaluations))
        .routes(routes!(get_evaluation, delete_evaluation))
        .routes(routes!(cancel_evaluation))
}

/// An interval of time; an end that is left out is open.
#[derive(Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
struct TimeRange {
    /// Samples from this instant on (RFC 3339).
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schema(format = DateTime)]
    from: Option<String>,
    /// Samples before this instant (RFC 3339).
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schema(format = DateTime)]
    until: Option<String>,
}

impl TimeRange {
    fn to_domain(&self) -> Result<domain::TimeRange> {
        let from = instant("from", self.from.as_deref())?;
        domain::TimeRange::new(from, instant("until", self.until.as_deref())?)
    }
}

impl From<domain::TimeRange> for TimeRange {
    fn from(range: domain::TimeRange) -> Self {
        let text = |at: Option<Timestamp>| at.map(|at| at.to_string());
        Self { from: text(range.from()), until: text(range.until()) }
    }
}

/// The parameters of an evaluation.
#[derive(Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
struct EvaluationDraft {
    /// The camera whose samples are used.
    camera_id: String,
    /// The samples to learn from. Given together with `test`, or not at all.
    train: Option<TimeRange>,
    /// The samples to judge on; may not overlap `train`.
    test: Option<TimeRange>,
    /// The last share of all samples by time is the test, where no ranges are given; 0.2 if left out.
    #[schema(minimum = 0.01, maximum = 0.9, example = 0.2)]
    test_share: Option<f64>,
    /// The target stood there. Without a truth here, that which the samples state is taken.
    truth_point: Option<Position>,
    /// The target walked on this line, as a GeoJSON LineString's coordinates: `[longitude, latitude]`.
    #[schema(example = json!([[103.98678, 30.62801], [103.98702, 30.62833]]))]
    truth_line: Option<Vec<Vec<f64>>>,
    /// `gnss`, `imm_ukf`, `dnn`, `dnn.denied`, `homography.denied`, `track`, `track.denied`, and of each
    /// recipe R: `R.one_step`, `R.two_step`, `R.denied`. If
    /// left out: all that the profile's recipe gives, without the networks `dnn`.
    #[schema(example = json!(["gnss", "auto.two_step"]))]
    methods: Option<Vec<String>>,
    /// Every seed from 1 to this, 1 if left out. The server's settings limit it, to 20 if nothing is set.
    #[schema(minimum = 1)]
    seeds: Option<u32>,
    /// Test boxes grow to the upper left by this; 0 if left out.
    #[schema(minimum = 0.0, maximum = 10000.0)]
    box_shift_px: Option<f64>,
    /// Standard deviation per axis of the receiver in metres; the profile's if left out.
    #[schema(minimum = 0.001, maximum = 10000.0)]
    gnss_sigma_m: Option<f64>,
}

impl EvaluationDraft {
    fn to_domain(&self) -> Result<EvaluationRequest> {
        let range = |name: &str, range: &Option<TimeRange>| {
            range.as_ref().map(TimeRange::to_domain).transpose().map_err(|error| error.under(name))
        };
        let methods = self.methods.as_ref().map(|names| {
            let method = |(index, name): (usize, &String)| {
                name.parse::<Method>().map_err(|error| error.at(&format!("methods[{index}]")))
            };
            names.iter().enumerate().map(method).collect()
        });
        Ok(EvaluationRequest {
            train: range("train", &self.train)?,
            test: range("test", &self.test)?,
            test_share: self.test_share,
            truth: self.truth()?,
            methods: methods.transpose()?,
            seeds: self.seeds,
            box_shift_px: self.box_shift_px,
            gnss_sigma: self
                .gnss_sigma_m
                .map(SigmaM::new)
                .transpose()
                .map_err(|error| error.at("gnss_sigma_m"))?,
        })
    }

    fn truth(&self) -> Result<Option<Truth>> {
        match (&self.truth_point, &self.truth_line) {
            (None, None) => Ok(None),
            (Some(_), Some(_)) => Err(Error::invalid("truth_line", "give it or truth_point, not both")),
            (Some(point), None) => {
                let point = point.to_domain().map_err(|error| error.under("truth_point"))?;
                Ok(Some(Truth::Point(point)))
            }
            (None, Some(line)) => {
                let line = line.iter().enumerate().map(|(index, pair)| {
                    position(pair).map_err(|error| error.under(&format!("truth_line[{index}]")))
                });
                Ok(Some(Truth::Lines(vec![line.collect::<Result<_>>()?])))
            }
        }
    }
}

/// A GeoJSON position; its height, if it has one, is left out.
fn position(numbers: &[f64]) -> Result<geo::Position> {
    match numbers {
        &[longitude_deg, latitude_deg] | &[longitude_deg, latitude_deg, _] => {
            Position { longitude_deg, latitude_deg }.to_domain()
        }
        _ => Err(Error::invalid("", "must be [longitude, latitude]")),
    }
}

/// An evaluation. All that was left out in the request is filled in.
#[derive(Serialize, ToSchema)]
struct Evaluation {
    /// A UUID of version 7.
    #[schema(format = "uuid")]
    id: String,
    /// The camera whose samples are used.
    camera_id: String,
    /// The samples to learn from.
    train: TimeRange,
    /// The samples to judge on.
    test: TimeRange,
    /// The target stood there. Without a truth here, the samples state it.
    #[serde(skip_serializing_if = "Option::is_none")]
    truth_point: Option<Position>,
    /// The target walked on this line.
    #[serde(skip_serializing_if = "Option::is_none")]
    truth_line: Option<Vec<[f64; 2]>>,
    /// The methods that are compared.
    methods: Vec<String>,
    /// The recipe that tracks stand on.
    recipe: Recipe,
    /// Every seed from 1 to this.
    seeds: u32,
    /// Test boxes grow to the upper left by this.
    box_shift_px: f64,
    /// Standard deviation per axis of the receiver, if known.
    #[serde(skip_serializing_if = "Option::is_none")]
    gnss_sigma_m: Option<f64>,
    /// State of the evaluation.
    state: JobState,
    /// How far it has come.
    progress: EvaluationProgress,
    /// Times a worker has claimed it without returning it to the queue in order.
    attempt: u32,
    /// Why it failed.
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
    /// Once it has succeeded: the figures, as in the document of `sightfix evaluate --json`, and the positions
    /// from which they are computed. Lists leave it out.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(value_type = Option<ReportWithPositions>)]
    report: Option<Box<RawValue>>,
}

impl From<domain::EvaluationJob> for Evaluation {
    fn from(job: domain::EvaluationJob) -> Self {
        let plan = job.plan;
        let pair = |point: &geo::Position| [point.longitude_deg(), point.latitude_deg()];
        let (truth_point, truth_line) = match plan.truth {
            Truth::Columns => (None, None),
            Truth::Point(point) => (Some(point.into()), None),
            // A request has one line.
            Truth::Lines(lines) => (None, lines.first().map(|line| line.iter().map(pair).collect())),
        };
        Self {
            id: job.id.to_string(),
            camera_id: job.camera_id.as_str().to_owned(),
            train: plan.train.into(),
            test: plan.test.into(),
            truth_point,
            truth_line,
            methods: plan.methods.iter().map(Method::to_string).collect(),
            recipe: plan.recipe,
            seeds: plan.seeds,
            box_shift_px: plan.box_shift_px,
            gnss_sigma_m: plan.gnss_sigma.map(SigmaM::metres),
            state: job.state.into(),
            progress: job.progress,
            attempt: job.attempt,
            outcome: job.outcome,
            created_at: job.created_at,
            started_at: job.started_at,
            ended_at: job.ended_at,
            report: None,
        }
    }
}

/// A page of evaluations, newest first.
#[derive(Serialize, ToSchema)]
struct EvaluationPage {
    /// Evaluations without their reports.
    items: Vec<Evaluation>,
    /// Asks for the next page; missing on the last.
    #[serde(skip_serializing_if = "Option::is_none")]
    next_cursor: Option<String>,
}

/// Start an evaluation
///
/// Every method learns from the training samples alone, tells all test samples in order of time per
/// target, and is judged against the truth, once per seed. The evaluation waits in a queue and is
/// carried out in the background; the answer comes at once.
#[utoipa::path(
    post, path = "/v1/evaluations", tag = "evaluations", request_body = EvaluationDraft,
    responses(
        (status = 202, description = "The queued evaluation", body = Evaluation, headers(("location" = String, description = "Its path"))),
        (status = 404, description = "There is no such camera", body = Problem, content_type = "application/problem+json"),
    )
)]
async fn start_evaluation(CallerApp(app): CallerApp, body: JsonBody) -> ApiResult {
    let draft: EvaluationDraft = body.read()?;
    let job = app.evaluations().start(&camera_of(&draft.camera_id)?, draft.to_domain()?).await?;
    let location = format!("/v1/evaluations/{}", job.id);
    Ok(created(StatusCode::ACCEPTED, &location, &Evaluation::from(job))?)
}

/// List evaluations, newest first
#[utoipa::path(
    get, path = "/v1/evaluations", tag = "evaluations",
    params(
        ("camera" = Option<String>, Query, description = "Only evaluations of this camera"),
        ("limit" = Option<u32>, Query, description = "Items on a page, 100 if left out"),
        ("cursor" = Option<String>, Query, description = "`next_cursor` of the page before"),
    ),
    responses(
        (status = 200, description = "A page of evaluations", body = EvaluationPage),
        (status = 404, description = "There is no such camera", body = Problem, content_type = "application/problem+json"),
    )
)]
async fn list_evaluations(CallerApp(app): CallerApp, uri: Uri) -> ApiResult {
    let mut params = Params::of(&uri)?;
    let camera = params.take("camera", camera_of)?;
    let limit = params.limit(app.limits.page_items)?;
    let before = params.cursor()?;
    params.end()?;
    let page = app.evaluations().list(camera.as_ref(), before, limit).await?;
    Ok(json(&EvaluationPage {
        items: page.items.into_iter().map(Evaluation::from).collect(),
        next_cursor: page.next.map(|id| write_cursor(&id)),
    })?)
}

/// Read an evaluation, with its report once it has succeeded
#[utoipa::path(
    get, path = "/v1/evaluations/{evaluation}", tag = "evaluations",
    params(("evaluation" = String, Path, pattern = "^[0-9a-f-]{36}$", description = "The evaluation's id")),
    responses(
        (status = 200, description = "The evaluation", body = Evaluation),
        (status = 404, description = "There is no such evaluation", body = Problem, content_type = "application/problem+json"),
    )
)]
async fn get_evaluation(CallerApp(app): CallerApp, EvaluationPath(id): EvaluationPath) -> ApiResult {
    let (job, report) = app.evaluations().get(id).await?;
    let report = report.map(RawValue::from_string).transpose().map_err(Error::fault)?;
    Ok(json(&Evaluation { report, ..Evaluation::from(job) })?)
}

/// Cancel an evaluation
///
/// At once if it waits, at its next step if it runs. It stays in the list.
#[utoipa::path(
    post, path = "/v1/evaluations/{evaluation}/cancel", tag = "evaluations",
    params(("evaluation" = String, Path, pattern = "^[0-9a-f-]{36}$", description = "The evaluation's id")),
    responses(
        (status = 200, description = "The evaluation in its present state", body = Evaluation),
        (status = 404, description = "There is no such evaluation", body = Problem, content_type = "application/problem+json"),
        (status = 409, description = "The evaluation has ended", body = Problem, content_type = "application/problem+json"),
    )
)]
async fn cancel_evaluation(CallerApp(app): CallerApp, EvaluationPath(id): EvaluationPath) -> ApiResult {
    Ok(json(&Evaluation::from(app.evaluations().cancel(id).await?))?)
}

/// Delete an evaluation
///
/// With its report. One that runs stops at its next step.
#[utoipa::path(
    delete, path = "/v1/evaluations/{evaluation}", tag = "evaluations",
    params(("evaluation" = String, Path, pattern = "^[0-9a-f-]{36}$", description = "The evaluation's id")),
    responses(
        (status = 204, description = "It is gone"),
        (status = 404, description = "There is no such evaluation", body = Problem, content_type = "application/problem+json"),
    )
)]
async fn delete_evaluation(CallerApp(app): CallerApp, EvaluationPath(id): EvaluationPath) -> ApiResult {
    app.evaluations().delete(id).await?;
    Ok(empty())
}
