//! Pictures of cameras.

use jiff::Timestamp;

use super::Store;
use super::cameras::camera_key;
use super::errors::failed;
use crate::domain::{AuditAction, CameraId, Picture, Result};
use crate::rows::audit::Change;
use crate::rows::pictures::{picture_change, read_picture};

impl Store {
    pub(crate) async fn picture(&self, camera: &CameraId) -> Result<Option<Picture>> {
        let key = camera_key(self.readers(), camera).await?;
        let row =
            sqlx::query("SELECT camera_key, media_type, content FROM camera_pictures WHERE camera_key = ?")
                .bind(key)
                .fetch_optional(self.readers())
                .await
                .map_err(failed)?;
        row.as_ref().map(read_picture).transpose()
    }

    pub(crate) async fn set_picture(
        &self,
        camera: &CameraId,
        picture: Option<&Picture>,
        now: Timestamp,
    ) -> Result<()> {
        let mut writer = self.growing().await?;
        let mut transaction = writer.begin().await?;
        let key = camera_key(&mut *transaction, camera).await?;
        sqlx::query("DELETE FROM camera_pictures WHERE camera_key = ?")
            .bind(key)
            .execute(&mut *transaction)
            .await
            .map_err(failed)?;
        if let Some(picture) = picture {
            sqlx::query(
                "INSERT INTO camera_pictures (camera_key, media_type, content, updated_at_us) VALUES (?, ?, ?, ?)",
            )
            .bind(key)
            .bind(picture.format().media_type())
            .bind(picture.content())
            .bind(now.as_microsecond())
            .execute(&mut *transaction)
            .await
            .map_err(failed)?;
        }
        let change = Change::of_camera(AuditAction::CameraChanged, camera, Some(picture_change(picture)));
        self.record(&mut transaction, change, now).await?;
        transaction.commit().await.map_err(failed)
    }
}
