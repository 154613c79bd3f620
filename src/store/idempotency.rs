//! Answers of changes that clients may repeat, written in the transaction of the change.

use jiff::{SignedDuration, Timestamp};
use sqlx::{SqliteConnection, SqliteExecutor};

use super::Store;
use super::errors::failed;
use super::space::StoreLimits;
use crate::domain::{Actor, Error, ErrorKind, IdempotencyKey, RequestDigest, Result};

/// A request that its client may repeat.
#[derive(Debug, Clone)]
pub struct IdempotencyRecord {
    /// The client's key.
    pub key: IdempotencyKey,
    /// What the request asks for.
    pub digest: RequestDigest,
}

/// An answer that was stored under a key.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct StoredAnswer {
    digest: Vec<u8>,
    answer: String,
}

impl StoredAnswer {
    /// The answer, if it was given to the same request.
    ///
    /// # Errors
    /// [`ErrorKind::IdempotencyKeyReused`].
    pub fn to_request(self, digest: &RequestDigest) -> Result<String> {
        if self.digest == digest {
            return Ok(self.answer);
        }
        Err(Error::field(
            ErrorKind::IdempotencyKeyReused,
            "idempotency-key",
            "was used for another request; send the same request again, or this one under a new key",
        ))
    }
}

impl Store {
    /// The answer that is stored under a key of the caller, if there is one that has not expired.
    ///
    /// # Errors
    /// Faults only.
    pub async fn stored_answer(&self, key: &IdempotencyKey, now: Timestamp) -> Result<Option<StoredAnswer>> {
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

fn owner(actor: &Actor) -> String {
    actor.key_id.map(|id| id.to_string()).unwrap_or_default()
}

/// Keys of this time and before have expired.
fn expired_until_us(limits: &StoreLimits, now: Timestamp) -> i64 {
    let life = SignedDuration::from_secs(limits.idempotency_key_s.into());
    now.saturating_sub(life).map_or(i64::MIN, Timestamp::as_microsecond)
}
