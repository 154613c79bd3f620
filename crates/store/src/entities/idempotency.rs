//! Answers of changes that clients may repeat.

use jiff::Timestamp;

use crate::database::Database;
use crate::domain::{IdempotencyKey, Result};
use crate::rows::idempotency::StoredAnswer;
use crate::statements::idempotency::find_answer;

impl Database {
    pub(crate) async fn stored_answer(
        &self,
        key: &IdempotencyKey,
        now: Timestamp,
    ) -> Result<Option<StoredAnswer>> {
        let mut reader = self.reader().await?;
        find_answer(&mut reader, self.limits(), (&self.actor, key), now).await
    }
}
