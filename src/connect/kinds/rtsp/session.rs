//! A session of RTSP 1.0 (RFC 2326) that plays the metadata of a stream.

use std::time::Duration;

use futures_util::{SinkExt as _, StreamExt as _};
use rtsp_types::headers::{
    ACCEPT, AUTHORIZATION, CONTENT_BASE, CSEQ, PUBLIC, RANGE, SESSION, TRANSPORT, USER_AGENT,
    WWW_AUTHENTICATE,
};
use rtsp_types::{HeaderName, HeaderValue, Message, Method, Request, Response, StatusCode, Url, Version};
use tokio::time::{Interval, interval};
use tokio_util::codec::Framed;

use super::codec::Codec;
use super::description::Controls;
use crate::connect::credentials::{Credentials, PeerError};
use crate::connect::peer::{ByteStream, connect};
use crate::connect::sign_in::SignIn;
use crate::exchange::{Address, bracketed};

/// Time after which a server ends a session that it has not heard of, where it does not state one (RFC 2326, 12.37).
const SESSION_TIMEOUT: Duration = Duration::from_secs(60);
/// Longest pause between two signs of life; routers forget connections that are silent for longer.
const KEEP_ALIVE: Duration = Duration::from_secs(30);
/// Asks for the packets inside of this connection.
const INTERLEAVED: &str = "RTP/AVP/TCP;unicast;interleaved=0-1";
const CLOSED: &str = "the camera has closed the connection";

/// A stream's metadata, playing.
pub(super) struct Session {
    connection: Connection,
    id: String,
    url: Url,
    /// The channel of the metadata's packets.
    channel: u8,
    sign_of_life: Method,
    keep_alive: Interval,
    /// True if a sign of life was sent and not answered yet.
    waits: bool,
}

impl Session {
    /// Connects, signs in where the camera asks for it, and has it send its metadata.
    pub(super) async fn open(address: &Address, credentials: &Credentials<'_>) -> Result<Self, PeerError> {
        let Address { scheme, host, port, path, .. } = address;
        let url = format!("{scheme}://{}:{port}{path}", bracketed(host));
        let url = Url::parse(&url).map_err(|error| PeerError(format!("{url} is no URL: {error}")))?;
        let mut connection = Connection::new(connect(address, credentials).await?, credentials);

        let options = connection.ask(&Method::Options, &url, &[]).await?;
        let is_offered = header(&options, &PUBLIC).contains("GET_PARAMETER");
        let sign_of_life = if is_offered { Method::GetParameter } else { Method::Options };
        let accept = [(ACCEPT, "application/sdp")];
        let described = connection.ask(&Method::Describe, &url, &accept).await?;
        let base = Url::parse(header(&described, &CONTENT_BASE)).unwrap_or(url);
        let controls = Controls::find(&String::from_utf8_lossy(described.body()), &base)?;
        let transport = [(TRANSPORT, INTERLEAVED)];
        let set_up = connection.ask(&Method::Setup, &controls.metadata, &transport).await?;
        let (id, timeout) = session_of(header(&set_up, &SESSION))?;
        let range = [(SESSION, id.as_str()), (RANGE, "npt=0.000-")];
        connection.ask(&Method::Play, &controls.stream, &range).await?;

        let mut keep_alive = interval((timeout / 2).min(KEEP_ALIVE));
        keep_alive.reset();
        let channel = channel_of(header(&set_up, &TRANSPORT));
        Ok(Self { connection, id, url: controls.stream, channel, sign_of_life, keep_alive, waits: false })
    }

    /// The next packet of the metadata. Cancelling the wait loses none.
    pub(super) async fn next_packet(&mut self) -> Result<Vec<u8>, PeerError> {
        loop {
            tokio::select! {
                message = self.connection.stream.next() => match message.ok_or(CLOSED)?? {
                    Message::Data(data) if data.channel_id() == self.channel => return Ok(data.into_body()),
                    Message::Response(response) => self.take_answer(&response)?,
                    Message::Data(_) | Message::Request(_) => {}
                },
                _ = self.keep_alive.tick() => self.send_sign_of_life().await?,
            }
        }
    }

    async fn send_sign_of_life(&mut self) -> Result<(), PeerError> {
        if std::mem::replace(&mut self.waits, true) {
            return Err(PeerError(format!(
                "the camera did not answer within {} s",
                self.keep_alive.period().as_secs()
            )));
        }
        self.connection.send(&self.sign_of_life, &self.url, &[(SESSION, &self.id)]).await
    }

    /// Takes the answer to a sign of life. A refusal of another reason than a nonce that has expired does not matter while
    /// packets come.
    fn take_answer(&mut self, answer: &Response<Vec<u8>>) -> Result<(), PeerError> {
        self.waits = false;
        match answer.status() {
            StatusCode::Unauthorized => self.connection.take_challenge(answer),
            StatusCode::SessionNotFound => Err("the camera has ended the session".into()),
            _ => Ok(()),
        }
    }
}

/// Requests and their answers.
struct Connection {
    stream: Framed<Box<dyn ByteStream>, Codec>,
    sign_in: SignIn,
    sequence: u32,
}

impl Connection {
    fn new(stream: Box<dyn ByteStream>, credentials: &Credentials<'_>) -> Self {
        let sign_in = SignIn::new(credentials.username, credentials.secrets.get("password"));
        Self { stream: Framed::new(stream, Codec), sign_in, sequence: 0 }
    }

    async fn send(
        &mut self,
        method: &Method,
        url: &Url,
        headers: &[(HeaderName, &str)],
    ) -> Result<(), PeerError> {
        self.sequence = self.sequence.wrapping_add(1);
        let request = Request::builder(method.clone(), Version::V1_0)
            .request_uri(url.clone())
            .header(CSEQ, self.sequence.to_string())
            .header(USER_AGENT, "sightfix");
        let authorization = self.sign_in.authorization(method.into(), url.as_str(), &[])?;
        let authorization = authorization.as_deref().map(|value| (AUTHORIZATION, value));
        let headers = headers.iter().cloned().chain(authorization);
        let request = headers.fold(request, |request, (name, value)| request.header(name, value));
        self.stream.send(request.empty()).await
    }

    /// Sends a request and returns its answer, signed in where the camera asks for it.
    async fn ask(
        &mut self,
        method: &Method,
        url: &Url,
        headers: &[(HeaderName, &str)],
    ) -> Result<Response<Vec<u8>>, PeerError> {
        let name: &str = method.into();
        for is_second in [false, true] {
            self.send(method, url, headers).await?;
            let answer = self.answer().await?;
            match answer.status() {
                status if status.is_success() => return Ok(answer),
                StatusCode::Unauthorized if !is_second => self.take_challenge(&answer)?,
                StatusCode::Unauthorized => break,
                status => {
                    let code = u16::from(status);
                    return Err(PeerError(format!("the camera answered {code} {status} to {name}")));
                }
            }
        }
        Err("the camera refuses the username or the password".into())
    }

    /// The answer to the last request. Packets that come before it are of no use without it.
    async fn answer(&mut self) -> Result<Response<Vec<u8>>, PeerError> {
        let sequence = self.sequence.to_string();
        loop {
            match self.stream.next().await.ok_or(CLOSED)?? {
                Message::Response(answer) if header(&answer, &CSEQ) == sequence => return Ok(answer),
                _ => {}
            }
        }
    }

    fn take_challenge(&mut self, refusal: &Response<Vec<u8>>) -> Result<(), PeerError> {
        let no_user = "the camera asks for a user; give username and the secret password";
        self.sign_in.take_challenge(header(refusal, &WWW_AUTHENTICATE), no_user)
    }
}

/// A header's value; empty where it is missing.
fn header<'a>(response: &'a Response<Vec<u8>>, name: &HeaderName) -> &'a str {
    response.header(name).map_or("", HeaderValue::as_str)
}

/// Id and timeout of a session, such as `12345678;timeout=60`.
fn session_of(header: &str) -> Result<(String, Duration), PeerError> {
    let mut parts = header.split(';').map(str::trim);
    let id = parts.next().filter(|id| !id.is_empty()).ok_or("the camera gave the session no id")?;
    let timeout_s = parts.find_map(|part| part.strip_prefix("timeout=")?.parse().ok());
    let timeout = timeout_s.filter(|seconds| *seconds >= 2).map_or(SESSION_TIMEOUT, Duration::from_secs);
    Ok((id.to_owned(), timeout))
}

/// The channel of packets by a transport such as `RTP/AVP/TCP;unicast;interleaved=2-3`; by default the one that was asked for.
fn channel_of(header: &str) -> u8 {
    let channels = header.split(';').find_map(|part| part.trim().strip_prefix("interleaved="));
    let first = channels.and_then(|channels| channels.split('-').next());
    first.and_then(|channel| channel.parse().ok()).unwrap_or(0)
}
