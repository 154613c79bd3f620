//! The audit log, written in the transaction of the change that it records.

use jiff::Timestamp;
use sqlx::SqliteConnection;

use super::Store;
use super::errors::failed;
use crate::domain::{Actor, AuditEntry, AuditNumber, CameraId, Result};
use crate::limits::StoreLimits;
use crate::rows::audit::{Change, read_entry};

impl Store {
    /// Records a change of the transaction that is open on the connection. The oldest entries beyond the
    /// limit are deleted.
    pub(super) async fn record(
        &self,
        connection: &mut SqliteConnection,
        change: Change<'_>,
        now: Timestamp,
    ) -> Result<()> {
        record(connection, (&self.actor, self.limits()), change, now).await
    }

    pub(crate) async fn audit_log(
        &self,
        camera: Option<&CameraId>,
        before: Option<AuditNumber>,
        limit: u32,
    ) -> Result<Vec<AuditEntry>> {
        const COLUMNS: &str =
            "number, time_us, actor, key_id, address, request_id, action, camera_id, subject";
        let of_camera = if camera.is_some() { "AND camera_id = ?" } else { "" };
        let sql = format!(
            "SELECT {COLUMNS} FROM audit_log WHERE number < ? {of_camera} ORDER BY number DESC LIMIT ?"
        );
        let before = before.map_or(i64::MAX, |before| i64::try_from(before.0).unwrap_or(i64::MAX));
        let mut query = sqlx::query(sqlx::AssertSqlSafe(sql)).bind(before);
        if let Some(camera) = camera {
            query = query.bind(camera.as_str().to_owned());
        }
        let rows = query.bind(limit).fetch_all(self.readers()).await.map_err(failed)?;
        rows.iter().map(read_entry).collect()
    }
}

/// As [`Store::record`].
pub(super) async fn record(
    connection: &mut SqliteConnection,
    (actor, limits): (&Actor, &StoreLimits),
    change: Change<'_>,
    now: Timestamp,
) -> Result<()> {
    let number: i64 = sqlx::query_scalar(
        "INSERT INTO audit_log (time_us, actor, key_id, address, request_id, action, camera_id, subject) \
         VALUES (?, ?, ?, ?, ?, ?, ?, ?) RETURNING number",
    )
    .bind(now.as_microsecond())
    .bind(&*actor.name)
    .bind(actor.key_id.map(|id| id.to_string()))
    .bind(actor.address.map(|address| address.to_string()))
    .bind(actor.request_id.as_deref())
    .bind(change.action.as_str())
    .bind(change.camera.map(CameraId::as_str))
    .bind(change.subject)
    .fetch_one(&mut *connection)
    .await
    .map_err(failed)?;
    sqlx::query("DELETE FROM audit_log WHERE number <= ?")
        .bind(number.saturating_sub(limits.audit_entries.into()))
        .execute(connection)
        .await
        .map_err(failed)?;
    Ok(())
}
