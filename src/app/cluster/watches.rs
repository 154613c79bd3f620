//! Readers of live state, which must not wait here for what happens on another node.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, Weak};

use tokio_util::sync::CancellationToken;

use crate::app::live::sync::lock;
use crate::domain::{CameraKey, SiteKey};

/// A camera or site that is read.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(super) enum Watched {
    Camera(CameraKey),
    Site(SiteKey),
}

/// Held by a reader of events.
#[derive(Clone, Default)]
pub struct Watch(Option<Arc<CancellationToken>>);

impl Watch {
    /// Waits until another node has become the owner, or may have; without end for a server that owns everything.
    pub async fn ended(&self) {
        match &self.0 {
            None => std::future::pending().await,
            Some(ended) => ended.cancelled().await,
        }
    }

    /// True if another node has become the owner, or may have.
    #[must_use]
    pub fn has_ended(&self) -> bool {
        self.0.as_ref().is_some_and(|ended| ended.is_cancelled())
    }
}

/// The readers of this node.
#[derive(Default)]
pub(super) struct Watches(Mutex<HashMap<Watched, Weak<CancellationToken>>>);

impl Watches {
    pub(super) fn begin(&self, watched: Watched) -> Watch {
        let mut watches = lock(&self.0);
        if let Some(known) = watches.get(&watched).and_then(Weak::upgrade) {
            return Watch(Some(known));
        }
        let ended = Arc::new(CancellationToken::new());
        watches.insert(watched, Arc::downgrade(&ended));
        Watch(Some(ended))
    }

    /// Returns the cameras and sites that are read now.
    pub(super) fn watched(&self) -> (Vec<CameraKey>, Vec<SiteKey>) {
        let mut watches = lock(&self.0);
        watches.retain(|_, watch| watch.strong_count() > 0);
        let (mut cameras, mut sites) = (Vec::new(), Vec::new());
        for watched in watches.keys() {
            match watched {
                Watched::Camera(key) => cameras.push(*key),
                Watched::Site(key) => sites.push(*key),
            }
        }
        (cameras, sites)
    }

    pub(super) fn end_all(&self) {
        let watches = std::mem::take(&mut *lock(&self.0));
        watches.into_values().filter_map(|watch| watch.upgrade()).for_each(|watch| watch.cancel());
    }

    pub(super) fn end(&self, watched: Watched) {
        if let Some(ended) = lock(&self.0).remove(&watched).and_then(|watch| watch.upgrade()) {
            ended.cancel();
        }
    }
}
