//! A response's body that ends when the key of its request is revoked or expires.

use std::pin::Pin;
use std::task::{Context, Poll};

use axum::body::Body;
use bytes::Bytes;
use futures_util::FutureExt as _;
use futures_util::future::BoxFuture;
use hyper::body::{Body as HttpBody, Frame, SizeHint};

use crate::domain::{Error, Result};
use crate::grpc;
use crate::request::RequestContext;

/// Ends with an error status over gRPC; over REST it breaks off, so that nobody takes a part for the whole.
pub(super) struct RevocableBody {
    body: Body,
    context: RequestContext,
    ended: Option<BoxFuture<'static, Error>>,
    is_over: bool,
}

impl RevocableBody {
    pub(super) const fn new(body: Body, context: RequestContext) -> Self {
        Self { body, context, ended: None, is_over: false }
    }

    /// Why the body must end, if it must; the task is woken when it has to.
    fn poll_ended(&mut self, context: &mut Context<'_>) -> Poll<Error> {
        let request = &self.context;
        let ended = self.ended.get_or_insert_with(|| {
            let caller = request.caller().clone();
            async move { caller.ended().await }.boxed()
        });
        ended.poll_unpin(context)
    }

    fn end(&mut self, error: &Error) -> Option<Result<Frame<Bytes>, axum::Error>> {
        self.is_over = true;
        Some(if self.context.is_grpc() {
            Ok(Frame::trailers(grpc::trailers(error, self.context.id())))
        } else {
            Err(axum::Error::new(error.to_string()))
        })
    }
}

impl HttpBody for RevocableBody {
    type Data = Bytes;
    type Error = axum::Error;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
    ) -> Poll<Option<Result<Frame<Bytes>, axum::Error>>> {
        if self.is_over {
            return Poll::Ready(None);
        }
        if let Err(error) = self.context.caller().check_active() {
            return Poll::Ready(self.end(&error));
        }
        if let ready @ Poll::Ready(_) = Pin::new(&mut self.body).poll_frame(context) {
            return ready;
        }
        match self.poll_ended(context) {
            Poll::Ready(error) => Poll::Ready(self.end(&error)),
            Poll::Pending => Poll::Pending,
        }
    }

    fn is_end_stream(&self) -> bool {
        self.is_over || self.body.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        self.body.size_hint()
    }
}
