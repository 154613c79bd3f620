//! Camera profiles.

use std::sync::Arc;

use super::pictures::check_snapshot;
use super::registry::Registry;
use super::{App, Page, page_of};
use crate::clock::Clock;
use crate::domain::{
    Camera, CameraChange, CameraId, CameraMoved, ExpectedVersion, NewCamera, Result, SiteId,
};
use crate::store::Store;

/// The use cases of cameras and their profiles.
#[derive(Clone, Copy)]
pub struct Cameras<'a> {
    store: &'a Store,
    registry: &'a Registry,
    clock: &'a Clock,
}

impl App {
    /// The use cases of cameras and their profiles.
    #[must_use]
    pub fn cameras(&self) -> Cameras<'_> {
        Cameras { store: &self.store, registry: &self.registry, clock: &self.clock }
    }
}

impl Cameras<'_> {
    /// Stores a new camera.
    ///
    /// # Errors
    /// `CameraExists`; `InvalidArgument` naming the field.
    pub async fn create(&self, profile: NewCamera) -> Result<Camera> {
        let profile = profile.check()?;
        check_snapshot(&profile)?;
        let camera = self.store.insert_camera(&profile, self.clock.now()).await?;
        self.registry.refresh_camera(self.store, camera.id()).await?;
        Ok(camera)
    }

    /// One camera.
    ///
    /// # Errors
    /// `CameraNotFound`.
    pub async fn get(&self, id: &CameraId) -> Result<Camera> {
        self.store.camera(id).await
    }

    /// Cameras, of a site or of all, by id, after a cursor.
    ///
    /// # Errors
    /// `SiteNotFound`.
    pub async fn list(
        &self,
        site: Option<&SiteId>,
        after: Option<&CameraId>,
        limit: u32,
    ) -> Result<Page<Camera, CameraId>> {
        if let Some(site) = site {
            self.store.site(site).await?;
        }
        let cameras = self.store.cameras(site, after, limit + 1).await?;
        Ok(page_of(cameras, limit, |camera| camera.id().clone()))
    }

    /// Warnings about fields that the profile leaves out, and about an active model that does not fit the profile.
    #[must_use]
    pub fn warnings(&self, camera: &Camera) -> Vec<String> {
        let mut warnings = camera.profile.warnings();
        let active = self.registry.get(camera.id());
        let trained = active.and_then(|active| active.model().and_then(|(model, _)| model.image_size()));
        if let (Some(stated), Some(trained)) = (camera.profile.image_size, trained)
            && stated != trained
        {
            warnings.push(format!(
                "the active model was trained on images of {}x{} px, and the profile states {}x{} px: its \
                 positions are wrong unless the boxes are scaled",
                trained.width_px(),
                trained.height_px(),
                stated.width_px(),
                stated.height_px()
            ));
        }
        warnings
    }

    /// Returns the detected movement of a camera if its active model no longer fits what the camera sees.
    #[must_use]
    pub fn moved(&self, id: &CameraId) -> Option<Arc<CameraMoved>> {
        self.registry.get(id)?.moved.clone()
    }

    /// Changes a profile, from the revision that the caller saw (any, if `None`).
    ///
    /// # Errors
    /// `CameraNotFound`, `RevisionMismatch`, `InvalidArgument` naming the field.
    pub async fn change(
        &self,
        id: &CameraId,
        change: CameraChange,
        expected: Option<ExpectedVersion>,
    ) -> Result<Camera> {
        let camera = self.store.camera(id).await?;
        // Changing what was read needs the revision that was read, whatever the caller said, so
        // that two changes at once cannot undo each other.
        let expected = expected.unwrap_or(camera.version());
        let profile = change.apply(camera.profile)?;
        check_snapshot(&profile)?;
        let camera = self.store.replace_camera(&profile, Some(expected), self.clock.now()).await?;
        self.registry.refresh_camera(self.store, id).await?;
        Ok(camera)
    }

    /// Deletes a camera with its samples, runs and models.
    ///
    /// # Errors
    /// `CameraNotFound`, `RevisionMismatch`, `RunLive`.
    pub async fn delete(&self, id: &CameraId, expected: Option<ExpectedVersion>) -> Result<()> {
        self.store.delete_camera(id, expected, self.clock.now()).await?;
        self.registry.forget(id).await;
        Ok(())
    }
}
