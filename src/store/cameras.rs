//! Profiles of cameras.

use std::collections::BTreeMap;

use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use sqlx::sqlite::{SqliteArguments, SqliteRow};
use sqlx::{Sqlite, SqliteConnection, SqliteExecutor};

use super::Store;
use super::audit::Change;
use super::errors::{failed, no_camera, unknown_site};
use super::row_decoder::RowDecoder;
use crate::domain::{
    AuditAction, Camera, CameraId, CameraKey, ClockOffset, Error, ErrorKind, ExpectedVersion, GnssBiasSigma,
    GnssError, ImageSize, NewCamera, Receiver, ReceiverId, Receivers, Result, Revision, SampleCount, SigmaM,
    SiteId, TargetClass, TargetId,
};

macro_rules! columns {
    () => {
        "key, id, display_name, image_width_px, image_height_px, gnss_sigma_m, gnss_bias_sigma_m, recipe, \
         target_classes, labels, receivers, retrain_when_moved, revision, created_at_us, updated_at_us, \
         active_model, (SELECT samples FROM sample_counts WHERE camera_key = key) AS samples_with_fix, \
         (SELECT without_fix FROM sample_counts WHERE camera_key = key) AS samples_without_fix, \
         (SELECT sites.id FROM sites WHERE sites.key = site_key) AS site"
    };
}

type Query = sqlx::query::Query<'static, Sqlite, SqliteArguments>;

impl Store {
    /// Stores a new camera with revision 1.
    ///
    /// # Errors
    /// [`ErrorKind::CameraExists`]; [`ErrorKind::InvalidArgument`] naming `site` if there is no such site;
    /// [`ErrorKind::InsufficientStorage`] beyond the limit of cameras.
    pub async fn insert_camera(&self, profile: &NewCamera, now: Timestamp) -> Result<Camera> {
        let mut writer = self.growing().await?;
        let mut transaction = writer.begin().await?;
        let insert = sqlx::query(concat!(
            "INSERT INTO cameras (display_name, image_width_px, image_height_px, gnss_sigma_m, \
             gnss_bias_sigma_m, recipe, target_classes, labels, receivers, retrain_when_moved, site_key, \
             updated_at_us, id, created_at_us, revision) VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?, \
             (SELECT key FROM sites WHERE id = ?), ?, ?, ?, 1) ON CONFLICT (id) DO NOTHING RETURNING ",
            columns!()
        ));
        let row = bind_profile(insert, profile, now)?
            .bind(profile.id.as_str().to_owned())
            .bind(now.as_microsecond())
            .fetch_optional(&mut *transaction)
            .await
            .map_err(failed)?;
        let Some(row) = row else {
            let taken = format!("a camera of the id {} exists already", profile.id);
            return Err(Error::field(ErrorKind::CameraExists, "id", taken));
        };
        let camera = read_camera(&row)?;
        check_site(&camera, profile)?;
        check_limit(&mut transaction, self.limits().cameras).await?;
        let change = Change::of_camera(AuditAction::CameraCreated, &profile.id, None);
        self.record(&mut transaction, change, now).await?;
        transaction.commit().await.map_err(failed)?;
        Ok(camera)
    }

    /// One camera.
    ///
    /// # Errors
    /// [`ErrorKind::CameraNotFound`].
    pub async fn camera(&self, id: &CameraId) -> Result<Camera> {
        find_camera(self.readers(), id).await
    }

    /// A page of cameras, of a site or of all, ordered by id, after an id.
    ///
    /// # Errors
    /// Faults only.
    pub async fn cameras(
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

    /// Id, key, revision and active model of every camera: enough to see what has changed.
    ///
    /// # Errors
    /// Faults only.
    pub async fn camera_versions(&self) -> Result<Vec<(CameraId, CameraKey, Revision, Option<u32>)>> {
        let rows = sqlx::query("SELECT id, key, revision, active_model FROM cameras")
            .fetch_all(self.readers())
            .await
            .map_err(failed)?;
        let read = |row| {
            let mut fields = RowDecoder::new("cameras", row);
            let id = fields.parse(CameraId::new)?;
            let key = CameraKey(fields.get()?);
            let revision = fields.revision()?;
            Ok((id, key, revision, fields.optional_count()?))
        };
        rows.iter().map(read).collect()
    }

    /// Puts a profile in the place of the stored one and counts its revision up, if the stored
    /// revision is the expected one.
    ///
    /// # Errors
    /// [`ErrorKind::CameraNotFound`], [`ErrorKind::RevisionMismatch`]; [`ErrorKind::InvalidArgument`] naming
    /// `site` if there is no such site.
    pub async fn replace_camera(
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
             retrain_when_moved = ?, site_key = (SELECT key FROM sites WHERE id = ?), updated_at_us = ?, \
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

    /// Deletes a camera with its samples, runs and models, if its revision is the expected one.
    ///
    /// # Errors
    /// [`ErrorKind::CameraNotFound`], [`ErrorKind::RevisionMismatch`], [`ErrorKind::RunLive`] while a
    /// training run has not ended.
    pub async fn delete_camera(
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
            return Err(Error::refused(
                ErrorKind::RunLive,
                "the camera has a training run that has not ended; cancel it first",
            ));
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

/// Refuses the camera that was just inserted if it is one too many.
async fn check_limit(connection: &mut SqliteConnection, limit: u32) -> Result<()> {
    let cameras: i64 =
        sqlx::query_scalar("SELECT count(*) FROM cameras").fetch_one(connection).await.map_err(failed)?;
    if cameras > i64::from(limit) {
        return Err(Error::refused(
            ErrorKind::InsufficientStorage,
            format!(
                "limits.cameras is {limit}; delete a camera that is no longer needed, or raise the limit"
            ),
        ));
    }
    Ok(())
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

fn check_version(camera: &Camera, expected: Option<ExpectedVersion>) -> Result<()> {
    expected.map_or(Ok(()), |expected| expected.check("camera", camera.key, camera.revision))
}

/// Refuses a stored camera whose site was looked up and not found.
fn check_site(stored: &Camera, wanted: &NewCamera) -> Result<()> {
    match &wanted.site {
        Some(site) if stored.profile.site.is_none() => Err(unknown_site(site)),
        _ => Ok(()),
    }
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
        .bind(profile.site.as_ref().map(|site| site.as_str().to_owned()))
        .bind(now.as_microsecond()))
}

fn read_camera(row: &SqliteRow) -> Result<Camera> {
    let mut fields = RowDecoder::new("cameras", row);
    let key = CameraKey(fields.get()?);
    let id = fields.parse(CameraId::new)?;
    let display_name = fields.get()?;
    let width_px = fields.optional_count()?;
    let height_px = fields.optional_count()?;
    let image_size = width_px.zip(height_px).map(|(width, height)| ImageSize::new(width, height)).transpose();
    let image_size = fields.checked(image_size)?;
    let gnss_error = fields.parse_optional(SigmaM::new)?.map_or(GnssError::Unknown, GnssError::Known);
    let gnss_bias_sigma = fields.parse_optional(GnssBiasSigma::new)?;
    let recipe = fields.parse(|name: &str| name.parse())?;
    let target_classes = fields.parse(read_classes)?;
    let labels = fields.parse(serde_json::from_str::<BTreeMap<String, String>>)?;
    let receivers = fields.parse(read_receivers)?;
    let retrain_when_moved = fields.get()?;
    let revision = fields.revision()?;
    let (created_at, updated_at) = (fields.timestamp()?, fields.timestamp()?);
    let active_model = fields.optional_count()?;
    let mut samples = || fields.parse(|stored: Option<i64>| u64::try_from(stored.unwrap_or_default()));
    let (with_fix, without_fix) = (samples()?, samples()?);
    let samples = SampleCount { all: with_fix + without_fix, without_fix };
    let site = fields.parse_optional(SiteId::new)?;
    let profile = NewCamera {
        id,
        display_name,
        image_size,
        gnss_error,
        gnss_bias_sigma,
        recipe,
        target_classes,
        labels,
        receivers,
        retrain_when_moved,
        site,
    };
    Ok(Camera { key, profile, revision, created_at, updated_at, active_model, samples })
}

fn read_classes(json: &str) -> Result<Vec<TargetClass>> {
    let names: Vec<String> = serde_json::from_str(json).map_err(Error::fault)?;
    names.iter().map(|name| TargetClass::new(name)).collect()
}

/// A receiver as it is stored.
#[derive(Serialize, Deserialize)]
struct StoredReceiver {
    receiver_id: String,
    target_id: String,
    clock_offset_us: i64,
}

fn write_receivers(receivers: &Receivers) -> Result<String> {
    let stored = receivers.iter().map(|receiver| StoredReceiver {
        receiver_id: receiver.receiver_id.as_str().to_owned(),
        target_id: receiver.target_id.as_str().to_owned(),
        clock_offset_us: receiver.clock_offset.microseconds(),
    });
    serde_json::to_string(&stored.collect::<Vec<_>>()).map_err(Error::fault)
}

fn read_receivers(json: &str) -> Result<Receivers> {
    let stored: Vec<StoredReceiver> = serde_json::from_str(json).map_err(Error::fault)?;
    let receiver = |stored: &StoredReceiver| {
        Ok(Receiver {
            receiver_id: ReceiverId::new(&stored.receiver_id)?,
            target_id: TargetId::new(&stored.target_id)?,
            clock_offset: ClockOffset::from_microseconds(stored.clock_offset_us)?,
        })
    };
    Receivers::new(stored.iter().map(receiver).collect::<Result<Vec<_>>>()?)
}
