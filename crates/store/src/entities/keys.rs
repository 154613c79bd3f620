//! Keys that clients present: digests, scopes, last use, revocation.

use jiff::Timestamp;

use crate::database::Database;
use crate::domain::{ApiKey, AuditAction, CameraId, Error, KeyId, NewKey, Result, SecretDigest};
use crate::locks::{Limit, lock_limit};
use crate::query::{Session, query, query_scalar};
use crate::refusals::no_key;
use crate::rows::audit::Change;
use crate::rows::keys::{KeysVersion, check_limit, read_key, select_keys as select};
use crate::statements::versions::keys_version;

impl Database {
    pub(crate) async fn insert_key(
        &self,
        id: KeyId,
        key: &NewKey,
        digest: &SecretDigest,
        now: Timestamp,
    ) -> Result<ApiKey> {
        let mut writer = self.growing().await?;
        let mut transaction = writer.begin().await?;
        lock_limit(&mut transaction, Limit::Keys).await?;
        if let Some(known) = find_by_digest(&mut transaction, digest).await? {
            return Ok(known);
        }
        make_room(&mut transaction, self.limits().keys, now).await?;
        let cameras: Vec<&str> = key.scope.cameras().iter().map(CameraId::as_str).collect();
        query(
            "INSERT INTO api_keys (id, name, role, cameras, sha256, created_at_us, expires_at_us) \
             VALUES ($1, $2, $3, $4, $5, $6, $7)",
        )
        .bind(id.to_string())
        .bind(&key.name)
        .bind(key.scope.role().as_str())
        .bind(serde_json::to_string(&cameras).map_err(Error::fault)?)
        .bind(digest.as_bytes().as_slice())
        .bind(now.as_microsecond())
        .bind(key.expires_at.map(Timestamp::as_microsecond))
        .execute(&mut transaction)
        .await?;
        let subject = format!("{id} {} {}", key.scope.role(), key.name);
        self.record(&mut transaction, Change::of(AuditAction::KeyCreated, subject), now).await?;
        transaction.commit().await?;
        self.key(id).await
    }

    pub(crate) async fn key(&self, id: KeyId) -> Result<ApiKey> {
        let mut reader = self.reader().await?;
        let row = query(select!("WHERE id = $1")).bind(id.to_string()).fetch_optional(&mut reader).await?;
        Ok(read_key(&row.ok_or_else(|| no_key(id))?)?.0)
    }

    pub(crate) async fn keys(&self, before: Option<KeyId>, limit: u32) -> Result<Vec<ApiKey>> {
        let mut reader = self.reader().await?;
        let rows = query(select!("WHERE id < $1 ORDER BY id DESC LIMIT $2"))
            // "~" sorts after all UUIDs.
            .bind(before.map_or_else(|| "~".to_owned(), |id| id.to_string()))
            .bind(limit)
            .fetch_all(&mut reader)
            .await?;
        rows.iter().map(|row| Ok(read_key(row)?.0)).collect()
    }

    pub(crate) async fn unrevoked_keys(&self) -> Result<Vec<(ApiKey, SecretDigest)>> {
        let mut reader = self.reader().await?;
        let rows = query(select!("WHERE revoked_at_us IS NULL")).fetch_all(&mut reader).await?;
        rows.iter().map(read_key).collect()
    }

    pub(crate) async fn key_by_digest(&self, digest: &SecretDigest) -> Result<Option<ApiKey>> {
        find_by_digest(&mut self.reader().await?, digest).await
    }

    pub(crate) async fn keys_version(&self) -> Result<KeysVersion> {
        keys_version(&mut self.reader().await?).await
    }

    pub(crate) async fn revoke_key(&self, id: KeyId, now: Timestamp) -> Result<ApiKey> {
        let mut writer = self.synced().await?;
        let mut transaction = writer.begin().await?;
        let revoked: Option<String> = query_scalar(
            "UPDATE api_keys SET revoked_at_us = $1 WHERE id = $2 AND revoked_at_us IS NULL RETURNING name",
        )
        .bind(now.as_microsecond())
        .bind(id.to_string())
        .fetch_optional(&mut transaction)
        .await?;
        if let Some(name) = revoked {
            let change = Change::of(AuditAction::KeyRevoked, format!("{id} {name}"));
            self.record(&mut transaction, change, now).await?;
        }
        transaction.commit().await?;
        self.key(id).await
    }

    pub(crate) async fn record_sign_in(&self, now: Timestamp) -> Result<()> {
        let mut writer = self.relaxed().await?;
        let mut transaction = writer.begin().await?;
        self.record(&mut transaction, Change::of(AuditAction::SignedIn, "session".to_owned()), now).await?;
        transaction.commit().await
    }

    pub(crate) async fn note_key_uses(&self, uses: &[(KeyId, Timestamp)]) -> Result<()> {
        let mut writer = self.relaxed().await?;
        let mut transaction = writer.begin().await?;
        // In one order everywhere, or two nodes could wait for each other.
        let mut uses = uses.to_vec();
        uses.sort_by_key(|(id, _)| id.to_string());
        for (id, used_at) in uses {
            query("UPDATE api_keys SET last_used_at_us = $1 WHERE id = $2 AND coalesce(last_used_at_us, 0) < $1")
                .bind(used_at.as_microsecond())
                .bind(id.to_string())
                .execute(&mut transaction).await?;
        }
        transaction.commit().await
    }
}

async fn find_by_digest(session: &mut dyn Session, digest: &SecretDigest) -> Result<Option<ApiKey>> {
    let row = query(select!("WHERE sha256 = $1"))
        .bind(digest.as_bytes().as_slice())
        .fetch_optional(session)
        .await?;
    row.map(|row| Ok(read_key(&row)?.0)).transpose()
}

async fn make_room(session: &mut dyn Session, limit: u32, now: Timestamp) -> Result<()> {
    let excess = count(session).await? + 1 - i64::from(limit);
    query(
        "DELETE FROM api_keys WHERE id IN (SELECT id FROM api_keys \
         WHERE revoked_at_us IS NOT NULL OR expires_at_us <= $1 ORDER BY id LIMIT $2)",
    )
    .bind(now.as_microsecond())
    .bind(excess.max(0))
    .execute(session)
    .await?;
    check_limit(count(session).await?, limit)
}

async fn count(session: &mut dyn Session) -> Result<i64> {
    query_scalar("SELECT count(*) FROM api_keys").fetch_one(session).await
}
