//! TLS towards peers.

use std::sync::Arc;

use rustls::crypto::ring::default_provider;
use rustls::pki_types::pem::PemObject as _;
use rustls::pki_types::{CertificateDer, PrivateKeyDer, ServerName};
use rustls::{ClientConfig, RootCertStore};

use super::peer::{Credentials, PeerError};

/// The configuration of a client that trusts the given authority, or those of the operating system, and presents the
/// connection's certificate if it has one.
pub(super) fn client_config(credentials: &Credentials<'_>) -> Result<Arc<ClientConfig>, PeerError> {
    let builder = ClientConfig::builder_with_provider(Arc::new(default_provider()))
        .with_safe_default_protocol_versions()
        .map_err(|error| PeerError(error.to_string()))?
        .with_root_certificates(roots(credentials.ca_certificate)?);
    let (certificate, key) =
        (credentials.secrets.get("client_certificate"), credentials.secrets.get("client_key"));
    let (Some(certificate), Some(key)) = (certificate, key) else {
        return Ok(Arc::new(builder.with_no_client_auth()));
    };
    let chain = certificates("the secret client_certificate", certificate)?;
    let key = PrivateKeyDer::from_pem_slice(key.as_bytes())
        .map_err(|_| PeerError::from("the secret client_key is no private key (PEM)"))?;
    let config = builder.with_client_auth_cert(chain, key);
    config.map(Arc::new).map_err(|error| PeerError(format!("the client certificate cannot be used: {error}")))
}

/// The name that the peer's certificate must have.
pub(super) fn server_name(host: &str) -> Result<ServerName<'static>, PeerError> {
    ServerName::try_from(host.to_owned()).map_err(|_| PeerError(format!("{host} is no name for TLS")))
}

fn roots(authority: Option<&str>) -> Result<RootCertStore, PeerError> {
    let mut roots = RootCertStore::empty();
    if let Some(authority) = authority {
        for certificate in certificates("ca_certificate", authority)? {
            roots.add(certificate).map_err(|error| PeerError(format!("ca_certificate: {error}")))?;
        }
        return Ok(roots);
    }
    roots.add_parsable_certificates(rustls_native_certs::load_native_certs().certs);
    if roots.is_empty() {
        return Err("the system has no authorities of certificates; give ca_certificate".into());
    }
    Ok(roots)
}

fn certificates(name: &str, pem: &str) -> Result<Vec<CertificateDer<'static>>, PeerError> {
    let chain: Result<Vec<_>, _> = CertificateDer::pem_slice_iter(pem.as_bytes()).collect();
    chain
        .ok()
        .filter(|chain| !chain.is_empty())
        .ok_or_else(|| PeerError(format!("{name} contains no certificate (PEM)")))
}
