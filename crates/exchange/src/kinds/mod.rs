//! The kinds of sources and sinks: a file each, with the schemes of its addresses and the settings that it knows.
//!
//! A kind is registered by its variant in [`SourceKind`] or [`SinkKind`] and its line in the table of the same side.

mod fields;
mod file;
mod gpsd;
mod kafka;
mod mqtt;
mod nats;
mod push;
mod rtsp;
mod serial;
mod tcp;
mod tcp_listen;
mod topic;
mod udp;
mod webhook;

use crate::address::{Address, Scheme};
use crate::domain::Result;

pub use fields::{Login, SaslMechanism, SinkContent};
pub(crate) use fields::{LoginFields, SinkFields, SourceFields};
pub use file::FileSink;
pub use gpsd::GpsdSource;
pub use kafka::{KafkaSink, KafkaSource};
pub use mqtt::{MqttSink, MqttSource};
pub use nats::NatsSink;
pub use rtsp::RtspSource;
pub use serial::SerialLine;
pub use tcp::TcpPeer;
pub use topic::Topic;
pub use udp::UdpSink;
pub use webhook::WebhookSink;

/// The settings of a source that its kind knows.
#[derive(Debug, Clone)]
#[expect(missing_docs, reason = "each is the kind of its settings")]
pub enum SourceKind {
    Mqtt(MqttSource),
    Kafka(KafkaSource),
    Tcp(TcpPeer),
    TcpListen(Address),
    Udp(Address),
    Serial(SerialLine),
    Gpsd(GpsdSource),
    Rtsp(RtspSource),
    Push,
}

/// The settings of a sink that its kind knows.
#[derive(Debug, Clone)]
#[expect(missing_docs, reason = "each is the kind of its settings")]
pub enum SinkKind {
    Mqtt(MqttSink),
    Kafka(KafkaSink),
    Nats(NatsSink),
    Tcp(TcpPeer),
    Udp(UdpSink),
    Webhook(WebhookSink),
    File(FileSink),
}

type Row<F, K> = (&'static [Scheme], fn(Address, &mut F) -> Result<K>);

/// The kinds of sources.
const SOURCES: &[Row<SourceFields, SourceKind>] = &[
    (mqtt::SCHEMES, |address, fields| MqttSource::new(address, fields).map(SourceKind::Mqtt)),
    (kafka::SCHEMES, |address, fields| KafkaSource::new(address, fields).map(SourceKind::Kafka)),
    (tcp::SCHEMES, |address, fields| Ok(SourceKind::Tcp(TcpPeer::new(address, &mut fields.login)))),
    (tcp_listen::SCHEMES, |address, _| Ok(SourceKind::TcpListen(address))),
    (udp::SCHEMES, |address, _| Ok(SourceKind::Udp(address))),
    (serial::SCHEMES, |address, _| SerialLine::new(&address).map(SourceKind::Serial)),
    (gpsd::SCHEMES, |address, fields| GpsdSource::new(address, fields).map(SourceKind::Gpsd)),
    (rtsp::SCHEMES, |address, fields| RtspSource::new(address, fields).map(SourceKind::Rtsp)),
    (push::SCHEMES, |_, _| Ok(SourceKind::Push)),
];

/// The kinds of sinks.
const SINKS: &[Row<SinkFields, SinkKind>] = &[
    (mqtt::SCHEMES, |address, fields| MqttSink::new(address, fields).map(SinkKind::Mqtt)),
    (kafka::SCHEMES, |address, fields| KafkaSink::new(address, fields).map(SinkKind::Kafka)),
    (nats::SCHEMES, |address, fields| NatsSink::new(address, fields).map(SinkKind::Nats)),
    (tcp::SCHEMES, |address, fields| Ok(SinkKind::Tcp(TcpPeer::new(address, &mut fields.login)))),
    (udp::SCHEMES, |address, fields| Ok(SinkKind::Udp(UdpSink::new(address, fields)))),
    (webhook::SCHEMES, |address, fields| Ok(SinkKind::Webhook(WebhookSink::new(address, fields)))),
    (file::SCHEMES, |_, fields| FileSink::new(fields).map(SinkKind::File)),
];

/// Makes the kind of an address from the fields that it takes; with its scheme.
fn made<F, K>(address: &str, table: &'static [Row<F, K>], fields: &mut F) -> Result<(K, &'static str)> {
    let (address, make) = Address::parse(address, table)?;
    let scheme = address.scheme;
    Ok((make(address, fields)?, scheme))
}

/// Where a source is.
///
/// # Errors
/// `InvalidArgument` naming `address`.
pub(crate) fn source_address(text: &str) -> Result<Address> {
    Address::parse(text, SOURCES).map(|(address, _)| address)
}

/// Where a sink is.
///
/// # Errors
/// `InvalidArgument` naming `address`.
pub(crate) fn sink_address(text: &str) -> Result<Address> {
    Address::parse(text, SINKS).map(|(address, _)| address)
}

impl SourceKind {
    /// The kind of an address, with the fields that it knows.
    ///
    /// # Errors
    /// `InvalidArgument` naming the field.
    pub(crate) fn new(address: &str, mut fields: SourceFields) -> Result<Self> {
        let (kind, scheme) = made(address, SOURCES, &mut fields)?;
        fields.refuse_rest(scheme).map(|()| kind)
    }
}

impl SinkKind {
    /// The kind of an address, with the fields that it knows.
    ///
    /// # Errors
    /// `InvalidArgument` naming the field.
    pub(crate) fn new(address: &str, mut fields: SinkFields) -> Result<Self> {
        let (kind, scheme) = made(address, SINKS, &mut fields)?;
        fields.refuse_rest(scheme).map(|()| kind)
    }

    /// The topic of each message; where its protocol has none, that of MQTT as a name.
    #[must_use]
    pub fn topic(&self, content: SinkContent) -> Topic {
        match self {
            Self::Mqtt(MqttSink { topic, .. })
            | Self::Kafka(KafkaSink { topic, .. })
            | Self::Nats(NatsSink { subject: topic, .. }) => topic.clone(),
            Self::Tcp(_) | Self::Udp(_) | Self::Webhook(_) | Self::File(_) => {
                let name = match content {
                    SinkContent::Positions => mqtt::DEFAULT_TOPIC,
                    SinkContent::PlaceEvents => mqtt::DEFAULT_EVENT_TOPIC,
                };
                Topic::new(name.to_owned(), mqtt::is_special)
            }
        }
    }
}
