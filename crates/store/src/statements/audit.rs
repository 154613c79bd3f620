//! Entries of the audit log, written in the transaction of the change that they record.

use jiff::Timestamp;

use crate::domain::{Actor, CameraId, Result};
use crate::limits::StoreLimits;
use crate::locks::delete_upto;
use crate::query::{Session, query_scalar};
use crate::rows::audit::Change;

/// Records a change of the transaction that is open on the session. The oldest entries beyond the limit are deleted.
pub(crate) async fn record(
    session: &mut dyn Session,
    (actor, limits): (&Actor, &StoreLimits),
    change: Change<'_>,
    now: Timestamp,
) -> Result<()> {
    let number: i64 = query_scalar(
        "INSERT INTO audit_log (time_us, actor, key_id, address, request_id, action, camera_id, subject) \
         VALUES ($1, $2, $3, $4, $5, $6, $7, $8) RETURNING number",
    )
    .bind(now.as_microsecond())
    .bind(&*actor.name)
    .bind(actor.key_id.map(|id| id.to_string()))
    .bind(actor.address.map(|address| address.to_string()))
    .bind(actor.request_id.as_deref())
    .bind(change.action.as_str())
    .bind(change.camera.map(CameraId::as_str))
    .bind(change.subject)
    .fetch_one(session)
    .await?;
    delete_upto(session, "audit_log", "number", number.saturating_sub(limits.audit_entries.into())).await
}
