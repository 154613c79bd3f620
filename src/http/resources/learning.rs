//! `/v1/cameras/{camera}/learning`: how far a camera has come on its way to a model.

use jiff::Timestamp;
use serde::Serialize;
use utoipa::ToSchema;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use crate::app;
use crate::http::plumbing::access::CallerApp;
use crate::http::plumbing::extract::CameraPath;
use crate::http::plumbing::problem::{ApiResult, Problem};
use crate::http::plumbing::state::Rest;
use crate::http::plumbing::wire::json;

pub(super) fn routes() -> OpenApiRouter<Rest> {
    OpenApiRouter::new().routes(routes!(get_learning))
}

/// How far a camera has come on its way to a model.
#[derive(Serialize, ToSchema)]
#[serde(rename_all = "snake_case")]
enum LearningState {
    /// The profile switches it off.
    Off,
    /// Boxes and fixes are recorded; the message says what is missing.
    Recording,
    /// Boxes are matched with receivers.
    Matching,
    /// A training run is queued or running.
    Training,
    /// A model answers.
    Learned,
}

impl From<app::LearningState> for LearningState {
    fn from(state: app::LearningState) -> Self {
        match state {
            app::LearningState::Off => Self::Off,
            app::LearningState::Recording => Self::Recording,
            app::LearningState::Matching => Self::Matching,
            app::LearningState::Training => Self::Training,
            app::LearningState::Learned => Self::Learned,
        }
    }
}

/// The recording that a camera learns from, and what is missing in it.
#[derive(Serialize, ToSchema)]
struct Learning {
    /// How far it has come.
    state: LearningState,
    /// The same in a sentence for the operator, with what to do.
    #[schema(example = "4 of about 8 minutes with boxes and fixes at the same time")]
    message: String,
    /// Time in which boxes and fixes came together, s.
    recorded_s: u64,
    /// Time that is recorded before boxes are matched with receivers, s.
    needed_s: u64,
    /// Number of recorded boxes.
    boxes: u64,
    /// Number of recorded fixes.
    fixes: u64,
    /// Number of receivers with recorded fixes.
    receivers: u64,
    /// The latest attempt to match boxes with receivers, since the server was started.
    #[serde(skip_serializing_if = "Option::is_none")]
    last_attempt: Option<LearningAttempt>,
    /// The latest training run, while it has not given a model.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(format = "uuid")]
    training_run: Option<String>,
}

/// An attempt to match boxes with receivers.
#[derive(Serialize, ToSchema)]
struct LearningAttempt {
    /// When it ended.
    #[schema(value_type = String, format = DateTime)]
    time: Timestamp,
    /// The outcome of the attempt.
    outcome: String,
}

impl From<app::Learning> for Learning {
    fn from(learning: app::Learning) -> Self {
        let app::Learning { message, recorded_s, needed_s, boxes, fixes, receivers, .. } = learning;
        Self {
            state: learning.state.into(),
            message,
            recorded_s,
            needed_s,
            boxes,
            fixes,
            receivers,
            last_attempt: learning.last_attempt.map(|(time, outcome)| LearningAttempt { time, outcome }),
            training_run: learning.training_run.map(|run| run.to_string()),
        }
    }
}

/// Read how far a camera has come on its way to a model
///
/// While `learn_automatically` of the profile is on and there is no model, boxes that have only a tracker's id are recorded
/// with the fixes of receivers. They are matched once enough is recorded, and matched again with more where that shows
/// nobody's receiver beyond doubt. Boxes with a probable receiver become samples, and a training run starts.
#[utoipa::path(
    get, path = "/v1/cameras/{camera}/learning", tag = "cameras",
    params(("camera" = String, Path, description = "The camera's id")),
    responses(
        (status = 200, description = "The recording, and what is missing in it", body = Learning),
        (status = 404, description = "There is no such camera", body = Problem, content_type = "application/problem+json"),
    )
)]
async fn get_learning(CallerApp(app): CallerApp, CameraPath(id): CameraPath) -> ApiResult {
    Ok(json(&Learning::from(app.recordings().learning(&id).await?))?)
}
