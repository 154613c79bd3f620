//! A client of `FusionService.Stream`, whose interface does not show the transport.
//!
//! One [`Connection`] carries many streams. [`Connection::open`] gives the two halves of one: an
//! [`ItemSender`], whose waiting is the server's backpressure, and the [`Events`] that come back.
//! Has no retries, buffers or clocks; the caller decides on those, see
//! [`crate::replay`].

use std::fmt;
use std::time::Duration;

use futures_util::stream;
use tokio::sync::mpsc;
use tonic::metadata::AsciiMetadataValue;
use tonic::transport::{Channel, Endpoint};
use tonic::{Code, Status, Streaming};
use tonic_types::StatusExt as _;

use super::convert::timestamp;
use super::proto;
use super::proto::fusion_service_client::FusionServiceClient;
use crate::domain::{CameraId, KeySecret, LiveItem, Score};

/// A server that does not take the connection within this time counts as unreachable.
const CONNECT_TIME: Duration = Duration::from_secs(5);
/// A connection that is silent for this long is asked for a sign of life ...
const PING_AFTER: Duration = Duration::from_secs(10);
/// ... and is broken if none comes within this time.
const PING_TIME: Duration = Duration::from_secs(10);
/// Items on their way to the connection; beyond them the sender waits.
const ITEMS_QUEUED: usize = 16;

/// How a stream begins.
#[derive(Debug, Clone)]
pub struct Opening {
    /// The camera that the items belong to.
    pub camera_id: CameraId,
    /// Who streams; streams per name are limited.
    pub client_name: String,
    /// The last seq that an earlier stream of this client had acknowledged; 0 to begin.
    pub resume_after_seq: u64,
    /// True if the items become training samples and are acknowledged.
    pub store_samples: bool,
}

/// A message of the server on a stream.
#[derive(Debug, Clone, PartialEq)]
pub enum Event {
    /// The first: the stream is open.
    Opened {
        /// Number of the model version that answers now, if there is one.
        model_version: Option<u32>,
    },
    /// The answer for one item.
    Answer(Box<proto::StreamAnswer>),
    /// Every item up to this seq is committed or can no longer become a sample.
    Acknowledged { seq: u64 },
    /// The camera no longer looks where it looked when its model was trained.
    CameraMoved(proto::CameraMoved),
    /// Half-close, wait for the last acknowledgement and the end, and open another stream.
    Reconnect {
        /// The reason, for people.
        reason: String,
    },
}

/// Why a call or a stream ended badly.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ClientError {
    /// The stable name of the kind of error if the server gave one; else the name of the code.
    pub reason: String,
    /// The error, for people.
    pub message: String,
    /// True if the same may succeed later: the connection broke, or the server is overloaded.
    pub retryable: bool,
    /// Address of the node that does what was asked for, where the server is one of several.
    pub owner: Option<String>,
}

impl fmt::Display for ClientError {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(out, "{} ({})", self.message, self.reason)
    }
}

impl std::error::Error for ClientError {}

impl ClientError {
    /// A transport error without a gRPC status.
    #[must_use]
    pub fn broken_line(message: &str) -> Self {
        Self { reason: "broken-line".to_owned(), message: message.to_owned(), retryable: true, owner: None }
    }
}

impl From<Status> for ClientError {
    fn from(status: Status) -> Self {
        let (server_reason, owner) = status
            .get_details_error_info()
            .map(|mut info| (info.reason, info.metadata.remove("owner")))
            .unzip();
        let retryable = match status.code() {
            Code::Unavailable | Code::DeadlineExceeded | Code::Aborted | Code::Internal => true,
            // The line's own faults come under these codes, without any details.
            Code::Unknown | Code::Cancelled | Code::ResourceExhausted => server_reason.is_none(),
            _ => false,
        };
        let reason = server_reason.unwrap_or_else(|| format!("{:?}", status.code()).to_lowercase());
        let message = match status.message() {
            "" => status.code().description().to_owned(),
            message => message.to_owned(),
        };
        Self { reason, message, retryable, owner: owner.flatten() }
    }
}

/// An HTTP/2 connection, made when it is first needed and again after it broke. Clones share it.
#[derive(Debug, Clone)]
pub struct Connection {
    channel: Channel,
    /// Sent with every call, if the server asks for a key.
    authorization: Option<AsciiMetadataValue>,
}

impl Connection {
    /// To a server such as `http://127.0.0.1:8080`, with a key if it asks for one. Nothing is sent yet.
    ///
    /// # Errors
    /// An address that is none, or that asks for TLS, which this client does not speak.
    pub fn to(server: &str, key: Option<&KeySecret>) -> Result<Self, ClientError> {
        let refused = |message: String| ClientError {
            reason: "invalid-argument".to_owned(),
            message,
            retryable: false,
            owner: None,
        };
        if !server.starts_with("http://") {
            return Err(refused(format!("`{server}` must begin with http://")));
        }
        let endpoint = Endpoint::from_shared(server.to_owned())
            .map_err(|error| refused(format!("`{server}` is not the address of a server: {error}")))?;
        let endpoint = endpoint
            .connect_timeout(CONNECT_TIME)
            .tcp_nodelay(true)
            .http2_keep_alive_interval(PING_AFTER)
            .keep_alive_timeout(PING_TIME);
        let authorization = key.map(|key| {
            #[expect(clippy::expect_used, reason = "the secret was parsed")]
            let mut value =
                AsciiMetadataValue::try_from(format!("Bearer {}", key.reveal())).expect("a key is ASCII");
            value.set_sensitive(true);
            value
        });
        Ok(Self { channel: endpoint.connect_lazy(), authorization })
    }

    /// Opens a stream. The first event is [`Event::Opened`].
    ///
    /// # Errors
    /// The error that the server or the connection reports.
    pub async fn open(&self, opening: &Opening) -> Result<(ItemSender, Events), ClientError> {
        let (sender, mut queue) = mpsc::channel(ITEMS_QUEUED);
        // The queue is empty and has room, so this cannot fail.
        let _ = sender.try_send(request(proto::stream_request::Kind::Opening(opening.into())));
        let requests = stream::poll_fn(move |context| queue.poll_recv(context));
        let mut request = tonic::Request::new(requests);
        if let Some(authorization) = &self.authorization {
            request.metadata_mut().insert("authorization", authorization.clone());
        }
        let answers = FusionServiceClient::new(self.channel.clone()).stream(request).await?.into_inner();
        Ok((ItemSender(sender), Events(answers)))
    }
}

/// The client's half of a stream. Dropping it half-closes: it sends no further items, and answers still come.
#[derive(Debug)]
pub struct ItemSender(mpsc::Sender<proto::StreamRequest>);

impl ItemSender {
    /// Waits for the capacity to send one item. Cancel safe.
    ///
    /// # Errors
    /// The stream has ended; the [`Events`] say why.
    pub async fn reserve(&self) -> Result<SendPermit<'_>, ClientError> {
        let permit = self.0.reserve().await;
        permit.map(SendPermit).map_err(|_| ClientError::broken_line("the stream accepts no further items"))
    }
}

/// Capacity to send one item.
#[derive(Debug)]
pub struct SendPermit<'a>(mpsc::Permit<'a, proto::StreamRequest>);

impl SendPermit<'_> {
    /// Sends the item. Seqs must rise.
    pub fn send(self, seq: u64, item: LiveItem) {
        let item = proto::StreamItem {
            seq,
            time: Some(timestamp(item.time)),
            target_id: item.target_id.map(|id| id.as_str().to_owned()),
            receiver_id: item.receiver_id.map(|id| id.as_str().to_owned()),
            tracker_id: item.tracker_id.map(|id| id.as_str().to_owned()),
            bounding_box: item.bounding_box.map(Into::into),
            fix: item.fix.map(Into::into),
            class: item.class.map(|class| class.as_str().to_owned()),
            score: item.score.map(Score::value),
        };
        self.0.send(request(proto::stream_request::Kind::Item(item)));
    }
}

/// The server's half of a stream.
#[derive(Debug)]
pub struct Events(Streaming<proto::StreamResponse>);

impl Events {
    /// The next event; `None` when the server has ended the stream in order. Dropping the wait loses
    /// nothing. Events of a kind that this client does not know yet are passed over.
    ///
    /// # Errors
    /// The error that ended the stream otherwise.
    pub async fn next(&mut self) -> Result<Option<Event>, ClientError> {
        use proto::stream_response::Kind;
        loop {
            let Some(response) = self.0.message().await? else { return Ok(None) };
            return Ok(Some(match response.kind {
                None => continue,
                Some(Kind::Opened(opened)) => Event::Opened { model_version: opened.model_version },
                Some(Kind::Answer(answer)) => Event::Answer(answer),
                Some(Kind::Acknowledgement(upto)) => Event::Acknowledged { seq: upto.seq },
                Some(Kind::CameraMoved(moved)) => Event::CameraMoved(moved),
                Some(Kind::Reconnect(invitation)) => Event::Reconnect { reason: invitation.reason },
            }));
        }
    }
}

fn request(kind: proto::stream_request::Kind) -> proto::StreamRequest {
    proto::StreamRequest { kind: Some(kind) }
}

impl From<&Opening> for proto::StreamOpening {
    fn from(opening: &Opening) -> Self {
        Self {
            camera_id: opening.camera_id.as_str().to_owned(),
            client_name: opening.client_name.clone(),
            resume_after_seq: opening.resume_after_seq,
            store_samples: opening.store_samples,
            ..Self::default()
        }
    }
}

#[cfg(test)]
mod tests {
    use std::collections::HashMap;

    use tonic_types::ErrorDetails;

    use super::*;

    #[test]
    fn a_broken_line_passes_and_a_refusal_stays() {
        for code in [Code::Unavailable, Code::Unknown, Code::Internal, Code::Cancelled] {
            assert!(ClientError::from(Status::new(code, "h2 protocol error")).retryable, "{code:?}");
        }
        for code in [Code::NotFound, Code::InvalidArgument, Code::Unimplemented] {
            assert!(!ClientError::from(Status::new(code, "no")).retryable, "{code:?}");
        }
        let details =
            ErrorDetails::with_error_info("too-large", "sightfix", HashMap::<String, String>::new());
        let error = ClientError::from(Status::with_error_details(Code::ResourceExhausted, "no", details));
        assert_eq!((error.reason.as_str(), error.retryable), ("too-large", false));
        assert_eq!(error.to_string(), "no (too-large)");
        let owner = [("owner".to_owned(), "http://node-2:8080".to_owned())];
        let details = ErrorDetails::with_error_info("camera-on-other-node", "sightfix", HashMap::from(owner));
        let error = ClientError::from(Status::with_error_details(Code::Unavailable, "no", details));
        assert_eq!((error.owner.as_deref(), error.retryable), (Some("http://node-2:8080"), true));
    }

    #[tokio::test]
    async fn only_plain_addresses_are_taken() {
        for wrong in ["https://127.0.0.1:1", "127.0.0.1:8080", "http://", "http://a b"] {
            let refused = Connection::to(wrong, None).expect_err(wrong);
            assert!(!refused.retryable, "{wrong}");
        }
        Connection::to("http://127.0.0.1:8080", None).expect("an address");
    }

    #[tokio::test]
    async fn a_server_that_is_not_there_may_come_back() {
        let listener = std::net::TcpListener::bind("127.0.0.1:0").expect("a port");
        let address = listener.local_addr().expect("its address");
        drop(listener);
        let opening = Opening {
            camera_id: CameraId::new("yard").expect("a slug"),
            client_name: "test".to_owned(),
            resume_after_seq: 0,
            store_samples: false,
        };
        let connection = Connection::to(&format!("http://{address}"), None).expect("an address");
        let refused = connection.open(&opening).await.expect_err("nobody listens");
        assert!(refused.retryable, "{refused}");
    }
}
