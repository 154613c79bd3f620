//! How far outboxes have come in the log of the server that fills them, and servers that ended too soon.

use sqlx::SqliteConnection;

use super::Store;
use super::errors::failed;
use crate::domain::{ConnectionKey, Durability, OutboxLog, Result};

impl Store {
    /// A data folder has one server, so logs of others are of servers that have ended.
    pub(crate) async fn lost_outbox_logs(&self, own: &OutboxLog) -> Result<Vec<ConnectionKey>> {
        let log = own.id.to_string();
        let has_others: bool = sqlx::query_scalar("SELECT EXISTS (SELECT 1 FROM outbox_logs WHERE log <> ?)")
            .bind(&log)
            .fetch_one(self.readers())
            .await
            .map_err(failed)?;
        if !has_others {
            return Ok(Vec::new());
        }
        let mut writer = self.changing(Durability::Synced).await?;
        let mut transaction = writer.begin().await?;
        let lost: Vec<i64> =
            sqlx::query_scalar("DELETE FROM outbox_logs WHERE log <> ? RETURNING connection_key")
                .bind(&log)
                .fetch_all(&mut *transaction)
                .await
                .map_err(failed)?;
        transaction.commit().await.map_err(failed)?;
        Ok(lost.into_iter().map(ConnectionKey).collect())
    }
}

/// How far the outbox has come in a log, which is known from then on. `None` for a connection that was deleted.
pub(crate) async fn open_log(
    connection: &mut SqliteConnection,
    key: ConnectionKey,
    log: &OutboxLog,
) -> Result<Option<i64>> {
    sqlx::query_scalar(
        "INSERT INTO outbox_logs (connection_key, log, position) SELECT key, ?2, 0 FROM connections WHERE key = ?1 \
         ON CONFLICT (connection_key, log) DO UPDATE SET position = position RETURNING position",
    )
    .bind(key.0)
    .bind(log.id.to_string())
    .fetch_optional(connection)
    .await
    .map_err(failed)
}
