//! The interface of a sink.

use std::time::Duration;

use futures_util::future::BoxFuture;

use super::credentials::PeerError;
use crate::domain::OutboxMessage;

/// Numbers of messages of the outbox, with `Ok` for what was delivered and the reason for what was refused for good.
pub(super) type Outcomes = Vec<(i64, Result<(), String>)>;

/// An open connection to a system that takes messages.
pub(super) trait Sink: Send {
    /// Delivers messages in their order; outcomes are added as they are known. After an error the rest is tried again.
    fn deliver<'a>(
        &'a mut self,
        messages: &'a [OutboxMessage],
        outcomes: &'a mut Outcomes,
    ) -> BoxFuture<'a, Result<(), PeerError>>;

    /// The pause that the receiver asks for after a delivery has failed.
    fn retry_after(&self) -> Option<Duration> {
        None
    }

    /// Completes once the connection has failed while nothing is delivered, for kinds that find out. Cancelling the wait
    /// loses nothing.
    fn failed(&mut self) -> BoxFuture<'_, PeerError> {
        Box::pin(std::future::pending())
    }
}
