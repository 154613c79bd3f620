//! Pictures of what cameras see.

use std::collections::HashMap;
use std::sync::Mutex;
use std::time::Duration;

use super::App;
use super::active_cameras::ActiveCameras;
use super::live::sync::lock;
use crate::clock::Clock;
use crate::domain::{CameraId, Error, ErrorKind, NewCamera, Picture, Result, SnapshotSource};
use crate::exchange::Address;
use crate::store::Store;

/// Least time between two requests to the snapshot address of a camera.
const SNAPSHOT_PAUSE: Duration = Duration::from_secs(2);

/// When the snapshot addresses of cameras were asked last; those within the pause are remembered.
#[derive(Default)]
pub(super) struct SnapshotTimes(Mutex<HashMap<CameraId, Duration>>);

impl SnapshotTimes {
    /// Notes that the address of a camera is asked now.
    ///
    /// # Errors
    /// `RateLimited` within the pause.
    fn take(&self, id: &CameraId, now: Duration) -> Result<()> {
        let mut asked = lock(&self.0);
        asked.retain(|_, at| now.saturating_sub(*at) < SNAPSHOT_PAUSE);
        if asked.contains_key(id) {
            let message = "a picture of this camera was fetched within the last 2 s; read it instead";
            return Err(Error::refused(ErrorKind::RateLimited, message));
        }
        asked.insert(id.clone(), now);
        Ok(())
    }
}

/// Checks that the snapshot address of a profile can be reached at all.
///
/// # Errors
/// `InvalidArgument` naming `snapshot.url`.
pub(super) fn check_snapshot(profile: &NewCamera) -> Result<()> {
    let address = profile.snapshot.as_ref().map(|source| Address::of_http(&source.http_url()));
    address.transpose().map(drop).map_err(|error| error.at("snapshot.url"))
}

/// Pictures of what cameras see.
#[derive(Clone, Copy)]
pub struct Pictures<'a> {
    cameras: ActiveCameras<'a>,
    store: &'a Store,
    clock: &'a Clock,
    snapshot_times: &'a SnapshotTimes,
}

impl App {
    /// Pictures of what cameras see.
    #[must_use]
    pub fn pictures(&self) -> Pictures<'_> {
        Pictures {
            cameras: self.active_cameras(),
            store: &self.store,
            clock: &self.clock,
            snapshot_times: &self.snapshot_times,
        }
    }
}

impl Pictures<'_> {
    /// The picture of what a camera sees; `None` if nobody has set one.
    ///
    /// # Errors
    /// `CameraNotFound`.
    pub async fn get(&self, id: &CameraId) -> Result<Option<Picture>> {
        self.store.picture(id).await
    }

    /// The snapshot address of a camera, which is to be asked now.
    ///
    /// # Errors
    /// `CameraNotFound`; `InvalidArgument` if its profile has none; `PermissionDenied` for a device of other cameras;
    /// `RateLimited`.
    pub async fn begin_snapshot(&self, id: &CameraId) -> Result<SnapshotSource> {
        self.cameras.get(id).await?;
        let missing = || Error::invalid("snapshot", "is missing in the profile of the camera; set its url");
        let source = self.store.camera(id).await?.profile.snapshot.ok_or_else(missing)?;
        self.snapshot_times.take(id, self.clock.monotonic())?;
        Ok(source)
    }

    /// Sets the picture of what a camera sees, or removes it.
    ///
    /// # Errors
    /// `CameraNotFound`; `PermissionDenied` for a device of other cameras; `InsufficientStorage`.
    pub async fn set(&self, id: &CameraId, picture: Option<&Picture>) -> Result<()> {
        self.cameras.get(id).await?;
        self.store.set_picture(id, picture, self.clock.now()).await
    }
}
