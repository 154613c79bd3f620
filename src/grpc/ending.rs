//! Client streams that end when the server does.

use std::convert::Infallible;
use std::pin::Pin;
use std::task::{Context, Poll};

use bytes::Bytes;
use hyper::Request;
use hyper::body::{Frame, SizeHint};
use tonic::Status;
use tonic::body::Body;
use tonic::server::NamedService;
use tower::Service;

use crate::shutdown::Shutdown;

/// A service whose clients' streams end when the server's end begins. For services of others that
/// would otherwise listen for as long as a client pleases.
#[derive(Clone)]
pub(super) struct EndsWithServer<S> {
    service: S,
    shutdown: Shutdown,
}

impl<S> EndsWithServer<S> {
    pub(super) fn new(service: S, shutdown: &Shutdown) -> Self {
        Self { service, shutdown: shutdown.clone() }
    }
}

impl<S: NamedService> NamedService for EndsWithServer<S> {
    const NAME: &'static str = S::NAME;
}

impl<S> Service<Request<Body>> for EndsWithServer<S>
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
        let ending = Box::pin(async move { shutdown.begun().await });
        self.service.call(request.map(|body| Body::new(Until { body, ending })))
    }
}

/// A body that is at its end when the server's end begins.
struct Until {
    body: Body,
    ending: Pin<Box<dyn Future<Output = ()> + Send>>,
}

impl hyper::body::Body for Until {
    type Data = Bytes;
    type Error = Status;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
    ) -> Poll<Option<Result<Frame<Bytes>, Status>>> {
        // First, so that a client whose backlog never ends cannot hold the server up.
        if self.ending.as_mut().poll(context).is_ready() {
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
