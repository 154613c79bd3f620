//! The outboxes of sinks, and the logs of positions that this process keeps for them.

use crate::app::cluster::Nodes;
use crate::app::{App, SinkFeeds};
use crate::domain::{ConnectionKey, OutboxLog, OutboxMessage, Result};
use crate::store::Store;

/// The outboxes of sinks, and the logs of positions that this process keeps for them.
#[derive(Clone, Copy)]
pub struct Outboxes<'a> {
    store: &'a Store,
    sink_feeds: &'a SinkFeeds,
    nodes: Nodes<'a>,
}

impl App {
    /// The outboxes of sinks, and the logs of positions that this process keeps for them.
    #[must_use]
    pub fn outboxes(&self) -> Outboxes<'_> {
        Outboxes { store: &self.store, sink_feeds: &self.sink_feeds, nodes: self.nodes() }
    }
}

impl Outboxes<'_> {
    /// Appends messages of this process's log to the outbox of a sink. Returns the number of the oldest messages that
    /// were dropped for the limit. Messages that an earlier attempt stored without an answer are left out.
    ///
    /// # Errors
    /// The store cannot be written; then none is appended, or all are and the next attempt finds them.
    pub async fn append(&self, sink: ConnectionKey, messages: &[OutboxMessage]) -> Result<u64> {
        self.store.append_to_outbox(sink, &self.log(), messages).await
    }

    /// Sinks whose latest positions a process may have lost, since it ended before it had appended them; each loss is
    /// returned once, by one process.
    ///
    /// # Errors
    /// The store cannot be read or written.
    pub async fn lost_logs(&self) -> Result<Vec<ConnectionKey>> {
        self.store.lost_outbox_logs(&self.log()).await
    }

    /// At the end of the server: waits for the outboxes, and tells the database which of them have everything.
    pub(in crate::app) async fn close_logs(&self) {
        let complete = self.sink_feeds.close().await;
        if complete.is_empty() {
            return;
        }
        if let Err(error) = self.store.close_outbox_logs(&self.log(), &complete).await {
            tracing::warn!(%error, "the next start will count positions of sinks as lost");
        }
    }

    fn log(&self) -> OutboxLog {
        OutboxLog { id: self.sink_feeds.log(), node: self.nodes.reporting_node() }
    }
}
