//! One client for both versions of MQTT: 5, and 3.1.1 for brokers that do not know it.

use std::time::Duration;

use bytes::Bytes;
use rumqttc::v5::mqttbytes as five;
use rumqttc::v5::mqttbytes::v5::{ConnectReturnCode, LastWill, PubAckReason, PublishProperties};
use rumqttc::{Outgoing, Transport, v5};

use crate::connect::credentials::{Credentials, PeerError};
use crate::connect::peer::OPEN_TIME;

const KEEP_ALIVE: Duration = Duration::from_secs(20);
/// How long a broker of MQTT 5 keeps the messages of a source that is away; one of 3.1.1 decides itself.
const SESSION_EXPIRY_S: u32 = 86_400;

/// A version of the protocol.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Version {
    Five,
    ThreeOneOne,
}

/// The options that a client asks of its broker.
pub(super) struct Wishes {
    pub(super) client_id: String,
    /// True if the broker keeps the session while the client is away.
    pub(super) is_kept: bool,
    /// Messages that the broker may send before they are acknowledged; as many as it likes if `None`.
    pub(super) receive_maximum: Option<u16>,
    pub(super) max_packet_bytes: usize,
    /// Messages that nobody has taken yet.
    pub(super) queue: usize,
    /// Requests to the broker that are not sent: one for each message that may be acknowledged at once, or both sides
    /// would wait for each other.
    pub(super) requests: usize,
    /// A topic, and what the broker publishes and retains there when the connection is lost.
    pub(super) last_will: Option<(String, &'static str)>,
}

/// Where a broker is reached: a host, or the path of a Unix socket.
pub(super) struct Place {
    pub(super) host: String,
    pub(super) port: u16,
    pub(super) is_socket: bool,
}

/// A message of the broker.
pub(super) struct Incoming {
    pub(super) topic: String,
    pub(super) payload: Bytes,
    /// The promise to acknowledge the message; `None` for QoS 0.
    pub(super) promise: Option<Promise>,
}

/// The number of a message that the broker sends again until it is acknowledged.
pub(super) enum Promise {
    Five(Box<v5::mqttbytes::v5::Publish>),
    ThreeOneOne(Box<rumqttc::Publish>),
}

/// A report of the task of a connection.
pub(super) enum Report {
    Subscribed(Result<(), String>),
    Connected,
    Message(Incoming),
    /// A message was sent under this packet id. They are sent in the order in which they were given.
    Sent(u16),
    /// The broker has taken, or refused, the message of this packet id.
    Published(u16, Result<(), String>),
    Failed(String),
    /// It failed as it does with a broker that does not know the version.
    UnknownVersion(String),
}

impl Report {
    /// Bytes that it occupies.
    pub(super) fn bytes(&self) -> usize {
        match self {
            Self::Message(message) => message.payload.len() + message.topic.len(),
            _ => 0,
        }
    }

    /// True if the connection has ended.
    pub(super) const fn is_end(&self) -> bool {
        matches!(self, Self::Failed(_) | Self::UnknownVersion(_))
    }
}

/// Sends to the broker.
pub(super) enum Client {
    Five(v5::AsyncClient),
    ThreeOneOne(rumqttc::AsyncClient),
}

/// Receives from the broker.
pub(super) enum Connection {
    Five(Box<v5::EventLoop>),
    ThreeOneOne(Box<rumqttc::EventLoop>),
}

/// A client with its connection, which connects when it is polled.
pub(super) fn client(
    version: Version,
    place: &Place,
    wishes: &Wishes,
    credentials: &Credentials<'_>,
) -> (Client, Connection) {
    let login =
        credentials.username.map(|name| (name, credentials.secrets.get("password").unwrap_or_default()));
    match version {
        Version::Five => {
            let mut options = v5::MqttOptions::new(&wishes.client_id, &place.host, place.port);
            options
                .set_keep_alive(KEEP_ALIVE)
                .set_connection_timeout(OPEN_TIME.as_secs())
                .set_manual_acks(true)
                .set_clean_start(!wishes.is_kept)
                .set_session_expiry_interval(wishes.is_kept.then_some(SESSION_EXPIRY_S))
                .set_receive_maximum(wishes.receive_maximum)
                .set_max_packet_size(u32::try_from(wishes.max_packet_bytes).ok());
            if place.is_socket {
                options.set_transport(Transport::unix());
            }
            if let Some((name, password)) = login {
                options.set_credentials(name, password);
            }
            if let Some((topic, text)) = &wishes.last_will {
                options.set_last_will(LastWill::new(topic, *text, five::QoS::AtLeastOnce, true, None));
            }
            let (client, connection) = v5::AsyncClient::new(options, wishes.requests);
            (Client::Five(client), Connection::Five(Box::new(connection)))
        }
        Version::ThreeOneOne => {
            let mut options = rumqttc::MqttOptions::new(&wishes.client_id, &place.host, place.port);
            options
                .set_keep_alive(KEEP_ALIVE)
                .set_manual_acks(true)
                .set_clean_session(!wishes.is_kept)
                .set_max_packet_size(wishes.max_packet_bytes, wishes.max_packet_bytes);
            if place.is_socket {
                options.set_transport(Transport::unix());
            }
            if let Some((name, password)) = login {
                options.set_credentials(name, password);
            }
            if let Some((topic, text)) = &wishes.last_will {
                let qos = rumqttc::QoS::AtLeastOnce;
                options.set_last_will(rumqttc::LastWill::new(topic, *text, qos, true));
            }
            let (client, mut connection) = rumqttc::AsyncClient::new(options, wishes.requests);
            connection.network_options.set_connection_timeout(OPEN_TIME.as_secs());
            (Client::ThreeOneOne(client), Connection::ThreeOneOne(Box::new(connection)))
        }
    }
}

fn ended(error: impl ToString) -> PeerError {
    PeerError(error.to_string())
}

impl Client {
    pub(super) async fn subscribe(&self, topics: &[String]) -> Result<(), PeerError> {
        match self {
            Self::Five(client) => {
                let filter = |topic: &String| five::v5::Filter::new(topic.as_str(), five::QoS::AtLeastOnce);
                client.subscribe_many(topics.iter().map(filter)).await.map_err(ended)
            }
            Self::ThreeOneOne(client) => {
                let filter =
                    |topic: &String| rumqttc::SubscribeFilter::new(topic.clone(), rumqttc::QoS::AtLeastOnce);
                client.subscribe_many(topics.iter().map(filter)).await.map_err(ended)
            }
        }
    }

    pub(super) async fn acknowledge(&self, promise: &Promise) -> Result<(), PeerError> {
        match (self, promise) {
            (Self::Five(client), Promise::Five(publish)) => client.ack(publish).await.map_err(ended),
            (Self::ThreeOneOne(client), Promise::ThreeOneOne(publish)) => {
                client.ack(publish).await.map_err(ended)
            }
            // A client gets the messages of its own connection alone.
            _ => Ok(()),
        }
    }

    /// Publishes with QoS 1. MQTT 3.1.1 has no place for the type and the id of a message.
    pub(super) async fn publish(
        &self,
        topic: &str,
        payload: Bytes,
        media_type: &str,
        message_id: &str,
    ) -> Result<(), PeerError> {
        match self {
            Self::Five(client) => {
                let properties = PublishProperties {
                    content_type: Some(media_type.to_owned()),
                    user_properties: vec![("message-id".to_owned(), message_id.to_owned())],
                    ..PublishProperties::default()
                };
                let qos = five::QoS::AtLeastOnce;
                client.publish_with_properties(topic, qos, false, payload, properties).await.map_err(ended)
            }
            Self::ThreeOneOne(client) => {
                let qos = rumqttc::QoS::AtLeastOnce;
                client.publish_bytes(topic, qos, false, payload).await.map_err(ended)
            }
        }
    }
}

impl Client {
    /// Publishes with QoS 1 what the broker keeps for those who subscribe later.
    pub(super) async fn retain(&self, topic: &str, payload: Bytes) -> Result<(), PeerError> {
        match self {
            Self::Five(client) => {
                client.publish_bytes(topic, five::QoS::AtLeastOnce, true, payload).await.map_err(ended)
            }
            Self::ThreeOneOne(client) => {
                client.publish_bytes(topic, rumqttc::QoS::AtLeastOnce, true, payload).await.map_err(ended)
            }
        }
    }
}

impl Connection {
    /// Returns the next report; `None` for an event that nobody needs.
    pub(super) async fn next(&mut self, is_connected: bool) -> Option<Report> {
        match self {
            Self::Five(connection) => match connection.poll().await {
                Ok(event) => of_five(event),
                Err(error) if !is_connected && may_lack_mqtt_5(&error) => {
                    Some(Report::UnknownVersion(error.to_string()))
                }
                Err(error) => Some(Report::Failed(error.to_string())),
            },
            Self::ThreeOneOne(connection) => match connection.poll().await {
                Ok(event) => of_three_one_one(event),
                Err(error) => Some(Report::Failed(error.to_string())),
            },
        }
    }
}

/// True if a broker may have failed to answer because it does not know MQTT 5: it says so, ends the connection, or
/// sends the answer of MQTT 3.1.1, which is two bytes shorter than a packet of MQTT 5 can be.
const fn may_lack_mqtt_5(error: &v5::ConnectionError) -> bool {
    use ConnectReturnCode::{RefusedProtocolVersion, UnsupportedProtocolVersion};
    matches!(
        error,
        v5::ConnectionError::MqttState(_)
            | v5::ConnectionError::Timeout(_)
            | v5::ConnectionError::ConnectionRefused(RefusedProtocolVersion | UnsupportedProtocolVersion)
    )
}

fn of_five(event: v5::Event) -> Option<Report> {
    use v5::mqttbytes::v5::{Packet, SubscribeReasonCode};
    Some(match event {
        v5::Event::Incoming(Packet::Publish(mut publish)) => {
            let topic = String::from_utf8_lossy(&std::mem::take(&mut publish.topic)).into_owned();
            let payload = std::mem::take(&mut publish.payload);
            // Nothing of them is used, and they may be as large as the packet.
            publish.properties = None;
            let is_promised = publish.qos != five::QoS::AtMostOnce;
            Report::Message(Incoming {
                topic,
                payload,
                promise: is_promised.then(|| Promise::Five(Box::new(publish))),
            })
        }
        v5::Event::Incoming(Packet::ConnAck(_)) => Report::Connected,
        v5::Event::Incoming(Packet::PubAck(ack)) => {
            let is_taken = matches!(ack.reason, PubAckReason::Success | PubAckReason::NoMatchingSubscribers);
            let refused = || format!("the broker refuses the message: {:?}", ack.reason);
            Report::Published(ack.pkid, if is_taken { Ok(()) } else { Err(refused()) })
        }
        v5::Event::Outgoing(Outgoing::Publish(id)) => Report::Sent(id),
        v5::Event::Incoming(Packet::SubAck(answer)) => {
            let refused = answer
                .return_codes
                .iter()
                .find(|code| !matches!(code, SubscribeReasonCode::Success(_)))
                .map(|code| format!("the broker refuses a topic: {code:?}"));
            Report::Subscribed(refused.map_or(Ok(()), Err))
        }
        v5::Event::Incoming(Packet::Disconnect(reason)) => {
            Report::Failed(format!("the broker ends the connection: {:?}", reason.reason_code))
        }
        _ => return None,
    })
}

fn of_three_one_one(event: rumqttc::Event) -> Option<Report> {
    use rumqttc::{Packet, SubscribeReasonCode};
    Some(match event {
        rumqttc::Event::Incoming(Packet::Publish(mut publish)) => {
            let topic = std::mem::take(&mut publish.topic);
            let payload = std::mem::take(&mut publish.payload);
            let is_promised = publish.qos != rumqttc::QoS::AtMostOnce;
            let promise = is_promised.then(|| Promise::ThreeOneOne(Box::new(publish)));
            Report::Message(Incoming { topic, payload, promise })
        }
        rumqttc::Event::Incoming(Packet::ConnAck(_)) => Report::Connected,
        rumqttc::Event::Incoming(Packet::PubAck(ack)) => Report::Published(ack.pkid, Ok(())),
        rumqttc::Event::Outgoing(Outgoing::Publish(id)) => Report::Sent(id),
        rumqttc::Event::Incoming(Packet::SubAck(answer)) => {
            let is_refused = answer.return_codes.contains(&SubscribeReasonCode::Failure);
            let refused = || "the broker refuses a topic".to_owned();
            Report::Subscribed(if is_refused { Err(refused()) } else { Ok(()) })
        }
        rumqttc::Event::Incoming(Packet::Disconnect) => {
            Report::Failed("the broker ends the connection".to_owned())
        }
        _ => return None,
    })
}
