//! Profiles of cameras.

use jiff::Timestamp;
use sqlx::sqlite::SqliteArguments;
use sqlx::{Sqlite, SqliteConnection, SqliteExecutor};

use super::Store;
use super::errors::failed;
use crate::domain::{
    AuditAction, Camera, CameraId, Error, ExpectedVersion, GnssBiasSigma, GnssError, ImageSize, NewCamera,
    Result, SiteId, TargetClass,
};
use crate::refusals::no_camera;
use crate::rows::audit::Change;
use crate::rows::cameras::{
    CameraContent, CameraVersions, ChangeMark, camera_columns as columns, camera_exists, check_limit,
    check_site, check_version, has_live_run, read_camera, read_version, write_receivers,
};

type Query = sqlx::query::Query<'static, Sqlite, SqliteArguments>;

impl Store {
    pub(crate) async fn insert_camera(&self, profile: &NewCamera, now: Timestamp) -> Result<Camera> {
        let mut writer = self.growing().await?;
        let mut transaction = writer.begin().await?;
        let insert = sqlx::query(concat!(
            "INSERT INTO cameras (display_name, image_width_px, image_height_px, gnss_sigma_m, \
             gnss_bias_sigma_m, recipe, target_classes, labels, receivers, retrain_when_moved, learn_automatically, \
             site_key, updated_at_us, id, created_at_us, revision) VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, \
             (SELECT key FROM sites WHERE id = ?), ?, ?, ?, 1) ON CONFLICT (id) DO NOTHING RETURNING ",
            columns!()
        ));
        let row = bind_profile(insert, profile, now)?
            .bind(profile.id.as_str().to_owned())
            .bind(now.as_microsecond())
            .fetch_optional(&mut *transaction)
            .await
            .map_err(failed)?;
        let camera = read_camera(&row.ok_or_else(|| camera_exists(&profile.id))?)?;
        check_site(&camera, profile)?;
        check_limit(count(&mut transaction).await?, self.limits().cameras)?;
        let change = Change::of_camera(AuditAction::CameraCreated, &profile.id, None);
        self.record(&mut transaction, change, now).await?;
        transaction.commit().await.map_err(failed)?;
        Ok(camera)
    }

    pub(crate) async fn camera(&self, id: &CameraId) -> Result<Camera> {
        find_camera(self.readers(), id).await
    }

    pub(crate) async fn cameras(
        &self,
        site: Option<&SiteId>,
        after: Option<&CameraId>,
        limit: u32,
    ) -> Result<Vec<Camera>> {
        let query = match site {
            None => {
                sqlx::query(concat!("SELECT ", columns!(), " FROM cameras WHERE id > ? ORDER BY id LIMIT ?"))
            }
            Some(site) => sqlx::query(concat!(
                "SELECT ",
                columns!(),
                " FROM cameras WHERE site_key = (SELECT key FROM sites WHERE id = ?) AND id > ? \
                 ORDER BY id LIMIT ?"
            ))
            .bind(site.as_str().to_owned()),
        };
        let rows = query
            .bind(after.map_or("", CameraId::as_str).to_owned())
            .bind(limit)
            .fetch_all(self.readers())
            .await
            .map_err(failed)?;
        rows.iter().map(read_camera).collect()
    }

    /// One process changes most of what is in a folder: all cameras are read each time.
    pub(crate) async fn camera_versions(&self, _since: Option<ChangeMark>) -> Result<CameraVersions> {
        let rows = sqlx::query("SELECT id, key, revision, active_model FROM cameras")
            .fetch_all(self.readers())
            .await
            .map_err(failed)?;
        let versions = rows.iter().map(read_version).collect::<Result<_>>()?;
        Ok(CameraVersions { versions, deleted: None, upto: None })
    }

    pub(crate) async fn camera_contents(&self, ids: &[CameraId]) -> Result<Vec<Result<CameraContent>>> {
        let mut contents = Vec::with_capacity(ids.len());
        for id in ids {
            contents.push(self.camera_content(id).await);
        }
        Ok(contents)
    }

    async fn camera_content(&self, id: &CameraId) -> Result<CameraContent> {
        let camera = self.camera(id).await?;
        let Some(active) = camera.active_model else {
            return Ok(CameraContent { camera, moved: None, model: None });
        };
        let moved = self.camera_move(id, active).await?;
        Ok(CameraContent { camera, moved, model: Some(self.model_content(id, active).await) })
    }

    pub(crate) async fn replace_camera(
        &self,
        profile: &NewCamera,
        expected: Option<ExpectedVersion>,
        now: Timestamp,
    ) -> Result<Camera> {
        let mut writer = self.synced().await?;
        let mut transaction = writer.begin().await?;
        check_version(&find_camera(&mut *transaction, &profile.id).await?, expected)?;
        let update = sqlx::query(concat!(
            "UPDATE cameras SET display_name = ?, image_width_px = ?, image_height_px = ?, \
             gnss_sigma_m = ?, gnss_bias_sigma_m = ?, recipe = ?, target_classes = ?, labels = ?, receivers = ?, \
             retrain_when_moved = ?, learn_automatically = ?, site_key = (SELECT key FROM sites WHERE id = ?), updated_at_us = ?, \
             revision = revision + 1 WHERE id = ? RETURNING ",
            columns!()
        ));
        let row = bind_profile(update, profile, now)?
            .bind(profile.id.as_str().to_owned())
            .fetch_one(&mut *transaction)
            .await
            .map_err(failed)?;
        let camera = read_camera(&row)?;
        check_site(&camera, profile)?;
        let revision = Some(format!("revision {}", camera.revision.0));
        let change = Change::of_camera(AuditAction::CameraChanged, &profile.id, revision);
        self.record(&mut transaction, change, now).await?;
        transaction.commit().await.map_err(failed)?;
        Ok(camera)
    }

    pub(crate) async fn delete_camera(
        &self,
        id: &CameraId,
        expected: Option<ExpectedVersion>,
        now: Timestamp,
    ) -> Result<()> {
        let mut deletion = self.deletion().await?;
        let mut transaction = deletion.begin().await?;
        check_version(&find_camera(&mut *transaction, id).await?, expected)?;
        let live: i64 = sqlx::query_scalar(
            "SELECT count(*) FROM training_runs JOIN cameras ON cameras.key = camera_key \
             WHERE cameras.id = ? AND state IN ('queued', 'running')",
        )
        .bind(id.as_str())
        .fetch_one(&mut *transaction)
        .await
        .map_err(failed)?;
        if live > 0 {
            return Err(has_live_run());
        }
        sqlx::query("DELETE FROM cameras WHERE id = ?")
            .bind(id.as_str())
            .execute(&mut *transaction)
            .await
            .map_err(failed)?;
        let change = Change::of_camera(AuditAction::CameraDeleted, id, None);
        self.record(&mut transaction, change, now).await?;
        transaction.commit().await.map_err(failed)?;
        deletion.reclaim().await;
        Ok(())
    }
}

async fn count(connection: &mut SqliteConnection) -> Result<i64> {
    sqlx::query_scalar("SELECT count(*) FROM cameras").fetch_one(connection).await.map_err(failed)
}

/// One camera, inside or outside of a transaction.
pub(super) async fn find_camera(executor: impl SqliteExecutor<'_>, id: &CameraId) -> Result<Camera> {
    let row = sqlx::query(concat!("SELECT ", columns!(), " FROM cameras WHERE id = ?"))
        .bind(id.as_str())
        .fetch_optional(executor)
        .await
        .map_err(failed)?;
    read_camera(&row.ok_or_else(|| no_camera(id))?)
}

/// The number by which the other tables call a camera.
pub(super) async fn camera_key(executor: impl SqliteExecutor<'_>, id: &CameraId) -> Result<i64> {
    sqlx::query_scalar("SELECT key FROM cameras WHERE id = ?")
        .bind(id.as_str())
        .fetch_optional(executor)
        .await
        .map_err(failed)?
        .ok_or_else(|| no_camera(id))
}

/// Binds the changeable columns in the order that INSERT and UPDATE share.
fn bind_profile(query: Query, profile: &NewCamera, now: Timestamp) -> Result<Query> {
    let sigma_m = match profile.gnss_error {
        GnssError::Known(sigma_m) => Some(sigma_m.metres()),
        GnssError::Unknown => None,
    };
    let classes: Vec<&str> = profile.target_classes.iter().map(TargetClass::as_str).collect();
    Ok(query
        .bind(profile.display_name.clone())
        .bind(profile.image_size.map(ImageSize::width_px))
        .bind(profile.image_size.map(ImageSize::height_px))
        .bind(sigma_m)
        .bind(profile.gnss_bias_sigma.map(GnssBiasSigma::metres))
        .bind(profile.recipe.as_str())
        .bind(serde_json::to_string(&classes).map_err(Error::fault)?)
        .bind(serde_json::to_string(&profile.labels).map_err(Error::fault)?)
        .bind(write_receivers(&profile.receivers)?)
        .bind(profile.retrain_when_moved)
        .bind(profile.learn_automatically)
        .bind(profile.site.as_ref().map(|site| site.as_str().to_owned()))
        .bind(now.as_microsecond()))
}
