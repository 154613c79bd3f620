//! Pictures of what cameras see.

use super::cameras::Cameras;
use crate::domain::{CameraId, Picture, Result};

impl Cameras<'_> {
    /// The picture of what a camera sees; `None` if nobody has set one.
    ///
    /// # Errors
    /// `CameraNotFound`.
    pub async fn picture(&self, id: &CameraId) -> Result<Option<Picture>> {
        self.store.picture(id).await
    }

    /// Sets the picture of what a camera sees, or removes it.
    ///
    /// # Errors
    /// `CameraNotFound`; `PermissionDenied` for a device of other cameras; `InsufficientStorage`.
    pub async fn set_picture(&self, id: &CameraId, picture: Option<&Picture>) -> Result<()> {
        self.registry.active_camera(self.store, self.caller, id).await?;
        self.store.set_picture(id, picture, self.clock.now()).await
    }
}
