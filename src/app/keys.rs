//! Keys: create, list, revoke.

use super::access::{Access, Caller, Principal};
use super::{App, Page, page_of};
use crate::clock::{Clock, Randomness};
use crate::domain::{ApiKey, Error, ErrorKind, KeyId, KeySecret, NewKey, Result, Role, Scope};
use crate::store::Store;

/// Name of the key that the settings give.
const ADMIN_KEY_NAME: &str = "admin key of the settings";

/// The use cases of keys.
#[derive(Clone, Copy)]
pub struct Keys<'a> {
    store: &'a Store,
    access: &'a Access,
    clock: &'a Clock,
    randomness: &'a Randomness,
    caller: &'a Caller,
}

impl App {
    /// The use cases of keys.
    #[must_use]
    pub fn keys(&self) -> Keys<'_> {
        Keys {
            store: &self.store,
            access: &self.access,
            clock: &self.clock,
            randomness: &self.randomness,
            caller: &self.caller,
        }
    }
}

impl Keys<'_> {
    /// Creates a key. Its secret is not stored, so this is the only time that it is known.
    ///
    /// # Errors
    /// `InsufficientStorage` beyond the limit of keys; `Unauthenticated` for everybody once a key exists.
    pub async fn create(&self, key: &NewKey) -> Result<(ApiKey, KeySecret)> {
        if let Principal::Everyone = self.caller.principal() {
            // Another process may have created the first key a moment ago.
            self.access.refresh(self.store, self.clock).await?;
            if !self.access.is_open() {
                let message = "a key was created a moment ago: from now on every request needs one";
                return Err(Error::refused(ErrorKind::Unauthenticated, message));
            }
        }
        let secret = KeySecret::generate(|bytes| self.randomness.fill(bytes));
        let stored = self.store_new(key, &secret).await?;
        self.access.refresh(self.store, self.clock).await?;
        Ok((stored, secret))
    }

    async fn store_new(&self, key: &NewKey, secret: &KeySecret) -> Result<ApiKey> {
        let now = self.clock.now();
        let id = KeyId(self.randomness.uuid_v7(now));
        self.store.insert_key(id, key, &secret.digest(), now).await
    }

    /// Makes sure that a secret from the settings is the key of an administrator, which works here when this returns,
    /// also where another process has stored it meanwhile.
    ///
    /// # Errors
    /// `PermissionDenied` if that key was revoked, has expired or has another role.
    pub async fn ensure_admin(&self, secret: &KeySecret) -> Result<()> {
        let key = match self.store.key_by_digest(&secret.digest()).await? {
            Some(key) => key,
            None => {
                let scope = Scope::new(Role::Admin, Vec::new())?;
                let key = NewKey { name: ADMIN_KEY_NAME.to_owned(), scope, expires_at: None };
                let stored = self.store_new(&key, secret).await?;
                tracing::info!(key.id = %stored.id, "stored the admin key of the settings");
                stored
            }
        };
        self.access.refresh(self.store, self.clock).await?;
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
    pub async fn get(&self, id: KeyId) -> Result<ApiKey> {
        Ok(with_last_use(self.access, self.store.key(id).await?))
    }

    /// All keys, also those that no longer work, newest first, after a cursor.
    ///
    /// # Errors
    /// A fault of the store.
    pub async fn list(&self, before: Option<KeyId>, limit: u32) -> Result<Page<ApiKey, KeyId>> {
        let keys = self.store.keys(before, limit + 1).await?;
        let keys = keys.into_iter().map(|key| with_last_use(self.access, key)).collect();
        Ok(page_of(keys, limit, |key: &ApiKey| key.id))
    }

    /// Revokes a key at once: its open streams and sessions end, here now and in other processes on the
    /// same data folder within two seconds.
    ///
    /// # Errors
    /// `KeyNotFound`.
    pub async fn revoke(&self, id: KeyId) -> Result<ApiKey> {
        let now = self.clock.now();
        // Its last use is known in memory, which forgets the key now.
        self.access.store_last_uses(self.store).await?;
        let key = self.store.revoke_key(id, now).await?;
        self.access.refresh(self.store, self.clock).await?;
        Ok(key)
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
    use crate::config::Limits;
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
        first.keys().ensure_admin(&secret).await.expect("stored");
        assert!(second.access.is_open(), "as far as it has looked");
        second.keys().ensure_admin(&secret).await.expect("it is an admin's");
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
        everyone(&first).keys().create(&key).await.expect("the first");
        let refused = everyone(&second).keys().create(&key).await.expect_err("no longer open");
        assert_eq!(refused.kind(), ErrorKind::Unauthenticated);
    }
}
