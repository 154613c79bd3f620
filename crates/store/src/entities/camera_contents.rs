//! The contents that a process reads to follow the changes of cameras: profiles, pose changes and active models of many
//! cameras in three queries. PostgreSQL lists changed cameras.

use std::collections::HashMap;
use std::slice;

use sqlx::AssertSqlSafe;

use crate::database::{Backend, Database};
use crate::domain::{CameraId, Error, Result};
use crate::query::{Session, query, query_as};
use crate::refusals::no_camera;
use crate::row_decoder::{RowDecoder, StoredRow};
use crate::rows::cameras::{
    CameraContent, CameraVersions, ChangeMark, camera_columns as columns, read_camera,
};
use crate::rows::models::{StoredModel, read_move};
use crate::statements::versions::all_versions;

/// Id of the camera, metadata document, weights and checksum.
type ModelRow = (String, Vec<u8>, Vec<u8>, String);

impl Database {
    pub(crate) async fn camera_versions(&self, since: Option<ChangeMark>) -> Result<CameraVersions> {
        if let Backend::Postgres(store) = &self.backend {
            return store.camera_versions(since).await;
        }
        // One process changes most of what is in a folder: all cameras are read each time.
        let versions = all_versions(&mut self.reader().await?).await?;
        Ok(CameraVersions { versions, deleted: None, upto: None })
    }

    pub(crate) async fn camera_contents(&self, ids: &[CameraId]) -> Result<Vec<Result<CameraContent>>> {
        let read = self.contents_at_once(ids).await;
        if read.is_ok() || matches!(self.backend, Backend::Postgres(_)) {
            return read;
        }
        // A damaged page of a file keeps the cameras that are on it from being read, and no others.
        let mut contents = Vec::with_capacity(ids.len());
        for id in ids {
            let one = self.contents_at_once(slice::from_ref(id)).await;
            contents.push(one.and_then(|mut one| one.pop().unwrap_or_else(|| Err(no_camera(id)))));
        }
        Ok(contents)
    }

    async fn contents_at_once(&self, ids: &[CameraId]) -> Result<Vec<Result<CameraContent>>> {
        let names: Vec<&str> = ids.iter().map(CameraId::as_str).collect();
        let names = serde_json::to_string(&names).map_err(Error::fault)?;
        // One snapshot: an active version is among the models.
        let mut reader = self.reader().await?;
        let asked = format!("WHERE cameras.id IN ({})", reader.dialect().listed_texts());
        let select = |what: &str| AssertSqlSafe(format!("SELECT {what} {asked}"));
        let cameras = query(select(concat!(columns!(), " FROM cameras")))
            .bind(names.clone())
            .fetch_all(&mut reader)
            .await?;
        let moves = query(select(
            "cameras.id, model_number, began_at_us, raised_at_us, shift_east_m, shift_north_m, statistic, targets \
             FROM camera_moves JOIN cameras ON cameras.key = camera_key AND model_number = active_model",
        ))
        .bind(names.clone())
        .fetch_all(&mut reader)
        .await?;
        let models: Vec<ModelRow> = query_as(select(&format!(
            "cameras.id, {}, weights, sha256 \
             FROM models JOIN cameras ON cameras.key = camera_key AND number = active_model",
            reader.dialect().metadata_bytes()
        )))
        .bind(names)
        .fetch_all(&mut reader)
        .await?;
        let camera_of = |row| Ok((RowDecoder::new("camera_moves", row).get::<&str>()?, row));
        let moves: HashMap<&str, &StoredRow> = moves.iter().map(camera_of).collect::<Result<_>>()?;
        let models =
            models.into_iter().map(|(id, document, weights, sha256)| (id, (document, weights, sha256)));
        let mut models: HashMap<_, _> = models.collect();
        let mut found: HashMap<&str, _> = HashMap::with_capacity(ids.len());
        for row in &cameras {
            let id: &str = RowDecoder::new("cameras", row).skip(1).get()?;
            let mut content = || {
                let camera = read_camera(row)?;
                let moved = moves.get(id).map(|row| read_move(row)).transpose()?;
                let stored =
                    |number| StoredModel { camera: camera.id().clone(), number, content: models.remove(id) };
                let model = camera.active_model.map(stored);
                Ok(CameraContent { camera, moved, model })
            };
            found.insert(id, content());
        }
        Ok(ids.iter().map(|id| found.remove(id.as_str()).unwrap_or_else(|| Err(no_camera(id)))).collect())
    }
}
