//! How far outboxes have come in the logs of the processes that fill them, and processes that ended too soon.

use sqlx::PgConnection;

use super::errors::failed;
use super::{Store, database_now_us};
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
        sqlx::query(concat!(
            "UPDATE outbox_logs SET ended_at_us = ",
            database_now_us!(),
            " WHERE log <> $1 AND ended_at_us IS NULL AND NOT EXISTS (SELECT 1 FROM nodes WHERE id = node_id)"
        ))
        .bind(&log)
        .execute(&mut *transaction)
        .await
        .map_err(failed)?;
        let lost: Vec<i64> = sqlx::query_scalar(concat!(
            "DELETE FROM outbox_logs WHERE log <> $1 AND ended_at_us < ",
            database_now_us!(),
            " - $2 RETURNING connection_key"
        ))
        .bind(&log)
        .bind(GRACE_US)
        .fetch_all(&mut *transaction)
        .await
        .map_err(failed)?;
        transaction.commit().await.map_err(failed)?;
        Ok(lost.into_iter().map(ConnectionKey).collect())
    }

    pub(crate) async fn close_outbox_logs(&self, own: &OutboxLog, sinks: &[ConnectionKey]) -> Result<()> {
        let mut transaction = self.writer().await?;
        sqlx::query("DELETE FROM outbox_logs WHERE log = $1 AND connection_key = ANY($2)")
            .bind(own.id.to_string())
            .bind(sinks.iter().map(|key| key.0).collect::<Vec<_>>())
            .execute(&mut *transaction)
            .await
            .map_err(failed)?;
        transaction.commit().await.map_err(failed)
    }
}

/// Locks a log, after its connection as a deletion does; how far the outbox has come in it. `None` for a connection that was deleted.
pub(super) async fn lock_log(
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

/// Notes that the outbox has come so far in a log.
pub(super) async fn note_position(
    connection: &mut PgConnection,
    key: ConnectionKey,
    log: &OutboxLog,
    position: i64,
) -> Result<()> {
    sqlx::query("UPDATE outbox_logs SET position = $3 WHERE connection_key = $1 AND log = $2")
        .bind(key.0)
        .bind(log.id.to_string())
        .bind(position)
        .execute(connection)
        .await
        .map_err(failed)?;
    Ok(())
}
