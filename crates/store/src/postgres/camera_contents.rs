//! The contents needed to answer for many cameras at once: profiles, pose changes and active models, in three queries.

use std::collections::HashMap;

use super::Store;
use super::errors::failed;
use crate::domain::{CameraId, Result};
use crate::refusals::no_camera;
use crate::row_decoder::{RowDecoder, StoredRow};
use crate::rows::cameras::{CameraContent, camera_columns as columns, read_camera};
use crate::rows::models::{read_content, read_move};

/// Id of the camera, metadata document, weights and checksum.
type StoredModel = (String, Vec<u8>, Vec<u8>, String);

impl Store {
    pub(crate) async fn camera_contents(&self, ids: &[CameraId]) -> Result<Vec<Result<CameraContent>>> {
        let names: Vec<&str> = ids.iter().map(CameraId::as_str).collect();
        // One snapshot: an active version is among the models.
        let mut reader = self.reader().await?;
        let cameras = sqlx::query(concat!("SELECT ", columns!(), " FROM cameras WHERE id = ANY($1::TEXT[])"))
            .bind(&names)
            .fetch_all(&mut *reader)
            .await
            .map_err(failed)?;
        let cameras: Vec<StoredRow> = cameras.into_iter().map(StoredRow::Postgres).collect();
        let moves = sqlx::query(
            "SELECT cameras.id, model_number, began_at_us, raised_at_us, shift_east_m, shift_north_m, statistic, \
             targets FROM camera_moves JOIN cameras ON cameras.key = camera_key AND model_number = active_model \
             WHERE cameras.id = ANY($1::TEXT[])",
        )
        .bind(&names)
        .fetch_all(&mut *reader)
        .await
        .map_err(failed)?;
        let models: Vec<StoredModel> = sqlx::query_as(
            "SELECT cameras.id, convert_to(metadata, 'UTF8'), weights, sha256 \
             FROM models JOIN cameras ON cameras.key = camera_key AND number = active_model \
             WHERE cameras.id = ANY($1::TEXT[])",
        )
        .bind(&names)
        .fetch_all(&mut *reader)
        .await
        .map_err(failed)?;
        let moves: Vec<StoredRow> = moves.into_iter().map(StoredRow::Postgres).collect();
        let camera_of = |row| Ok((RowDecoder::new("camera_moves", row).get::<&str>()?, row));
        let moves: HashMap<&str, _> = moves.iter().map(camera_of).collect::<Result<_>>()?;
        let mut models: HashMap<_, _> = models
            .into_iter()
            .map(|(id, document, weights, sha256)| (id, (document, weights, sha256)))
            .collect();
        let mut found: HashMap<&str, _> = HashMap::with_capacity(ids.len());
        for row in &cameras {
            let id: &str = RowDecoder::new("cameras", row).skip(1).get()?;
            let mut content = || {
                let camera = read_camera(row)?;
                let moved = moves.get(id).map(|row| read_move(row)).transpose()?;
                let model =
                    camera.active_model.map(|number| read_content(camera.id(), number, models.remove(id)));
                Ok(CameraContent { camera, moved, model })
            };
            found.insert(id, content());
        }
        Ok(ids.iter().map(|id| found.remove(id.as_str()).unwrap_or_else(|| Err(no_camera(id)))).collect())
    }
}
