//! The status of every camera at a glance, for an operator.

use std::sync::Arc;

use super::cluster::Nodes;
use super::live::CameraActivity;
use super::registry::{ModelSummary, Registry};
use super::{App, Page, page_of};
use crate::clock::Clock;
use crate::domain::{Camera, CameraId, JobState, Result, RunId};
use crate::store::Store;

/// A camera with its latest run, its model and what happens in its view.
pub struct CameraStatus {
    pub camera: Camera,
    /// Its latest training run, and that run's state.
    pub latest_run: Option<(RunId, JobState)>,
    /// The active model's summary; `None` without a usable model.
    pub model_summary: Option<Arc<ModelSummary>>,
    /// The activity in its view.
    pub activity: CameraActivity,
}

/// The status of cameras at a glance.
#[derive(Clone, Copy)]
pub struct CameraStatuses<'a> {
    store: &'a Store,
    registry: &'a Registry,
    nodes: Nodes<'a>,
    clock: &'a Clock,
}

impl App {
    /// The status of cameras at a glance.
    #[must_use]
    pub fn camera_statuses(&self) -> CameraStatuses<'_> {
        CameraStatuses {
            store: &self.store,
            registry: &self.registry,
            nodes: self.nodes(),
            clock: &self.clock,
        }
    }
}

impl CameraStatuses<'_> {
    /// The activity in the view of a stored camera, and its model; without its latest run.
    ///
    /// # Errors
    /// `CameraNotFound`.
    pub async fn get(&self, id: &CameraId) -> Result<CameraStatus> {
        Ok(self.status_of(self.store.camera(id).await?, None))
    }

    /// Statuses of cameras by id, after a cursor.
    ///
    /// # Errors
    /// A fault of the store.
    pub async fn list(&self, after: Option<&CameraId>, limit: u32) -> Result<Page<CameraStatus, CameraId>> {
        let cameras = self.store.cameras_with_latest_run(after, limit + 1).await?;
        let statuses = cameras.into_iter().map(|(camera, latest_run)| self.status_of(camera, latest_run));
        Ok(page_of(statuses.collect(), limit, |status| status.camera.id().clone()))
    }

    fn status_of(&self, camera: Camera, latest_run: Option<(RunId, JobState)>) -> CameraStatus {
        let active = self.registry.get(camera.id());
        CameraStatus {
            model_summary: active.as_ref().and_then(|active| active.model_summary.clone()),
            activity: active.map_or_else(CameraActivity::default, |active| {
                CameraActivity::of(&active, self.nodes.owns_camera(&active), self.clock.monotonic())
            }),
            camera,
            latest_run,
        }
    }
}
