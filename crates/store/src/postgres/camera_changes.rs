//! The cameras that have changed since a poll, in rows that a trigger writes.
//!
//! Transactions are committed in another order than they are numbered in. A poll therefore continues from the oldest
//! transaction that had not ended when it was made, and may list a camera twice.

use super::Store;
use super::errors::failed;
use crate::domain::{CameraId, CameraKey, Error, Result};
use crate::row_decoder::{RowDecoder, StoredRow};
use crate::rows::cameras::{CameraVersion, CameraVersions, ChangeMark, read_version};
use crate::statements::versions::all_versions;

impl Store {
    pub(crate) async fn camera_versions(&self, since: Option<ChangeMark>) -> Result<CameraVersions> {
        let mut reader = self.reader().await?;
        let upto: String = sqlx::query_scalar("SELECT pg_snapshot_xmin(pg_current_snapshot())::TEXT")
            .fetch_one(&mut *reader)
            .await
            .map_err(failed)?;
        let upto = Some(ChangeMark(upto.parse().map_err(Error::fault)?));
        let Some(since) = since else {
            let versions = all_versions(&mut *reader).await?;
            return Ok(CameraVersions { versions, deleted: None, upto });
        };
        // Transactions that this server has not begun yet are those of a server whose dump was restored here.
        let rows = sqlx::query(
            "SELECT changes.id, camera_key, revision, active_model FROM camera_changes AS changes \
             LEFT JOIN cameras ON cameras.key = camera_key \
             WHERE changed_in >= $1::TEXT::XID8 AND changed_in < pg_snapshot_xmax(pg_current_snapshot())",
        )
        .bind(since.0.to_string())
        .fetch_all(&mut *reader)
        .await
        .map_err(failed)?;
        let (mut versions, mut deleted) = (Vec::new(), Vec::new());
        for row in rows {
            match read_change(&StoredRow::Postgres(row))? {
                Change::Is(version) => versions.push(version),
                Change::Deleted(id, key) => deleted.push((id, key)),
            }
        }
        Ok(CameraVersions { versions, deleted: Some(deleted), upto })
    }
}

enum Change {
    Is(CameraVersion),
    Deleted(CameraId, CameraKey),
}

fn read_change(row: &StoredRow) -> Result<Change> {
    let mut fields = RowDecoder::new("camera_changes", row);
    let (id, key) = (fields.parse(CameraId::new)?, CameraKey(fields.get()?));
    match fields.get::<Option<i64>>()? {
        Some(_) => read_version(row).map(Change::Is),
        None => Ok(Change::Deleted(id, key)),
    }
}
