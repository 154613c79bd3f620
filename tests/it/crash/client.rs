//! A client of a server that may be killed at any moment.

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::sync::{Arc, Mutex};

use http_body_util::{BodyExt as _, Full};
use hyper::body::Bytes;
use hyper::{Request, Uri};
use hyper_util::client::legacy::Client as HttpClient;
use hyper_util::client::legacy::connect::HttpConnector;
use hyper_util::rt::TokioExecutor;
use serde_json::Value;

/// The response that a client receives for a request.
pub(super) enum Reply {
    /// The server did it.
    Done(Value),
    /// The server refused it: nothing was changed.
    Refused(u16, String),
    /// The connection broke, or the server failed: it may have been done or not.
    Unknown,
}

/// Clones share connections, and the count of answers by status.
#[derive(Clone)]
pub(super) struct Client {
    http: HttpClient<HttpConnector, Full<Bytes>>,
    pub(super) address: SocketAddr,
    pub(super) key: Arc<str>,
    statuses: Arc<Mutex<BTreeMap<u16, u64>>>,
}

impl Client {
    pub(super) fn new(address: SocketAddr, key: &str) -> Self {
        let http = HttpClient::builder(TokioExecutor::new()).build_http();
        Self { http, address, key: key.into(), statuses: Arc::default() }
    }

    /// The same client with another key.
    pub(super) fn with_key(&self, key: &str) -> Self {
        Self { key: key.into(), ..self.clone() }
    }

    pub(super) async fn send(
        &self,
        method: &str,
        path: &str,
        content_type: &str,
        body: impl Into<Bytes>,
    ) -> Reply {
        let uri: Uri = format!("http://{}{path}", self.address).parse().expect("a path");
        let request = Request::builder()
            .method(method)
            .uri(uri)
            .header("content-type", content_type)
            .header("authorization", format!("Bearer {}", self.key))
            .body(Full::new(body.into()))
            .expect("a request");
        let Ok(response) = self.http.request(request).await else { return Reply::Unknown };
        let status = response.status().as_u16();
        *self.statuses.lock().expect("no panic").entry(status).or_default() += 1;
        let Ok(body) = response.into_body().collect().await else { return Reply::Unknown };
        let body = body.to_bytes();
        match status {
            200..300 => Reply::Done(serde_json::from_slice(&body).unwrap_or_default()),
            500 => Reply::Unknown,
            _ => Reply::Refused(status, String::from_utf8_lossy(&body).into_owned()),
        }
    }

    pub(super) async fn json(&self, method: &str, path: &str, body: &Value) -> Reply {
        self.send(method, path, "application/json", body.to_string()).await
    }

    /// Answers so far by status.
    pub(super) fn statuses(&self) -> BTreeMap<u16, u64> {
        self.statuses.lock().expect("no panic").clone()
    }
}
