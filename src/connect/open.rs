//! Opens the source or the sink that an address names: the one place that knows all kinds.

use std::sync::Arc;

use super::credentials::{Credentials, PeerError};
use super::sink::Sink;
use super::source::{Source, SourceIdentity};
use super::{lines, mqtt, nats, push, stream, udp, webhook};
use crate::app::LiveConnection;
use crate::clock::Clock;
use crate::config::Limits;
use crate::exchange::{OutgoingFormat, Scheme, Secrets, SinkSettings, SourceSettings};

/// Opens a source.
pub(super) async fn source(
    settings: &SourceSettings,
    secrets: &Secrets,
    identity: &SourceIdentity,
    live: &Arc<LiveConnection>,
    limits: &Limits,
) -> Result<Box<dyn Source>, PeerError> {
    let address = settings.address()?;
    let credentials = Credentials {
        username: settings.username.as_deref(),
        ca_certificate: settings.ca_certificate.as_deref(),
        secrets,
    };
    let (queue, message_bytes) = (limits.connection_queue, limits.connection_message_bytes);
    Ok(match address.scheme {
        Scheme::Mqtt | Scheme::Mqtts => Box::new(
            mqtt::MqttSource::open(&address, &settings.topics, &credentials, identity, limits).await?,
        ),
        Scheme::Tcp | Scheme::Tls | Scheme::Gpsd => {
            Box::new(lines::LineSource::connect(&address, &credentials, message_bytes).await?)
        }
        Scheme::TcpListen => Box::new(lines::LineListener::bind(&address, queue, message_bytes).await?),
        Scheme::Udp => Box::new(udp::UdpSource::bind(&address).await?),
        Scheme::Push => Box::new(push::PushSource::open(live.clone(), queue)),
        Scheme::Http | Scheme::Https | Scheme::Nats => return Err("a source cannot have this address".into()),
    })
}

/// Opens a sink.
pub(super) async fn sink(
    settings: &SinkSettings,
    secrets: &Secrets,
    client_id: &str,
    clock: &Clock,
) -> Result<Box<dyn Sink>, PeerError> {
    let address = settings.address()?;
    let credentials = Credentials {
        username: settings.username.as_deref(),
        ca_certificate: settings.ca_certificate.as_deref(),
        secrets,
    };
    let media_type = match settings.format {
        OutgoingFormat::Json => "application/json",
        OutgoingFormat::Cot => "application/xml",
    };
    Ok(match address.scheme {
        Scheme::Mqtt | Scheme::Mqtts => {
            Box::new(mqtt::MqttSink::open(&address, &credentials, client_id, media_type).await?)
        }
        Scheme::Http | Scheme::Https => {
            Box::new(webhook::Webhook::open(&address, &credentials, media_type, clock.clone()).await?)
        }
        Scheme::Nats => Box::new(nats::NatsSink::open(&address, &credentials).await?),
        Scheme::Tcp | Scheme::Tls => Box::new(stream::StreamSink::open(&address, &credentials).await?),
        Scheme::Udp => Box::new(udp::UdpSink::open(&address, settings.multicast_ttl.unwrap_or(1)).await?),
        Scheme::TcpListen | Scheme::Gpsd | Scheme::Push => {
            return Err("a sink cannot have this address".into());
        }
    })
}
