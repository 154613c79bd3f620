//! Datagrams.

use super::fields::SinkFields;
use crate::address::{Address, Scheme};

pub(super) const SCHEMES: &[Scheme] = &[Scheme::host("udp", None)];

/// A receiver of datagrams, or a multicast group.
#[derive(Debug, Clone)]
pub struct UdpSink {
    /// Where it is.
    pub address: Address,
    /// Routers that a multicast datagram may pass.
    pub multicast_ttl: u8,
}

impl UdpSink {
    pub(super) fn new(address: Address, fields: &mut SinkFields) -> Self {
        Self { address, multicast_ttl: fields.multicast_ttl.take().unwrap_or(1) }
    }
}
