//! Datagrams: taken, and sent, also to multicast groups.

use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr};

use bytes::Bytes;
use futures_util::future::BoxFuture;
use tokio::net::{UdpSocket, lookup_host};

use crate::connect::credentials::PeerError;
use crate::connect::sink::{Outcomes, Sink};
use crate::connect::source::{Message, Source};
use crate::domain::OutboxMessage;
use crate::exchange::Address;

/// Largest datagram.
const MAX_DATAGRAM_BYTES: usize = 65_535;

/// Takes datagrams that are sent to an address of this machine, or to a multicast group.
pub(super) struct UdpSource {
    socket: UdpSocket,
    buffer: Vec<u8>,
}

impl UdpSource {
    pub(super) async fn bind(address: &Address) -> Result<Self, PeerError> {
        let address = resolve(address).await?;
        let socket = UdpSocket::bind(address).await?;
        match address.ip() {
            IpAddr::V4(group) if group.is_multicast() => {
                socket.join_multicast_v4(group, Ipv4Addr::UNSPECIFIED)?;
            }
            IpAddr::V6(group) if group.is_multicast() => socket.join_multicast_v6(&group, 0)?,
            _ => {}
        }
        Ok(Self { socket, buffer: vec![0; MAX_DATAGRAM_BYTES] })
    }
}

impl Source for UdpSource {
    fn next(&mut self) -> BoxFuture<'_, Result<Message, PeerError>> {
        Box::pin(async {
            let (bytes, peer) = self.socket.recv_from(&mut self.buffer).await?;
            let payload = Bytes::copy_from_slice(&self.buffer[..bytes]);
            Ok(Message::new(0, peer.to_string(), payload))
        })
    }
}

/// Sends a datagram per message. What is sent counts as delivered: nobody acknowledges it.
pub(super) struct UdpSink {
    socket: UdpSocket,
    address: SocketAddr,
}

impl UdpSink {
    pub(super) async fn open(address: &Address, multicast_ttl: u8) -> Result<Self, PeerError> {
        let address = resolve(address).await?;
        let own = match address {
            SocketAddr::V4(_) => SocketAddr::from((Ipv4Addr::UNSPECIFIED, 0)),
            SocketAddr::V6(_) => SocketAddr::from((Ipv6Addr::UNSPECIFIED, 0)),
        };
        let socket = UdpSocket::bind(own).await?;
        if address.is_ipv4() {
            socket.set_multicast_ttl_v4(multicast_ttl.into())?;
        }
        Ok(Self { socket, address })
    }
}

impl Sink for UdpSink {
    fn deliver<'a>(
        &'a mut self,
        messages: &'a [OutboxMessage],
        outcomes: &'a mut Outcomes,
    ) -> BoxFuture<'a, Result<(), PeerError>> {
        Box::pin(async move {
            for message in messages {
                self.socket.send_to(&message.payload, self.address).await?;
                outcomes.push((message.number, Ok(())));
            }
            Ok(())
        })
    }
}

async fn resolve(address: &Address) -> Result<SocketAddr, PeerError> {
    let mut addresses = lookup_host((address.host.as_str(), address.port)).await?;
    addresses.next().ok_or_else(|| PeerError(format!("{} has no address", address.host)))
}
