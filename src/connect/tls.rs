//! TLS towards peers.

use std::sync::Arc;

use rustls::ClientConfig;
use rustls::pki_types::ServerName;

use super::credentials::{Credentials, PeerError};
use crate::tls_client::{Identity, TlsClientError, authorities, client_config};

/// The configuration of a client that trusts the given authority, or those of the operating system, and presents the
/// connection's certificate if it has one.
pub(super) fn peer_config(credentials: &Credentials<'_>) -> Result<Arc<ClientConfig>, PeerError> {
    let trusted = authorities(credentials.ca_certificate.map(str::as_bytes));
    let trusted = trusted.map_err(|error| PeerError(format!("ca_certificate: {error}")))?;
    if trusted.is_empty() {
        return Err("the system has no authorities of certificates; give ca_certificate".into());
    }
    let (certificate, key) =
        (credentials.secrets.get("client_certificate"), credentials.secrets.get("client_key"));
    let unusable = |error: TlsClientError| PeerError(format!("client_certificate and client_key: {error}"));
    let identity = certificate
        .zip(key)
        .map(|(certificate, key)| Identity::from_pem(certificate.as_bytes(), key.as_bytes()))
        .transpose()
        .map_err(unusable)?;
    client_config(trusted, identity).map_err(unusable)
}

/// The name that the peer's certificate must have.
pub(super) fn server_name(host: &str) -> Result<ServerName<'static>, PeerError> {
    ServerName::try_from(host.to_owned()).map_err(|_| PeerError(format!("{host} is no name for TLS")))
}
