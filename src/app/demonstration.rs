//! The demonstration that the server shows, and its end.

use std::sync::Mutex;

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
    /// if none is shown. After an error it can be repeated.
    ///
    /// # Errors
    /// `RunLive` while one of its cameras is trained; a fault of the store.
    pub async fn end_demonstration(&self) -> Result<()> {
        let Some((parts, stop)) = lock(&self.demonstration.0).clone() else { return Ok(()) };
        stop.cancel();
        for id in &parts.connections {
            removed(self.connections().delete(id, None).await, ErrorKind::ConnectionNotFound)?;
        }
        for id in &parts.cameras {
            removed(self.cameras().delete(id, None).await, ErrorKind::CameraNotFound)?;
        }
        for id in &parts.sites {
            removed(self.sites().delete(id, None).await, ErrorKind::SiteNotFound)?;
        }
        *lock(&self.demonstration.0) = None;
        Ok(())
    }
}

/// Counts as removed if somebody else has removed it before.
fn removed(outcome: Result<()>, missing: ErrorKind) -> Result<()> {
    outcome.or_else(|error| if error.kind() == missing { Ok(()) } else { Err(error) })
}
