//! The contents that a process reads to follow the changes of cameras. PostgreSQL lists changed cameras, and reads
//! many at once.

use crate::database::{Backend, Database};
use crate::domain::{CameraId, Result};
use crate::rows::cameras::{CameraContent, CameraVersions, ChangeMark};
use crate::statements::versions::all_versions;

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
        if let Backend::Postgres(store) = &self.backend {
            return store.camera_contents(ids).await;
        }
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
}
