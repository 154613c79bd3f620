//! Client streams that end when the server shuts down.

use std::convert::Infallible;
use std::pin::Pin;
use std::task::{Context, Poll};

use bytes::Bytes;
use futures_util::FutureExt as _;
use futures_util::future::{BoxFuture, Fuse, FusedFuture as _};
use hyper::Request;
use hyper::body::{Frame, SizeHint};
use tonic::Status;
use tonic::body::Body;
use tonic::server::NamedService;
use tower::Service;

use crate::shutdown::Shutdown;

/// A service whose client streams are at their end when the server begins to shut down. For services of
/// other crates, which would otherwise read for as long as a client sends.
#[derive(Clone)]
pub(super) struct CancelOnShutdown<S> {
    service: S,
    shutdown: Shutdown,
}

impl<S> CancelOnShutdown<S> {
    pub(super) fn new(service: S, shutdown: &Shutdown) -> Self {
        Self { service, shutdown: shutdown.clone() }
    }
}

impl<S: NamedService> NamedService for CancelOnShutdown<S> {
    const NAME: &'static str = S::NAME;
}

impl<S> Service<Request<Body>> for CancelOnShutdown<S>
where
    S: Service<Request<Body>, Error = Infallible>,
{
    type Response = S::Response;
    type Error = Infallible;
    type Future = S::Future;

    fn poll_ready(&mut self, context: &mut Context<'_>) -> Poll<Result<(), Infallible>> {
        self.service.poll_ready(context)
    }

    fn call(&mut self, request: Request<Body>) -> S::Future {
        let shutdown = self.shutdown.clone();
        let drained = async move { shutdown.begun().await }.boxed().fuse();
        self.service.call(request.map(|body| Body::new(CancellableBody { body, drained })))
    }
}

/// A body that is at its end once the server begins to shut down.
struct CancellableBody {
    body: Body,
    drained: Fuse<BoxFuture<'static, ()>>,
}

impl hyper::body::Body for CancellableBody {
    type Data = Bytes;
    type Error = Status;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
    ) -> Poll<Option<Result<Frame<Bytes>, Status>>> {
        // First, so that a client whose backlog never ends cannot hold the server up.
        if self.drained.is_terminated() || self.drained.poll_unpin(context).is_ready() {
            return Poll::Ready(None);
        }
        Pin::new(&mut self.body).poll_frame(context)
    }

    fn is_end_stream(&self) -> bool {
        self.body.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        self.body.size_hint()
    }
}
