//! Answers of changes that clients may repeat, written in the transaction of the change.

use jiff::Timestamp;

use crate::domain::{Actor, IdempotencyKey, Result};
use crate::limits::StoreLimits;
use crate::locks::delete_upto;
use crate::query::{Dialect, Session, query, query_as, query_scalar};
use crate::rows::idempotency::{IdempotencyRecord, StoredAnswer, expired_until_us, owner};

const TABLE: &str = "idempotency_keys";

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
    let found: Option<(Vec<u8>, String)> = query_as(
        "SELECT digest, answer FROM idempotency_keys \
         WHERE owner = $1 AND idempotency_key = $2 AND created_at_us > $3",
    )
    .bind(owner(actor))
    .bind(key.as_str())
    .bind(expired_until_us(limits, now))
    .fetch_optional(session)
    .await?;
    Ok(found.map(|(digest, answer)| StoredAnswer { digest, answer }))
}

/// Stores an answer, unless one that has not expired is stored under its key. Expired ones and the oldest
/// beyond the limit are deleted.
pub(crate) async fn insert_answer(
    session: &mut dyn Session,
    limits: &StoreLimits,
    (actor, record): (&Actor, &IdempotencyRecord),
    answer: &str,
    now: Timestamp,
) -> Result<()> {
    delete_upto(session, TABLE, "created_at_us", expired_until_us(limits, now)).await?;
    let number: Option<i64> = query_scalar(
        "INSERT INTO idempotency_keys (owner, idempotency_key, digest, answer, created_at_us) \
         VALUES ($1, $2, $3, $4, $5) ON CONFLICT DO NOTHING RETURNING number",
    )
    .bind(owner(actor))
    .bind(record.key.as_str())
    .bind(record.digest.as_slice())
    .bind(answer)
    .bind(now.as_microsecond())
    .fetch_optional(session)
    .await?;
    let Some(number) = number else { return Ok(()) };
    delete_upto(session, TABLE, "number", number.saturating_sub(limits.idempotency_keys.into())).await
}
