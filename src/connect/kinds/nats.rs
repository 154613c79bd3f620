//! A sink of NATS.
//!
//! Messages have the header `Nats-Msg-Id`, by which a JetStream stream recognises repetitions. With the setting
//! `jetstream` a message counts as delivered when a stream has acknowledged that it is stored, else when the server has
//! answered a `PING` after it: it has taken all that came before. Whether somebody keeps that is the server's business.

use std::collections::HashSet;
use std::sync::Arc;

use futures_util::future::BoxFuture;
use serde::Deserialize;
use tokio::io::{
    AsyncBufReadExt as _, AsyncReadExt as _, AsyncWriteExt as _, BufReader, ReadHalf, WriteHalf,
};
use tokio::net::TcpStream;
use tokio::sync::{Mutex, mpsc};
use tokio_util::task::AbortOnDropHandle;

use crate::connect::credentials::{Credentials, PeerError};
use crate::connect::peer::{ByteStream, OPEN_TIME, connect, encrypt, tcp, within};
use crate::connect::sink::{Outcomes, Sink};
use crate::connect::tls;
use crate::domain::OutboxMessage;
use crate::exchange::{Secrets, kinds};

/// Longest line and longest message of the server that are read; `INFO` is the longest.
const MAX_ANSWER_BYTES: usize = 64 << 10;
/// Messages after which answers are awaited.
const WINDOW: usize = 128;

type Output = Arc<Mutex<WriteHalf<Box<dyn ByteStream>>>>;

/// An answer of the server.
enum Answer {
    /// It has taken all that came before a `PING`.
    Taken,
    /// A stream has stored the message of this number.
    Stored(i64),
}

/// An open connection to a NATS server.
pub(super) struct NatsSink {
    out: Output,
    /// The subject before the numbers of messages that streams acknowledge; `None` if no stream is awaited.
    inbox: Option<String>,
    /// Answers, or what the server does not take.
    answers: mpsc::Receiver<Result<Answer, String>>,
    _reading: AbortOnDropHandle<()>,
}

impl NatsSink {
    pub(super) async fn open(
        server: &kinds::NatsSink,
        secrets: &Secrets,
        client_id: &str,
    ) -> Result<Self, PeerError> {
        let credentials = Credentials::of(&server.login, secrets);
        let stream = if server.address.is_encrypted {
            within(OPEN_TIME, connect_encrypted(server, &credentials)).await?
        } else {
            connect(&server.address, &credentials).await?
        };
        let (incoming, out) = tokio::io::split(stream);
        let out = Arc::new(Mutex::new(out));
        let (answers_in, answers) = mpsc::channel(16);
        let reading = tokio::spawn(read(incoming, out.clone(), answers_in));
        let inbox = server.jetstream.then(|| format!("_INBOX.{client_id}"));
        let mut sink = Self { out, inbox, answers, _reading: AbortOnDropHandle::new(reading) };
        sink.send(format!("CONNECT {}\r\n", options(&credentials)).as_bytes()).await?;
        if let Some(inbox) = &sink.inbox {
            sink.send(format!("SUB {inbox}.* 1\r\n").as_bytes()).await?;
        }
        sink.confirm().await?;
        Ok(sink)
    }

    async fn send(&self, bytes: &[u8]) -> Result<(), PeerError> {
        Ok(self.out.lock().await.write_all(bytes).await?)
    }

    async fn flush(&self) -> Result<(), PeerError> {
        Ok(self.out.lock().await.flush().await?)
    }

    async fn answer(&mut self) -> Result<Answer, PeerError> {
        let answer = async {
            self.answers.recv().await.ok_or_else(|| PeerError::from("the server has closed the connection"))
        };
        within(OPEN_TIME, answer).await?.map_err(PeerError)
    }

    /// Waits until the server has taken all that was sent.
    async fn confirm(&mut self) -> Result<(), PeerError> {
        self.send(b"PING\r\n").await?;
        self.flush().await?;
        while !matches!(self.answer().await?, Answer::Taken) {}
        Ok(())
    }

    /// Waits until streams have stored the messages of these numbers.
    async fn stored(&mut self, mut numbers: HashSet<i64>, outcomes: &mut Outcomes) -> Result<(), PeerError> {
        self.flush().await?;
        while !numbers.is_empty() {
            if let Answer::Stored(number) = self.answer().await?
                && numbers.remove(&number)
            {
                outcomes.push((number, Ok(())));
            }
        }
        Ok(())
    }

    /// A message as it is published.
    fn published(&self, message: &OutboxMessage) -> Vec<u8> {
        let header = format!("NATS/1.0\r\nNats-Msg-Id: {}\r\n\r\n", message.message_id);
        let total = header.len() + message.payload.len();
        let reply =
            self.inbox.as_ref().map_or_else(String::new, |inbox| format!(" {inbox}.{}", message.number));
        let head = format!("HPUB {}{reply} {} {total}\r\n{header}", message.subject, header.len());
        [head.as_bytes(), &message.payload, b"\r\n"].concat()
    }
}

/// The options of the client, with its user.
fn options(credentials: &Credentials<'_>) -> serde_json::Value {
    let password = credentials.secrets.get("password");
    let mut options = serde_json::json!({
        "verbose": false, "pedantic": false, "headers": true, "no_responders": true, "lang": "rust",
        "name": "sightfix", "version": env!("CARGO_PKG_VERSION"), "protocol": 1,
    });
    match credentials.username {
        Some(username) => {
            options["user"] = username.into();
            options["pass"] = password.unwrap_or_default().into();
        }
        None => options["auth_token"] = password.into(),
    }
    options
}

/// Connects and begins TLS after the server's first line, in which it describes itself.
async fn connect_encrypted(
    server: &kinds::NatsSink,
    credentials: &Credentials<'_>,
) -> Result<Box<dyn ByteStream>, PeerError> {
    let (host, tls) = (&server.address.host, tls::peer_config(credentials)?);
    let mut reader = BufReader::new(tcp(host, server.address.port).await?);
    let greeting = line(&mut reader).await.unwrap_or_default();
    // What follows in plain text could be of anybody.
    if !greeting.starts_with("INFO ") || !reader.buffer().is_empty() {
        return Err("the server does not begin as one of NATS".into());
    }
    let stream: TcpStream = reader.into_inner();
    encrypt(stream, host, tls).await
}

/// The next line; `None` at the end, and for one that is too long.
async fn line(incoming: &mut (impl tokio::io::AsyncBufRead + Unpin)) -> Option<String> {
    let mut line = String::new();
    let read = incoming.take(MAX_ANSWER_BYTES as u64).read_line(&mut line).await;
    line.ends_with('\n').then_some(())?;
    read.ok().map(|_| line.trim_end().to_owned())
}

/// Answers the server's `PING`, and hands on what it says.
async fn read(
    incoming: ReadHalf<Box<dyn ByteStream>>,
    out: Output,
    answers: mpsc::Sender<Result<Answer, String>>,
) {
    let mut incoming = BufReader::new(incoming);
    while let Some(line) = line(&mut incoming).await {
        let answer = match line.split_once(' ').map_or(line.as_str(), |(name, _)| name) {
            "PING" => {
                let mut out = out.lock().await;
                if out.write_all(b"PONG\r\n").await.is_err() || out.flush().await.is_err() {
                    return;
                }
                continue;
            }
            "PONG" => Ok(Answer::Taken),
            "-ERR" => Err(format!("the server answered {line}")),
            "MSG" | "HMSG" => match acknowledgement(&mut incoming, &line).await {
                Some(answer) => answer,
                None => return,
            },
            _ => continue,
        };
        if answers.send(answer).await.is_err() {
            return;
        }
    }
}

/// The acknowledgement of a stream (`PubAck` of JetStream).
#[derive(Deserialize)]
struct StreamAnswer {
    stream: Option<String>,
    error: Option<StreamError>,
}

#[derive(Deserialize)]
struct StreamError {
    description: String,
}

/// Reads the message after a line `MSG INBOX.NUMBER 1 BYTES`, or `HMSG INBOX.NUMBER 1 HEADER_BYTES BYTES` where nobody
/// listens; `None` if it cannot be read.
async fn acknowledgement(
    incoming: &mut (impl tokio::io::AsyncRead + Unpin),
    line: &str,
) -> Option<Result<Answer, String>> {
    let words: Vec<&str> = line.split_ascii_whitespace().collect();
    let (_, number) = words.get(1)?.rsplit_once('.')?;
    let bytes = words.last()?.parse().ok().filter(|bytes| *bytes <= MAX_ANSWER_BYTES)?;
    let mut message = vec![0; bytes + "\r\n".len()];
    incoming.read_exact(&mut message).await.ok()?;
    if line.starts_with("HMSG") {
        return Some(Err("no JetStream stream takes the sink's subjects; create one".to_owned()));
    }
    Some(match serde_json::from_slice(&message[..bytes]) {
        Ok(StreamAnswer { stream: Some(_), error: None }) => Ok(Answer::Stored(number.parse().ok()?)),
        Ok(StreamAnswer { error: Some(error), .. }) => {
            Err(format!("a stream refuses: {}", error.description))
        }
        _ => Err("what answers the sink's messages is no JetStream stream".to_owned()),
    })
}

impl Sink for NatsSink {
    fn deliver<'a>(
        &'a mut self,
        messages: &'a [OutboxMessage],
        outcomes: &'a mut Outcomes,
    ) -> BoxFuture<'a, Result<(), PeerError>> {
        Box::pin(async move {
            for window in messages.chunks(WINDOW) {
                let bytes: Vec<u8> = window.iter().flat_map(|message| self.published(message)).collect();
                self.send(&bytes).await?;
                if self.inbox.is_some() {
                    self.stored(window.iter().map(|message| message.number).collect(), outcomes).await?;
                } else {
                    self.confirm().await?;
                    outcomes.extend(window.iter().map(|message| (message.number, Ok(()))));
                }
            }
            Ok(())
        })
    }

    fn failed(&mut self) -> BoxFuture<'_, PeerError> {
        Box::pin(async {
            loop {
                match self.answers.recv().await {
                    // Nothing that was sent is unanswered.
                    Some(Ok(_)) => {}
                    Some(Err(refusal)) => return PeerError(refusal),
                    None => return "the server has closed the connection".into(),
                }
            }
        })
    }
}
