//! The kinds of sources and sinks, a file or a folder each.
//!
//! [`source`] and [`sink`] open the one that an address names: the one place that knows all kinds.

mod file;
mod kafka;
mod line_reader;
mod lines;
mod listener;
mod mqtt;
mod mqtt_client;
mod nats;
mod push;
mod rtsp;
mod serial;
mod stream;
mod udp;
mod webhook;

use std::sync::Arc;

use crate::app::{App, LiveConnection};
use crate::connect::credentials::{Credentials, PeerError};
use crate::connect::sink::Sink;
use crate::connect::source::{Source, SourceIdentity};
use crate::domain::{Connection, ConnectionId};
use crate::exchange::kinds::{SinkKind, SourceKind};
use crate::exchange::{OutgoingFormat, Secrets, SinkSettings, SourceSettings};

/// Opens a source.
pub(super) async fn source(
    app: &App,
    connection: &Connection,
    settings: &SourceSettings,
    secrets: &Secrets,
    identity: &SourceIdentity,
    live: &Arc<LiveConnection>,
) -> Result<Box<dyn Source>, PeerError> {
    let limits = &app.limits;
    let (queue, message_bytes) = (limits.connection_queue, limits.connection_message_bytes);
    Ok(match settings.kind()? {
        SourceKind::Mqtt(broker) => {
            let credentials = Credentials::of(&broker.login, secrets);
            let (address, topics) = (&broker.address, &broker.topics);
            Box::new(mqtt::MqttSource::open(address, topics, &credentials, identity, (limits, live)).await?)
        }
        SourceKind::Kafka(cluster) => {
            let user = Credentials::of(&cluster.login, secrets);
            let credentials = Credentials { sasl_mechanism: cluster.sasl_mechanism, ..user };
            let brokers = kafka::Brokers::open(&cluster.address, &credentials, &identity.client_id).await?;
            let offsets = identity.is_lasting.then(|| (app.store.clone(), connection.key));
            let reader = kafka::SourceReader { offsets, limits: limits.clone() };
            Box::new(reader.open(brokers, cluster.topics.into_iter().collect()).await?)
        }
        SourceKind::Serial(line) => {
            app.connections().check_serial_line(&line)?;
            Box::new(lines::LineSource::open_serial(&line, message_bytes, live)?)
        }
        SourceKind::Tcp(peer) => {
            let credentials = Credentials::trusting(peer.ca_certificate.as_ref(), secrets);
            Box::new(lines::LineSource::connect(&peer.address, &credentials, message_bytes, live).await?)
        }
        SourceKind::Gpsd(daemon) => {
            Box::new(lines::LineSource::watch_gpsd(&daemon.address, secrets, message_bytes, live).await?)
        }
        SourceKind::Rtsp(stream) => {
            let credentials = Credentials::of(&stream.login, secrets);
            Box::new(rtsp::RtspSource::open(&stream.address, &credentials, message_bytes, live).await?)
        }
        SourceKind::TcpListen(address) => Box::new(listener::LineListener::bind(&address, app, live).await?),
        SourceKind::Udp(address) => Box::new(udp::UdpSource::bind(&address).await?),
        SourceKind::Push => Box::new(push::PushSource::open(live.clone(), queue)),
    })
}

/// Opens a sink of a connection; one that is only tried announces nothing of itself.
pub(super) async fn sink(
    app: &App,
    connection: &ConnectionId,
    settings: &SinkSettings,
    secrets: &Secrets,
    (client_id, is_lasting): (&str, bool),
) -> Result<Box<dyn Sink>, PeerError> {
    let media_type = match settings.format {
        OutgoingFormat::Cot | OutgoingFormat::Onvif => "application/xml",
        OutgoingFormat::Json | OutgoingFormat::HomeAssistant | OutgoingFormat::Gpx | OutgoingFormat::Kml => {
            "application/json"
        }
    };
    Ok(match settings.kind()? {
        SinkKind::Mqtt(broker) => {
            let announces = is_lasting && settings.format == OutgoingFormat::HomeAssistant;
            let availability = announces.then(|| format!("sightfix-availability/{connection}"));
            let credentials = Credentials::of(&broker.login, secrets);
            let address = &broker.address;
            Box::new(mqtt::MqttSink::open(address, &credentials, client_id, media_type, availability).await?)
        }
        SinkKind::Webhook(receiver) => {
            let credentials = Credentials::trusting(receiver.ca_certificate.as_ref(), secrets);
            let clock = app.clock.clone();
            Box::new(webhook::Webhook::open(&receiver.address, &credentials, media_type, clock).await?)
        }
        SinkKind::Kafka(cluster) => {
            let user = Credentials::of(&cluster.login, secrets);
            let credentials = Credentials { sasl_mechanism: cluster.sasl_mechanism, ..user };
            Box::new(kafka::KafkaSink::open(&cluster.address, &credentials, client_id, media_type).await?)
        }
        SinkKind::Nats(server) => Box::new(nats::NatsSink::open(&server, secrets, client_id).await?),
        SinkKind::Tcp(peer) => {
            let credentials = Credentials::trusting(peer.ca_certificate.as_ref(), secrets);
            Box::new(stream::StreamSink::open(&peer.address, &credentials).await?)
        }
        SinkKind::Udp(receiver) => {
            Box::new(udp::UdpSink::open(&receiver.address, receiver.multicast_ttl).await?)
        }
        SinkKind::File(files) => {
            let folder = app.export_folder.get().ok_or(
                "sinks may not write files here; name the folder for them in the setting export_folder",
            )?;
            Box::new(file::FileSink::open(folder, connection, files, app.limits.export_files).await?)
        }
    })
}
