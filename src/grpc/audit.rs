//! `AuditService`.

use super::convert::{camera_id, timestamp};
use super::pages;
use super::proto;
use super::proto::audit_service_server::AuditService;
use super::statuses::{Reply, answer};
use crate::app::App;
use crate::domain::{AuditEntry, AuditNumber};

pub(super) struct Audit {
    app: App,
}

impl Audit {
    pub(super) fn new(app: &App) -> Self {
        Self { app: app.clone() }
    }
}

#[tonic::async_trait]
impl AuditService for Audit {
    async fn list_audit_entries(
        &self,
        request: tonic::Request<proto::ListAuditEntriesRequest>,
    ) -> Reply<proto::ListAuditEntriesResponse> {
        answer(&self.app, request, |app, asked| async move {
            let camera = Some(asked.camera_id.as_str()).filter(|id| !id.is_empty());
            let camera = camera.map(camera_id).transpose()?;
            let size = pages::size(asked.page_size, &app.limits)?;
            let before = pages::cursor::<AuditNumber>(&asked.page_token)?;
            let page = app.audit_log().list(camera.as_ref(), before, size).await?;
            Ok(proto::ListAuditEntriesResponse {
                next_page_token: pages::token(page.next.as_ref()),
                entries: page.items.into_iter().map(Into::into).collect(),
            })
        })
        .await
    }
}

impl From<AuditEntry> for proto::AuditEntry {
    fn from(entry: AuditEntry) -> Self {
        Self {
            number: entry.number.0,
            time: Some(timestamp(entry.time)),
            actor: entry.actor.name.to_string(),
            key_id: entry.actor.key_id.map(|id| id.to_string()),
            address: entry.actor.address.map(|address| address.to_string()),
            request_id: entry.actor.request_id.map(|id| id.to_string()),
            action: entry.action.as_str().to_owned(),
            camera_id: entry.camera_id.map(|camera| camera.as_str().to_owned()),
            subject: entry.subject,
        }
    }
}
