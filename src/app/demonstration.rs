//! The demonstration that the server shows, and its end.

use std::pin::pin;
use std::sync::Mutex;

use futures_util::TryStreamExt as _;
use tokio_util::sync::CancellationToken;

use super::App;
use super::live::sync::lock;
use crate::domain::{CameraId, ConnectionId, ErrorKind, Result, SiteId};

/// The cameras, sites and connections that a demonstration has made, which its end removes.
#[derive(Debug, Clone, Default)]
pub struct DemonstrationParts {
    pub cameras: Vec<CameraId>,
    pub sites: Vec<SiteId>,
    pub connections: Vec<ConnectionId>,
}

/// The demonstration, if one is shown.
#[derive(Default)]
pub struct Demonstration(Mutex<Option<(DemonstrationParts, CancellationToken)>>);

impl Demonstration {
    /// Notes that a demonstration is shown; it ends when the token is cancelled.
    #[must_use]
    pub fn begin(&self, parts: DemonstrationParts) -> CancellationToken {
        let stop = CancellationToken::new();
        *lock(&self.0) = Some((parts, stop.clone()));
        stop
    }

    /// True while simulated devices send to the server, or what they need is not removed yet.
    #[must_use]
    pub fn is_shown(&self) -> bool {
        lock(&self.0).is_some()
    }
}

impl App {
    /// Ends the demonstration and removes its cameras, sites and connections with all that they have stored. Does nothing
    /// if none is shown. Waits until training runs of its cameras have ended, which it cancels. After an error it can be
    /// repeated.
    ///
    /// # Errors
    /// `RunLive` if somebody trains one of its cameras again meanwhile; a fault of the store.
    pub async fn end_demonstration(&self) -> Result<()> {
        let Some((parts, stop)) = lock(&self.demonstration.0).clone() else { return Ok(()) };
        stop.cancel();
        for id in &parts.connections {
            removed(self.connections().delete(id, None).await, ErrorKind::ConnectionNotFound)?;
        }
        for id in &parts.cameras {
            let deleted = async {
                self.end_training(id).await?;
                self.cameras().delete(id, None).await
            };
            removed(deleted.await, ErrorKind::CameraNotFound)?;
        }
        for id in &parts.sites {
            removed(self.sites().delete(id, None).await, ErrorKind::SiteNotFound)?;
        }
        *lock(&self.demonstration.0) = None;
        Ok(())
    }

    /// Cancels the training run of a camera that has not ended, which is the latest if there is one, and waits for its end.
    async fn end_training(&self, camera: &CameraId) -> Result<()> {
        let training = self.training();
        let latest = training.list(camera, None, 1).await?.items.pop();
        let Some(run) = latest.filter(|run| !run.state.has_ended()) else { return Ok(()) };
        match training.cancel(camera, run.id).await {
            Err(error) if error.kind() != ErrorKind::RunEnded => return Err(error),
            _ => {}
        }
        let mut seen = pin!(training.watch(camera, run.id).await?);
        while seen.try_next().await?.is_some() {}
        Ok(())
    }
}

/// Counts as removed if somebody else has removed it before.
fn removed(outcome: Result<()>, missing: ErrorKind) -> Result<()> {
    outcome.or_else(|error| if error.kind() == missing { Ok(()) } else { Err(error) })
}
