//! The audit log, written in the transaction of what it tells of.

use std::net::IpAddr;

use jiff::Timestamp;
use sqlx::SqliteConnection;
use sqlx::sqlite::SqliteRow;

use super::Store;
use super::errors::failed;
use super::row_decoder::RowDecoder;
use super::space::StoreLimits;
use crate::domain::{Actor, AuditAction, AuditEntry, AuditNumber, CameraId, KeyId, Result};

/// A change, for the audit log.
pub(super) struct Change<'a> {
    pub(super) action: AuditAction,
    pub(super) camera: Option<&'a CameraId>,
    pub(super) subject: Option<String>,
}

impl<'a> Change<'a> {
    /// A change of a camera, or of something that belongs to it.
    pub(super) fn of_camera(action: AuditAction, camera: &'a CameraId, subject: Option<String>) -> Self {
        Self { action, camera: Some(camera), subject }
    }

    /// Any other change.
    pub(super) const fn of(action: AuditAction, subject: String) -> Self {
        Self { action, camera: None, subject: Some(subject) }
    }
}

/// A model version as the subject of a change.
pub(super) fn version(number: impl std::fmt::Display) -> String {
    format!("version {number}")
}

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

    /// A page of the audit log, of a camera or of all, newest first, before a number.
    ///
    /// # Errors
    /// Faults only.
    pub async fn audit_log(
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

fn read_entry(row: &SqliteRow) -> Result<AuditEntry> {
    let mut fields = RowDecoder::new("audit_log", row);
    Ok(AuditEntry {
        number: AuditNumber(fields.parse(|number: i64| u64::try_from(number))?),
        time: fields.timestamp()?,
        actor: Actor {
            name: fields.get::<String>()?.into(),
            key_id: fields.parse_optional(|id: &str| id.parse::<KeyId>())?,
            address: fields.parse_optional(|address: &str| address.parse::<IpAddr>())?,
            request_id: fields.get::<Option<String>>()?.map(Into::into),
        },
        action: fields.parse(|action: &str| action.parse::<AuditAction>())?,
        camera_id: fields.parse_optional(CameraId::new)?,
        subject: fields.get()?,
    })
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
