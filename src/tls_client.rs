//! TLS of clients: whom they trust, and who they say they are.

// Input of other systems and of settings reaches this module: nothing in it may end the process.
#![warn(clippy::expect_used, clippy::panic, clippy::unreachable)]

use std::sync::Arc;

use rustls::crypto::ring::default_provider;
use rustls::pki_types::pem::PemObject as _;
use rustls::pki_types::{CertificateDer, PrivateKeyDer};
use rustls::{ClientConfig, RootCertStore};

/// Why a client cannot be configured.
#[derive(Debug, thiserror::Error)]
pub enum TlsClientError {
    /// A PEM document without a certificate.
    #[error("contains no certificate (PEM)")]
    NoCertificate,
    /// A PEM document without a private key.
    #[error("contains no private key (PEM)")]
    NoKey,
    /// A certificate or key that cannot be used.
    #[error(transparent)]
    Unusable(#[from] rustls::Error),
}

/// A client's own certificate.
pub struct Identity {
    chain: Vec<CertificateDer<'static>>,
    key: PrivateKeyDer<'static>,
}

impl Identity {
    /// From PEM documents.
    ///
    /// # Errors
    /// One of them does not contain what it is to contain.
    pub fn from_pem(certificate: &[u8], key: &[u8]) -> Result<Self, TlsClientError> {
        let key = PrivateKeyDer::from_pem_slice(key).map_err(|_| TlsClientError::NoKey)?;
        Ok(Self { chain: certificates(certificate)?, key })
    }
}

/// The authorities of a PEM document, or those of the operating system, of which there may be none.
///
/// # Errors
/// The document contains no certificate, or one that cannot be used.
pub fn authorities(pem: Option<&[u8]>) -> Result<RootCertStore, TlsClientError> {
    let mut roots = RootCertStore::empty();
    match pem {
        Some(pem) => {
            for certificate in certificates(pem)? {
                roots.add(certificate)?;
            }
        }
        None => {
            roots.add_parsable_certificates(rustls_native_certs::load_native_certs().certs);
        }
    }
    Ok(roots)
}

/// The configuration of a client that trusts these authorities.
///
/// # Errors
/// The identity cannot be used.
pub fn client_config(
    authorities: RootCertStore,
    identity: Option<Identity>,
) -> Result<Arc<ClientConfig>, TlsClientError> {
    let builder = ClientConfig::builder_with_provider(Arc::new(default_provider()))
        .with_safe_default_protocol_versions()?
        .with_root_certificates(authorities);
    let config = match identity {
        Some(Identity { chain, key }) => builder.with_client_auth_cert(chain, key)?,
        None => builder.with_no_client_auth(),
    };
    Ok(Arc::new(config))
}

fn certificates(pem: &[u8]) -> Result<Vec<CertificateDer<'static>>, TlsClientError> {
    let chain: Result<Vec<_>, _> = CertificateDer::pem_slice_iter(pem).collect();
    chain.ok().filter(|chain| !chain.is_empty()).ok_or(TlsClientError::NoCertificate)
}
