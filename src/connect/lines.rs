//! Lines: of a peer that is connected to, of clients that connect, or of a serial device.

use std::net::SocketAddr;
use std::time::Duration;

use bytes::{Bytes, BytesMut};
use futures_util::future::BoxFuture;
use tokio::io::{AsyncRead, AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::TcpListener;
use tokio::sync::mpsc;
use tokio::task::JoinSet;
use tokio_util::task::AbortOnDropHandle;

use super::credentials::{Credentials, PeerError};
use super::peer::connect;
use super::serial;
use super::source::{Message, Source};
use crate::exchange::{Address, Scheme, SerialLine};

/// Asks gpsd for its reports.
const GPSD_WATCH: &[u8] = b"?WATCH={\"enable\":true,\"json\":true};\n";
/// A peer that is silent for longer is connected to again: its end of the connection may be gone.
const LONGEST_SILENCE: Duration = Duration::from_secs(300);
/// Clients that may be connected to a listener.
const MAX_CLIENTS: usize = 64;

/// Puts lines together. What is read stays in the buffer, so that a wait can be cancelled.
struct LineReader<S> {
    stream: S,
    buffer: BytesMut,
    /// Bytes of the buffer that contain no line end.
    searched: usize,
    max_bytes: usize,
    /// Whether the rest of a line that is too long is being skipped.
    skips: bool,
}

impl<S: AsyncRead + Unpin> LineReader<S> {
    fn new(stream: S, max_bytes: usize) -> Self {
        Self { stream, buffer: BytesMut::with_capacity(8_192), searched: 0, max_bytes, skips: false }
    }

    /// The next line without its end; `None` at the end of the stream. Lines that are too long are skipped.
    async fn next(&mut self) -> std::io::Result<Option<Bytes>> {
        loop {
            if let Some(at) = self.buffer[self.searched..].iter().position(|byte| *byte == b'\n') {
                let line = self.buffer.split_to(self.searched + at + 1).freeze();
                self.searched = 0;
                if !std::mem::take(&mut self.skips) {
                    return Ok(Some(line.slice(..line.len() - 1)));
                }
                continue;
            }
            self.searched = self.buffer.len();
            if self.buffer.len() > self.max_bytes {
                self.buffer.clear();
                (self.searched, self.skips) = (0, true);
            }
            self.buffer.reserve(4_096);
            if self.stream.read_buf(&mut self.buffer).await? == 0 {
                return Ok(None);
            }
        }
    }
}

type Input = Box<dyn AsyncRead + Send + Unpin>;

/// Lines of a peer.
pub(super) struct LineSource {
    reader: LineReader<Input>,
    peer: String,
}

impl LineSource {
    pub(super) async fn connect(
        address: &Address,
        credentials: &Credentials<'_>,
        max_bytes: usize,
    ) -> Result<Self, PeerError> {
        let mut stream = connect(address, address.scheme == Scheme::Tls, credentials).await?;
        if address.scheme == Scheme::Gpsd {
            stream.write_all(GPSD_WATCH).await?;
            stream.flush().await?;
        }
        let peer = format!("{}:{}", address.host, address.port);
        let input: Input = Box::new(stream);
        Ok(Self { reader: LineReader::new(input, max_bytes), peer })
    }

    pub(super) fn open_serial(line: &SerialLine, max_bytes: usize) -> Result<Self, PeerError> {
        let input: Input = Box::new(serial::open(line)?);
        let peer = line.path.display().to_string();
        Ok(Self { reader: LineReader::new(input, max_bytes), peer })
    }
}

impl Source for LineSource {
    fn next(&mut self) -> BoxFuture<'_, Result<Message, PeerError>> {
        Box::pin(async {
            match tokio::time::timeout(LONGEST_SILENCE, self.reader.next()).await {
                Ok(Ok(Some(payload))) => Ok(Message { receipt: 0, subject: self.peer.clone(), payload }),
                Ok(Ok(None)) => Err("the peer has closed the connection".into()),
                Ok(Err(error)) => Err(error.into()),
                Err(_) => Err("the peer was silent for 300 s".into()),
            }
        })
    }
}

/// Lines of clients that connect.
pub(super) struct LineListener {
    lines: mpsc::Receiver<(SocketAddr, Bytes)>,
    _accepting: AbortOnDropHandle<()>,
}

impl LineListener {
    pub(super) async fn bind(address: &Address, queue: usize, max_bytes: usize) -> Result<Self, PeerError> {
        let listener = TcpListener::bind((address.host.as_str(), address.port)).await?;
        let (lines_in, lines) = mpsc::channel(queue);
        let accepting = tokio::spawn(accept(listener, lines_in, max_bytes));
        Ok(Self { lines, _accepting: AbortOnDropHandle::new(accepting) })
    }
}

async fn accept(listener: TcpListener, lines: mpsc::Sender<(SocketAddr, Bytes)>, max_bytes: usize) {
    let mut clients = JoinSet::new();
    loop {
        tokio::select! {
            Some(_) = clients.join_next(), if !clients.is_empty() => {}
            accepted = listener.accept() => match accepted {
                Ok((stream, peer)) if clients.len() < MAX_CLIENTS => {
                    let lines = lines.clone();
                    clients.spawn(async move {
                        let mut reader = LineReader::new(stream, max_bytes);
                        while let Ok(Ok(Some(line))) = tokio::time::timeout(LONGEST_SILENCE, reader.next()).await {
                            if lines.send((peer, line)).await.is_err() {
                                return;
                            }
                        }
                    });
                }
                // One too many is closed.
                Ok(_) => {}
                // Commonly no free file; the next attempt may find one.
                Err(_) => tokio::time::sleep(Duration::from_millis(100)).await,
            }
        }
    }
}

impl Source for LineListener {
    fn next(&mut self) -> BoxFuture<'_, Result<Message, PeerError>> {
        Box::pin(async {
            let (peer, payload) =
                self.lines.recv().await.ok_or_else(|| PeerError::from("the listener has ended"))?;
            Ok(Message { receipt: 0, subject: peer.to_string(), payload })
        })
    }
}
