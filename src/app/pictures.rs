//! Pictures of what cameras see.

use super::App;
use crate::domain::{CameraId, Picture, Result};

impl App {
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
        self.active_camera(id).await?;
        self.store.set_picture(id, picture, self.clock.now()).await
    }
}
