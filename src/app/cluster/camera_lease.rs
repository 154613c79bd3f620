//! The right to have a camera's live state.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use tokio_util::sync::CancellationToken;

use super::registration::{Registration, as_ns};
use crate::app::registry::ActiveCamera;
use crate::domain::{CameraId, CameraKey, Error, ErrorKind, Result, SiteId};

/// Held by everything that changes a camera's live state. A server that shares its database with no other has it
/// without asking.
#[derive(Clone)]
pub struct CameraLease(pub(super) Option<Arc<HeldLease>>);

/// An ownership that is stored in the database.
pub(super) struct HeldLease {
    pub(super) camera: CameraId,
    pub(super) key: CameraKey,
    /// The site whose cameras have the same owner.
    pub(super) site: Option<SiteId>,
    pub(super) fence: i64,
    pub(super) registration: Arc<Registration>,
    pub(super) ended: CancellationToken,
    last_used_ns: AtomicU64,
}

impl CameraLease {
    /// That of a server which owns everything.
    pub(super) const fn of_only_node() -> Self {
        Self(None)
    }

    /// Checks that nobody else can have the camera at this reading of the monotonic clock.
    ///
    /// # Errors
    /// `CameraBetweenNodes`.
    pub fn check(&self, now: Duration) -> Result<()> {
        match &self.0 {
            None => Ok(()),
            Some(held) if held.is_valid(now) => {
                held.touch(now);
                Ok(())
            }
            Some(held) => Err(held.lost()),
        }
    }

    /// Waits until the lease has been given up or lost; without end for a server that owns everything.
    pub async fn ended(&self) -> Error {
        match &self.0 {
            None => std::future::pending().await,
            Some(held) => {
                held.ended.cancelled().await;
                held.lost()
            }
        }
    }
}

impl HeldLease {
    pub(super) fn new(
        camera: &ActiveCamera,
        fence: i64,
        registration: Arc<Registration>,
        now: Duration,
    ) -> Self {
        Self {
            camera: camera.id.clone(),
            key: camera.key,
            site: camera.site.clone(),
            fence,
            registration,
            ended: CancellationToken::new(),
            last_used_ns: AtomicU64::new(as_ns(now)),
        }
    }

    pub(super) fn is_valid(&self, now: Duration) -> bool {
        self.registration.is_valid(now) && !self.ended.is_cancelled()
    }

    fn lost(&self) -> Error {
        between_nodes(&camera_text(&self.camera))
    }

    pub(super) fn touch(&self, now: Duration) {
        self.last_used_ns.store(as_ns(now), Ordering::Relaxed);
    }

    pub(super) fn unused_for(&self, now: Duration) -> Duration {
        Duration::from_nanos(as_ns(now).saturating_sub(self.last_used_ns.load(Ordering::Relaxed)))
    }
}

/// A camera in a message.
pub(super) fn camera_text(camera: &CameraId) -> String {
    format!("camera {camera}")
}

/// The refusal for a camera or site whose owner cannot be named; the client tries again.
pub(super) fn between_nodes(owned: &str) -> Error {
    Error::refused(
        ErrorKind::CameraBetweenNodes,
        format!("no node has the live state of {owned} for sure at this moment; try again"),
    )
}
