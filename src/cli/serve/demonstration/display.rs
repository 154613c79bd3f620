//! A display at the quay: a receiver of webhooks that is told of every event of the square's places.

use std::convert::Infallible;

use bytes::Bytes;
use http_body_util::{BodyExt as _, Empty, Limited};
use hyper::body::Incoming;
use hyper::server::conn::http1;
use hyper::service::service_fn;
use hyper::{Request, Response, StatusCode};
use hyper_util::rt::TokioIo;
use tokio::net::{TcpListener, TcpStream};
use tokio_util::sync::CancellationToken;

/// Bytes of an event that are read.
const MAX_EVENT_BYTES: usize = 64 << 10;

/// Takes events from every sender that connects.
pub(super) async fn receive_forever(listener: TcpListener) {
    // Connections end with the demonstration.
    let end = CancellationToken::new();
    let _end = end.clone().drop_guard();
    loop {
        match listener.accept().await {
            Ok((stream, _)) => drop(tokio::spawn(end.clone().run_until_cancelled_owned(serve(stream)))),
            Err(error) => {
                tracing::debug!(%error, "the display of the demonstration was not reached");
                tokio::time::sleep(super::device::PAUSE).await;
            }
        }
    }
}

async fn serve(stream: TcpStream) {
    let served = http1::Builder::new().serve_connection(TokioIo::new(stream), service_fn(take)).await;
    if let Err(error) = served {
        tracing::debug!(%error, "a connection to the display of the demonstration has failed");
    }
}

async fn take(request: Request<Incoming>) -> Result<Response<Empty<Bytes>>, Infallible> {
    let is_read = Limited::new(request.into_body(), MAX_EVENT_BYTES).collect().await.is_ok();
    let mut answer = Response::new(Empty::new());
    *answer.status_mut() = if is_read { StatusCode::NO_CONTENT } else { StatusCode::PAYLOAD_TOO_LARGE };
    Ok(answer)
}
