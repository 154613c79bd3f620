//! A connection to one broker: requests and their answers, in turn.

use std::sync::Arc;

use bytes::{BufMut as _, Bytes, BytesMut};
use rsasl::config::SASLConfig;
use rsasl::prelude::{Mechname, SASLClient};
use rustls::ClientConfig;
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};

use super::fields::{FieldError, Fields, Write as _};
use super::requests::{ErrorCode, Request, SaslAuthenticate, SaslHandshake};
use crate::connect::credentials::{Credentials, PeerError};
use crate::connect::peer::{ByteStream, OPEN_TIME, dial, within};
use crate::connect::tls;
use crate::exchange::Address;
use crate::exchange::kinds::SaslMechanism;

/// Largest answer of a broker that is read, bytes. A broker sends at least one batch of records, however large it is.
const MAX_ANSWER_BYTES: u64 = 64 << 20;

impl From<ErrorCode> for PeerError {
    fn from(error: ErrorCode) -> Self {
        Self(error.to_string())
    }
}

impl From<FieldError> for PeerError {
    fn from(error: FieldError) -> Self {
        Self(format!("the broker's answer {error}"))
    }
}

/// A user and how it signs in.
struct User {
    mechanism: &'static str,
    name: String,
    password: String,
}

/// Opens connections to the brokers of a cluster.
pub(super) struct Dialer {
    client_id: String,
    tls: Option<Arc<ClientConfig>>,
    user: Option<User>,
}

impl Dialer {
    pub(super) fn new(
        address: &Address,
        credentials: &Credentials<'_>,
        client_id: &str,
    ) -> Result<Self, PeerError> {
        let tls = address.is_encrypted.then(|| tls::peer_config(credentials)).transpose()?;
        let user = credentials.username.map(|name| User {
            mechanism: match credentials.sasl_mechanism {
                None | Some(SaslMechanism::Plain) => "PLAIN",
                Some(SaslMechanism::ScramSha256) => "SCRAM-SHA-256",
                Some(SaslMechanism::ScramSha512) => "SCRAM-SHA-512",
            },
            name: name.to_owned(),
            password: credentials.secrets.get("password").unwrap_or_default().to_owned(),
        });
        Ok(Self { client_id: client_id.to_owned(), tls, user })
    }

    /// Connects to a broker and signs in.
    pub(super) async fn open(&self, (host, port): &(String, u16)) -> Result<Broker, PeerError> {
        let stream = dial(host, *port, self.tls.clone()).await?;
        let mut broker = Broker { stream, client_id: self.client_id.clone(), requests: 0 };
        if let Some(user) = &self.user {
            broker.sign_in(user).await.map_err(|error| PeerError(format!("signing in: {error}")))?;
        }
        Ok(broker)
    }
}

/// An open connection to a broker.
pub(super) struct Broker {
    stream: Box<dyn ByteStream>,
    client_id: String,
    /// Number of the last request, which its answer repeats.
    requests: i32,
}

impl Broker {
    async fn sign_in(&mut self, user: &User) -> Result<(), PeerError> {
        let (error, known) = self.ask(&SaslHandshake { mechanism: user.mechanism }).await?;
        error
            .check()
            .map_err(|error| PeerError(format!("{error}; the broker knows {}", known.join(", "))))?;
        let sasl = |error: &dyn std::fmt::Display| PeerError(error.to_string());
        let config = SASLConfig::with_credentials(None, user.name.clone(), user.password.clone());
        let mechanism = Mechname::parse(user.mechanism.as_bytes()).map_err(|error| sasl(&error))?;
        let client = SASLClient::new(config.map_err(|error| sasl(&error))?);
        let mut session = client.start_suggested(&[mechanism]).map_err(|error| sasl(&error))?;
        let mut received = None;
        loop {
            let mut message = Vec::new();
            let state = session.step(received.as_deref(), &mut message).map_err(|error| sasl(&error))?;
            if state.has_sent_message() {
                let (error, text, answer) = self.ask(&SaslAuthenticate(message)).await?;
                error.check().map_err(|error| PeerError(format!("{error}: {text}")))?;
                received = Some(answer);
            }
            if state.is_finished() {
                return Ok(());
            }
        }
    }

    /// The answer to a request.
    pub(super) async fn ask<R: Request>(&mut self, request: &R) -> Result<R::Answer, PeerError> {
        within(OPEN_TIME, async {
            self.send(request).await?;
            let size = self.answer_size().await?;
            self.answer::<R>(size).await
        })
        .await
    }

    pub(super) async fn send<R: Request>(&mut self, request: &R) -> Result<(), PeerError> {
        self.requests = self.requests.wrapping_add(1);
        let mut content = BytesMut::new();
        content.put_i16(R::KEY);
        content.put_i16(R::VERSION);
        content.put_i32(self.requests);
        content.put_text(&self.client_id);
        request.write(&mut content);
        let mut frame = BytesMut::with_capacity(content.len() + 4);
        frame.put_bytes_field(&content);
        self.stream.write_all(&frame).await?;
        Ok(self.stream.flush().await?)
    }

    /// Waits until an answer begins; how long it is, bytes.
    pub(super) async fn answer_size(&mut self) -> Result<u64, PeerError> {
        let size = self.stream.read_u32().await.map(u64::from);
        let size = size.map_err(|error| PeerError(format!("the broker sent no answer: {error}")))?;
        match size {
            ..=MAX_ANSWER_BYTES => Ok(size),
            _ => Err(PeerError(format!("the broker's answer is larger than {MAX_ANSWER_BYTES} bytes"))),
        }
    }

    /// Reads an answer that has begun. Memory grows with what comes.
    pub(super) async fn answer<R: Request>(&mut self, size: u64) -> Result<R::Answer, PeerError> {
        let mut content = Vec::new();
        (&mut self.stream).take(size).read_to_end(&mut content).await?;
        if content.len() as u64 != size {
            return Err("the broker closed the connection within an answer".into());
        }
        let mut fields = Fields(Bytes::from(content));
        if fields.i32()? != self.requests {
            return Err("the broker answered another request".into());
        }
        Ok(R::read(&mut fields)?)
    }
}
