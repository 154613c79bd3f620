//! Cameras in memory, as a caller may reach them.

use std::sync::Arc;

use super::App;
use super::access::Caller;
use super::registry::{ActiveCamera, Registry};
use crate::domain::{CameraId, Result};
use crate::store::Store;

/// The cameras in memory that a caller may reach.
#[derive(Clone, Copy)]
pub(super) struct ActiveCameras<'a> {
    store: &'a Store,
    registry: &'a Registry,
    caller: &'a Caller,
}

impl App {
    /// The cameras in memory that the caller may reach.
    pub(super) fn active_cameras(&self) -> ActiveCameras<'_> {
        ActiveCameras { store: &self.store, registry: &self.registry, caller: &self.caller }
    }

    /// The active camera of an id; looks into the store for one that another process has made.
    ///
    /// # Errors
    /// `PermissionDenied` if the caller is a device of other cameras; `CameraNotFound`; a fault of the store.
    pub async fn active_camera(&self, id: &CameraId) -> Result<Arc<ActiveCamera>> {
        self.active_cameras().get(id).await
    }
}

impl ActiveCameras<'_> {
    /// As [`App::active_camera`].
    pub(super) async fn get(&self, id: &CameraId) -> Result<Arc<ActiveCamera>> {
        self.caller.authorize_camera(id)?;
        match self.registry.get(id) {
            Some(camera) => Ok(camera),
            None => self.registry.refresh_camera(self.store, id).await,
        }
    }
}
