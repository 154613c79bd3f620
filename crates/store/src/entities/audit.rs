//! The audit log, written in the transaction of the change that it records.

use jiff::Timestamp;

use crate::database::Database;
use crate::domain::{AuditEntry, AuditNumber, CameraId, Result};
use crate::query::{Session, query};
use crate::rows::audit::{Change, read_entry};
use crate::statements::audit;

impl Database {
    /// Records a change of the transaction that is open on the session. The oldest entries beyond the
    /// limit are deleted.
    pub(super) async fn record(
        &self,
        session: &mut dyn Session,
        change: Change<'_>,
        now: Timestamp,
    ) -> Result<()> {
        audit::record(session, (&self.actor, self.limits()), change, now).await
    }

    pub(crate) async fn audit_log(
        &self,
        camera: Option<&CameraId>,
        before: Option<AuditNumber>,
        limit: u32,
    ) -> Result<Vec<AuditEntry>> {
        const COLUMNS: &str =
            "number, time_us, actor, key_id, address, request_id, action, camera_id, subject";
        let of_camera = if camera.is_some() { "AND camera_id = $3" } else { "" };
        let sql = format!(
            "SELECT {COLUMNS} FROM audit_log WHERE number < $1 {of_camera} ORDER BY number DESC LIMIT $2"
        );
        let before = before.map_or(i64::MAX, |before| i64::try_from(before.0).unwrap_or(i64::MAX));
        let mut query = query(sqlx::AssertSqlSafe(sql)).bind(before).bind(limit);
        if let Some(camera) = camera {
            query = query.bind(camera.as_str().to_owned());
        }
        let mut reader = self.reader().await?;
        let rows = query.fetch_all(&mut reader).await?;
        rows.iter().map(read_entry).collect()
    }
}
