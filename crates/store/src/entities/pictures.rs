//! Pictures of cameras.

use jiff::Timestamp;

use super::cameras::{camera_key, lock_camera};
use crate::database::Database;
use crate::domain::{AuditAction, CameraId, Picture, PictureFormat, Result};
use crate::query::query;
use crate::row_decoder::{RowDecoder, StoredRow};
use crate::rows::audit::Change;

impl Database {
    pub(crate) async fn picture(&self, camera: &CameraId) -> Result<Option<Picture>> {
        let mut reader = self.reader().await?;
        let key = camera_key(&mut reader, camera).await?;
        let row = query("SELECT media_type, content FROM camera_pictures WHERE camera_key = $1")
            .bind(key)
            .fetch_optional(&mut reader)
            .await?;
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
        let key = lock_camera(&mut transaction, camera).await?;
        query("DELETE FROM camera_pictures WHERE camera_key = $1")
            .bind(key)
            .execute(&mut transaction)
            .await?;
        if let Some(picture) = picture {
            query(
                "INSERT INTO camera_pictures (camera_key, media_type, content, updated_at_us) VALUES ($1, $2, $3, $4)",
            )
            .bind(key)
            .bind(picture.format().media_type())
            .bind(picture.content())
            .bind(now.as_microsecond())
            .execute(&mut transaction)
            .await?;
        } else {
            // Pictures come from devices again and again, as samples do, and would fill the log.
            let change =
                Change::of_camera(AuditAction::CameraChanged, camera, Some("picture removed".to_owned()));
            self.record(&mut transaction, change, now).await?;
        }
        transaction.commit().await
    }
}

fn read_picture(row: &StoredRow) -> Result<Picture> {
    let mut fields = RowDecoder::new("camera_pictures", row);
    let format = fields.parse(|media_type: &str| media_type.parse::<PictureFormat>())?;
    fields.parse(|content: Vec<u8>| Picture::new(format, content))
}
