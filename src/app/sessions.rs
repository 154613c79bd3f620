//! Sessions of browsers: sign-in by a key, or as a person at a provider of OpenID Connect.

use super::App;
use super::access::{Access, Caller, Principal, SessionToken};
use crate::admission::{ClientId, Lease, Quotas};
use crate::clock::{Clock, Randomness};
use crate::config::Limits;
use crate::domain::{Actor, Error, ErrorKind, Result};
use crate::openid::{Provider, SignInSecret};
use crate::store::Store;

/// The use cases of sessions of browsers.
#[derive(Clone, Copy)]
pub struct Sessions<'a> {
    store: &'a Store,
    access: &'a Access,
    clock: &'a Clock,
    randomness: &'a Randomness,
    limits: &'a Limits,
    quotas: &'a Quotas,
    caller: &'a Caller,
}

impl App {
    /// The use cases of sessions of browsers.
    #[must_use]
    pub fn sessions(&self) -> Sessions<'_> {
        Sessions {
            store: &self.store,
            access: &self.access,
            clock: &self.clock,
            randomness: &self.randomness,
            limits: &self.limits,
            quotas: &self.quotas,
            caller: &self.caller,
        }
    }
}

impl Sessions<'_> {
    /// Starts a session for the holder of a key.
    ///
    /// # Errors
    /// `Unauthenticated` for a key that does not work.
    pub async fn start(&self, secret: &str) -> Result<(SessionToken, Principal)> {
        let token = SessionToken::generate(|bytes| self.randomness.fill(bytes));
        let principal = self.access.start_session(secret, &token, self.clock.now(), self.limits)?;
        self.record_sign_in(principal.clone()).await;
        Ok((token, principal))
    }

    /// Records a sign-in in the audit log. Where the store takes no entry the person is let in all the same: they may
    /// come to mend the store.
    async fn record_sign_in(&self, principal: Principal) {
        let Actor { address, request_id, .. } = &**self.caller.actor();
        let caller = Caller::new(principal, *address, request_id.clone());
        let now = self.clock.now();
        if !self.access.records_sign_in(caller.actor(), now) {
            return;
        }
        if let Err(error) = self.store.on_behalf_of(caller.actor().clone()).record_sign_in(now).await {
            tracing::warn!(%error, "a sign-in is missing in the audit log");
        }
    }

    /// Begins the sign-in of a person: a secret for their browser, and where it is sent.
    ///
    /// # Errors
    /// `RouteNotFound` where the settings name no provider; what
    /// [`Provider::authorization_url`] refuses; `Overloaded` where too many wait for the provider.
    pub async fn begin_sign_in(&self) -> Result<(SignInSecret, String)> {
        let secret = SignInSecret::generate(|bytes| self.randomness.fill(bytes));
        let _turn = self.sign_in_turn()?;
        let url = self.openid()?.authorization_url(&secret, self.clock.now()).await?;
        Ok((secret, url))
    }

    /// Starts a session for a person who comes back from the provider with a code.
    ///
    /// # Errors
    /// As [`Sessions::begin_sign_in`]; what [`Provider::identity`] refuses.
    pub async fn finish_sign_in(
        &self,
        secret: &SignInSecret,
        state: &str,
        code: &str,
    ) -> Result<SessionToken> {
        let _turn = self.sign_in_turn()?;
        let identity = self.openid()?.identity(secret, state, code, self.clock.now()).await?;
        tracing::info!(user = identity.name, role = %identity.scope.role(), "a person has signed in");
        let token = SessionToken::generate(|bytes| self.randomness.fill(bytes));
        let principal = self.access.start_user_session(identity, &token, self.clock.now(), self.limits)?;
        self.record_sign_in(principal).await;
        Ok(token)
    }

    /// A place among the sign-ins that wait for the provider, of which one address has its share.
    fn sign_in_turn(&self) -> Result<Lease> {
        let client = self.caller.actor().address.map_or(ClientId::UNKNOWN, ClientId::from);
        self.quotas.sign_ins.try_acquire(client, 1)
    }

    fn openid(&self) -> Result<&Provider> {
        let missing = || Error::refused(ErrorKind::RouteNotFound, "sign-in by OpenID Connect is not set up");
        self.access.openid().ok_or_else(missing)
    }
}
