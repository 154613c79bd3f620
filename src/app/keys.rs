//! Keys: create, list, revoke; sessions of browsers.

use super::access::{Access, Principal, SessionToken};
use super::{App, Page, page_of};
use crate::domain::{ApiKey, Error, ErrorKind, KeyId, KeySecret, NewKey, Result, Role, Scope};
use crate::openid::{Provider, SignInSecret};

/// Name of the key that the settings give.
const ADMIN_KEY_NAME: &str = "admin key of the settings";

impl App {
    /// Creates a key. Its secret is not stored, so this is the only time that it is known.
    ///
    /// # Errors
    /// `InsufficientStorage` beyond the limit of keys.
    pub async fn create_key(&self, key: &NewKey) -> Result<(ApiKey, KeySecret)> {
        let secret = KeySecret::generate(|bytes| self.randomness.fill(bytes));
        Ok((self.store_key(key, &secret).await?, secret))
    }

    async fn store_key(&self, key: &NewKey, secret: &KeySecret) -> Result<ApiKey> {
        let now = self.clock.now();
        let id = KeyId(self.randomness.uuid_v7(now));
        let stored = self.store.insert_key(id, key, &secret.digest(), now).await?;
        self.access.refresh(&self.store, now).await?;
        Ok(stored)
    }

    /// Makes sure that a secret from the settings is the key of an administrator.
    ///
    /// # Errors
    /// `PermissionDenied` if that key was revoked, has expired or has another role.
    pub async fn ensure_admin_key(&self, secret: &KeySecret) -> Result<()> {
        match self.store.key_by_digest(&secret.digest()).await? {
            None => {
                let scope = Scope::new(Role::Admin, Vec::new())?;
                let key = NewKey { name: ADMIN_KEY_NAME.to_owned(), scope, expires_at: None };
                let stored = self.store_key(&key, secret).await?;
                tracing::info!(key.id = %stored.id, "stored the admin key of the settings");
                Ok(())
            }
            Some(key) if key.is_valid_at(self.clock.now()) && key.scope.role() == Role::Admin => Ok(()),
            Some(key) => Err(Error::refused(
                ErrorKind::PermissionDenied,
                format!(
                    "the admin key of the settings is key {}, which was revoked, has expired or has another \
                     role; give another one",
                    key.id
                ),
            )),
        }
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
        self.access.refresh(&self.store, now).await?;
        Ok(key)
    }

    /// Starts a session for the holder of a key.
    ///
    /// # Errors
    /// `Unauthenticated` for a key that does not work.
    pub fn start_session(&self, secret: &str) -> Result<(SessionToken, Principal)> {
        let token = SessionToken::generate(|bytes| self.randomness.fill(bytes));
        let principal = self.access.start_session(secret, &token, self.clock.now())?;
        Ok((token, principal))
    }

    /// Begins the sign-in of a person: a secret for their browser, and where it is sent.
    ///
    /// # Errors
    /// `RouteNotFound` where the settings name no provider; what
    /// [`Provider::authorization_url`] refuses.
    pub async fn begin_sign_in(&self) -> Result<(SignInSecret, String)> {
        let secret = SignInSecret::generate(|bytes| self.randomness.fill(bytes));
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
        let identity = self.openid()?.identity(secret, state, code, self.clock.now()).await?;
        tracing::info!(user = identity.name, role = %identity.scope.role(), "a person has signed in");
        let token = SessionToken::generate(|bytes| self.randomness.fill(bytes));
        self.access.start_user_session(identity, &token, self.clock.now());
        Ok(token)
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
