//! The audit log.

use super::{App, Page, page_of};
use crate::domain::{AuditEntry, AuditNumber, CameraId, Result};

impl App {
    /// Who changed what, newest first, of a camera or of all, after a cursor. The camera may have been
    /// deleted since.
    ///
    /// # Errors
    /// A fault of the store.
    pub async fn audit_log(
        &self,
        camera: Option<&CameraId>,
        before: Option<AuditNumber>,
        limit: u32,
    ) -> Result<Page<AuditEntry, AuditNumber>> {
        let entries = self.store.audit_log(camera, before, limit + 1).await?;
        Ok(page_of(entries, limit, |entry| entry.number))
    }
}
