//! Lines of clients that connect.
//!
//! Nobody proves who they are, so clients share what there is: one address has at most half of the places, and when all
//! are taken, the client that has been silent for longest gives way to a new one.

use std::collections::HashMap;
use std::net::{IpAddr, SocketAddr};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use bytes::Bytes;
use futures_util::future::BoxFuture;
use tokio::net::{TcpListener, TcpStream};
use tokio::task::{AbortHandle, JoinSet};
use tokio_util::task::AbortOnDropHandle;

use super::line_reader::{Line, LineReader};
use super::lines::LONGEST_SILENCE;
use crate::app::{App, LiveConnection};
use crate::clock::Clock;
use crate::connect::credentials::PeerError;
use crate::connect::inbox::{Inlet, Outlet, inbox};
use crate::connect::source::{Message, Source};
use crate::exchange::Address;

/// Time in which a client must send its first line.
const FIRST_LINE: Duration = Duration::from_secs(30);
/// A client that was silent for this time is closed for a new one when all places are taken.
const GIVES_WAY: Duration = Duration::from_secs(10);

/// Takes lines of clients.
pub(super) struct LineListener {
    lines: Outlet<(SocketAddr, Bytes)>,
    live: Arc<LiveConnection>,
    _accepting: AbortOnDropHandle<()>,
}

impl Drop for LineListener {
    fn drop(&mut self) {
        self.live.update(|status| status.clients = 0);
    }
}

impl LineListener {
    pub(super) async fn bind(
        address: &Address,
        app: &App,
        live: &Arc<LiveConnection>,
    ) -> Result<Self, PeerError> {
        let listener = TcpListener::bind((address.host.as_str(), address.port)).await?;
        let limits = &app.limits;
        let (inlet, lines) = inbox(limits.connection_queue, limits.connection_queue_bytes);
        let clients = Clients {
            inlet,
            max_line_bytes: limits.connection_message_bytes,
            places: limits.connection_clients,
            connected: HashMap::new(),
            tasks: JoinSet::new(),
            status: ClientStatus { live: live.clone(), clock: app.clock.clone() },
        };
        let accepting = tokio::spawn(clients.accept(listener));
        Ok(Self { lines, live: live.clone(), _accepting: AbortOnDropHandle::new(accepting) })
    }
}

impl Source for LineListener {
    fn next(&mut self) -> BoxFuture<'_, Result<Message, PeerError>> {
        Box::pin(async {
            let ended = || PeerError::from("the listener has ended");
            let ((peer, payload), _held) = self.lines.recv().await.ok_or_else(ended)?;
            Ok(Message::new(0, peer.to_string(), payload))
        })
    }
}

/// The clients of a connection, for its status.
#[derive(Clone)]
struct ClientStatus {
    live: Arc<LiveConnection>,
    clock: Clock,
}

impl ClientStatus {
    fn refused(&self, reason: String) {
        let now = self.clock.now();
        self.live.update(|status| {
            status.refused_clients += 1;
            status.last_error = Some((now, reason));
        });
    }

    fn connected(&self, count: usize) {
        self.live.update(|status| status.clients = count as u64);
    }

    fn lost_line(&self) {
        self.live.update(|status| status.lost += 1);
    }
}

/// A client that is connected.
struct Client {
    address: IpAddr,
    task: AbortHandle,
    /// By the monotonic clock, when its last line came, or when it connected.
    heard_at: Arc<Mutex<Duration>>,
}

impl Client {
    fn heard_at(&self) -> Duration {
        *self.heard_at.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

struct Clients {
    inlet: Inlet<(SocketAddr, Bytes)>,
    max_line_bytes: usize,
    places: usize,
    connected: HashMap<SocketAddr, Client>,
    tasks: JoinSet<SocketAddr>,
    status: ClientStatus,
}

impl Clients {
    async fn accept(mut self, listener: TcpListener) {
        loop {
            tokio::select! {
                Some(ended) = self.tasks.join_next(), if !self.tasks.is_empty() => {
                    // One that gave way was removed already.
                    if let Ok(peer) = ended {
                        self.connected.remove(&peer);
                        self.status.connected(self.connected.len());
                    }
                }
                accepted = listener.accept() => match accepted {
                    Ok((stream, peer)) => self.take(stream, peer),
                    // Commonly no free file; the next attempt may find one.
                    Err(_) => tokio::time::sleep(Duration::from_millis(100)).await,
                }
            }
        }
    }

    /// Gives a client a place, or closes its connection.
    fn take(&mut self, stream: TcpStream, peer: SocketAddr) {
        let address = peer.ip();
        let own_share = self.places.div_ceil(2);
        if self.connected.values().filter(|client| client.address == address).count() >= own_share {
            let reason =
                format!("{address} has {own_share} connections, which is its share; one more was refused");
            return self.status.refused(reason);
        }
        if self.connected.len() >= self.places && !self.make_place() {
            let reason =
                format!("{} clients are connected and none is silent; {peer} was refused", self.places);
            return self.status.refused(reason);
        }
        let now = self.status.clock.monotonic();
        let heard_at = Arc::new(Mutex::new(now));
        let reading = read(
            stream,
            peer,
            self.inlet.clone(),
            self.max_line_bytes,
            heard_at.clone(),
            self.status.clone(),
        );
        let task = self.tasks.spawn(reading);
        self.connected.insert(peer, Client { address, task, heard_at });
        self.status.connected(self.connected.len());
    }

    /// Ends the client that has been silent for longest, if it was long enough.
    fn make_place(&mut self) -> bool {
        let now = self.status.clock.monotonic();
        let silent = self.connected.iter().min_by_key(|(_, client)| client.heard_at());
        let silent = silent.filter(|(_, client)| now.saturating_sub(client.heard_at()) >= GIVES_WAY);
        let Some(peer) = silent.map(|(peer, _)| *peer) else { return false };
        if let Some(client) = self.connected.remove(&peer) {
            client.task.abort();
            self.status.refused(format!(
                "{} clients are connected; {peer}, which was silent, was closed",
                self.places
            ));
        }
        true
    }
}

/// Reads a client's lines to their end.
async fn read(
    stream: TcpStream,
    peer: SocketAddr,
    inlet: Inlet<(SocketAddr, Bytes)>,
    max_bytes: usize,
    heard_at: Arc<Mutex<Duration>>,
    status: ClientStatus,
) -> SocketAddr {
    let mut reader = LineReader::new(stream, max_bytes, Some(inlet.budget().clone()));
    let mut patience = FIRST_LINE;
    while let Ok(Ok(Some(line))) = tokio::time::timeout(patience, reader.next()).await {
        *heard_at.lock().unwrap_or_else(PoisonError::into_inner) = status.clock.monotonic();
        patience = LONGEST_SILENCE;
        match line {
            Line::TooLong => status.lost_line(),
            Line::Whole(line) => {
                let bytes = line.len();
                if !inlet.put((peer, line), bytes).await {
                    break;
                }
            }
        }
    }
    peer
}
