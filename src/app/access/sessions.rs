//! Sessions of browsers: a token in a cookie stands for a key, so that no page holds the key itself.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use base64::Engine as _;
use base64::engine::general_purpose::URL_SAFE_NO_PAD;
use jiff::{SignedDuration, Timestamp};

use super::key_table::ActiveKey;
use crate::domain::SecretDigest;

/// How long a session lasts.
pub const SESSION_TIME: SignedDuration = SignedDuration::from_hours(12);
/// Sessions at a time; beyond, the oldest ends.
const MAX_SESSIONS: usize = 1_000;

/// The secret of a session.
pub struct SessionToken(String);

impl SessionToken {
    /// A new token from a source of random bytes.
    pub(in crate::app) fn generate(fill_random: impl FnOnce(&mut [u8])) -> Self {
        let mut bytes = [0; 32];
        fill_random(&mut bytes);
        Self(URL_SAFE_NO_PAD.encode(bytes))
    }

    /// The text, for the cookie.
    #[must_use]
    pub fn reveal(&self) -> &str {
        &self.0
    }
}

struct Session {
    digest: SecretDigest,
    key: Arc<ActiveKey>,
    expires_at: Timestamp,
}

/// The sessions of this process; a restart ends them.
#[derive(Default)]
pub(super) struct Sessions(Mutex<HashMap<u64, Session>>);

impl Sessions {
    fn lock(&self) -> MutexGuard<'_, HashMap<u64, Session>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub(super) fn start(&self, token: &SessionToken, key: Arc<ActiveKey>, now: Timestamp) {
        let mut sessions = self.lock();
        sessions.retain(|_, session| session.expires_at > now && !session.key.has_ended());
        if sessions.len() >= MAX_SESSIONS {
            let oldest = sessions.iter().min_by_key(|(_, session)| session.expires_at).map(|it| *it.0);
            oldest.and_then(|oldest| sessions.remove(&oldest));
        }
        let digest = SecretDigest::of(token.0.as_bytes());
        let expires_at = now.saturating_add(SESSION_TIME).unwrap_or(Timestamp::MAX);
        sessions.insert(digest.bucket(), Session { digest, key, expires_at });
    }

    pub(super) fn key_of(&self, token: &str, now: Timestamp) -> Option<Arc<ActiveKey>> {
        let digest = SecretDigest::of(token.as_bytes());
        let sessions = self.lock();
        let session = sessions.get(&digest.bucket())?;
        (session.digest == digest && now < session.expires_at).then(|| session.key.clone())
    }

    pub(super) fn end(&self, token: &str) {
        let digest = SecretDigest::of(token.as_bytes());
        let mut sessions = self.lock();
        if sessions.get(&digest.bucket()).is_some_and(|session| session.digest == digest) {
            sessions.remove(&digest.bucket());
        }
    }
}
