use super::*;
use crate::domain::{AuditAction, KeyId, KeySecret, NewKey, Role, Scope};

#[tokio::test]
async fn a_secret_that_several_store_at_once_is_one_key() {
    let fixture = Fixture::new().await;
    let scope = Scope::new(Role::Admin, Vec::new()).expect("all cameras");
    let key = NewKey { name: "of the settings".to_owned(), scope, expires_at: None };
    let secret = KeySecret::generate(|bytes| bytes.fill(7));
    let storing = (1..=6).map(|n| {
        let (store, key, digest) = (fixture.store.clone(), key.clone(), secret.digest());
        tokio::spawn(async move { store.insert_key(KeyId(Uuid::from_u128(n)), &key, &digest, at(1)).await })
    });
    let mut ids = Vec::new();
    for stored in storing.collect::<Vec<_>>() {
        ids.push(stored.await.expect("no panic").expect("stored once, and known to all").id);
    }
    ids.dedup();
    assert_eq!(ids.len(), 1, "{ids:?}");
    assert_eq!(fixture.store.keys(None, 9).await.expect("a page").len(), 1);
    let audit = fixture.store.audit_log(None, None, 9).await.expect("a page");
    assert_eq!(audit.iter().filter(|entry| entry.action == AuditAction::KeyCreated).count(), 1);
}
