//! Messages that wait for their receivers.
//!
//! A message is deleted when its receiver has acknowledged it, so a crash in between delivers it again, under the
//! same id. Beyond the limit the oldest waiting message of the connection is dropped, and counted by the caller.

use jiff::Timestamp;

use crate::database::{Backend, Database};
use crate::domain::{
    AuditAction, Connection, ConnectionKey, DeadLetter, OutboxCounts, OutboxLog, OutboxMessage, Result,
};
use crate::query::{AnyConnection, Session, query, query_as};
use crate::row_decoder::RowDecoder;
use crate::rows::audit::Change;
use crate::rows::connections::{read_dead_letter, read_message};
use crate::{postgres, sqlite};

impl Database {
    pub(crate) async fn append_to_outbox(
        &self,
        key: ConnectionKey,
        log: &OutboxLog,
        messages: &[OutboxMessage],
    ) -> Result<u64> {
        let mut writer = self.growing().await?;
        let mut transaction = writer.begin().await?;
        let Some(position) = open_log(&mut transaction, key, log).await? else { return Ok(0) };
        for message in messages.iter().filter(|message| message.number > position) {
            insert_message(&mut transaction, key, message).await?;
        }
        if let Some(last) = messages.last().filter(|last| last.number > position) {
            note_position(&mut transaction, key, log, last.number).await?;
        }
        let dropped = trim_queued(&mut transaction, key, self.limits().outbox_messages).await?;
        transaction.commit().await?;
        Ok(dropped)
    }

    pub(crate) async fn lost_outbox_logs(&self, own: &OutboxLog) -> Result<Vec<ConnectionKey>> {
        match &self.backend {
            Backend::Sqlite(store) => store.lost_outbox_logs(own).await,
            Backend::Postgres(store) => store.lost_outbox_logs(own).await,
        }
    }

    pub(crate) async fn close_outbox_logs(&self, own: &OutboxLog, sinks: &[ConnectionKey]) -> Result<()> {
        let mut writer = self.synced().await?;
        let mut transaction = writer.begin().await?;
        for key in sinks {
            query("DELETE FROM outbox_logs WHERE log = $1 AND connection_key = $2")
                .bind(own.id.to_string())
                .bind(key.0)
                .execute(&mut transaction)
                .await?;
        }
        transaction.commit().await
    }

    pub(crate) async fn outbox(&self, key: ConnectionKey, limit: u32) -> Result<Vec<OutboxMessage>> {
        let mut reader = self.reader().await?;
        let rows = query(
            "SELECT number, message_id, subject, payload, created_at_us FROM outbox \
             WHERE connection_key = $1 AND dead_reason IS NULL ORDER BY number LIMIT $2",
        )
        .bind(key.0)
        .bind(limit)
        .fetch_all(&mut reader)
        .await?;
        rows.iter().map(|row| read_message(&mut RowDecoder::new("outbox", row))).collect()
    }

    pub(crate) async fn settle_outbox(
        &self,
        key: ConnectionKey,
        outcomes: &[(i64, Result<(), String>)],
    ) -> Result<()> {
        let mut writer = self.relaxed().await?;
        let mut transaction = writer.begin().await?;
        for (number, outcome) in outcomes {
            let sql = match outcome {
                Ok(()) => "DELETE FROM outbox WHERE connection_key = $1 AND number = $2",
                Err(_) => "UPDATE outbox SET dead_reason = $3 WHERE connection_key = $1 AND number = $2",
            };
            let query = query(sql).bind(key.0).bind(*number);
            let query = match outcome {
                Ok(()) => query,
                Err(reason) => query.bind(reason),
            };
            query.execute(&mut transaction).await?;
        }
        trim(&mut transaction, key, "IS NOT NULL", self.limits().dead_letters).await?;
        transaction.commit().await
    }

    pub(crate) async fn dead_letters(
        &self,
        key: ConnectionKey,
        after: i64,
        limit: u32,
    ) -> Result<Vec<DeadLetter>> {
        let mut reader = self.reader().await?;
        let rows = query(
            "SELECT number, message_id, subject, payload, created_at_us, dead_reason FROM outbox \
             WHERE connection_key = $1 AND dead_reason IS NOT NULL AND number > $2 ORDER BY number LIMIT $3",
        )
        .bind(key.0)
        .bind(after)
        .bind(limit)
        .fetch_all(&mut reader)
        .await?;
        rows.iter().map(read_dead_letter).collect()
    }

    pub(crate) async fn retry_dead_letters(&self, connection: &Connection, now: Timestamp) -> Result<u64> {
        let change = (AuditAction::DeadLettersRetried, "UPDATE outbox SET dead_reason = NULL");
        self.change_dead_letters(connection, change, now).await
    }

    pub(crate) async fn delete_dead_letters(&self, connection: &Connection, now: Timestamp) -> Result<u64> {
        let change = (AuditAction::DeadLettersDeleted, "DELETE FROM outbox");
        self.change_dead_letters(connection, change, now).await
    }

    /// Where there are none, nothing is recorded.
    async fn change_dead_letters(
        &self,
        connection: &Connection,
        (action, change): (AuditAction, &str),
        now: Timestamp,
    ) -> Result<u64> {
        let mut writer = self.synced().await?;
        let mut transaction = writer.begin().await?;
        let sql = format!("{change} WHERE connection_key = $1 AND dead_reason IS NOT NULL");
        let changed =
            query(sqlx::AssertSqlSafe(sql)).bind(connection.key.0).execute(&mut transaction).await?;
        if changed > 0 {
            let subject = format!("{changed} dead letters of connection {}", connection.id());
            self.record(&mut transaction, Change::of(action, subject), now).await?;
        }
        transaction.commit().await?;
        Ok(changed)
    }

    pub(crate) async fn outbox_counts(&self, key: ConnectionKey) -> Result<OutboxCounts> {
        let mut reader = self.reader().await?;
        let (queued, dead, oldest_us): (i64, i64, Option<i64>) = query_as(
            "SELECT count(*) FILTER (WHERE dead_reason IS NULL), count(dead_reason), \
             min(created_at_us) FILTER (WHERE dead_reason IS NULL) FROM outbox WHERE connection_key = $1",
        )
        .bind(key.0)
        .fetch_one(&mut reader)
        .await?;
        Ok(OutboxCounts {
            queued: queued.try_into().unwrap_or_default(),
            dead: dead.try_into().unwrap_or_default(),
            oldest_at: oldest_us.and_then(|us| Timestamp::from_microsecond(us).ok()),
        })
    }
}

/// Appends a message. A connection that was deleted takes none.
pub(super) async fn insert_message(
    session: &mut dyn Session,
    key: ConnectionKey,
    message: &OutboxMessage,
) -> Result<()> {
    query(
        "INSERT INTO outbox (connection_key, message_id, subject, payload, created_at_us) \
         SELECT key, $1, $2, $3, $4 FROM connections WHERE key = $5",
    )
    .bind(&message.message_id)
    .bind(&message.subject)
    .bind(&*message.payload)
    .bind(message.created_at.as_microsecond())
    .bind(key.0)
    .execute(session)
    .await?;
    Ok(())
}

/// How far the outbox has come in a log, which is known from then on. `None` for a connection that was deleted.
async fn open_log(session: &mut dyn Session, key: ConnectionKey, log: &OutboxLog) -> Result<Option<i64>> {
    match session.connection() {
        AnyConnection::Sqlite(connection) => sqlite::open_log(connection, key, log).await,
        AnyConnection::Postgres(connection) => postgres::lock_log(connection, key, log).await,
    }
}

/// Notes that the outbox has come so far in a log.
async fn note_position(
    session: &mut dyn Session,
    key: ConnectionKey,
    log: &OutboxLog,
    position: i64,
) -> Result<()> {
    query("UPDATE outbox_logs SET position = $3 WHERE connection_key = $1 AND log = $2")
        .bind(key.0)
        .bind(log.id.to_string())
        .bind(position)
        .execute(session)
        .await?;
    Ok(())
}

/// Deletes the oldest waiting messages beyond a limit; how many.
pub(super) async fn trim_queued(session: &mut dyn Session, key: ConnectionKey, limit: u32) -> Result<u64> {
    trim(session, key, "IS NULL", limit).await
}

/// Deletes the oldest messages beyond a limit; how many.
async fn trim(session: &mut dyn Session, key: ConnectionKey, dead_reason: &str, limit: u32) -> Result<u64> {
    let sql = format!(
        "DELETE FROM outbox WHERE connection_key = $1 AND dead_reason {dead_reason} \
         AND number <= (SELECT number FROM outbox WHERE connection_key = $1 AND dead_reason {dead_reason} \
         ORDER BY number DESC LIMIT 1 OFFSET $2)"
    );
    let trimmed = query(sqlx::AssertSqlSafe(sql)).bind(key.0).bind(limit).execute(session).await?;
    Ok(trimmed)
}
