//! MQTT 5: a source of topics, and a sink.
//!
//! A source subscribes with QoS 1 in a session that the broker keeps for a day, and acknowledges a message when what
//! was to be stored of it is stored; what it has not acknowledged comes again after a reconnect. Its receive maximum
//! is the limit of unsettled messages, for brokers allow as few as 20 where a client states none. A sink publishes
//! with QoS 1 and counts a message as delivered when the broker has acknowledged it.
//!
//! The library's own encryption needs an outdated verifier of certificates, so an encrypted connection is opened here
//! as any other, and the library reaches it by a Unix socket that only this process can open.

use std::collections::{HashMap, VecDeque};
use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use futures_util::future::BoxFuture;
use rumqttc::v5::mqttbytes::QoS;
use rumqttc::v5::mqttbytes::v5::{
    ConnectReturnCode, Filter, Packet, PubAckReason, Publish, PublishProperties, SubscribeReasonCode,
};
use rumqttc::v5::{AsyncClient, ConnectionError, Event, EventLoop, MqttOptions};
use rumqttc::{Outgoing, Transport};
use tempfile::TempDir;
use tokio::net::UnixListener;
use tokio::time::Instant;
use tokio_util::task::AbortOnDropHandle;

use super::credentials::{Credentials, PeerError};
use super::inbox::{HeldBytes, Inlet, Outlet, inbox};
use super::peer::{OPEN_TIME, connect, within};
use super::sink::{Outcomes, Sink};
use super::source::{Message, Settled, Source, SourceIdentity};
use crate::app::LiveConnection;
use crate::config::Limits;
use crate::domain::OutboxMessage;
use crate::exchange::{Address, Scheme};

const KEEP_ALIVE: Duration = Duration::from_secs(20);
/// How long a broker keeps the messages of a source that is away.
const SESSION_EXPIRY_S: u32 = 86_400;
/// What a PUBLISH packet has besides its payload, at most: topic and properties.
const PACKET_OVERHEAD_BYTES: usize = 66_000;
/// Messages that a sink may have under way; fewer where the broker states so.
const PUBLISH_QUEUE: usize = 128;
/// What a broker may send to a sink, which subscribes to nothing, bytes.
const SINK_BYTES: usize = 64 << 10;

/// Of a broker that never answers a subscription.
const UNCONFIRMED: &str = "the broker has not confirmed the subscription within 10 s";

const NEEDS_MQTT_5: &str = "connections need MQTT 5: a broker that speaks MQTT 3.1.1 alone has to be updated, or \
                            bridged by one that speaks both";

/// What the task of a connection reports.
enum Report {
    Subscribed(Result<(), String>),
    Connected,
    Message(Publish),
    /// A message was sent under this packet id. They are sent in the order in which they were given.
    Sent(u16),
    /// The broker has taken, or refused, the message of this packet id.
    Published(u16, Result<(), String>),
    Failed(String),
}

/// An encrypted connection that a Unix socket leads to.
struct Bridge {
    /// Has the socket, and is removed with the bridge. Other users cannot enter it.
    folder: TempDir,
    _copying: AbortOnDropHandle<()>,
}

impl Bridge {
    const SOCKET: &str = "mqtt";

    async fn open(address: &Address, credentials: &Credentials<'_>) -> Result<Self, PeerError> {
        let mut outer = connect(address, true, credentials).await?;
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

/// The options of a connection, and the bridge that it needs, if any.
async fn prepare(
    address: &Address,
    client_id: &str,
    credentials: &Credentials<'_>,
) -> Result<(MqttOptions, Option<Bridge>), PeerError> {
    let bridge = match address.scheme {
        Scheme::Mqtts => Some(Bridge::open(address, credentials).await?),
        _ => None,
    };
    let host = match &bridge {
        Some(bridge) => bridge.socket(),
        None if address.host.contains(':') => format!("[{}]", address.host),
        None => address.host.clone(),
    };
    let mut options = MqttOptions::new(client_id, host, address.port);
    options.set_keep_alive(KEEP_ALIVE).set_connection_timeout(OPEN_TIME.as_secs());
    if bridge.is_some() {
        options.set_transport(Transport::unix());
    }
    if let Some(username) = credentials.username {
        options.set_credentials(username, credentials.secrets.get("password").unwrap_or_default());
    }
    Ok((options, bridge))
}

/// Whether a broker may have failed to answer because it does not know MQTT 5: it says so, ends the connection, or
/// sends the answer of MQTT 3.1.1, which is two bytes shorter than a packet of MQTT 5 can be.
const fn may_lack_mqtt_5(error: &ConnectionError) -> bool {
    use ConnectReturnCode::{RefusedProtocolVersion, UnsupportedProtocolVersion};
    matches!(
        error,
        ConnectionError::MqttState(_)
            | ConnectionError::Timeout(_)
            | ConnectionError::ConnectionRefused(RefusedProtocolVersion | UnsupportedProtocolVersion)
    )
}

impl Report {
    /// Bytes that it takes up.
    fn bytes(&self) -> usize {
        match self {
            Self::Message(publish) => publish.payload.len() + publish.topic.len(),
            _ => 0,
        }
    }
}

/// Drives a connection until it fails or nobody takes its reports any more. It waits while these have too many bytes, so
/// that the broker waits, too.
async fn drive(mut connection: EventLoop, reports: Inlet<Report>, live: Option<Arc<LiveConnection>>) {
    let mut is_connected = false;
    loop {
        let report = match connection.poll().await {
            Ok(Event::Incoming(Packet::Publish(publish))) => {
                // Nothing of them is used, and they may be as large as the packet.
                Report::Message(Publish { properties: None, ..publish })
            }
            Ok(Event::Incoming(Packet::ConnAck(_))) => {
                is_connected = true;
                Report::Connected
            }
            Ok(Event::Incoming(Packet::PubAck(ack))) => {
                let is_taken =
                    matches!(ack.reason, PubAckReason::Success | PubAckReason::NoMatchingSubscribers);
                let refused = || format!("the broker refuses the message: {:?}", ack.reason);
                Report::Published(ack.pkid, if is_taken { Ok(()) } else { Err(refused()) })
            }
            Ok(Event::Outgoing(Outgoing::Publish(id))) => Report::Sent(id),
            Ok(Event::Incoming(Packet::SubAck(answer))) => {
                let refused = answer
                    .return_codes
                    .iter()
                    .find(|code| !matches!(code, SubscribeReasonCode::Success(_)))
                    .map(|code| format!("the broker refuses a topic: {code:?}"));
                Report::Subscribed(refused.map_or(Ok(()), Err))
            }
            Ok(Event::Incoming(Packet::Disconnect(reason))) => {
                Report::Failed(format!("the broker ends the connection: {:?}", reason.reason_code))
            }
            Ok(_) => continue,
            Err(error) if !is_connected && may_lack_mqtt_5(&error) => {
                Report::Failed(format!("{error}; {NEEDS_MQTT_5}"))
            }
            Err(error) => Report::Failed(error.to_string()),
        };
        let has_failed = matches!(report, Report::Failed(_));
        // Messages of QoS 0 are bounded by nothing: those beyond the queue are lost, as QoS 0 allows.
        let may_be_lost = matches!(&report, Report::Message(publish) if publish.qos == QoS::AtMostOnce);
        let bytes = report.bytes();
        if may_be_lost {
            if !reports.try_put(report, bytes)
                && let Some(live) = &live
            {
                live.update(|status| status.lost += 1);
            }
        } else if !reports.put(report, bytes).await || has_failed {
            return;
        }
    }
}

/// An open connection to a broker.
struct Link {
    client: AsyncClient,
    reports: Outlet<Report>,
    _driving: AbortOnDropHandle<()>,
    _bridge: Option<Bridge>,
}

impl Link {
    /// With at most `queue` messages and `bytes` of them that nobody has taken yet, and as many `requests` to the broker
    /// that are not sent: one for each message that may be acknowledged at once, or both sides would wait for each other.
    async fn open(
        (options, bridge): (MqttOptions, Option<Bridge>),
        (queue, bytes, requests): (usize, usize, usize),
        live: Option<Arc<LiveConnection>>,
    ) -> Result<Self, PeerError> {
        let (client, connection) = AsyncClient::new(options, requests);
        // Acknowledgements of subscriptions and of the connection come besides the messages.
        let (reports_in, reports) = inbox(2 * queue + 16, bytes);
        let driving = AbortOnDropHandle::new(tokio::spawn(drive(connection, reports_in, live)));
        let mut link = Self { client, reports, _driving: driving, _bridge: bridge };
        loop {
            if let (Report::Connected, _) = link.report().await? {
                return Ok(link);
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
    early: VecDeque<(Publish, HeldBytes)>,
    /// Until when the subscription must be confirmed; `None` once it is.
    confirmed_by: Option<Instant>,
    unsettled: HashMap<u64, Publish>,
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
        let (mut options, bridge) = prepare(address, &identity.client_id, credentials).await?;
        let (queue, unsettled) = (limits.connection_queue, limits.connection_unsettled);
        let receive_maximum = u16::try_from(unsettled).unwrap_or(u16::MAX);
        let packet_bytes = limits.connection_message_bytes.saturating_add(PACKET_OVERHEAD_BYTES);
        options
            .set_manual_acks(true)
            .set_clean_start(!identity.is_lasting)
            .set_session_expiry_interval(identity.is_lasting.then_some(SESSION_EXPIRY_S))
            .set_receive_maximum(Some(receive_maximum))
            .set_max_packet_size(u32::try_from(packet_bytes).ok());
        let filters: Vec<Filter> =
            topics.iter().map(|topic| Filter::new(topic.as_str(), QoS::AtLeastOnce)).collect();
        let open = async {
            let bytes = limits.connection_queue_bytes;
            let link =
                Link::open((options, bridge), (queue, bytes, unsettled + queue), Some(live.clone())).await?;
            link.client.subscribe_many(filters).await.map_err(|error| PeerError(error.to_string()))?;
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

    /// What the broker sends next, if it is a message.
    async fn message(&mut self) -> Result<Option<(Publish, HeldBytes)>, PeerError> {
        match self.link.report().await? {
            (Report::Message(publish), held) => return Ok(Some((publish, held))),
            (Report::Subscribed(confirmed), _) => {
                confirmed.map_err(PeerError)?;
                self.confirmed_by = None;
            }
            _ => {}
        }
        Ok(None)
    }

    async fn next_message(&mut self) -> Result<(Publish, HeldBytes), PeerError> {
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
            let (mut publish, _held) = self.next_message().await?;
            self.last_receipt += 1;
            let (payload, topic) = (std::mem::take(&mut publish.payload), std::mem::take(&mut publish.topic));
            let subject = String::from_utf8_lossy(&topic).into_owned();
            if publish.qos != QoS::AtMostOnce {
                // Its number alone is acknowledged.
                self.unsettled.insert(self.last_receipt, publish);
            }
            Ok(Message::new(self.last_receipt, subject, payload))
        })
    }

    fn settle(&mut self, settled: Vec<Settled>) -> BoxFuture<'_, Result<(), PeerError>> {
        Box::pin(async move {
            for Settled { receipt, .. } in settled {
                if let Some(publish) = self.unsettled.remove(&receipt) {
                    self.link.client.ack(&publish).await.map_err(|error| PeerError(error.to_string()))?;
                }
            }
            Ok(())
        })
    }
}

/// Publishes messages.
pub(super) struct MqttSink {
    link: Link,
    media_type: &'static str,
}

impl MqttSink {
    pub(super) async fn open(
        address: &Address,
        credentials: &Credentials<'_>,
        client_id: &str,
        media_type: &'static str,
    ) -> Result<Self, PeerError> {
        let (mut options, bridge) = prepare(address, client_id, credentials).await?;
        options.set_clean_start(true);
        let link = within(
            OPEN_TIME,
            Link::open((options, bridge), (PUBLISH_QUEUE, SINK_BYTES, PUBLISH_QUEUE), None),
        )
        .await?;
        Ok(Self { link, media_type })
    }

    async fn publish(&self, message: &OutboxMessage) -> Result<(), PeerError> {
        let properties = PublishProperties {
            content_type: Some(self.media_type.to_owned()),
            user_properties: vec![("message-id".to_owned(), message.message_id.clone())],
            ..PublishProperties::default()
        };
        let payload = Bytes::copy_from_slice(&message.payload);
        self.link
            .client
            .publish_with_properties(&message.subject, QoS::AtLeastOnce, false, payload, properties)
            .await
            .map_err(|error| PeerError(error.to_string()))
    }
}

impl Sink for MqttSink {
    fn deliver<'a>(
        &'a mut self,
        messages: &'a [OutboxMessage],
        outcomes: &'a mut Outcomes,
    ) -> BoxFuture<'a, Result<(), PeerError>> {
        Box::pin(async move {
            for window in messages.chunks(PUBLISH_QUEUE) {
                for message in window {
                    self.publish(message).await?;
                }
                let settled = async {
                    // Acknowledgements need not come in order.
                    let (mut unsent, mut sent) = (window.iter(), HashMap::new());
                    let mut missing = window.len();
                    while missing > 0 {
                        match self.link.report().await?.0 {
                            Report::Sent(id) => {
                                sent.extend(unsent.next().map(|message| (id, message.number)));
                            }
                            Report::Published(id, outcome) => {
                                missing -= 1;
                                outcomes.extend(sent.remove(&id).map(|number| (number, outcome)));
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
