//! Sessions of browsers: a token in a cookie stands for a key, so that no page holds the key itself, or for a person who
//! has signed in by OpenID Connect. Nobody's sign-in ends the session of somebody else.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use base64::Engine as _;
use base64::engine::general_purpose::URL_SAFE_NO_PAD;
use jiff::{SignedDuration, Timestamp};

use super::caller::Principal;
use super::key_table::ActiveKey;
use super::signed_in_user::SignedInUser;
use crate::config::Limits;
use crate::domain::{Error, ErrorKind, Result, SecretDigest};
use crate::openid::Identity;

/// How long a session lasts.
pub const SESSION_TIME: SignedDuration = SignedDuration::from_hours(12);

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

/// Whom a session stands for.
enum Holder {
    Key(Arc<ActiveKey>),
    User(Arc<SignedInUser>),
}

impl Holder {
    fn is(&self, other: &Self) -> bool {
        match (self, other) {
            (Self::Key(one), Self::Key(other)) => one.key().id == other.key().id,
            (Self::User(one), Self::User(other)) => one.name() == other.name(),
            _ => false,
        }
    }
}

struct Session {
    digest: SecretDigest,
    holder: Holder,
    expires_at: Timestamp,
}

impl Session {
    fn is_valid_at(&self, now: Timestamp) -> bool {
        let is_over = matches!(&self.holder, Holder::Key(key) if key.has_ended());
        now < self.expires_at && !is_over
    }
}

/// A user's open requests end with the session; a key's end with the key.
impl Drop for Session {
    fn drop(&mut self) {
        if let Holder::User(user) = &self.holder {
            user.end();
        }
    }
}

/// The sessions of this process; a restart ends them.
#[derive(Default)]
pub(super) struct Sessions(Mutex<HashMap<u64, Session>>);

impl Sessions {
    fn lock(&self) -> MutexGuard<'_, HashMap<u64, Session>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// A session of the holder of a key.
    ///
    /// # Errors
    /// `Overloaded` if there are as many sessions as there may be.
    pub(super) fn start_for_key(
        &self,
        token: &SessionToken,
        key: Arc<ActiveKey>,
        now: Timestamp,
        limits: &Limits,
    ) -> Result<()> {
        self.start(token, Holder::Key(key), now, limits)
    }

    /// A session of a person; who they are to all requests that come with its token.
    ///
    /// # Errors
    /// As [`Sessions::start_for_key`].
    pub(super) fn start_for_user(
        &self,
        token: &SessionToken,
        identity: Identity,
        now: Timestamp,
        limits: &Limits,
    ) -> Result<Principal> {
        let user = Arc::new(SignedInUser::new(identity));
        self.start(token, Holder::User(user.clone()), now, limits)?;
        Ok(Principal::User(user))
    }

    fn start(&self, token: &SessionToken, holder: Holder, now: Timestamp, limits: &Limits) -> Result<()> {
        self.end_expired(now);
        let mut sessions = self.lock();
        let of_holder = sessions.iter().filter(|(_, session)| session.holder.is(&holder));
        let (count, oldest) = (of_holder.clone().count(), of_holder.min_by_key(|(_, it)| it.expires_at));
        // A person who signs in again and again is let in; what they have forgotten ends.
        if let Some(oldest) = oldest.map(|it| *it.0).filter(|_| count >= limits.sessions_per_key) {
            sessions.remove(&oldest);
        }
        if sessions.len() >= limits.sessions {
            let message = format!("there are {} sessions, the limit; try again later", limits.sessions);
            return Err(Error::refused(ErrorKind::Overloaded, message));
        }
        let digest = SecretDigest::of(token.0.as_bytes());
        let expires_at = now.saturating_add(SESSION_TIME).unwrap_or(Timestamp::MAX);
        sessions.insert(digest.bucket(), Session { digest, holder, expires_at });
        Ok(())
    }

    /// Whom a token stands for, who makes a request now.
    pub(super) fn principal_of(&self, token: &str, now: Timestamp) -> Option<Principal> {
        let digest = SecretDigest::of(token.as_bytes());
        let sessions = self.lock();
        let session = sessions.get(&digest.bucket())?;
        if session.digest != digest || !session.is_valid_at(now) {
            return None;
        }
        match &session.holder {
            Holder::Key(key) => key.use_at(now).then(|| Principal::Key(key.clone())),
            Holder::User(user) => Some(Principal::User(user.clone())),
        }
    }

    /// Ends the sessions whose time is over.
    pub(super) fn end_expired(&self, now: Timestamp) {
        self.lock().retain(|_, session| session.is_valid_at(now));
    }

    pub(super) fn end(&self, token: &str) {
        let digest = SecretDigest::of(token.as_bytes());
        let mut sessions = self.lock();
        if sessions.get(&digest.bucket()).is_some_and(|session| session.digest == digest) {
            sessions.remove(&digest.bucket());
        }
    }
}
