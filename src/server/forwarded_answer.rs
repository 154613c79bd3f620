//! The answer of another node over gRPC, as this one passes it on.

use std::pin::Pin;
use std::task::{Context, Poll, ready};

use bytes::Bytes;
use futures_util::FutureExt as _;
use futures_util::future::BoxFuture;
use hyper::body::{Body as HttpBody, Frame, Incoming, SizeHint};

use crate::domain::{Error, ErrorKind};
use crate::grpc;
use crate::request::RequestContext;
use crate::shutdown::Shutdown;

/// Bytes before each message: whether it is compressed, and its length.
const MESSAGE_HEAD_BYTES: usize = 5;

/// Ends with a status where the connection to the other node breaks. On a live stream it asks the client to reconnect once
/// this node drains, so that the client ends the stream where it wants to: after the fix of its last box, for example.
pub(super) struct ForwardedAnswer {
    body: Incoming,
    context: RequestContext,
    messages: Messages,
    /// When the client of a live stream is to be asked.
    drain: Option<BoxFuture<'static, ()>>,
    /// The message that asks, until it is sent.
    invitation: Option<Bytes>,
    is_over: bool,
}

impl ForwardedAnswer {
    pub(super) fn new(body: Incoming, context: RequestContext) -> Self {
        let messages = Messages::default();
        Self { body, context, messages, drain: None, invitation: None, is_over: false }
    }

    /// The answer of a live stream, which lives no longer than this node.
    pub(super) fn until_drained(self, shutdown: Shutdown) -> Self {
        Self { drain: Some(Box::pin(async move { shutdown.draining().await })), ..self }
    }

    fn broken(&mut self, error: &hyper::Error) -> Frame<Bytes> {
        self.is_over = true;
        let message = format!("the connection to the node that has the camera broke: {error}");
        let error = Error::refused(ErrorKind::CameraBetweenNodes, message);
        Frame::trailers(grpc::trailers(&error, self.context.id()))
    }
}

impl HttpBody for ForwardedAnswer {
    type Data = Bytes;
    type Error = hyper::Error;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
    ) -> Poll<Option<Result<Frame<Bytes>, hyper::Error>>> {
        if self.is_over {
            return Poll::Ready(None);
        }
        if self.drain.as_mut().is_some_and(|drain| drain.poll_unpin(context).is_ready()) {
            self.drain = None;
            self.invitation = Some(grpc::reconnect_message());
        }
        if self.messages.is_between()
            && let Some(invitation) = self.invitation.take()
        {
            return Poll::Ready(Some(Ok(Frame::data(invitation))));
        }
        let Some(frame) = ready!(Pin::new(&mut self.body).poll_frame(context)) else {
            return Poll::Ready(None);
        };
        let frame = frame.unwrap_or_else(|error| self.broken(&error));
        if let Some(data) = frame.data_ref() {
            self.messages.pass(data);
        }
        Poll::Ready(Some(Ok(frame)))
    }

    fn is_end_stream(&self) -> bool {
        self.is_over || self.body.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        SizeHint::default()
    }
}

/// Where among messages the next byte belongs.
#[derive(Default)]
struct Messages {
    /// What was there of a message's head.
    head: Vec<u8>,
    /// Bytes of a message that are still to come.
    left: usize,
}

impl Messages {
    fn pass(&mut self, mut bytes: &[u8]) {
        while !bytes.is_empty() {
            let is_payload = self.left > 0;
            let wanted = if is_payload { self.left } else { MESSAGE_HEAD_BYTES - self.head.len() };
            let (part, rest) = bytes.split_at(wanted.min(bytes.len()));
            bytes = rest;
            if is_payload {
                self.left -= part.len();
                continue;
            }
            self.head.extend_from_slice(part);
            if let [_, a, b, c, d] = *self.head {
                self.left = u32::from_be_bytes([a, b, c, d]) as usize;
                self.head.clear();
            }
        }
    }

    fn is_between(&self) -> bool {
        self.left == 0 && self.head.is_empty()
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn the_end_of_each_message_is_found_however_the_bytes_are_cut(
            lengths in prop::collection::vec(0_usize..300, 1..20),
            cut in 1_usize..40,
        ) {
            let (mut bytes, mut ends) = (Vec::new(), vec![0]);
            for length in lengths {
                bytes.push(0);
                bytes.extend(u32::try_from(length).expect("short").to_be_bytes());
                bytes.resize(bytes.len() + length, 7);
                ends.push(bytes.len());
            }
            let (mut messages, mut passed) = (Messages::default(), 0);
            for part in bytes.chunks(cut) {
                prop_assert_eq!(messages.is_between(), ends.contains(&passed));
                messages.pass(part);
                passed += part.len();
            }
            prop_assert!(messages.is_between());
        }
    }
}
