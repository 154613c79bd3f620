//! `/v1/audit`: who changed what, when and from where.

use hyper::Uri;
use jiff::Timestamp;
use serde::Serialize;
use utoipa::ToSchema;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use crate::domain;
use crate::exchange::write_cursor;
use crate::http::plumbing::access::CallerApp;
use crate::http::plumbing::extract::{Params, camera_of};
use crate::http::plumbing::problem::{ApiResult, Problem};
use crate::http::plumbing::state::Rest;
use crate::http::plumbing::wire::json;

pub(super) fn routes() -> OpenApiRouter<Rest> {
    OpenApiRouter::new().routes(routes!(list_audit_entries))
}

/// An entry, written in the transaction of the change.
#[derive(Serialize, ToSchema)]
struct AuditEntry {
    /// Its number, in the order of the changes.
    number: u64,
    /// When it was changed.
    #[schema(value_type = String, format = DateTime)]
    time: Timestamp,
    /// Name of the key, or the part of the program that acted by itself.
    #[schema(example = "camera box at the north gate")]
    actor: String,
    /// Id of the key, if one was presented.
    #[serde(skip_serializing_if = "Option::is_none")]
    key_id: Option<String>,
    /// The client's network address; missing for a command on the data folder, and for the server itself.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(example = "192.0.2.7")]
    address: Option<String>,
    /// Id of the request, as in the server's log.
    #[serde(skip_serializing_if = "Option::is_none")]
    request_id: Option<String>,
    /// The kind of change.
    #[schema(example = "camera-deleted")]
    action: &'static str,
    /// The camera that it was done to or for. It may have been deleted since.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(example = "north-gate")]
    camera_id: Option<String>,
    /// The object of the change: id of a run, version of a model, name of a key.
    #[serde(skip_serializing_if = "Option::is_none")]
    subject: Option<String>,
}

impl From<domain::AuditEntry> for AuditEntry {
    fn from(entry: domain::AuditEntry) -> Self {
        Self {
            number: entry.number.0,
            time: entry.time,
            actor: entry.actor.name.to_string(),
            key_id: entry.actor.key_id.map(|id| id.to_string()),
            address: entry.actor.address.map(|address| address.to_string()),
            request_id: entry.actor.request_id.map(|id| id.to_string()),
            action: entry.action.as_str(),
            camera_id: entry.camera_id.map(|camera| camera.as_str().to_owned()),
            subject: entry.subject,
        }
    }
}

/// A page of the audit log, newest first.
#[derive(Serialize, ToSchema)]
struct AuditPage {
    /// A page of entries.
    items: Vec<AuditEntry>,
    /// Asks for the next page; missing on the last.
    #[serde(skip_serializing_if = "Option::is_none")]
    next_cursor: Option<String>,
}

/// List changes, newest first
///
/// Changes of cameras, runs, models, evaluations and keys, and deletions of samples, each with who made it and
/// from where. Samples that are added, and live items, are not in the log.
#[utoipa::path(
    get, path = "/v1/audit", tag = "access",
    params(
        ("camera" = Option<String>, Query, description = "Only entries of this camera, which may have been deleted"),
        ("limit" = Option<u32>, Query, description = "Items on a page, 100 if left out"),
        ("cursor" = Option<String>, Query, description = "`next_cursor` of the page before"),
    ),
    responses(
        (status = 200, description = "A page of entries", body = AuditPage),
        (status = 404, description = "There is no such camera", body = Problem, content_type = "application/problem+json"),
    )
)]
async fn list_audit_entries(CallerApp(app): CallerApp, uri: Uri) -> ApiResult {
    let mut params = Params::of(&uri)?;
    let camera = params.take("camera", camera_of)?;
    let limit = params.limit(app.limits.page_items)?;
    let before = params.cursor()?;
    params.end()?;
    let page = app.audit_log().list(camera.as_ref(), before, limit).await?;
    Ok(json(&AuditPage {
        items: page.items.into_iter().map(AuditEntry::from).collect(),
        next_cursor: page.next.map(|number| write_cursor(&number)),
    })?)
}
