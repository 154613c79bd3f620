//! A tower layer that is an async function. Its future needs no box.

use std::task::{Context, Poll};

use hyper::Request;
use tower::{Layer, Service};

/// A layer by a function of some state, a request and the service below. All services of the stack are always ready.
pub(super) const fn async_layer<T, F>(state: T, function: F) -> AsyncLayer<T, F> {
    AsyncLayer { state, function }
}

pub(super) struct AsyncLayer<T, F> {
    state: T,
    function: F,
}

impl<T: Clone, F: Clone, S> Layer<S> for AsyncLayer<T, F> {
    type Service = AsyncLayered<T, F, S>;

    fn layer(&self, next: S) -> Self::Service {
        AsyncLayered { state: self.state.clone(), function: self.function.clone(), next }
    }
}

/// A service under an [`AsyncLayer`].
#[derive(Clone)]
pub(super) struct AsyncLayered<T, F, S> {
    state: T,
    function: F,
    next: S,
}

impl<T, F, S, B, A, R, E> Service<Request<B>> for AsyncLayered<T, F, S>
where
    T: Clone,
    F: FnMut(T, Request<B>, S) -> A,
    S: Clone,
    A: Future<Output = Result<R, E>>,
{
    type Response = R;
    type Error = E;
    type Future = A;

    fn poll_ready(&mut self, _: &mut Context<'_>) -> Poll<Result<(), E>> {
        Poll::Ready(Ok(()))
    }

    fn call(&mut self, request: Request<B>) -> A {
        (self.function)(self.state.clone(), request, self.next.clone())
    }
}
