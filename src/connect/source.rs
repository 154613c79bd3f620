//! The interface of a source.

use bytes::Bytes;
use futures_util::future::BoxFuture;

use super::credentials::PeerError;

/// A message as it came.
pub(super) struct Message {
    /// Identifies it when it is settled.
    pub(super) receipt: u64,
    /// Its topic, or the address of its sender.
    pub(super) subject: String,
    /// Its content, or the beginning of it where it is larger than is taken.
    pub(super) payload: Bytes,
    /// Bytes of the whole content.
    pub(super) size_bytes: usize,
    /// Why the source could not read it; its content then says where it is.
    pub(super) unread: Option<String>,
}

impl Message {
    /// A message with its whole content.
    pub(super) const fn new(receipt: u64, subject: String, payload: Bytes) -> Self {
        let size_bytes = payload.len();
        Self { receipt, subject, payload, size_bytes, unread: None }
    }

    /// The whole content, if it has at most `most_bytes`.
    ///
    /// # Errors
    /// Why there is none.
    pub(super) fn content(&self, most_bytes: usize) -> Result<&Bytes, String> {
        match &self.unread {
            Some(reason) => Err(reason.clone()),
            None if self.size_bytes > most_bytes => Err(format!("is larger than {most_bytes} bytes")),
            None => Ok(&self.payload),
        }
    }
}

/// An open connection to a system that sends messages.
pub(super) trait Source: Send {
    /// The next message. Cancelling the wait loses none.
    fn next(&mut self) -> BoxFuture<'_, Result<Message, PeerError>>;

    /// Tells the peer what became of messages, in their order.
    fn settle(&mut self, settled: Vec<Settled>) -> BoxFuture<'_, Result<(), PeerError>> {
        drop(settled);
        Box::pin(async { Ok(()) })
    }
}

/// The outcome of a message.
pub(super) struct Settled {
    pub(super) receipt: u64,
    /// `Ok` when all is stored that was to be stored of it, else why it cannot be read.
    pub(super) outcome: Result<(), String>,
}

/// Who a source is to its peer.
pub(super) struct SourceIdentity {
    /// Name of the client, the same at every attempt.
    pub(super) client_id: String,
    /// True if the peer keeps what is not acknowledged while the source is away.
    pub(super) is_lasting: bool,
}
