//! Keys: create, list, revoke; sessions of browsers.

use super::access::{Access, Caller, Principal, SessionToken};
use super::{App, Page, page_of};
use crate::admission::{ClientId, Lease};
use crate::domain::{Actor, ApiKey, Error, ErrorKind, KeyId, KeySecret, NewKey, Result, Role, Scope};
use crate::openid::{Provider, SignInSecret};

/// Name of the key that the settings give.
const ADMIN_KEY_NAME: &str = "admin key of the settings";

impl App {
    /// Creates a key. Its secret is not stored, so this is the only time that it is known.
    ///
    /// # Errors
    /// `InsufficientStorage` beyond the limit of keys; `Unauthenticated` for everybody once a key exists.
    pub async fn create_key(&self, key: &NewKey) -> Result<(ApiKey, KeySecret)> {
        if let Principal::Everyone = self.caller.principal() {
            // Another process may have created the first key a moment ago.
            self.access.refresh(&self.store, &self.clock).await?;
            if !self.access.is_open() {
                let message = "a key was created a moment ago: from now on every request needs one";
                return Err(Error::refused(ErrorKind::Unauthenticated, message));
            }
        }
        let secret = KeySecret::generate(|bytes| self.randomness.fill(bytes));
        let stored = self.store_key(key, &secret).await?;
        self.access.refresh(&self.store, &self.clock).await?;
        Ok((stored, secret))
    }

    async fn store_key(&self, key: &NewKey, secret: &KeySecret) -> Result<ApiKey> {
        let now = self.clock.now();
        let id = KeyId(self.randomness.uuid_v7(now));
        self.store.insert_key(id, key, &secret.digest(), now).await
    }

    /// Makes sure that a secret from the settings is the key of an administrator, which works here when this returns,
    /// also where another process has stored it meanwhile.
    ///
    /// # Errors
    /// `PermissionDenied` if that key was revoked, has expired or has another role.
    pub async fn ensure_admin_key(&self, secret: &KeySecret) -> Result<()> {
        let key = match self.store.key_by_digest(&secret.digest()).await? {
            Some(key) => key,
            None => {
                let scope = Scope::new(Role::Admin, Vec::new())?;
                let key = NewKey { name: ADMIN_KEY_NAME.to_owned(), scope, expires_at: None };
                let stored = self.store_key(&key, secret).await?;
                tracing::info!(key.id = %stored.id, "stored the admin key of the settings");
                stored
            }
        };
        self.access.refresh(&self.store, &self.clock).await?;
        if key.is_valid_at(self.clock.now()) && key.scope.role() == Role::Admin {
            return Ok(());
        }
        let message = format!(
            "the admin key of the settings is key {}, which was revoked, has expired or has another role; give another one",
            key.id
        );
        Err(Error::refused(ErrorKind::PermissionDenied, message))
    }

    /// One key.
    ///
    /// # Errors
    /// `KeyNotFound`.
    pub async fn key(&self, id: KeyId) -> Result<ApiKey> {
        Ok(with_last_use(&self.access, self.store.key(id).await?))
    }

    /// All keys, also those that no longer work, newest first, after a cursor.
    ///
    /// # Errors
    /// A fault of the store.
    pub async fn keys(&self, before: Option<KeyId>, limit: u32) -> Result<Page<ApiKey, KeyId>> {
        let keys = self.store.keys(before, limit + 1).await?;
        let keys = keys.into_iter().map(|key| with_last_use(&self.access, key)).collect();
        Ok(page_of(keys, limit, |key: &ApiKey| key.id))
    }

    /// Revokes a key at once: its open streams and sessions end, here now and in other processes on the
    /// same data folder within two seconds.
    ///
    /// # Errors
    /// `KeyNotFound`.
    pub async fn revoke_key(&self, id: KeyId) -> Result<ApiKey> {
        let now = self.clock.now();
        // Its last use is known in memory, which forgets the key now.
        self.access.store_last_uses(&self.store).await?;
        let key = self.store.revoke_key(id, now).await?;
        self.access.refresh(&self.store, &self.clock).await?;
        Ok(key)
    }

    /// Starts a session for the holder of a key.
    ///
    /// # Errors
    /// `Unauthenticated` for a key that does not work.
    pub async fn start_session(&self, secret: &str) -> Result<(SessionToken, Principal)> {
        let token = SessionToken::generate(|bytes| self.randomness.fill(bytes));
        let principal = self.access.start_session(secret, &token, self.clock.now(), &self.limits)?;
        self.record_sign_in(principal.clone()).await;
        Ok((token, principal))
    }

    /// Records a sign-in in the audit log. Where the store takes no entry the person is let in all the same: they may
    /// come to mend the store.
    async fn record_sign_in(&self, principal: Principal) {
        let Actor { address, request_id, .. } = &**self.caller().actor();
        let caller = Caller::new(principal, *address, request_id.clone());
        let now = self.clock.now();
        if !self.access.records_sign_in(caller.actor(), now) {
            return;
        }
        if let Err(error) = self.on_behalf_of(caller).store.record_sign_in(now).await {
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
    /// As [`App::begin_sign_in`]; what [`Provider::identity`] refuses.
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
        let principal = self.access.start_user_session(identity, &token, self.clock.now(), &self.limits)?;
        self.record_sign_in(principal).await;
        Ok(token)
    }

    /// A place among the sign-ins that wait for the provider, of which one address has its share.
    fn sign_in_turn(&self) -> Result<Lease> {
        let client = self.caller().actor().address.map_or(ClientId::UNKNOWN, ClientId::from);
        self.quotas.sign_ins.try_acquire(client, 1)
    }

    fn openid(&self) -> Result<&Provider> {
        let missing = || Error::refused(ErrorKind::RouteNotFound, "sign-in by OpenID Connect is not set up");
        self.access.openid().ok_or_else(missing)
    }
}

/// Uses are stored lazily, so memory knows better.
fn with_last_use(access: &Access, key: ApiKey) -> ApiKey {
    let last_used_at = access.last_use(key.id).max(key.last_used_at);
    ApiKey { last_used_at, ..key }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::app::access::Caller;
    use crate::clock::{Clock, Randomness};
    use crate::config::Limits;
    use crate::store::Store;
    use crate::telemetry::Metrics;

    async fn app(folder: &std::path::Path) -> App {
        let store = Store::open(folder).await.expect("opens");
        let (clock, randomness) = (Clock::system(), Randomness::system());
        App::new(store, clock, randomness, Limits::default(), Metrics::new()).await.expect("an application")
    }

    /// If two nodes start at once with one admin key, the second has looked for keys before the first stored it.
    #[tokio::test]
    async fn an_admin_key_that_another_process_has_stored_closes_access_here_too() {
        let folder = tempfile::tempdir().expect("a folder");
        let (first, second) = (app(folder.path()).await, app(folder.path()).await);
        let secret = KeySecret::generate(|bytes| bytes.fill(7));
        first.ensure_admin_key(&secret).await.expect("stored");
        assert!(second.access.is_open(), "as far as it has looked");
        second.ensure_admin_key(&secret).await.expect("it is an admin's");
        assert!(!second.access.is_open());
    }

    /// Everybody may create the first key, and no other one.
    #[tokio::test]
    async fn nobody_without_a_key_creates_one_after_another_process_has_created_the_first() {
        let folder = tempfile::tempdir().expect("a folder");
        let (first, second) = (app(folder.path()).await, app(folder.path()).await);
        let scope = Scope::new(Role::Admin, Vec::new()).expect("all cameras");
        let key = NewKey { name: "mine".to_owned(), scope, expires_at: None };
        let everyone = |app: &App| app.on_behalf_of(Caller::new(Principal::Everyone, None, None));
        everyone(&first).create_key(&key).await.expect("the first");
        let refused = everyone(&second).create_key(&key).await.expect_err("no longer open");
        assert_eq!(refused.kind(), ErrorKind::Unauthenticated);
    }
}
