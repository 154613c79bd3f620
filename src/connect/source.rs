//! What a source is.

use bytes::Bytes;
use futures_util::future::BoxFuture;

use super::credentials::PeerError;

/// A message as it came.
pub(super) struct Message {
    /// Names it when it is settled.
    pub(super) receipt: u64,
    /// Its topic, or the address of its sender.
    pub(super) subject: String,
    pub(super) payload: Bytes,
}

/// An open connection to a system that sends messages.
pub(super) trait Source: Send {
    /// The next message. Cancelling the wait loses none.
    fn next(&mut self) -> BoxFuture<'_, Result<Message, PeerError>>;

    /// Tells the peer what became of a message: what was to be stored of it is stored, or it cannot be read. Called in
    /// the order of the messages.
    fn settle(&mut self, receipt: u64, outcome: Result<(), String>) -> BoxFuture<'_, Result<(), PeerError>> {
        let _ = (receipt, outcome);
        Box::pin(async { Ok(()) })
    }
}

/// Who a source is to its peer.
pub(super) struct SourceIdentity {
    /// Name of the client, the same at every attempt.
    pub(super) client_id: String,
    /// Whether the peer keeps what is not acknowledged while the source is away.
    pub(super) is_lasting: bool,
}
