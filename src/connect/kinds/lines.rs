//! Lines of a peer that is connected to, or of a serial device.

use std::sync::Arc;
use std::time::Duration;

use futures_util::future::BoxFuture;
use tokio::io::{AsyncRead, AsyncWriteExt as _};

use super::line_reader::{Line, LineReader};
use super::serial;
use crate::app::LiveConnection;
use crate::connect::credentials::{Credentials, PeerError};
use crate::connect::peer::connect;
use crate::connect::source::{Message, Source};
use crate::exchange::kinds::SerialLine;
use crate::exchange::{Address, Secrets};

/// Asks gpsd for its reports.
const GPSD_WATCH: &[u8] = b"?WATCH={\"enable\":true,\"json\":true};\n";
/// A peer that is silent for longer is connected to again: its end of the connection may be gone.
pub(super) const LONGEST_SILENCE: Duration = Duration::from_secs(300);

type Input = Box<dyn AsyncRead + Send + Unpin>;

/// Lines of a peer.
pub(super) struct LineSource {
    reader: LineReader<Input>,
    peer: String,
    live: Arc<LiveConnection>,
}

impl LineSource {
    pub(super) async fn connect(
        address: &Address,
        credentials: &Credentials<'_>,
        max_bytes: usize,
        live: &Arc<LiveConnection>,
    ) -> Result<Self, PeerError> {
        let stream = connect(address, credentials).await?;
        Ok(Self::of(Box::new(stream), format!("{}:{}", address.host, address.port), max_bytes, live))
    }

    /// Connects to a gpsd and asks for its reports.
    pub(super) async fn watch_gpsd(
        address: &Address,
        secrets: &Secrets,
        max_bytes: usize,
        live: &Arc<LiveConnection>,
    ) -> Result<Self, PeerError> {
        let mut stream = connect(address, &Credentials::trusting(None, secrets)).await?;
        stream.write_all(GPSD_WATCH).await?;
        stream.flush().await?;
        Ok(Self::of(Box::new(stream), format!("{}:{}", address.host, address.port), max_bytes, live))
    }

    pub(super) fn open_serial(
        line: &SerialLine,
        max_bytes: usize,
        live: &Arc<LiveConnection>,
    ) -> Result<Self, PeerError> {
        Ok(Self::of(Box::new(serial::open(line)?), line.path.display().to_string(), max_bytes, live))
    }

    fn of(input: Input, peer: String, max_bytes: usize, live: &Arc<LiveConnection>) -> Self {
        Self { reader: LineReader::new(input, max_bytes, None), peer, live: live.clone() }
    }
}

impl Source for LineSource {
    fn next(&mut self) -> BoxFuture<'_, Result<Message, PeerError>> {
        Box::pin(async {
            loop {
                match tokio::time::timeout(LONGEST_SILENCE, self.reader.next()).await {
                    Ok(Ok(Some(Line::Whole(line)))) => return Ok(Message::new(0, self.peer.clone(), line)),
                    Ok(Ok(Some(Line::TooLong))) => self.live.update(|status| status.lost += 1),
                    Ok(Ok(None)) => return Err("the peer has closed the connection".into()),
                    Ok(Err(error)) => return Err(error.into()),
                    Err(_) => return Err("the peer was silent for 300 s".into()),
                }
            }
        })
    }
}
