//! Opens the source or the sink that an address names: the one place that knows all kinds.

use std::sync::Arc;

use super::credentials::{Credentials, PeerError};
use super::file::{FileSettings, FileSink};
use super::sink::Sink;
use super::source::{Source, SourceIdentity};
use super::{kafka, lines, listener, mqtt, nats, push, rtsp, stream, udp, webhook};
use crate::app::{App, LiveConnection};
use crate::domain::{Connection, ConnectionId};
use crate::exchange::{OutgoingFormat, Scheme, Secrets, SinkSettings, SourceSettings};

/// Time after which a new file begins, s.
const DEFAULT_ROTATE_S: f64 = 3_600.0;

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
    let address = settings.address()?;
    let credentials = Credentials {
        username: settings.username.as_deref(),
        sasl_mechanism: settings.sasl_mechanism,
        ca_certificate: settings.ca_certificate.as_deref(),
        secrets,
    };
    let (queue, message_bytes) = (limits.connection_queue, limits.connection_message_bytes);
    Ok(match address.scheme {
        Scheme::Mqtt | Scheme::Mqtts => Box::new(
            mqtt::MqttSource::open(&address, &settings.topics, &credentials, identity, (limits, live))
                .await?,
        ),
        Scheme::Kafka | Scheme::Kafkas => {
            let brokers = kafka::Brokers::open(&address, &credentials, &identity.client_id).await?;
            let offsets = identity.is_lasting.then(|| (app.store.clone(), connection.key));
            let reader = kafka::SourceReader { offsets, limits: limits.clone() };
            Box::new(reader.open(brokers, settings.topics.iter().cloned().collect()).await?)
        }
        Scheme::Serial => {
            Box::new(lines::LineSource::open_serial(&app.serial_line(&address)?, message_bytes, live)?)
        }
        Scheme::Tcp | Scheme::Tls | Scheme::Gpsd => {
            Box::new(lines::LineSource::connect(&address, &credentials, message_bytes, live).await?)
        }
        Scheme::Rtsp | Scheme::Rtsps => {
            Box::new(rtsp::RtspSource::open(&address, &credentials, message_bytes, live).await?)
        }
        Scheme::TcpListen => Box::new(listener::LineListener::bind(&address, app, live).await?),
        Scheme::Udp => Box::new(udp::UdpSource::bind(&address).await?),
        Scheme::Push => Box::new(push::PushSource::open(live.clone(), queue)),
        Scheme::Http | Scheme::Https | Scheme::Nats | Scheme::File => {
            return Err("a source cannot have this address".into());
        }
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
    let address = settings.address()?;
    let credentials = Credentials {
        username: settings.username.as_deref(),
        sasl_mechanism: settings.sasl_mechanism,
        ca_certificate: settings.ca_certificate.as_deref(),
        secrets,
    };
    let media_type = match settings.format {
        OutgoingFormat::Cot | OutgoingFormat::Onvif => "application/xml",
        OutgoingFormat::Json | OutgoingFormat::HomeAssistant | OutgoingFormat::Gpx | OutgoingFormat::Kml => {
            "application/json"
        }
    };
    Ok(match address.scheme {
        Scheme::Mqtt | Scheme::Mqtts => {
            let announces = is_lasting && settings.format == OutgoingFormat::HomeAssistant;
            let availability_topic = announces.then(|| format!("sightfix-availability/{connection}"));
            Box::new(
                mqtt::MqttSink::open(&address, &credentials, client_id, media_type, availability_topic)
                    .await?,
            )
        }
        Scheme::Http | Scheme::Https => {
            Box::new(webhook::Webhook::open(&address, &credentials, media_type, app.clock.clone()).await?)
        }
        Scheme::Kafka | Scheme::Kafkas => {
            Box::new(kafka::KafkaSink::open(&address, &credentials, client_id, media_type).await?)
        }
        Scheme::Nats => Box::new(nats::NatsSink::open(&address, &credentials).await?),
        Scheme::Tcp | Scheme::Tls => Box::new(stream::StreamSink::open(&address, &credentials).await?),
        Scheme::Udp => Box::new(udp::UdpSink::open(&address, settings.multicast_ttl.unwrap_or(1)).await?),
        Scheme::File => Box::new(file_sink(app, connection, settings).await?),
        Scheme::TcpListen | Scheme::Gpsd | Scheme::Rtsp | Scheme::Rtsps | Scheme::Serial | Scheme::Push => {
            return Err("a sink cannot have this address".into());
        }
    })
}

async fn file_sink(
    app: &App,
    connection: &ConnectionId,
    settings: &SinkSettings,
) -> Result<FileSink, PeerError> {
    let folder = app.export_folder.get().ok_or_else(|| {
        PeerError::from(
            "sinks may not write files here; name the folder for them in the setting export_folder",
        )
    })?;
    let format = settings.format.track_file().ok_or_else(|| PeerError::from("format must be gpx or kml"))?;
    let rotate_s = settings.rotate_s.unwrap_or(DEFAULT_ROTATE_S);
    let settings = FileSettings { format, rotate_s, max_files: app.limits.export_files };
    FileSink::open(folder, connection, settings).await
}
