//! How far outboxes have come in the logs of the processes that fill them, and processes that ended too soon.

use sqlx::{AssertSqlSafe, PgConnection};

use super::errors::failed;
use super::{DATABASE_NOW_US, Store};
use crate::domain::{ConnectionKey, OutboxLog, Result};

/// A process that was cut off registers again as soon as it reaches the database; until then it is not believed to be gone.
const GRACE_US: i64 = 10_000_000;

impl Store {
    pub(crate) async fn lost_outbox_logs(&self, own: &OutboxLog) -> Result<Vec<ConnectionKey>> {
        let (log, node) = (own.id.to_string(), own.node.map(|node| node.to_string()));
        let mut reader = self.reader().await?;
        let has_changed: bool = sqlx::query_scalar(
            "SELECT EXISTS (SELECT 1 FROM outbox_logs LEFT JOIN nodes ON nodes.id = node_id \
             WHERE CASE WHEN log = $1 THEN node_id IS DISTINCT FROM $2 OR ended_at_us IS NOT NULL \
             ELSE nodes.id IS NULL END)",
        )
        .bind(&log)
        .bind(&node)
        .fetch_one(&mut *reader)
        .await
        .map_err(failed)?;
        reader.commit().await.map_err(failed)?;
        if !has_changed {
            return Ok(Vec::new());
        }
        let mut transaction = self.writer().await?;
        sqlx::query("UPDATE outbox_logs SET node_id = $2, ended_at_us = NULL WHERE log = $1")
            .bind(&log)
            .bind(&node)
            .execute(&mut *transaction)
            .await
            .map_err(failed)?;
        sqlx::query(AssertSqlSafe(format!(
            "UPDATE outbox_logs SET ended_at_us = {DATABASE_NOW_US} \
             WHERE log <> $1 AND ended_at_us IS NULL AND NOT EXISTS (SELECT 1 FROM nodes WHERE id = node_id)"
        )))
        .bind(&log)
        .execute(&mut *transaction)
        .await
        .map_err(failed)?;
        let lost: Vec<i64> = sqlx::query_scalar(AssertSqlSafe(format!(
            "DELETE FROM outbox_logs WHERE log <> $1 AND ended_at_us < {DATABASE_NOW_US} - $2 \
             RETURNING connection_key"
        )))
        .bind(&log)
        .bind(GRACE_US)
        .fetch_all(&mut *transaction)
        .await
        .map_err(failed)?;
        transaction.commit().await.map_err(failed)?;
        Ok(lost.into_iter().map(ConnectionKey).collect())
    }
}

/// Locks a log, after its connection as a deletion does; how far the outbox has come in it. `None` for a connection that was deleted.
pub(crate) async fn lock_log(
    connection: &mut PgConnection,
    key: ConnectionKey,
    log: &OutboxLog,
) -> Result<Option<i64>> {
    sqlx::query_scalar(
        "INSERT INTO outbox_logs (connection_key, log, node_id, position) \
         SELECT key, $2, $3, 0 FROM connections WHERE key = $1 FOR KEY SHARE \
         ON CONFLICT (connection_key, log) DO UPDATE SET node_id = excluded.node_id, ended_at_us = NULL \
         RETURNING position",
    )
    .bind(key.0)
    .bind(log.id.to_string())
    .bind(log.node.map(|node| node.to_string()))
    .fetch_optional(connection)
    .await
    .map_err(failed)
}
