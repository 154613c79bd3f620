//! A tower layer that is an async function. Its future needs no box.

use std::task::{Context, Poll};

use tower::{Layer, Service};

/// A layer by a function of a request and the service below. All services of the stack are always ready.
pub(super) const fn async_layer<F>(function: F) -> AsyncLayer<F> {
    AsyncLayer(function)
}

pub(super) struct AsyncLayer<F>(F);

impl<F: Clone, S> Layer<S> for AsyncLayer<F> {
    type Service = AsyncLayered<F, S>;

    fn layer(&self, next: S) -> Self::Service {
        AsyncLayered { function: self.0.clone(), next }
    }
}

/// A service under an [`AsyncLayer`].
#[derive(Clone)]
pub(super) struct AsyncLayered<F, S> {
    function: F,
    next: S,
}

impl<F, S, Q, A, R, E> Service<Q> for AsyncLayered<F, S>
where
    F: FnMut(Q, S) -> A,
    S: Clone,
    A: Future<Output = Result<R, E>>,
{
    type Response = R;
    type Error = E;
    type Future = A;

    fn poll_ready(&mut self, _: &mut Context<'_>) -> Poll<Result<(), E>> {
        Poll::Ready(Ok(()))
    }

    fn call(&mut self, request: Q) -> A {
        (self.function)(request, self.next.clone())
    }
}
