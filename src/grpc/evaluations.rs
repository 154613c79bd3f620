//! `EvaluationService`.

use super::convert::{camera_id, instant, position, required, timestamp};
use super::pages;
use super::proto;
use super::proto::evaluation_service_server::EvaluationService;
use super::proto::{evaluation, start_evaluation_request};
use super::statuses::{Reply, answer};
use crate::app::{App, EvaluationRequest};
use crate::domain::{
    Error, EvaluationId, EvaluationJob, EvaluationProgress, Method, Result, SigmaM, TimeRange, Truth,
};

pub(super) struct Evaluations {
    app: App,
}

impl Evaluations {
    pub(super) fn new(app: &App) -> Self {
        Self { app: app.clone() }
    }
}

#[tonic::async_trait]
impl EvaluationService for Evaluations {
    async fn start_evaluation(
        &self,
        request: tonic::Request<proto::StartEvaluationRequest>,
    ) -> Reply<proto::StartEvaluationResponse> {
        answer(&self.app, request, |app, asked| async move {
            let camera = camera_id(&asked.camera_id)?;
            let job = app.evaluations().start(&camera, evaluation_request(asked)?).await?;
            Ok(proto::StartEvaluationResponse { evaluation: Some(job.into()) })
        })
        .await
    }

    async fn get_evaluation(
        &self,
        request: tonic::Request<proto::GetEvaluationRequest>,
    ) -> Reply<proto::GetEvaluationResponse> {
        answer(&self.app, request, |app, asked| async move {
            let (job, report_json) = app.evaluations().get(evaluation_id(&asked.evaluation_id)?).await?;
            let evaluation = proto::Evaluation { report_json, ..job.into() };
            Ok(proto::GetEvaluationResponse { evaluation: Some(evaluation) })
        })
        .await
    }

    async fn list_evaluations(
        &self,
        request: tonic::Request<proto::ListEvaluationsRequest>,
    ) -> Reply<proto::ListEvaluationsResponse> {
        answer(&self.app, request, |app, asked| async move {
            let camera = Some(asked.camera_id.as_str()).filter(|id| !id.is_empty());
            let camera = camera.map(camera_id).transpose()?;
            let size = pages::size(asked.page_size, &app.limits)?;
            let before = pages::cursor::<EvaluationId>(&asked.page_token)?;
            let page = app.evaluations().list(camera.as_ref(), before, size).await?;
            Ok(proto::ListEvaluationsResponse {
                next_page_token: pages::token(page.next.as_ref()),
                evaluations: page.items.into_iter().map(Into::into).collect(),
            })
        })
        .await
    }

    async fn cancel_evaluation(
        &self,
        request: tonic::Request<proto::CancelEvaluationRequest>,
    ) -> Reply<proto::CancelEvaluationResponse> {
        answer(&self.app, request, |app, asked| async move {
            let job = app.evaluations().cancel(evaluation_id(&asked.evaluation_id)?).await?;
            Ok(proto::CancelEvaluationResponse { evaluation: Some(job.into()) })
        })
        .await
    }

    async fn delete_evaluation(
        &self,
        request: tonic::Request<proto::DeleteEvaluationRequest>,
    ) -> Reply<proto::DeleteEvaluationResponse> {
        answer(&self.app, request, |app, asked| async move {
            app.evaluations().delete(evaluation_id(&asked.evaluation_id)?).await?;
            Ok(proto::DeleteEvaluationResponse {})
        })
        .await
    }
}

/// The evaluation that a request names.
fn evaluation_id(id: &str) -> Result<EvaluationId> {
    required(Some(id).filter(|id| !id.is_empty()), "evaluation_id")?.parse()
}

fn evaluation_request(asked: proto::StartEvaluationRequest) -> Result<EvaluationRequest> {
    let range = |field: &str, range: Option<proto::TimeRange>| {
        range.map(time_range).transpose().map_err(|error| error.under(field))
    };
    let method = |(index, name): (usize, &String)| {
        name.parse::<Method>().map_err(|error| error.at(&format!("methods[{index}]")))
    };
    let methods = asked.methods.iter().enumerate().map(method).collect::<Result<Vec<_>>>()?;
    let gnss_sigma = asked.gnss_sigma_m.map(SigmaM::new).transpose();
    Ok(EvaluationRequest {
        train: range("train", asked.train)?,
        test: range("test", asked.test)?,
        test_share: asked.test_share,
        truth: asked.truth.map(truth).transpose()?,
        methods: Some(methods).filter(|methods| !methods.is_empty()),
        seeds: asked.seeds,
        box_shift_px: asked.box_shift_px,
        gnss_sigma: gnss_sigma.map_err(|error| error.at("gnss_sigma_m"))?,
    })
}

fn time_range(range: proto::TimeRange) -> Result<TimeRange> {
    TimeRange::new(instant(range.from, "from")?, instant(range.until, "until")?)
}

fn truth(truth: start_evaluation_request::Truth) -> Result<Truth> {
    match truth {
        start_evaluation_request::Truth::TruthPoint(point) => {
            Ok(Truth::Point(position(point).map_err(|error| error.under("truth_point"))?))
        }
        start_evaluation_request::Truth::TruthLine(line) => {
            let point = |(index, point)| {
                position(point).map_err(|error: Error| error.under(&format!("truth_line[{index}]")))
            };
            let points = line.points.into_iter().enumerate().map(point);
            Ok(Truth::Lines(vec![points.collect::<Result<_>>()?]))
        }
    }
}

impl From<EvaluationJob> for proto::Evaluation {
    fn from(job: EvaluationJob) -> Self {
        let plan = job.plan;
        let truth = match plan.truth {
            Truth::Columns => None,
            Truth::Point(point) => Some(evaluation::Truth::TruthPoint(point.into())),
            // A request has one line.
            Truth::Lines(lines) => {
                let points = lines.into_iter().next().unwrap_or_default();
                let points = points.into_iter().map(Into::into).collect();
                Some(evaluation::Truth::TruthLine(proto::TruthLine { points }))
            }
        };
        Self {
            id: job.id.to_string(),
            camera_id: job.camera_id.as_str().to_owned(),
            train: Some(plan.train.into()),
            test: Some(plan.test.into()),
            truth,
            methods: plan.methods.iter().map(Method::to_string).collect(),
            recipe: proto::Recipe::from(plan.recipe).into(),
            seeds: plan.seeds,
            box_shift_px: plan.box_shift_px,
            gnss_sigma_m: plan.gnss_sigma.map(SigmaM::metres),
            state: proto::TrainingRunState::from(job.state).into(),
            progress: Some(job.progress.into()),
            attempt: job.attempt,
            outcome: job.outcome,
            created_at: Some(timestamp(job.created_at)),
            started_at: job.started_at.map(timestamp),
            ended_at: job.ended_at.map(timestamp),
            report_json: None,
        }
    }
}

impl From<TimeRange> for proto::TimeRange {
    fn from(range: TimeRange) -> Self {
        Self { from: range.from().map(timestamp), until: range.until().map(timestamp) }
    }
}

impl From<EvaluationProgress> for proto::EvaluationProgress {
    fn from(progress: EvaluationProgress) -> Self {
        let EvaluationProgress { phase, steps_done, steps, remaining_s } = progress;
        Self { phase, steps_done, steps, remaining_s }
    }
}
