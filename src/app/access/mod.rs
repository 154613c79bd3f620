//! Who may do what: the one check for REST, gRPC, streams and pages alike.
//!
//! [`Access::authenticate`] makes a [`Principal`] of a credential, [`Caller::authorize`] compares it with the
//! [`Permission`] that an operation needs, and [`Caller::authorize_camera`] restricts devices to their
//! cameras. All of it is answered from memory. Does not know headers, status codes or TLS.

mod caller;
mod key_table;
mod permission;
mod sessions;
mod sign_in_log;
mod signed_in_user;

use std::borrow::Cow;
use std::sync::OnceLock;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use jiff::Timestamp;

use self::key_table::KeyTable;
use self::sessions::Sessions;
use self::sign_in_log::SignInLog;
use crate::clock::Clock;
use crate::config::Limits;
use crate::domain::{Actor, Error, ErrorKind, KeyId, KeySecret, Result};
use crate::openid::{Identity, Provider};
use crate::store::{KeysVersion, Store};

pub use caller::{Caller, CertificateHolder, Principal};
pub use key_table::ActiveKey;
pub use permission::Permission;
pub use sessions::{SESSION_TIME, SessionToken};
pub use signed_in_user::SignedInUser;

/// The credential that a client presents.
#[derive(Debug, Clone)]
pub enum Credential<'a> {
    /// No credential.
    None,
    /// A key's secret.
    Key(Cow<'a, str>),
    /// The token of a browser's session.
    Session(&'a str),
    /// A client certificate that was verified.
    Certificate(&'a CertificateHolder),
    /// Something that is none of these.
    Unreadable,
}

/// The keys and sessions of a server.
#[derive(Default)]
pub struct Access {
    keys: KeyTable,
    sessions: Sessions,
    sign_ins: SignInLog,
    /// Credentials are needed although no key exists, because there are client certificates.
    is_closed: AtomicBool,
    /// Where people sign in, if the settings say.
    openid: OnceLock<Provider>,
}

impl Access {
    /// Asks every client for a credential, even while no key exists.
    pub fn close(&self) {
        self.is_closed.store(true, Ordering::Relaxed);
    }

    /// Lets people sign in at a provider, and asks every client for a credential.
    pub fn use_openid(&self, provider: Provider) {
        if self.openid.set(provider).is_ok() {
            self.close();
        }
    }

    /// Where people sign in, if the settings say.
    #[must_use]
    pub fn openid(&self) -> Option<&Provider> {
        self.openid.get()
    }

    /// True if everybody may do everything, because no key was ever created.
    #[must_use]
    pub fn is_open(&self) -> bool {
        !self.is_closed.load(Ordering::Relaxed) && self.keys.is_empty()
    }

    /// Who presents a credential, at a time and a reading of the monotonic clock. While access is open, nobody is asked
    /// for one.
    ///
    /// # Errors
    /// `Unauthenticated` for a key that does not work, or a header that cannot be read; `Overloaded` while it is not
    /// known which keys work, or whether there are any.
    pub fn authenticate(
        &self,
        credential: Credential<'_>,
        now: Timestamp,
        monotonic: Duration,
    ) -> Result<Principal> {
        let is_open = self.is_open();
        // Only certificates, and sessions of people, do not depend on keys.
        if is_open || matches!(credential, Credential::Key(_)) {
            self.keys.check_confirmed(monotonic)?;
        }
        if is_open {
            return Ok(Principal::Everyone);
        }
        match credential {
            Credential::None => Ok(Principal::Anonymous),
            Credential::Certificate(holder) => Ok(Principal::Certificate(holder.clone())),
            Credential::Key(secret) => {
                let digest = KeySecret::parse(&secret)?.digest();
                self.keys.use_key(&digest, now).map(Principal::Key)
            }
            // A page whose session has ended must be able to sign in again.
            Credential::Session(token) => {
                let principal = self.sessions.principal_of(token, now).unwrap_or(Principal::Anonymous);
                if let Principal::Key(_) = principal {
                    self.keys.check_confirmed(monotonic)?;
                }
                Ok(principal)
            }
            Credential::Unreadable => Err(Error::refused(
                ErrorKind::Unauthenticated,
                "the header authorization must be `Bearer sf_...`, or `Basic ...` with the key as password, once",
            )),
        }
    }

    /// Checks that it is known which keys work, or that there is none.
    ///
    /// # Errors
    /// `Overloaded`.
    pub fn check_confirmed(&self, monotonic: Duration) -> Result<()> {
        self.keys.check_confirmed(monotonic)
    }

    /// Starts a session for the holder of a key.
    ///
    /// # Errors
    /// `Unauthenticated` for a key that does not work; `Overloaded`.
    pub(super) fn start_session(
        &self,
        secret: &str,
        token: &SessionToken,
        now: Timestamp,
        limits: &Limits,
    ) -> Result<Principal> {
        let key = self.keys.use_key(&KeySecret::parse(secret)?.digest(), now)?;
        self.sessions.start_for_key(token, key.clone(), now, limits)?;
        Ok(Principal::Key(key))
    }

    /// Starts a session for a person who has signed in.
    ///
    /// # Errors
    /// `Overloaded`.
    pub(super) fn start_user_session(
        &self,
        identity: Identity,
        token: &SessionToken,
        now: Timestamp,
        limits: &Limits,
    ) -> Result<Principal> {
        self.sessions.start_for_user(token, identity, now, limits)
    }

    /// True if the audit log records a sign-in; it is counted then.
    pub(super) fn records_sign_in(&self, actor: &Actor, now: Timestamp) -> bool {
        self.sign_ins.takes(actor, now)
    }

    /// Ends a session; nothing happens if there is none.
    pub fn end_session(&self, token: &str) {
        self.sessions.end(token);
    }

    /// Brings the keys up to date with the store, also after changes of another process, and ends what
    /// is open for keys that no longer work.
    ///
    /// # Errors
    /// A fault if the store cannot be read.
    pub async fn refresh(&self, store: &Store, clock: &Clock) -> Result<()> {
        let (now, began_at) = (clock.now(), clock.monotonic());
        self.sessions.end_expired(now);
        self.keys.refresh(store, now, began_at).await
    }

    /// True if the keys should be read again for a credential, at a reading of the monotonic clock: it is an unknown
    /// key, which another process may have created a moment ago. The keys are read at most ten times a second.
    pub fn is_worth_refresh(&self, credential: &Credential<'_>, monotonic: Duration) -> bool {
        let Credential::Key(secret) = credential else { return false };
        let Ok(secret) = KeySecret::parse(secret) else { return false };
        !self.is_open() && !self.keys.has(&secret.digest()) && self.keys.may_look(monotonic)
    }

    /// Lets keys count for a time only after each look at the store: other processes may revoke them there.
    pub(super) fn set_lease(&self, lease: Duration) {
        self.keys.set_lease(lease);
    }

    /// Notes which version of the keys a look at the store has found that began at this reading of the monotonic clock;
    /// whether it is that of the keys in memory.
    pub(super) fn confirm(&self, version: &KeysVersion, began_at: Duration) -> bool {
        self.keys.confirm(version, began_at)
    }

    /// Lets no key in until the next refresh, which reads all of them.
    pub(super) fn distrust(&self) {
        self.keys.distrust();
    }

    /// Stores when keys were used last.
    ///
    /// # Errors
    /// A fault if the store cannot be written.
    pub async fn store_last_uses(&self, store: &Store) -> Result<()> {
        let uses = self.keys.take_unstored_uses();
        if uses.is_empty() { Ok(()) } else { store.note_key_uses(&uses).await }
    }

    /// When a key was used last, as far as this process knows.
    #[must_use]
    pub(super) fn last_use(&self, id: KeyId) -> Option<Timestamp> {
        self.keys.last_use(id)
    }
}
