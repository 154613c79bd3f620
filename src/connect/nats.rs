//! A sink of NATS.
//!
//! Messages are published with the header `Nats-Msg-Id`, by which a JetStream stream recognises repetitions, and count
//! as delivered when the server has answered a `PING` after them: it has taken all that came before. Whether somebody
//! keeps them is the server's business.

use std::sync::Arc;

use futures_util::future::BoxFuture;
use tokio::io::{
    AsyncBufReadExt as _, AsyncReadExt as _, AsyncWriteExt as _, BufReader, ReadHalf, WriteHalf,
};
use tokio::sync::{Mutex, mpsc};
use tokio_util::task::AbortOnDropHandle;

use super::credentials::{Credentials, PeerError};
use super::peer::{ByteStream, OPEN_TIME, connect, within};
use super::sink::{Outcomes, Sink};
use crate::domain::OutboxMessage;
use crate::exchange::Address;

/// Longest line of the server that is read; `INFO` is the longest.
const MAX_LINE_BYTES: u64 = 64 << 10;
/// Messages after which one `PING` is sent.
const WINDOW: usize = 128;

type Output = Arc<Mutex<WriteHalf<Box<dyn ByteStream>>>>;

/// An open connection to a NATS server.
pub(super) struct NatsSink {
    out: Output,
    /// `Ok` for each `PONG`, else what the server does not take.
    answers: mpsc::Receiver<Result<(), String>>,
    _reading: AbortOnDropHandle<()>,
}

impl NatsSink {
    pub(super) async fn open(address: &Address, credentials: &Credentials<'_>) -> Result<Self, PeerError> {
        let stream = connect(address, false, credentials).await?;
        let (incoming, out) = tokio::io::split(stream);
        let out = Arc::new(Mutex::new(out));
        let (answers_in, answers) = mpsc::channel(16);
        let reading = tokio::spawn(read(incoming, out.clone(), answers_in));
        let mut sink = Self { out, answers, _reading: AbortOnDropHandle::new(reading) };
        let password = credentials.secrets.get("password");
        let mut options = serde_json::json!({
            "verbose": false, "pedantic": false, "headers": true, "lang": "rust", "name": "sightfix",
            "version": env!("CARGO_PKG_VERSION"), "protocol": 1,
        });
        match credentials.username {
            Some(username) => {
                options["user"] = username.into();
                options["pass"] = password.unwrap_or_default().into();
            }
            None => options["auth_token"] = password.into(),
        }
        sink.send(format!("CONNECT {options}\r\n").as_bytes()).await?;
        sink.confirm().await?;
        Ok(sink)
    }

    async fn send(&self, bytes: &[u8]) -> Result<(), PeerError> {
        Ok(self.out.lock().await.write_all(bytes).await?)
    }

    /// Waits until the server has taken all that was sent.
    async fn confirm(&mut self) -> Result<(), PeerError> {
        self.send(b"PING\r\n").await?;
        self.out.lock().await.flush().await?;
        let answer = async {
            self.answers.recv().await.ok_or_else(|| PeerError::from("the server has closed the connection"))
        };
        within(OPEN_TIME, answer).await?.map_err(PeerError)
    }
}

/// Answers the server's `PING`, and hands on what it says.
async fn read(
    incoming: ReadHalf<Box<dyn ByteStream>>,
    out: Output,
    answers: mpsc::Sender<Result<(), String>>,
) {
    let mut incoming = BufReader::new(incoming);
    let mut line = String::new();
    loop {
        line.clear();
        let read = (&mut incoming).take(MAX_LINE_BYTES).read_line(&mut line).await;
        let text = match read {
            Ok(bytes) if bytes > 0 => line.trim_end(),
            _ => return,
        };
        let answer = match text.split_once(' ').map_or(text, |(name, _)| name) {
            "PING" => {
                let mut out = out.lock().await;
                if out.write_all(b"PONG\r\n").await.is_err() || out.flush().await.is_err() {
                    return;
                }
                continue;
            }
            "PONG" => Ok(()),
            "-ERR" => Err(format!("the server answered {text}")),
            _ => continue,
        };
        if answers.send(answer).await.is_err() {
            return;
        }
    }
}

impl Sink for NatsSink {
    fn deliver<'a>(
        &'a mut self,
        messages: &'a [OutboxMessage],
        outcomes: &'a mut Outcomes,
    ) -> BoxFuture<'a, Result<(), PeerError>> {
        Box::pin(async move {
            for window in messages.chunks(WINDOW) {
                let mut bytes = Vec::new();
                for message in window {
                    let header = format!("NATS/1.0\r\nNats-Msg-Id: {}\r\n\r\n", message.message_id);
                    let total = header.len() + message.payload.len();
                    let head = format!("HPUB {} {} {total}\r\n{header}", message.subject, header.len());
                    bytes.extend_from_slice(head.as_bytes());
                    bytes.extend_from_slice(&message.payload);
                    bytes.extend_from_slice(b"\r\n");
                }
                self.send(&bytes).await?;
                self.confirm().await?;
                outcomes.extend(window.iter().map(|message| (message.number, Ok(()))));
            }
            Ok(())
        })
    }

    fn failed(&mut self) -> BoxFuture<'_, PeerError> {
        Box::pin(async {
            loop {
                match self.answers.recv().await {
                    // No `PING` of ours is under way.
                    Some(Ok(())) => {}
                    Some(Err(refusal)) => return PeerError(refusal),
                    None => return "the server has closed the connection".into(),
                }
            }
        })
    }
}
