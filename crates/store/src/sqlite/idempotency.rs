//! Answers of changes that clients may repeat, written in the transaction of the change.

use jiff::Timestamp;
use sqlx::{SqliteConnection, SqliteExecutor};

use super::Store;
use super::errors::failed;
use crate::domain::{Actor, IdempotencyKey, Result};
use crate::limits::StoreLimits;
use crate::rows::idempotency::{IdempotencyRecord, StoredAnswer, expired_until_us, owner};

impl Store {
    pub(crate) async fn stored_answer(
        &self,
        key: &IdempotencyKey,
        now: Timestamp,
    ) -> Result<Option<StoredAnswer>> {
        find_answer(self.readers(), self.limits(), (&self.actor, key), now).await
    }
}

/// As [`Store::stored_answer`].
pub(super) async fn find_answer(
    executor: impl SqliteExecutor<'_>,
    limits: &StoreLimits,
    (actor, key): (&Actor, &IdempotencyKey),
    now: Timestamp,
) -> Result<Option<StoredAnswer>> {
    let found: Option<(Vec<u8>, String)> = sqlx::query_as(
        "SELECT digest, answer FROM idempotency_keys \
         WHERE owner = ? AND idempotency_key = ? AND created_at_us > ?",
    )
    .bind(owner(actor))
    .bind(key.as_str())
    .bind(expired_until_us(limits, now))
    .fetch_optional(executor)
    .await
    .map_err(failed)?;
    Ok(found.map(|(digest, answer)| StoredAnswer { digest, answer }))
}

/// Stores an answer, unless one that has not expired is stored under its key. Expired ones and the oldest
/// beyond the limit are deleted.
pub(super) async fn insert_answer(
    connection: &mut SqliteConnection,
    limits: &StoreLimits,
    (actor, record): (&Actor, &IdempotencyRecord),
    answer: &str,
    now: Timestamp,
) -> Result<()> {
    sqlx::query("DELETE FROM idempotency_keys WHERE created_at_us <= ?")
        .bind(expired_until_us(limits, now))
        .execute(&mut *connection)
        .await
        .map_err(failed)?;
    let number: Option<i64> = sqlx::query_scalar(
        "INSERT INTO idempotency_keys (owner, idempotency_key, digest, answer, created_at_us) \
         VALUES (?, ?, ?, ?, ?) ON CONFLICT DO NOTHING RETURNING number",
    )
    .bind(owner(actor))
    .bind(record.key.as_str())
    .bind(record.digest.as_slice())
    .bind(answer)
    .bind(now.as_microsecond())
    .fetch_optional(&mut *connection)
    .await
    .map_err(failed)?;
    let Some(number) = number else { return Ok(()) };
    sqlx::query("DELETE FROM idempotency_keys WHERE number <= ?")
        .bind(number.saturating_sub(limits.idempotency_keys.into()))
        .execute(connection)
        .await
        .map_err(failed)?;
    Ok(())
}
