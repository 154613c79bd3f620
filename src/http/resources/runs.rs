//! Training runs, whether their subject is a camera or a site: what both resources do alike.

use hyper::{StatusCode, Uri};
use serde::Serialize;
use serde::de::DeserializeOwned;

use crate::app::{App, Trainable};
use crate::domain::{Error, IdempotentRequest, Result, TrainingRun};
use crate::exchange::write_cursor;
use crate::http::plumbing::extract::{JsonBody, Params};
use crate::http::plumbing::problem::ApiResult;
use crate::http::plumbing::wire::created;

/// Starts the run that the draft `D` of a body asks for, and shows it as `R`; `uri` is that of the subject's runs.
pub(super) async fn start<R, D, S>(
    app: &App,
    subject: &S,
    uri: &Uri,
    idempotent: Option<IdempotentRequest>,
    body: &JsonBody,
) -> ApiResult
where
    R: From<TrainingRun<S>> + Serialize,
    D: DeserializeOwned + Default + TryInto<S::RunRequest, Error = Error>,
    S: Trainable,
{
    if let Some(request) = &idempotent {
        request.hasher.update(body.bytes());
    }
    let request = body.read_or_default::<D>()?.try_into()?;
    let run = app.training().start(subject, request, idempotent).await?;
    let location = format!("{}/{}", uri.path(), run.id);
    Ok(created(StatusCode::ACCEPTED, &location, &R::from(run))?)
}

/// The page of a subject's runs that a query asks for, and the cursor of the next page.
///
/// # Errors
/// `CameraNotFound` or `SiteNotFound`; `InvalidArgument` naming the parameter.
pub(super) async fn page<R, S>(app: &App, subject: &S, uri: &Uri) -> Result<(Vec<R>, Option<String>)>
where
    R: From<TrainingRun<S>>,
    S: Trainable,
{
    let mut params = Params::of(uri)?;
    let limit = params.limit(app.limits.page_items)?;
    let before = params.cursor()?;
    params.end()?;
    let page = app.training().list(subject, before, limit).await?;
    Ok((page.items.into_iter().map(R::from).collect(), page.next.map(|run| write_cursor(&run))))
}
