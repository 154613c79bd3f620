//! Sites.

use jiff::Timestamp;

use crate::database::Database;
use crate::domain::{AuditAction, Error, ExpectedVersion, NewSite, Result, Revision, Site, SiteId, SiteKey};
use crate::locks::{Limit, lock_limit};
use crate::query::{Query, RowLock, Session, query, query_scalar};
use crate::refusals::no_site;
use crate::row_decoder::RowDecoder;
use crate::row_decoder::StoredRow;
use crate::rows::audit::Change;
use crate::rows::history::StoredHistory;
use crate::rows::sites::{
    check_limit, check_unused, check_version, read_site, site_columns as columns, site_exists,
};

/// The version that a change of a site is based on, if the caller states it.
type Expected = Option<ExpectedVersion<SiteKey>>;

impl Database {
    pub(crate) async fn insert_site(&self, profile: &NewSite, now: Timestamp) -> Result<Site> {
        let mut writer = self.growing().await?;
        let mut transaction = writer.begin().await?;
        lock_limit(&mut transaction, Limit::Sites).await?;
        let insert = query(concat!(
            "INSERT INTO sites (display_name, labels, origin_longitude_deg, origin_latitude_deg, history, \
             updated_at_us, id, created_at_us, revision) VALUES ($1, $2, $3, $4, $5, $6, $7, $8, 1) \
             ON CONFLICT (id) DO NOTHING RETURNING ",
            columns!()
        ));
        let row = bind_profile(insert, profile, now)?
            .bind(profile.id.as_str().to_owned())
            .bind(now.as_microsecond())
            .fetch_optional(&mut transaction)
            .await?;
        let site = read_site(&row.ok_or_else(|| site_exists(&profile.id))?)?;
        check_limit(count(&mut transaction).await?, self.limits().sites)?;
        self.record_site(&mut transaction, AuditAction::SiteCreated, &site, now).await?;
        transaction.commit().await?;
        Ok(site)
    }

    pub(crate) async fn site(&self, id: &SiteId) -> Result<Site> {
        let mut reader = self.reader().await?;
        find_site(&mut reader, id).await
    }

    pub(crate) async fn sites(&self, after: Option<&SiteId>, limit: u32) -> Result<Vec<Site>> {
        let mut reader = self.reader().await?;
        let page = concat!("SELECT ", columns!(), " FROM sites WHERE id > $1 ORDER BY id LIMIT $2");
        let rows = query(page)
            .bind(after.map_or("", SiteId::as_str).to_owned())
            .bind(limit)
            .fetch_all(&mut reader)
            .await?;
        rows.iter().map(read_site).collect()
    }

    pub(crate) async fn site_versions(&self) -> Result<Vec<(SiteId, SiteKey, Revision)>> {
        let mut reader = self.reader().await?;
        let rows = query("SELECT id, key, revision FROM sites").fetch_all(&mut reader).await?;
        let read = |row| {
            let mut fields = RowDecoder::new("sites", row);
            let id = fields.parse(SiteId::new)?;
            let key = SiteKey(fields.get()?);
            Ok((id, key, fields.revision()?))
        };
        rows.iter().map(read).collect()
    }

    pub(crate) async fn replace_site(
        &self,
        profile: &NewSite,
        expected: Expected,
        now: Timestamp,
    ) -> Result<Site> {
        let mut writer = self.synced().await?;
        let mut transaction = writer.begin().await?;
        lock_site(&mut transaction, &profile.id).await?;
        check_version(&find_site(&mut transaction, &profile.id).await?, expected)?;
        let update = query(concat!(
            "UPDATE sites SET display_name = $1, labels = $2, origin_longitude_deg = $3, \
             origin_latitude_deg = $4, history = $5, updated_at_us = $6, revision = revision + 1 WHERE id = $7 RETURNING ",
            columns!()
        ));
        let row = bind_profile(update, profile, now)?
            .bind(profile.id.as_str().to_owned())
            .fetch_one(&mut transaction)
            .await?;
        let site = read_site(&row)?;
        self.record_site(&mut transaction, AuditAction::SiteChanged, &site, now).await?;
        transaction.commit().await?;
        Ok(site)
    }

    pub(crate) async fn delete_site(&self, id: &SiteId, expected: Expected, now: Timestamp) -> Result<()> {
        let mut writer = self.deletion().await?;
        let mut transaction = writer.begin().await?;
        lock_site(&mut transaction, id).await?;
        let site = find_site(&mut transaction, id).await?;
        check_version(&site, expected)?;
        check_unused(&site)?;
        query("DELETE FROM sites WHERE id = $1").bind(id.as_str()).execute(&mut transaction).await?;
        self.record_site(&mut transaction, AuditAction::SiteDeleted, &site, now).await?;
        transaction.commit().await?;
        writer.reclaim().await;
        Ok(())
    }

    async fn record_site(
        &self,
        session: &mut dyn Session,
        action: AuditAction,
        site: &Site,
        now: Timestamp,
    ) -> Result<()> {
        let subject = match action {
            AuditAction::SiteChanged => format!("site {}, revision {}", site.id(), site.revision.0),
            _ => format!("site {}", site.id()),
        };
        self.record(session, Change::of(action, subject), now).await
    }
}

async fn count(session: &mut dyn Session) -> Result<i64> {
    query_scalar("SELECT count(*) FROM sites").fetch_one(session).await
}

/// Waits until no other transaction changes the site, or gives it to a camera.
async fn lock_site(session: &mut dyn Session, id: &SiteId) -> Result<()> {
    query("SELECT key FROM sites WHERE id = $1")
        .locking(RowLock::Update)
        .bind(id.as_str())
        .execute(session)
        .await?;
    Ok(())
}

async fn find_site(session: &mut dyn Session, id: &SiteId) -> Result<Site> {
    let row = query(concat!("SELECT ", columns!(), " FROM sites WHERE id = $1"))
        .bind(id.as_str())
        .fetch_optional(session)
        .await?;
    read_site(&row.ok_or_else(|| no_site(id))?)
}

/// Binds the changeable columns in the order that INSERT and UPDATE share.
fn bind_profile(query: Query<StoredRow>, profile: &NewSite, now: Timestamp) -> Result<Query<StoredRow>> {
    let history = profile.history.map(|it| serde_json::to_string(&StoredHistory::from(it))).transpose();
    Ok(query
        .bind(profile.display_name.clone())
        .bind(serde_json::to_string(&profile.labels).map_err(Error::fault)?)
        .bind(profile.origin.map(|origin| origin.longitude_deg()))
        .bind(profile.origin.map(|origin| origin.latitude_deg()))
        .bind(history.map_err(Error::fault)?)
        .bind(now.as_microsecond()))
}
