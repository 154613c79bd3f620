//! Profiles of cameras.

use jiff::Timestamp;

use crate::database::Database;
use crate::domain::{AuditAction, Camera, CameraId, ExpectedVersion, NewCamera, Result, SiteId};
use crate::locks::{Limit, lock_limit};
use crate::query::{Query, RowLock, Session, query, query_scalar};
use crate::refusals::no_camera;
use crate::row_decoder::StoredRow;
use crate::rows::audit::Change;
use crate::rows::cameras::{
    camera_columns as columns, camera_exists, check_limit, check_site, check_version, has_live_run,
    read_camera, write_profile,
};

impl Database {
    pub(crate) async fn insert_camera(&self, profile: &NewCamera, now: Timestamp) -> Result<Camera> {
        let mut writer = self.growing().await?;
        let mut transaction = writer.begin().await?;
        lock_limit(&mut transaction, Limit::Cameras).await?;
        let insert = query(concat!(
            "INSERT INTO cameras (profile, learn_automatically, site_key, updated_at_us, id, created_at_us, revision) \
             VALUES ($1, $2, (SELECT key FROM sites WHERE id = $3), $4, $5, $6, 1) ON CONFLICT (id) DO NOTHING RETURNING ",
            columns!()
        ));
        let row = bind_profile(insert, profile, now)?
            .bind(profile.id.as_str().to_owned())
            .bind(now.as_microsecond())
            .fetch_optional(&mut transaction)
            .await?;
        let camera = read_camera(&row.ok_or_else(|| camera_exists(&profile.id))?)?;
        check_site(&camera, profile)?;
        check_limit(count(&mut transaction).await?, self.limits().cameras)?;
        let change = Change::of_camera(AuditAction::CameraCreated, &profile.id, None);
        self.record(&mut transaction, change, now).await?;
        transaction.commit().await?;
        Ok(camera)
    }

    pub(crate) async fn camera(&self, id: &CameraId) -> Result<Camera> {
        let mut reader = self.reader().await?;
        find_camera(&mut reader, id).await
    }

    pub(crate) async fn cameras(
        &self,
        site: Option<&SiteId>,
        after: Option<&CameraId>,
        limit: u32,
    ) -> Result<Vec<Camera>> {
        let mut reader = self.reader().await?;
        let query = match site {
            None => query(concat!("SELECT ", columns!(), " FROM cameras WHERE id > $1 ORDER BY id LIMIT $2")),
            Some(site) => query(concat!(
                "SELECT ",
                columns!(),
                " FROM cameras WHERE site_key = (SELECT key FROM sites WHERE id = $1) AND id > $2 \
                 ORDER BY id LIMIT $3"
            ))
            .bind(site.as_str().to_owned()),
        };
        let rows = query
            .bind(after.map_or("", CameraId::as_str).to_owned())
            .bind(limit)
            .fetch_all(&mut reader)
            .await?;
        rows.iter().map(read_camera).collect()
    }

    pub(crate) async fn replace_camera(
        &self,
        profile: &NewCamera,
        expected: Option<ExpectedVersion>,
        now: Timestamp,
    ) -> Result<Camera> {
        let mut writer = self.synced().await?;
        let mut transaction = writer.begin().await?;
        lock_camera(&mut transaction, &profile.id).await?;
        check_version(&find_camera(&mut transaction, &profile.id).await?, expected)?;
        let update = query(concat!(
            "UPDATE cameras SET profile = $1, learn_automatically = $2, \
             site_key = (SELECT key FROM sites WHERE id = $3), updated_at_us = $4, revision = revision + 1 \
             WHERE id = $5 RETURNING ",
            columns!()
        ));
        let row = bind_profile(update, profile, now)?
            .bind(profile.id.as_str().to_owned())
            .fetch_one(&mut transaction)
            .await?;
        let camera = read_camera(&row)?;
        check_site(&camera, profile)?;
        let revision = Some(format!("revision {}", camera.revision.0));
        let change = Change::of_camera(AuditAction::CameraChanged, &profile.id, revision);
        self.record(&mut transaction, change, now).await?;
        transaction.commit().await?;
        Ok(camera)
    }

    /// A deletion locks rows of many tables, and meets writers that hold some of them and wait for the camera. The database
    /// ends one of the two.
    pub(crate) async fn delete_camera(
        &self,
        id: &CameraId,
        expected: Option<ExpectedVersion>,
        now: Timestamp,
    ) -> Result<()> {
        let mut writer = self.deletion().await?;
        let mut transaction = writer.begin().await?;
        lock_camera(&mut transaction, id).await?;
        check_version(&find_camera(&mut transaction, id).await?, expected)?;
        let live: i64 = query_scalar(
            "SELECT count(*) FROM training_runs JOIN cameras ON cameras.key = camera_key \
             WHERE cameras.id = $1 AND state IN ('queued', 'running')",
        )
        .bind(id.as_str())
        .fetch_one(&mut transaction)
        .await?;
        if live > 0 {
            return Err(has_live_run());
        }
        query("DELETE FROM cameras WHERE id = $1").bind(id.as_str()).execute(&mut transaction).await?;
        let change = Change::of_camera(AuditAction::CameraDeleted, id, None);
        self.record(&mut transaction, change, now).await?;
        transaction.commit().await?;
        writer.reclaim().await;
        Ok(())
    }
}

async fn count(session: &mut dyn Session) -> Result<i64> {
    query_scalar("SELECT count(*) FROM cameras").fetch_one(session).await
}

/// One camera, inside or outside of a transaction.
pub(super) async fn find_camera(session: &mut dyn Session, id: &CameraId) -> Result<Camera> {
    let row = query(concat!("SELECT ", columns!(), " FROM cameras WHERE id = $1"))
        .bind(id.as_str())
        .fetch_optional(session)
        .await?;
    read_camera(&row.ok_or_else(|| no_camera(id))?)
}

/// The number by which the other tables call a camera.
pub(super) async fn camera_key(session: &mut dyn Session, id: &CameraId) -> Result<i64> {
    query_scalar("SELECT key FROM cameras WHERE id = $1")
        .bind(id.as_str())
        .fetch_optional(session)
        .await?
        .ok_or_else(|| no_camera(id))
}

/// The number by which the other tables call a camera, which no other transaction changes or deletes until this one
/// ends. What is decided by a camera's rows begins with this, so that such changes follow one after another.
pub(super) async fn lock_camera(session: &mut dyn Session, id: &CameraId) -> Result<i64> {
    query_scalar("SELECT key FROM cameras WHERE id = $1")
        .locking(RowLock::NoKeyUpdate)
        .bind(id.as_str())
        .fetch_optional(session)
        .await?
        .ok_or_else(|| no_camera(id))
}

/// Binds the changeable columns in the order that INSERT and UPDATE share.
fn bind_profile(query: Query<StoredRow>, profile: &NewCamera, now: Timestamp) -> Result<Query<StoredRow>> {
    Ok(query
        .bind(write_profile(profile)?)
        .bind(profile.learn_automatically)
        .bind(profile.site.as_ref().map(|site| site.as_str().to_owned()))
        .bind(now.as_microsecond()))
}
