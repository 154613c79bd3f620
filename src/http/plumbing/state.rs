//! The state of all routes.

use std::ops::Deref;
use std::sync::Arc;

use crate::app::App;
use crate::config::Console;
use crate::shutdown::Shutdown;

/// The state that the handlers share. One pointer: the router clones it several times for each request.
#[derive(Clone)]
pub(in crate::http) struct Rest(Arc<RestState>);

/// See [`Rest`].
pub(in crate::http) struct RestState {
    pub(in crate::http) app: App,
    pub(in crate::http) console: Console,
    pub(in crate::http) shutdown: Shutdown,
}

impl Rest {
    pub(in crate::http) fn new(app: App, console: Console, shutdown: Shutdown) -> Self {
        Self(Arc::new(RestState { app, console, shutdown }))
    }
}

impl Deref for Rest {
    type Target = RestState;

    fn deref(&self) -> &RestState {
        &self.0
    }
}
