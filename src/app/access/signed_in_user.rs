//! People who have signed in by OpenID Connect.

use std::sync::Arc;

use tokio_util::sync::CancellationToken;

use crate::domain::{Error, ErrorKind, Result, Scope};
use crate::openid::Identity;

/// A person who has signed in, until the session ends.
pub struct SignedInUser {
    name: Arc<str>,
    subject: Arc<str>,
    scope: Scope,
    ended: CancellationToken,
}

impl SignedInUser {
    pub(super) fn new(identity: Identity) -> Self {
        let name = format!("user {}", identity.name).into();
        Self {
            name,
            subject: identity.subject.into(),
            scope: identity.scope,
            ended: CancellationToken::new(),
        }
    }

    /// As the audit log names them.
    #[must_use]
    pub fn name(&self) -> Arc<str> {
        self.name.clone()
    }

    /// The same person in every session.
    #[must_use]
    pub fn subject(&self) -> Arc<str> {
        self.subject.clone()
    }

    /// Returns the scope of the user.
    #[must_use]
    pub const fn scope(&self) -> &Scope {
        &self.scope
    }

    pub(super) fn end(&self) {
        self.ended.cancel();
    }

    pub(super) fn check_active(&self) -> Result<()> {
        if self.ended.is_cancelled() { Err(session_ended()) } else { Ok(()) }
    }

    /// Waits until the session ends.
    pub(super) async fn ended(&self) -> Error {
        self.ended.cancelled().await;
        session_ended()
    }
}

fn session_ended() -> Error {
    Error::refused(ErrorKind::Unauthenticated, "the session has ended: sign in again")
}
