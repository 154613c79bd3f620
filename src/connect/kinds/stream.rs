//! Messages one after the other over TCP or TLS, as TAK servers take Cursor on Target events.

use futures_util::future::BoxFuture;
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _, ReadHalf, WriteHalf};
use tokio_util::task::AbortOnDropHandle;

use crate::connect::credentials::{Credentials, PeerError};
use crate::connect::peer::{ByteStream, connect};
use crate::connect::sink::{Outcomes, Sink};
use crate::domain::OutboxMessage;
use crate::exchange::Address;

const CLOSED: &str = "the peer has closed the connection";

/// Writes messages. What the system has taken counts as delivered: the protocol has no acknowledgement.
pub(super) struct StreamSink {
    out: WriteHalf<Box<dyn ByteStream>>,
    /// Ends when the peer closes the connection; what it sends is not used.
    reading: AbortOnDropHandle<()>,
}

impl StreamSink {
    pub(super) async fn open(address: &Address, credentials: &Credentials<'_>) -> Result<Self, PeerError> {
        let stream = connect(address, credentials).await?;
        let (incoming, out) = tokio::io::split(stream);
        Ok(Self { out, reading: AbortOnDropHandle::new(tokio::spawn(read_to_end(incoming))) })
    }
}

async fn read_to_end(mut incoming: ReadHalf<Box<dyn ByteStream>>) {
    let mut buffer = [0; 4_096];
    while incoming.read(&mut buffer).await.is_ok_and(|bytes| bytes > 0) {}
}

impl Sink for StreamSink {
    fn deliver<'a>(
        &'a mut self,
        messages: &'a [OutboxMessage],
        outcomes: &'a mut Outcomes,
    ) -> BoxFuture<'a, Result<(), PeerError>> {
        Box::pin(async move {
            for message in messages {
                // A write into a connection that the peer has closed would seem to succeed once.
                if self.reading.is_finished() {
                    return Err(CLOSED.into());
                }
                self.out.write_all(&message.payload).await?;
                self.out.flush().await?;
                outcomes.push((message.number, Ok(())));
            }
            Ok(())
        })
    }

    fn failed(&mut self) -> BoxFuture<'_, PeerError> {
        Box::pin(async {
            // A handle must not be awaited again once it has yielded.
            if !self.reading.is_finished() {
                // Nothing but the end of the stream ends it.
                let _ = (&mut self.reading).await;
            }
            CLOSED.into()
        })
    }
}
