//! Which sign-ins the audit log records. It is of limited length, so nobody may fill it with their own.

use std::collections::HashMap;
use std::sync::{Mutex, PoisonError};

use jiff::{SignedDuration, Timestamp};

use crate::domain::Actor;

/// Sign-ins of one key or person that are recorded in an hour.
const RECORDED_PER_HOUR: u32 = 10;
const HOUR: SignedDuration = SignedDuration::from_hours(1);

/// The sign-ins of the hour that were recorded, by key or person.
#[derive(Default)]
pub(super) struct SignInLog(Mutex<HashMap<String, (Timestamp, u32)>>);

impl SignInLog {
    /// True if a sign-in is recorded; it is counted then.
    pub(super) fn takes(&self, actor: &Actor, now: Timestamp) -> bool {
        let mut counts = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        counts.retain(|_, (since, _)| now.duration_since(*since).abs() < HOUR);
        let holder =
            actor.key_id.map(|id| id.to_string()).or_else(|| actor.identity.as_deref().map(Into::into));
        let (_, count) = counts.entry(holder.unwrap_or_default()).or_insert((now, 0));
        *count = count.saturating_add(1);
        *count <= RECORDED_PER_HOUR
    }
}
