//! MQTT: a source of topics, and a sink. A broker is asked for MQTT 5, and if it does not know that, for 3.1.1.
//!
//! A source subscribes with QoS 1 in a session that the broker keeps for a day, and acknowledges a message when what
//! was to be stored of it is stored; what it has not acknowledged comes again after a reconnect. Its receive maximum
//! is the limit of unsettled messages, for brokers allow as few as 20 where a client states none. A sink publishes
//! with QoS 1 and counts a message as delivered when the broker has acknowledged it.
//!
//! The library's own encryption needs an outdated verifier of certificates, so an encrypted connection is opened here
//! as any other, and the library reaches it by a Unix socket that only this process can open.

use std::collections::{HashMap, HashSet, VecDeque};
use std::sync::Arc;

use bytes::Bytes;
use futures_util::future::BoxFuture;
use tempfile::TempDir;
use tokio::net::UnixListener;
use tokio::time::Instant;
use tokio_util::task::AbortOnDropHandle;

use super::mqtt_client::{Client, Connection, Incoming, Place, Promise, Report, Version, Wishes, client};
use crate::app::LiveConnection;
use crate::config::Limits;
use crate::connect::credentials::{Credentials, PeerError};
use crate::connect::inbox::{HeldBytes, Inlet, Outlet, inbox};
use crate::connect::peer::{OPEN_TIME, connect, within};
use crate::connect::sink::{Outcomes, Sink};
use crate::connect::source::{Message, Settled, Source, SourceIdentity};
use crate::domain::OutboxMessage;
use crate::exchange::{Address, bracketed, home_assistant_discovery};

/// The largest size of a PUBLISH packet besides its payload: topic and properties.
const PACKET_OVERHEAD_BYTES: usize = 66_000;
/// Messages that a sink may have under way; fewer where the broker states so.
const PUBLISH_QUEUE: usize = 128;
/// The largest size of a broker's messages to a sink, which subscribes to nothing, bytes.
const SINK_BYTES: usize = 64 << 10;
/// Largest packet of a sink, bytes.
const SINK_PACKET_BYTES: usize = 1 << 20;

/// The error of a broker that never answers a subscription.
const UNCONFIRMED: &str = "the broker has not confirmed the subscription within 10 s";

const NEEDS_MQTT: &str = "connections need MQTT 5 or 3.1.1";

/// An encrypted connection that a Unix socket leads to.
struct Bridge {
    /// Has the socket, and is removed with the bridge. Other users cannot enter it.
    folder: TempDir,
    _copying: AbortOnDropHandle<()>,
}

impl Bridge {
    const SOCKET: &str = "mqtt";

    async fn open(address: &Address, credentials: &Credentials<'_>) -> Result<Self, PeerError> {
        let mut outer = connect(address, credentials).await?;
        let folder = tempfile::tempdir()?;
        let listener = UnixListener::bind(folder.path().join(Self::SOCKET))?;
        let copying = tokio::spawn(async move {
            if let Ok((mut inner, _)) = listener.accept().await {
                // Either side sees the end of the other.
                let _ = tokio::io::copy_bidirectional(&mut inner, &mut outer).await;
            }
        });
        Ok(Self { folder, _copying: AbortOnDropHandle::new(copying) })
    }

    fn socket(&self) -> String {
        self.folder.path().join(Self::SOCKET).to_string_lossy().into_owned()
    }
}

/// Where the broker is, and the bridge that leads to it, if any.
async fn place(
    address: &Address,
    credentials: &Credentials<'_>,
) -> Result<(Place, Option<Bridge>), PeerError> {
    let bridge = if address.is_encrypted { Some(Bridge::open(address, credentials).await?) } else { None };
    let host = match &bridge {
        Some(bridge) => bridge.socket(),
        None => bracketed(&address.host).into_owned(),
    };
    Ok((Place { host, port: address.port, is_socket: bridge.is_some() }, bridge))
}

/// Drives a connection until it fails or nobody takes its reports any more. It waits while these have too many bytes, so
/// that the broker waits, too.
async fn drive(mut connection: Connection, reports: Inlet<Report>, live: Option<Arc<LiveConnection>>) {
    let mut is_connected = false;
    loop {
        let Some(report) = connection.next(is_connected).await else { continue };
        is_connected |= matches!(report, Report::Connected);
        let is_end = report.is_end();
        // Messages of QoS 0 are bounded by nothing: those beyond the queue are lost, as QoS 0 allows.
        let may_be_lost = matches!(&report, Report::Message(message) if message.promise.is_none());
        let bytes = report.bytes();
        if may_be_lost {
            if !reports.try_put(report, bytes)
                && let Some(live) = &live
            {
                live.update(|status| status.lost += 1);
            }
        } else if !reports.put(report, bytes).await || is_end {
            return;
        }
    }
}

/// An open connection to a broker.
struct Link {
    client: Client,
    reports: Outlet<Report>,
    _driving: AbortOnDropHandle<()>,
    _bridge: Option<Bridge>,
}

impl Link {
    /// With at most as many messages as are wished, and `bytes` of them, that nobody has taken yet.
    async fn open(
        address: &Address,
        credentials: &Credentials<'_>,
        wishes: &Wishes,
        bytes: usize,
        live: Option<&Arc<LiveConnection>>,
    ) -> Result<Self, PeerError> {
        let mut unknown = Vec::new();
        for version in [Version::Five, Version::ThreeOneOne] {
            let open = Self::open_version(version, address, credentials, wishes, bytes, live);
            match within(OPEN_TIME, open).await {
                Ok(Ok(link)) => return Ok(link),
                Ok(Err(reason)) => unknown.push(reason),
                Err(error) if unknown.is_empty() => return Err(error),
                Err(PeerError(reason)) => unknown.push(reason),
            }
        }
        Err(PeerError(format!("{}; {NEEDS_MQTT}", unknown.join("; then: "))))
    }

    /// The inner error is that of a broker that does not know the version.
    async fn open_version(
        version: Version,
        address: &Address,
        credentials: &Credentials<'_>,
        wishes: &Wishes,
        bytes: usize,
        live: Option<&Arc<LiveConnection>>,
    ) -> Result<Result<Self, String>, PeerError> {
        let (place, bridge) = place(address, credentials).await?;
        let (client, connection) = client(version, &place, wishes, credentials);
        // Acknowledgements of subscriptions and of the connection come besides the messages.
        let (reports_in, reports) = inbox(2 * wishes.queue + 16, bytes);
        let driving = AbortOnDropHandle::new(tokio::spawn(drive(connection, reports_in, live.cloned())));
        let mut link = Self { client, reports, _driving: driving, _bridge: bridge };
        loop {
            match link.report().await?.0 {
                Report::Connected => return Ok(Ok(link)),
                Report::UnknownVersion(reason) => return Ok(Err(reason)),
                _ => {}
            }
        }
    }

    /// Has the broker keep a text under a topic.
    async fn retain(&mut self, topic: &str, text: &'static str) -> Result<(), PeerError> {
        self.client.retain(topic, Bytes::from_static(text.as_bytes())).await?;
        loop {
            if let Report::Published(_, outcome) = self.report().await?.0 {
                return outcome.map_err(PeerError);
            }
        }
    }

    async fn report(&mut self) -> Result<(Report, HeldBytes), PeerError> {
        match self.reports.recv().await {
            Some((Report::Failed(reason), _)) => Err(PeerError(reason)),
            Some(report) => Ok(report),
            None => Err("the connection to the broker has ended".into()),
        }
    }
}

/// Messages of topics.
pub(super) struct MqttSource {
    link: Link,
    /// Messages that came before the subscription was confirmed, from the session that the broker has kept.
    early: VecDeque<(Incoming, HeldBytes)>,
    /// Until when the subscription must be confirmed; `None` once it is.
    confirmed_by: Option<Instant>,
    unsettled: HashMap<u64, Promise>,
    last_receipt: u64,
}

impl MqttSource {
    pub(super) async fn open(
        address: &Address,
        topics: &[String],
        credentials: &Credentials<'_>,
        identity: &SourceIdentity,
        (limits, live): (&Limits, &Arc<LiveConnection>),
    ) -> Result<Self, PeerError> {
        let (queue, unsettled) = (limits.connection_queue, limits.connection_unsettled);
        let wishes = Wishes {
            client_id: identity.client_id.clone(),
            is_kept: identity.is_lasting,
            receive_maximum: Some(u16::try_from(unsettled).unwrap_or(u16::MAX)),
            max_packet_bytes: limits.connection_message_bytes.saturating_add(PACKET_OVERHEAD_BYTES),
            queue,
            requests: unsettled + queue,
            last_will: None,
        };
        let bytes = limits.connection_queue_bytes;
        let link = Link::open(address, credentials, &wishes, bytes, Some(live)).await?;
        let open = async {
            link.client.subscribe(topics).await?;
            let mut source = Self {
                link,
                early: VecDeque::new(),
                confirmed_by: Some(Instant::now() + OPEN_TIME),
                unsettled: HashMap::new(),
                last_receipt: 0,
            };
            source.gather_early(bytes / 2).await?;
            Ok(source)
        };
        within(OPEN_TIME, open).await
    }
}

impl MqttSource {
    /// Reads until the subscription is confirmed, or as many messages have come first as may be held: those of a session
    /// that was kept must be taken before the broker goes on.
    async fn gather_early(&mut self, most_bytes: usize) -> Result<(), PeerError> {
        let mut bytes = 0;
        while self.confirmed_by.is_some() && bytes < most_bytes {
            if let Some(message) = self.message().await? {
                bytes += message.1.num_permits();
                self.early.push_back(message);
            }
        }
        Ok(())
    }

    /// Returns the broker's next packet, if it is a message.
    async fn message(&mut self) -> Result<Option<(Incoming, HeldBytes)>, PeerError> {
        match self.link.report().await? {
            (Report::Message(message), held) => return Ok(Some((message, held))),
            (Report::Subscribed(confirmed), _) => {
                confirmed.map_err(PeerError)?;
                self.confirmed_by = None;
            }
            _ => {}
        }
        Ok(None)
    }

    async fn next_message(&mut self) -> Result<(Incoming, HeldBytes), PeerError> {
        if let Some(early) = self.early.pop_front() {
            return Ok(early);
        }
        loop {
            let until = self.confirmed_by;
            let confirmation = async {
                match until {
                    Some(until) => tokio::time::sleep_until(until).await,
                    None => std::future::pending().await,
                }
            };
            let message = tokio::select! {
                // First: messages that come without end must not put it off.
                biased;
                () = confirmation => return Err(UNCONFIRMED.into()),
                message = self.message() => message?,
            };
            if let Some(message) = message {
                return Ok(message);
            }
        }
    }
}

impl Source for MqttSource {
    fn next(&mut self) -> BoxFuture<'_, Result<Message, PeerError>> {
        Box::pin(async {
            let (Incoming { topic, payload, promise }, _held) = self.next_message().await?;
            self.last_receipt += 1;
            self.unsettled.extend(promise.map(|promise| (self.last_receipt, promise)));
            Ok(Message::new(self.last_receipt, topic, payload))
        })
    }

    fn settle(&mut self, settled: Vec<Settled>) -> BoxFuture<'_, Result<(), PeerError>> {
        Box::pin(async move {
            for Settled { receipt, .. } in settled {
                if let Some(promise) = self.unsettled.remove(&receipt) {
                    self.link.client.acknowledge(&promise).await?;
                }
            }
            Ok(())
        })
    }
}

/// The messages to Home Assistant besides positions: the availability of the sink, and the configuration of each target.
struct Announcer {
    /// Has `online` while the connection is open, and `offline` by its last will.
    availability_topic: String,
    /// Topics of positions whose configurations the broker has of this connection.
    announced: HashSet<String>,
}

impl Announcer {
    /// Topics that are remembered; then all are announced again, which changes nothing.
    const MOST_ANNOUNCED: usize = 4_096;

    /// The configuration of a message's topic, if it was not announced yet.
    fn configuration(&mut self, message: &OutboxMessage) -> Option<(String, Vec<u8>)> {
        let OutboxMessage { subject, payload, .. } = message;
        if self.announced.contains(subject) {
            return None;
        }
        if self.announced.len() >= Self::MOST_ANNOUNCED {
            self.announced.clear();
        }
        self.announced.insert(subject.clone());
        home_assistant_discovery(subject, payload, &self.availability_topic, env!("CARGO_PKG_VERSION"))
    }
}

pub(super) struct MqttSink {
    link: Link,
    media_type: &'static str,
    announcer: Option<Announcer>,
}

impl MqttSink {
    pub(super) async fn open(
        address: &Address,
        credentials: &Credentials<'_>,
        client_id: &str,
        media_type: &'static str,
        availability_topic: Option<String>,
    ) -> Result<Self, PeerError> {
        let wishes = Wishes {
            client_id: client_id.to_owned(),
            is_kept: false,
            receive_maximum: None,
            max_packet_bytes: SINK_PACKET_BYTES,
            queue: PUBLISH_QUEUE,
            requests: PUBLISH_QUEUE,
            last_will: availability_topic.clone().map(|topic| (topic, "offline")),
        };
        let mut link = Link::open(address, credentials, &wishes, SINK_BYTES, None).await?;
        let announcer = match availability_topic {
            Some(availability_topic) => {
                within(OPEN_TIME, link.retain(&availability_topic, "online")).await?;
                Some(Announcer { availability_topic, announced: HashSet::new() })
            }
            None => None,
        };
        Ok(Self { link, media_type, announcer })
    }

    /// Publishes a message; whether something that announces it was published before.
    async fn publish(&mut self, message: &OutboxMessage) -> Result<bool, PeerError> {
        let client = &self.link.client;
        let configuration = self.announcer.as_mut().and_then(|it| it.configuration(message));
        let is_announced = configuration.is_some();
        if let Some((topic, configuration)) = configuration {
            client.retain(&topic, Bytes::from(configuration)).await?;
        }
        let payload = Bytes::copy_from_slice(&message.payload);
        let OutboxMessage { subject, message_id, .. } = message;
        client.publish(subject, payload, self.media_type, message_id).await?;
        Ok(is_announced)
    }
}

impl Sink for MqttSink {
    fn deliver<'a>(
        &'a mut self,
        messages: &'a [OutboxMessage],
        outcomes: &'a mut Outcomes,
    ) -> BoxFuture<'a, Result<(), PeerError>> {
        Box::pin(async move {
            // Each message may come with its announcement.
            for window in messages.chunks(PUBLISH_QUEUE / 2) {
                // Numbers of the messages in the order of what was published; `None` for an announcement.
                let mut published = VecDeque::with_capacity(PUBLISH_QUEUE);
                for message in window {
                    let is_announced = self.publish(message).await?;
                    published.extend(is_announced.then_some(None));
                    published.push_back(Some(message.number));
                }
                let settled = async {
                    // Acknowledgements need not come in order.
                    let (mut missing, mut sent) = (published.len(), HashMap::new());
                    while missing > 0 {
                        match self.link.report().await?.0 {
                            Report::Sent(id) => {
                                sent.extend(published.pop_front().map(|number| (id, number)));
                            }
                            Report::Published(id, outcome) => {
                                missing -= 1;
                                let number = sent.remove(&id).flatten();
                                outcomes.extend(number.map(|number| (number, outcome)));
                            }
                            _ => {}
                        }
                    }
                    Ok(())
                };
                within(OPEN_TIME, settled).await?;
            }
            Ok(())
        })
    }

    fn failed(&mut self) -> BoxFuture<'_, PeerError> {
        Box::pin(async move {
            loop {
                if let Err(error) = self.link.report().await {
                    return error;
                }
            }
        })
    }
}
