//! Changes that a client may repeat under its key: the first is made, the others get its answer.

use crate::clock::Clock;
use crate::domain::{IdempotentRequest, Result};
use crate::store::{IdempotencyRecord, Store, StoredAnswer};

/// The answer that is stored under the key of a request, if it was used before.
pub(super) async fn stored_answer(
    store: &Store,
    clock: &Clock,
    request: &IdempotentRequest,
) -> Result<Option<StoredAnswer>> {
    store.stored_answer(&request.key, clock.now()).await
}

/// The answer of the first request that was made under the same key, if any. What is asked for must have
/// been read.
///
/// # Errors
/// `IdempotencyKeyReused` if that was another request.
pub(super) async fn first_answer(
    store: &Store,
    clock: &Clock,
    request: &IdempotentRequest,
) -> Result<Option<String>> {
    let stored = stored_answer(store, clock, request).await?;
    stored.map(|stored| stored.to_request(&request.hasher.digest())).transpose()
}

/// The record of a request that has been read.
pub(super) fn record_of(request: &IdempotentRequest) -> IdempotencyRecord {
    IdempotencyRecord { key: request.key.clone(), digest: request.hasher.digest() }
}
