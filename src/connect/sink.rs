//! What a sink is.

use futures_util::future::BoxFuture;

use super::peer::{Credentials, PeerError};
use super::{mqtt, nats, stream, udp, webhook};
use crate::clock::Clock;
use crate::domain::OutboxMessage;
use crate::exchange::{OutgoingFormat, Scheme, Secrets, SinkSettings};

/// Numbers of messages of the outbox, with `Ok` for what was delivered and the reason for what was refused for good.
pub(super) type Outcomes = Vec<(i64, Result<(), String>)>;

/// An open connection to a system that takes messages.
pub(super) trait Sink: Send {
    /// Delivers messages in their order; outcomes are added as they are known. After an error the rest is tried again.
    fn deliver<'a>(
        &'a mut self,
        messages: &'a [OutboxMessage],
        outcomes: &'a mut Outcomes,
    ) -> BoxFuture<'a, Result<(), PeerError>>;
}

/// Opens a sink.
pub(super) async fn open(
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
