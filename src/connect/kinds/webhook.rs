//! Webhooks: a signed POST per message, as the Standard Webhooks specification has it.
//!
//! The headers `webhook-id`, `webhook-timestamp` (seconds since 1970 of the attempt) and `webhook-signature`
//! (`v1,` and the base64 of HMAC-SHA256 over `id.timestamp.body`) let the receiver recognise repetitions, old messages
//! and forgeries. The key is the secret `signing_key`: base64 after `whsec_`, else its bytes.

use std::time::Duration;

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use bytes::Bytes;
use futures_util::future::BoxFuture;
use hmac::{Hmac, KeyInit as _, Mac as _};
use http_body_util::{BodyExt as _, Full, Limited};
use hyper::client::conn::http1::{self, SendRequest};
use hyper::header::{AUTHORIZATION, CONTENT_TYPE, HOST, HeaderValue, RETRY_AFTER, USER_AGENT};
use hyper::{HeaderMap, Request, StatusCode};
use hyper_util::rt::TokioIo;
use jiff::Timestamp;
use jiff::fmt::rfc2822;
use sha2::Sha256;
use tokio_util::task::AbortOnDropHandle;

use crate::clock::Clock;
use crate::connect::credentials::{Credentials, PeerError};
use crate::connect::peer::{OPEN_TIME, connect, within};
use crate::connect::sink::{Outcomes, Sink};
use crate::domain::OutboxMessage;
use crate::exchange::{Address, bracketed};

/// Bytes of an answer that are read, so that the connection can be used again.
const MAX_ANSWER_BYTES: usize = 64 << 10;
/// Longest pause that a receiver may ask for.
const MAX_RETRY_AFTER: Duration = Duration::from_secs(300);

/// An open connection to a receiver of webhooks.
pub(super) struct Webhook {
    sender: SendRequest<Full<Bytes>>,
    host: HeaderValue,
    path: String,
    authorization: Option<HeaderValue>,
    signing_key: Option<Vec<u8>>,
    media_type: &'static str,
    clock: Clock,
    /// The pause that the latest answer asks for.
    retry_after: Option<Duration>,
    _connection: AbortOnDropHandle<()>,
}

impl Webhook {
    pub(super) async fn open(
        address: &Address,
        credentials: &Credentials<'_>,
        media_type: &'static str,
        clock: Clock,
    ) -> Result<Self, PeerError> {
        let signing_key = credentials.secrets.get("signing_key").map(signing_key).transpose()?;
        let authorization = credentials.secrets.get("authorization").map(header).transpose()?;
        let host = format!("{}:{}", bracketed(&address.host), address.port);
        let stream = connect(address, credentials).await?;
        let (sender, connection) =
            http1::handshake(TokioIo::new(stream)).await.map_err(|error| PeerError(error.to_string()))?;
        // Its end is seen by the next request.
        let connection = tokio::spawn(async move { drop(connection.await) });
        Ok(Self {
            sender,
            host: header(&host)?,
            path: address.path.clone(),
            authorization,
            signing_key,
            media_type,
            clock,
            retry_after: None,
            _connection: AbortOnDropHandle::new(connection),
        })
    }

    /// Posts a message: `Err` within for a refusal for good.
    async fn post(&mut self, message: &OutboxMessage) -> Result<Result<(), String>, PeerError> {
        let timestamp_s = self.clock.now().as_second().to_string();
        let mut request = Request::post(&self.path)
            .header(HOST, &self.host)
            .header(CONTENT_TYPE, self.media_type)
            .header(USER_AGENT, concat!("sightfix/", env!("CARGO_PKG_VERSION")))
            .header("webhook-id", &message.message_id)
            .header("webhook-timestamp", &timestamp_s);
        if let Some(key) = &self.signing_key {
            let signature = signature(key, &message.message_id, &timestamp_s, &message.payload)?;
            request = request.header("webhook-signature", signature);
        }
        if let Some(authorization) = &self.authorization {
            request = request.header(AUTHORIZATION, authorization);
        }
        let body = Full::new(Bytes::copy_from_slice(&message.payload));
        let request = request.body(body).map_err(|error| PeerError(error.to_string()))?;
        let broken = |error: hyper::Error| PeerError(error.to_string());
        self.sender.ready().await.map_err(broken)?;
        let answer = self.sender.send_request(request).await.map_err(broken)?;
        let status = answer.status();
        self.retry_after = retry_after(answer.headers(), self.clock.now());
        let _ = Limited::new(answer.into_body(), MAX_ANSWER_BYTES).collect().await;
        match status {
            status if status.is_success() => Ok(Ok(())),
            StatusCode::REQUEST_TIMEOUT | StatusCode::TOO_EARLY | StatusCode::TOO_MANY_REQUESTS => {
                Err(PeerError(format!("the receiver answered {status}")))
            }
            status if status.is_client_error() => Ok(Err(format!("the receiver answered {status}"))),
            status => Err(PeerError(format!("the receiver answered {status}"))),
        }
    }
}

/// The pause of a header `retry-after` (RFC 9110, 10.2.3), which has seconds or a date.
fn retry_after(headers: &HeaderMap, now: Timestamp) -> Option<Duration> {
    let text = headers.get(RETRY_AFTER)?.to_str().ok()?.trim();
    let pause = match text.parse() {
        Ok(seconds) => Duration::from_secs(seconds),
        // A date that has passed asks for nothing.
        Err(_) => rfc2822::parse(text).ok()?.timestamp().duration_since(now).try_into().ok()?,
    };
    Some(pause.min(MAX_RETRY_AFTER))
}

impl Sink for Webhook {
    fn retry_after(&self) -> Option<Duration> {
        self.retry_after
    }

    fn deliver<'a>(
        &'a mut self,
        messages: &'a [OutboxMessage],
        outcomes: &'a mut Outcomes,
    ) -> BoxFuture<'a, Result<(), PeerError>> {
        Box::pin(async move {
            for message in messages {
                let outcome = within(OPEN_TIME, self.post(message)).await?;
                outcomes.push((message.number, outcome));
            }
            Ok(())
        })
    }
}

fn signing_key(secret: &str) -> Result<Vec<u8>, PeerError> {
    match secret.strip_prefix("whsec_") {
        None => Ok(secret.as_bytes().to_vec()),
        Some(encoded) => {
            STANDARD.decode(encoded).map_err(|_| "the secret signing_key is not base64 after whsec_".into())
        }
    }
}

fn header(text: &str) -> Result<HeaderValue, PeerError> {
    let mut value =
        HeaderValue::from_str(text).map_err(|_| PeerError::from("a header has a control character"))?;
    value.set_sensitive(true);
    Ok(value)
}

fn signature(key: &[u8], id: &str, timestamp_s: &str, body: &[u8]) -> Result<String, PeerError> {
    let mut mac = Hmac::<Sha256>::new_from_slice(key).map_err(|error| PeerError(error.to_string()))?;
    for part in [id.as_bytes(), b".", timestamp_s.as_bytes(), b".", body] {
        mac.update(part);
    }
    Ok(format!("v1,{}", STANDARD.encode(mac.finalize().into_bytes())))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_pause_is_that_of_seconds_or_of_a_date_and_has_a_limit() {
        let now = "2026-05-01T12:00:00Z".parse().expect("a time");
        let pause_s = |text: &str| {
            let headers = HeaderMap::from_iter([(RETRY_AFTER, text.parse().expect("a header"))]);
            retry_after(&headers, now).map(|pause| pause.as_secs())
        };
        assert_eq!(pause_s("120"), Some(120));
        assert_eq!(pause_s("Fri, 01 May 2026 12:02:00 GMT"), Some(120));
        assert_eq!(
            (pause_s("99999999999"), pause_s("Sat, 01 May 2027 12:00:00 GMT")),
            (Some(300), Some(300))
        );
        for none in ["Fri, 01 May 2026 11:59:00 GMT", "soon", "-1", ""] {
            assert_eq!(pause_s(none), None, "{none}");
        }
        assert_eq!(retry_after(&HeaderMap::new(), now), None);
    }

    /// The example of the Standard Webhooks specification's reference libraries.
    #[test]
    fn a_signature_is_that_of_the_specification() {
        let key = signing_key("whsec_MfKQ9r8GKYqrTwjUPD8ILPZIo2LaLaSw").expect("base64");
        let signed =
            signature(&key, "msg_p5jXN8AQM9LWM0D4loKWxJek", "1614265330", br#"{"test": 2432232314}"#);
        assert_eq!(signed.expect("a key"), "v1,g0hM9SsE+OTPJTGt/tmIKtSyZlE3uFJELVlNIOLJ1OE=");
    }
}
