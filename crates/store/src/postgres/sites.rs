//! Sites.

use jiff::Timestamp;
use sqlx::postgres::PgArguments;
use sqlx::{PgConnection, Postgres};

use super::Store;
use super::errors::failed;
use super::locks::{Limit, lock_limit};
use crate::domain::{AuditAction, Error, ExpectedVersion, NewSite, Result, Revision, Site, SiteId, SiteKey};
use crate::refusals::no_site;
use crate::row_decoder::RowDecoder;
use crate::rows::audit::Change;
use crate::rows::sites::{
    check_limit, check_unused, check_version, read_site, site_columns as columns, site_exists,
};

type Query = sqlx::query::Query<'static, Postgres, PgArguments>;
/// What a change of a site is based on, if the caller states it.
type Expected = Option<ExpectedVersion<SiteKey>>;

impl Store {
    pub(crate) async fn insert_site(&self, profile: &NewSite, now: Timestamp) -> Result<Site> {
        let mut transaction = self.writer().await?;
        lock_limit(&mut transaction, Limit::Sites).await?;
        let insert = sqlx::query(concat!(
            "INSERT INTO sites (display_name, labels, origin_longitude_deg, origin_latitude_deg, \
             updated_at_us, id, created_at_us, revision) VALUES ($1, $2, $3, $4, $5, $6, $7, 1) \
             ON CONFLICT (id) DO NOTHING RETURNING ",
            columns!()
        ));
        let row = bind_profile(insert, profile, now)?
            .bind(profile.id.as_str().to_owned())
            .bind(now.as_microsecond())
            .fetch_optional(&mut *transaction)
            .await
            .map_err(failed)?;
        let site = read_site(&row.ok_or_else(|| site_exists(&profile.id))?)?;
        check_limit(count(&mut transaction).await?, self.limits().sites)?;
        self.record_site(&mut transaction, AuditAction::SiteCreated, &site, now).await?;
        transaction.commit().await.map_err(failed)?;
        Ok(site)
    }

    pub(crate) async fn site(&self, id: &SiteId) -> Result<Site> {
        let mut reader = self.reader().await?;
        find_site(&mut reader, id).await
    }

    pub(crate) async fn sites(&self, after: Option<&SiteId>, limit: u32) -> Result<Vec<Site>> {
        let mut reader = self.reader().await?;
        let page = concat!("SELECT ", columns!(), " FROM sites WHERE id > $1 ORDER BY id LIMIT $2");
        let rows = sqlx::query(page)
            .bind(after.map_or("", SiteId::as_str).to_owned())
            .bind(i64::from(limit))
            .fetch_all(&mut *reader)
            .await
            .map_err(failed)?;
        rows.iter().map(read_site).collect()
    }

    pub(crate) async fn site_versions(&self) -> Result<Vec<(SiteId, SiteKey, Revision)>> {
        let mut reader = self.reader().await?;
        let rows = sqlx::query("SELECT id, key, revision FROM sites")
            .fetch_all(&mut *reader)
            .await
            .map_err(failed)?;
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
        let mut transaction = self.writer().await?;
        lock_site(&mut transaction, &profile.id).await?;
        check_version(&find_site(&mut transaction, &profile.id).await?, expected)?;
        let update = sqlx::query(concat!(
            "UPDATE sites SET display_name = $1, labels = $2, origin_longitude_deg = $3, \
             origin_latitude_deg = $4, updated_at_us = $5, revision = revision + 1 WHERE id = $6 RETURNING ",
            columns!()
        ));
        let row = bind_profile(update, profile, now)?
            .bind(profile.id.as_str().to_owned())
            .fetch_one(&mut *transaction)
            .await
            .map_err(failed)?;
        let site = read_site(&row)?;
        self.record_site(&mut transaction, AuditAction::SiteChanged, &site, now).await?;
        transaction.commit().await.map_err(failed)?;
        Ok(site)
    }

    pub(crate) async fn delete_site(&self, id: &SiteId, expected: Expected, now: Timestamp) -> Result<()> {
        let mut transaction = self.writer().await?;
        lock_site(&mut transaction, id).await?;
        let site = find_site(&mut transaction, id).await?;
        check_version(&site, expected)?;
        check_unused(&site)?;
        sqlx::query("DELETE FROM sites WHERE id = $1")
            .bind(id.as_str())
            .execute(&mut *transaction)
            .await
            .map_err(failed)?;
        self.record_site(&mut transaction, AuditAction::SiteDeleted, &site, now).await?;
        transaction.commit().await.map_err(failed)?;
        Ok(())
    }

    async fn record_site(
        &self,
        transaction: &mut PgConnection,
        action: AuditAction,
        site: &Site,
        now: Timestamp,
    ) -> Result<()> {
        let subject = match action {
            AuditAction::SiteChanged => format!("site {}, revision {}", site.id(), site.revision.0),
            _ => format!("site {}", site.id()),
        };
        self.record(transaction, Change::of(action, subject), now).await
    }
}

async fn count(connection: &mut PgConnection) -> Result<i64> {
    sqlx::query_scalar("SELECT count(*) FROM sites").fetch_one(connection).await.map_err(failed)
}

/// Waits until no other transaction changes the site, or gives it to a camera.
async fn lock_site(connection: &mut PgConnection, id: &SiteId) -> Result<()> {
    sqlx::query("SELECT key FROM sites WHERE id = $1 FOR UPDATE")
        .bind(id.as_str())
        .execute(connection)
        .await
        .map_err(failed)?;
    Ok(())
}

async fn find_site(connection: &mut PgConnection, id: &SiteId) -> Result<Site> {
    let row = sqlx::query(concat!("SELECT ", columns!(), " FROM sites WHERE id = $1"))
        .bind(id.as_str())
        .fetch_optional(connection)
        .await
        .map_err(failed)?;
    read_site(&row.ok_or_else(|| no_site(id))?)
}

/// Binds the changeable columns in the order that INSERT and UPDATE share.
fn bind_profile(query: Query, profile: &NewSite, now: Timestamp) -> Result<Query> {
    Ok(query
        .bind(profile.display_name.clone())
        .bind(serde_json::to_string(&profile.labels).map_err(Error::fault)?)
        .bind(profile.origin.map(|origin| origin.longitude_deg()))
        .bind(profile.origin.map(|origin| origin.latitude_deg()))
        .bind(now.as_microsecond()))
}
