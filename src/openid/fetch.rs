//! The few requests that a sign-in makes to the provider: HTTP/1.1, over TLS but to this machine, each with a
//! deadline and a limit on its answer.

use std::path::Path;
use std::time::Duration;

use anyhow::Context as _;
use bytes::Bytes;
use http_body_util::{BodyExt as _, Full, Limited};
use hyper::header::{ACCEPT, AUTHORIZATION, CONNECTION, CONTENT_TYPE, HOST};
use hyper::{Method, Request, StatusCode, Uri};
use hyper_util::rt::TokioIo;
use rustls::pki_types::ServerName;
use serde::de::DeserializeOwned;
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::net::TcpStream;
use tokio_rustls::TlsConnector;

use crate::tls_client::{authorities, client_config};

/// Time for a request, from the connection to the last byte of its answer.
const TIME: Duration = Duration::from_secs(10);
/// Bytes of an answer.
const MAX_BYTES: usize = 1 << 20;

/// The response of the provider.
pub(super) struct Answer {
    status: StatusCode,
    body: Bytes,
}

impl Answer {
    /// The content of a success.
    ///
    /// # Errors
    /// The status of anything else.
    pub(super) fn content<T: DeserializeOwned>(&self) -> anyhow::Result<T> {
        // An error's body may repeat the code, so only its name is shown.
        let name: String = self.error_name().unwrap_or_default().chars().take(64).collect();
        anyhow::ensure!(self.status.is_success(), "the answer is {} {name:?}", self.status);
        serde_json::from_slice(&self.body).context("the answer cannot be read")
    }

    /// The error of RFC 6749, 5.2, if the answer names one.
    pub(super) fn error_name(&self) -> Option<String> {
        #[derive(serde::Deserialize)]
        struct Named {
            error: String,
        }
        Some(serde_json::from_slice::<Named>(&self.body).ok()?.error)
    }
}

/// A client that trusts certain authorities.
pub(super) struct Fetch {
    tls: TlsConnector,
}

impl Fetch {
    /// Trusts the authorities of a file, or those of the system.
    ///
    /// # Errors
    /// Names the file that cannot be used.
    pub(super) fn new(ca: Option<&Path>) -> anyhow::Result<Self> {
        let unusable = || format!("openid.ca: {} cannot be used", ca.unwrap_or(Path::new("")).display());
        let pem = ca.map(std::fs::read).transpose().with_context(unusable)?;
        let trusted = authorities(pem.as_deref()).with_context(unusable)?;
        Ok(Self { tls: client_config(trusted, None)?.into() })
    }

    pub(super) async fn get<T: DeserializeOwned>(&self, url: &str) -> anyhow::Result<T> {
        self.fetch(Method::GET, url, None, String::new()).await?.content()
    }

    /// Sends a form.
    pub(super) async fn post(
        &self,
        url: &str,
        authorization: Option<String>,
        form: String,
    ) -> anyhow::Result<Answer> {
        self.fetch(Method::POST, url, authorization, form).await
    }

    async fn fetch(
        &self,
        method: Method,
        url: &str,
        authorization: Option<String>,
        form: String,
    ) -> anyhow::Result<Answer> {
        let fetched = async {
            let uri: Uri = url.parse()?;
            let host = uri.host().context("the URL has no host")?;
            let path = uri.path_and_query().map_or("/", |path| path.as_str());
            let authority = uri.authority().context("the URL has no host")?.as_str();
            let mut request = Request::builder()
                .method(method)
                .uri(path)
                .header(HOST, authority)
                .header(ACCEPT, "application/json")
                .header(CONNECTION, "close");
            if !form.is_empty() {
                request = request.header(CONTENT_TYPE, "application/x-www-form-urlencoded");
            }
            if let Some(authorization) = authorization {
                request = request.header(AUTHORIZATION, authorization);
            }
            let request = request.body(Full::from(form))?;
            let host = host.trim_start_matches('[').trim_end_matches(']').to_owned();
            let is_https = uri.scheme_str() == Some("https");
            let port = uri.port_u16().unwrap_or(if is_https { 443 } else { 80 });
            let stream = TcpStream::connect((host.as_str(), port)).await?;
            if is_https {
                exchange(self.tls.connect(ServerName::try_from(host)?, stream).await?, request).await
            } else {
                anyhow::ensure!(stream.peer_addr()?.ip().is_loopback(), "http is for this machine only");
                exchange(stream, request).await
            }
        };
        let answer = tokio::time::timeout(TIME, fetched).await;
        let answer = answer.unwrap_or_else(|_| Err(anyhow::anyhow!("no answer within {} s", TIME.as_secs())));
        answer.with_context(|| format!("cannot ask {url}"))
    }
}

async fn exchange<S>(stream: S, request: Request<Full<Bytes>>) -> anyhow::Result<Answer>
where
    S: AsyncRead + AsyncWrite + Unpin,
{
    let (mut sender, connection) = hyper::client::conn::http1::handshake(TokioIo::new(stream)).await?;
    let answered = async move {
        let answer = sender.send_request(request).await?;
        let status = answer.status();
        let body = Limited::new(answer.into_body(), MAX_BYTES).collect().await;
        let body = body.map_err(|error| anyhow::anyhow!(error))?.to_bytes();
        anyhow::Ok(Answer { status, body })
    };
    let (answer, _) = tokio::join!(answered, connection);
    answer
}
