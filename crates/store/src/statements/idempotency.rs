//! Answers of changes that clients may repeat, written in the transaction of the change.

use jiff::Timestamp;
use sqlx::AssertSqlSafe;

use crate::domain::{Actor, IdempotencyKey, Result};
use crate::limits::StoreLimits;
use crate::locks::delete_upto;
use crate::query::{Dialect, Session, query, query_as, query_scalar};
use crate::rows::idempotency::{IdempotencyRecord, StoredAnswer, owner};

/// Waits until no other transaction looks for an answer under the same key, or stores one. SQLite has one writer at a
/// time.
pub(crate) async fn lock_key(
    session: &mut dyn Session,
    (actor, key): (&Actor, &IdempotencyKey),
) -> Result<()> {
    if session.dialect() == Dialect::Sqlite {
        return Ok(());
    }
    query("SELECT pg_advisory_xact_lock(hashtextextended($1, 0))")
        .bind(format!("{} {}", owner(actor), key.as_str()))
        .execute(session)
        .await?;
    Ok(())
}

/// The answer under a key of an actor that has not expired.
pub(crate) async fn find_answer(
    session: &mut dyn Session,
    limits: &StoreLimits,
    (actor, key): (&Actor, &IdempotencyKey),
    now: Timestamp,
) -> Result<Option<StoredAnswer>> {
    let now_us = session.dialect().now_us("$3");
    let sql = format!(
        "SELECT digest, answer FROM idempotency_keys \
         WHERE owner = $1 AND idempotency_key = $2 AND created_at_us > {now_us} - $4"
    );
    let found: Option<(Vec<u8>, String)> = query_as(AssertSqlSafe(sql))
        .bind(owner(actor))
        .bind(key.as_str())
        .bind(now.as_microsecond())
        .bind(life_us(limits))
        .fetch_optional(session)
        .await?;
    Ok(found.map(|(digest, answer)| StoredAnswer { digest, answer }))
}

/// Stores an answer, unless one that has not expired is stored under its key. The oldest beyond the limit are deleted, and
/// none for its age: a clock that was ahead for a while takes no answer away.
pub(crate) async fn insert_answer(
    session: &mut dyn Session,
    limits: &StoreLimits,
    (actor, record): (&Actor, &IdempotencyRecord),
    answer: &str,
    now: Timestamp,
) -> Result<()> {
    let now_us = session.dialect().now_us("$3");
    let sql = format!(
        "DELETE FROM idempotency_keys \
         WHERE owner = $1 AND idempotency_key = $2 AND created_at_us <= {now_us} - $4"
    );
    query(AssertSqlSafe(sql))
        .bind(owner(actor))
        .bind(record.key.as_str())
        .bind(now.as_microsecond())
        .bind(life_us(limits))
        .execute(session)
        .await?;
    let now_us = session.dialect().now_us("$5");
    let sql = format!(
        "INSERT INTO idempotency_keys (owner, idempotency_key, digest, answer, created_at_us) \
         VALUES ($1, $2, $3, $4, {now_us}) ON CONFLICT DO NOTHING RETURNING number"
    );
    let number: Option<i64> = query_scalar(AssertSqlSafe(sql))
        .bind(owner(actor))
        .bind(record.key.as_str())
        .bind(record.digest.as_slice())
        .bind(answer)
        .bind(now.as_microsecond())
        .fetch_optional(session)
        .await?;
    let Some(number) = number else { return Ok(()) };
    delete_upto(session, "idempotency_keys", "number", number.saturating_sub(limits.idempotency_keys.into()))
        .await
}

fn life_us(limits: &StoreLimits) -> i64 {
    i64::from(limits.idempotency_key_s) * 1_000_000
}
