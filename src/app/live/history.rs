//! Where a target was: its latest point, and before it points some time apart.

use std::collections::VecDeque;
use std::sync::Arc;

use jiff::{SignedDuration, Timestamp};

/// Points of a history are at least this far apart in time; the latest is always there.
const STEP: SignedDuration = SignedDuration::from_millis(500);

/// Points in order of time.
pub(super) struct History<P>(VecDeque<Arc<P>>);

impl<P> Default for History<P> {
    fn default() -> Self {
        Self(VecDeque::new())
    }
}

impl<P> History<P> {
    /// Adds the latest point; at most `most` points stay. A point before the latest begins the history again.
    pub(super) fn push(&mut self, point: &Arc<P>, time_of: impl Fn(&P) -> Timestamp, most: usize) {
        let points = &mut self.0;
        if points.back().is_some_and(|latest| time_of(point) < time_of(latest)) {
            points.clear();
        }
        let time = |at: usize| points.get(at).map(|point| time_of(point));
        let last = points.len().saturating_sub(1);
        let is_close = time(last)
            .zip(last.checked_sub(1).and_then(time))
            .is_some_and(|(latest, before)| latest.duration_since(before) < STEP);
        if is_close {
            points.pop_back();
        }
        while points.len() >= most.max(2) {
            points.pop_front();
        }
        points.push_back(point.clone());
    }

    /// The latest point.
    pub(super) fn latest(&self) -> Option<&Arc<P>> {
        self.0.back()
    }

    /// All points, oldest first.
    pub(super) fn points(&self) -> Vec<Arc<P>> {
        self.0.iter().cloned().collect()
    }
}
