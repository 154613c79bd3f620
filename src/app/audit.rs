//! The audit log.

use super::{App, Page, page_of};
use crate::domain::{AuditEntry, AuditNumber, CameraId, Result};
use crate::store::Store;

/// Who changed what.
#[derive(Clone, Copy)]
pub struct AuditLog<'a> {
    store: &'a Store,
}

impl App {
    /// Who changed what.
    #[must_use]
    pub fn audit_log(&self) -> AuditLog<'_> {
        AuditLog { store: &self.store }
    }
}

impl AuditLog<'_> {
    /// Who changed what, newest first, of a camera or of all, after a cursor. The camera may have been
    /// deleted since.
    ///
    /// # Errors
    /// A fault of the store.
    pub async fn list(
        &self,
        camera: Option<&CameraId>,
        before: Option<AuditNumber>,
        limit: u32,
    ) -> Result<Page<AuditEntry, AuditNumber>> {
        let entries = self.store.audit_log(camera, before, limit + 1).await?;
        Ok(page_of(entries, limit, |entry| entry.number))
    }
}
