//! Sites.

use std::collections::BTreeMap;

use jiff::Timestamp;
use sqlx::sqlite::{SqliteArguments, SqliteRow};
use sqlx::{Sqlite, SqliteConnection, SqliteExecutor};

use super::Store;
use super::audit::Change;
use super::errors::{failed, no_site};
use super::row_decoder::RowDecoder;
use crate::domain::{
    AuditAction, Error, ErrorKind, ExpectedVersion, NewSite, Result, Revision, Site, SiteId, SiteKey,
};
use crate::geo::Position;

macro_rules! columns {
    () => {
        "key, id, display_name, labels, origin_longitude_deg, origin_latitude_deg, revision, created_at_us, \
         updated_at_us, (SELECT count(*) FROM cameras WHERE site_key = sites.key) AS cameras"
    };
}

type Query = sqlx::query::Query<'static, Sqlite, SqliteArguments>;
/// What a change of a site is based on, if the caller states it.
type Expected = Option<ExpectedVersion<SiteKey>>;

impl Store {
    /// Stores a new site with revision 1.
    ///
    /// # Errors
    /// [`ErrorKind::SiteExists`]; [`ErrorKind::InsufficientStorage`] beyond the limit of sites.
    pub async fn insert_site(&self, profile: &NewSite, now: Timestamp) -> Result<Site> {
        let mut writer = self.growing().await?;
        let mut transaction = writer.begin().await?;
        let insert = sqlx::query(concat!(
            "INSERT INTO sites (display_name, labels, origin_longitude_deg, origin_latitude_deg, \
             updated_at_us, id, created_at_us, revision) VALUES (?, ?, ?, ?, ?, ?, ?, 1) \
             ON CONFLICT (id) DO NOTHING RETURNING ",
            columns!()
        ));
        let row = bind_profile(insert, profile, now)?
            .bind(profile.id.as_str().to_owned())
            .bind(now.as_microsecond())
            .fetch_optional(&mut *transaction)
            .await
            .map_err(failed)?;
        let Some(row) = row else {
            let taken = format!("a site of the id {} exists already", profile.id);
            return Err(Error::field(ErrorKind::SiteExists, "id", taken));
        };
        let site = read_site(&row)?;
        check_limit(&mut transaction, self.limits().sites).await?;
        self.record_site(&mut transaction, AuditAction::SiteCreated, &site, now).await?;
        transaction.commit().await.map_err(failed)?;
        Ok(site)
    }

    /// One site.
    ///
    /// # Errors
    /// [`ErrorKind::SiteNotFound`].
    pub async fn site(&self, id: &SiteId) -> Result<Site> {
        find_site(self.readers(), id).await
    }

    /// A page of sites ordered by id, after an id.
    ///
    /// # Errors
    /// Faults only.
    pub async fn sites(&self, after: Option<&SiteId>, limit: u32) -> Result<Vec<Site>> {
        let page = concat!("SELECT ", columns!(), " FROM sites WHERE id > ? ORDER BY id LIMIT ?");
        let rows = sqlx::query(page)
            .bind(after.map_or("", SiteId::as_str).to_owned())
            .bind(limit)
            .fetch_all(self.readers())
            .await
            .map_err(failed)?;
        rows.iter().map(read_site).collect()
    }

    /// Id, key and revision of every site: enough to see what has changed.
    ///
    /// # Errors
    /// Faults only.
    pub async fn site_versions(&self) -> Result<Vec<(SiteId, SiteKey, Revision)>> {
        let rows = sqlx::query("SELECT id, key, revision FROM sites")
            .fetch_all(self.readers())
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

    /// Puts a profile in the place of the stored one and counts its revision up, if the stored revision is the
    /// expected one.
    ///
    /// # Errors
    /// [`ErrorKind::SiteNotFound`], [`ErrorKind::RevisionMismatch`].
    pub async fn replace_site(&self, profile: &NewSite, expected: Expected, now: Timestamp) -> Result<Site> {
        let mut writer = self.synced().await?;
        let mut transaction = writer.begin().await?;
        check_version(&find_site(&mut *transaction, &profile.id).await?, expected)?;
        let update = sqlx::query(concat!(
            "UPDATE sites SET display_name = ?, labels = ?, origin_longitude_deg = ?, \
             origin_latitude_deg = ?, updated_at_us = ?, revision = revision + 1 WHERE id = ? RETURNING ",
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

    /// Deletes a site that no camera belongs to, if its revision is the expected one.
    ///
    /// # Errors
    /// [`ErrorKind::SiteNotFound`], [`ErrorKind::RevisionMismatch`], [`ErrorKind::SiteInUse`] while cameras
    /// belong to it.
    pub async fn delete_site(&self, id: &SiteId, expected: Expected, now: Timestamp) -> Result<()> {
        let mut deletion = self.deletion().await?;
        let mut transaction = deletion.begin().await?;
        let site = find_site(&mut *transaction, id).await?;
        check_version(&site, expected)?;
        if site.cameras > 0 {
            let message =
                format!("the site has {} camera(s); give them another site, or none, first", site.cameras);
            return Err(Error::refused(ErrorKind::SiteInUse, message));
        }
        sqlx::query("DELETE FROM sites WHERE id = ?")
            .bind(id.as_str())
            .execute(&mut *transaction)
            .await
            .map_err(failed)?;
        self.record_site(&mut transaction, AuditAction::SiteDeleted, &site, now).await?;
        transaction.commit().await.map_err(failed)?;
        deletion.reclaim().await;
        Ok(())
    }

    async fn record_site(
        &self,
        transaction: &mut SqliteConnection,
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

/// Refuses the site that was just inserted if it is one too many.
async fn check_limit(connection: &mut SqliteConnection, limit: u32) -> Result<()> {
    let sites: i64 =
        sqlx::query_scalar("SELECT count(*) FROM sites").fetch_one(connection).await.map_err(failed)?;
    if sites > i64::from(limit) {
        let message =
            format!("limits.sites is {limit}; delete a site that is no longer needed, or raise the limit");
        return Err(Error::refused(ErrorKind::InsufficientStorage, message));
    }
    Ok(())
}

async fn find_site(executor: impl SqliteExecutor<'_>, id: &SiteId) -> Result<Site> {
    let row = sqlx::query(concat!("SELECT ", columns!(), " FROM sites WHERE id = ?"))
        .bind(id.as_str())
        .fetch_optional(executor)
        .await
        .map_err(failed)?;
    read_site(&row.ok_or_else(|| no_site(id))?)
}

fn check_version(site: &Site, expected: Expected) -> Result<()> {
    expected.map_or(Ok(()), |expected| expected.check("site", site.key, site.revision))
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

fn read_site(row: &SqliteRow) -> Result<Site> {
    let mut fields = RowDecoder::new("sites", row);
    let key = SiteKey(fields.get()?);
    let id = fields.parse(SiteId::new)?;
    let display_name = fields.get()?;
    let labels = fields.parse(serde_json::from_str::<BTreeMap<String, String>>)?;
    let (longitude_deg, latitude_deg): (Option<f64>, Option<f64>) = (fields.get()?, fields.get()?);
    let origin = longitude_deg.zip(latitude_deg);
    let origin = fields.checked(origin.map(|(east, north)| Position::new(east, north)).transpose())?;
    let revision = fields.revision()?;
    let (created_at, updated_at) = (fields.timestamp()?, fields.timestamp()?);
    let cameras = fields.count()?;
    Ok(Site {
        key,
        profile: NewSite { id, display_name, labels, origin },
        revision,
        created_at,
        updated_at,
        cameras,
    })
}
