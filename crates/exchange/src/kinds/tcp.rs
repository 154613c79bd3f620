//! Peers of TCP and TLS.

use super::fields::LoginFields;
use crate::address::{Address, Scheme};

pub(super) const SCHEMES: &[Scheme] = &[Scheme::host("tcp", None), Scheme::host("tls", None).encrypted()];

/// A peer whose lines are read, or that takes messages.
#[derive(Debug, Clone)]
pub struct TcpPeer {
    /// Where it listens.
    pub address: Address,
    /// Authority of its certificate (PEM).
    pub ca_certificate: Option<String>,
}

impl TcpPeer {
    pub(super) fn new(address: Address, fields: &mut LoginFields) -> Self {
        Self { address, ca_certificate: fields.ca_certificate.take() }
    }
}
