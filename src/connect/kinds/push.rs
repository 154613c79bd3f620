//! Messages that clients hand in by HTTP.

use std::collections::HashMap;
use std::sync::Arc;

use futures_util::future::BoxFuture;
use tokio::sync::{mpsc, oneshot};

use crate::app::{LiveConnection, PushedMessage};
use crate::connect::credentials::PeerError;
use crate::connect::source::{Message, Settled, Source};

/// Takes what `Connections::push` hands in, while it exists.
pub(super) struct PushSource {
    live: Arc<LiveConnection>,
    messages: mpsc::Receiver<PushedMessage>,
    unsettled: HashMap<u64, oneshot::Sender<Result<(), String>>>,
    last_receipt: u64,
}

impl PushSource {
    pub(super) fn open(live: Arc<LiveConnection>, queue: usize) -> Self {
        let (inlet, messages) = mpsc::channel(queue);
        live.set_inlet(Some(inlet));
        Self { live, messages, unsettled: HashMap::new(), last_receipt: 0 }
    }
}

impl Drop for PushSource {
    fn drop(&mut self) {
        self.live.set_inlet(None);
    }
}

impl Source for PushSource {
    fn next(&mut self) -> BoxFuture<'_, Result<Message, PeerError>> {
        Box::pin(async {
            let PushedMessage { sender, payload, settled } =
                self.messages.recv().await.ok_or_else(|| PeerError::from("the connection is closed"))?;
            self.last_receipt += 1;
            self.unsettled.insert(self.last_receipt, settled);
            Ok(Message::new(self.last_receipt, sender, payload))
        })
    }

    fn settle(&mut self, settled: Vec<Settled>) -> BoxFuture<'_, Result<(), PeerError>> {
        for Settled { receipt, outcome } in settled {
            if let Some(answer) = self.unsettled.remove(&receipt) {
                // The client may have gone.
                let _ = answer.send(outcome);
            }
        }
        Box::pin(async { Ok(()) })
    }
}
