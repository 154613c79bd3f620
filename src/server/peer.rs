//! Who is at the other end of a connection.

use std::net::IpAddr;
use std::sync::Arc;

use crate::app::access::CertificateHolder;
use crate::domain::Error;

/// The connection that a request came over.
#[derive(Clone)]
pub(super) struct Peer {
    /// As the audit log names it; limits count it while it presents no key.
    pub(super) address: IpAddr,
    /// Whose certificate was verified, if one was presented.
    pub(super) certificate: Option<CertificateHolder>,
    /// True if the connection is TLS.
    pub(super) is_tls: bool,
    /// Why only probes are answered on it, if so.
    pub(super) refusal: Option<Arc<Error>>,
}
