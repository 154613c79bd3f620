//! What a source is.

use std::sync::Arc;

use bytes::Bytes;
use futures_util::future::BoxFuture;

use super::peer::{Credentials, PeerError};
use super::{lines, mqtt, push, udp};
use crate::app::LiveConnection;
use crate::config::Limits;
use crate::exchange::{Scheme, Secrets, SourceSettings};

/// A message as it came.
pub(super) struct Message {
    /// Names it when it is settled.
    pub(super) receipt: u64,
    /// Its topic, or the address of its sender.
    pub(super) subject: String,
    pub(super) payload: Bytes,
}

/// An open connection to a system that sends messages.
pub(super) trait Source: Send {
    /// The next message. Cancelling the wait loses none.
    fn next(&mut self) -> BoxFuture<'_, Result<Message, PeerError>>;

    /// Tells the peer what became of a message: what was to be stored of it is stored, or it cannot be read. Called in
    /// the order of the messages.
    fn settle(&mut self, receipt: u64, outcome: Result<(), String>) -> BoxFuture<'_, Result<(), PeerError>> {
        let _ = (receipt, outcome);
        Box::pin(async { Ok(()) })
    }
}

/// Who a source is to its peer.
pub(super) struct SourceIdentity {
    /// Name of the client, the same at every attempt.
    pub(super) client_id: String,
    /// Whether the peer keeps what is not acknowledged while the source is away.
    pub(super) is_lasting: bool,
}

/// Opens a source.
pub(super) async fn open(
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
