//! TLS on the shared port: HTTP/2 and HTTP/1.1 by ALPN, certificates replaced while connections are open.

use std::fmt::Write as _;
use std::fs::Metadata;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::SystemTime;

use anyhow::Context as _;
use arc_swap::ArcSwap;
use rustls::crypto::ring::default_provider;
use rustls::pki_types::pem::PemObject as _;
use rustls::pki_types::{CertificateDer, PrivateKeyDer};
use rustls::server::WebPkiClientVerifier;
use rustls::{RootCertStore, ServerConfig};
use sha2::{Digest as _, Sha256};
use tokio::net::TcpStream;
use tokio_rustls::TlsAcceptor;
use tokio_rustls::server::TlsStream;

use crate::app::access::CertificateHolder;
use crate::config::TlsSettings;
use crate::domain::Scope;

/// First byte of every TLS connection: a handshake record.
pub(super) const HANDSHAKE_RECORD: u8 = 0x16;
/// In the order of preference; gRPC clients insist on the first.
const PROTOCOLS: [&[u8]; 2] = [b"h2", b"http/1.1"];
/// Bytes of a certificate's digest that name its holder.
const FINGERPRINT_BYTES: usize = 8;

/// The server's certificate, and the files that it is loaded from again when they change.
pub(super) struct Tls {
    files: TlsFiles,
    /// The scope of certificates of the client authority, if there is one.
    client_scope: Option<Arc<Scope>>,
    config: ArcSwap<ServerConfig>,
    loaded: Mutex<Vec<FileVersion>>,
}

struct TlsFiles {
    certificate: PathBuf,
    key: PathBuf,
    client_ca: Option<PathBuf>,
}

/// Tells whether a file was written since; `None` for one that cannot be read.
type FileVersion = Option<(SystemTime, u64)>;

impl Tls {
    /// From the settings; `None` where they ask for plain HTTP.
    ///
    /// # Errors
    /// Names the file that cannot be used, or the setting that is missing.
    pub(super) fn load(settings: &TlsSettings) -> anyhow::Result<Option<Arc<Self>>> {
        let Some((certificate, key)) = settings.certificate_and_key()? else { return Ok(None) };
        let (certificate, key) = (certificate.to_owned(), key.to_owned());
        let files = TlsFiles { certificate, key, client_ca: settings.client_ca.clone() };
        let client_scope = match &files.client_ca {
            Some(_) => Some(Arc::new(settings.client_scope()?)),
            None => None,
        };
        let loaded = Mutex::new(files.versions());
        let config = ArcSwap::new(files.load()?);
        Ok(Some(Arc::new(Self { files, client_scope, config, loaded })))
    }

    /// True if clients may present certificates.
    pub(super) const fn takes_client_certificates(&self) -> bool {
        self.client_scope.is_some()
    }

    /// Loads the files again if one has changed, or in any case if asked to. Connections that are open keep
    /// their certificate. Where the files cannot be used, the certificate stays as it is; that is logged once.
    pub(super) fn reload(&self, in_any_case: bool) {
        let versions = self.files.versions();
        let mut loaded = self.loaded.lock().unwrap_or_else(PoisonError::into_inner);
        if !in_any_case && *loaded == versions {
            return;
        }
        *loaded = versions;
        match self.files.load() {
            Ok(config) => {
                self.config.store(config);
                tracing::info!(certificate = %self.files.certificate.display(), "loaded the certificate again");
            }
            Err(error) => tracing::error!(
                error = format!("{error:#}"),
                "the changed certificate cannot be used; the previous one stays in use"
            ),
        }
    }

    /// The handshake, and whose certificate the client has presented.
    ///
    /// # Errors
    /// The client's offer cannot be used, or the connection breaks.
    pub(super) async fn accept(
        &self,
        stream: TcpStream,
    ) -> std::io::Result<(TlsStream<TcpStream>, Option<CertificateHolder>)> {
        let stream = TlsAcceptor::from(self.config.load_full()).accept(stream).await?;
        let certificate = stream.get_ref().1.peer_certificates().and_then(<[_]>::first);
        let holder = certificate.zip(self.client_scope.as_ref()).map(|(certificate, scope)| {
            CertificateHolder { fingerprint: fingerprint(certificate), scope: scope.clone() }
        });
        Ok((stream, holder))
    }
}

fn fingerprint(certificate: &CertificateDer<'_>) -> Arc<str> {
    let digest = Sha256::digest(certificate);
    let text = digest.iter().take(FINGERPRINT_BYTES).fold(String::new(), |mut text, byte| {
        let _ = write!(text, "{byte:02x}");
        text
    });
    text.into()
}

impl TlsFiles {
    fn versions(&self) -> Vec<FileVersion> {
        let version = |metadata: Metadata| Some((metadata.modified().ok()?, metadata.len()));
        let paths = [&self.certificate, &self.key].into_iter().chain(&self.client_ca);
        paths.map(|path| std::fs::metadata(path).ok().and_then(version)).collect()
    }

    fn load(&self) -> anyhow::Result<Arc<ServerConfig>> {
        let chain = certificates(&self.certificate)?;
        let key = PrivateKeyDer::from_pem_file(&self.key)
            .with_context(|| format!("{} contains no private key (PEM)", self.key.display()))?;
        let provider = Arc::new(default_provider());
        let builder = ServerConfig::builder_with_provider(provider.clone())
            .with_safe_default_protocol_versions()
            .context("the cryptography has no protocol version")?;
        let builder = match &self.client_ca {
            None => builder.with_no_client_auth(),
            Some(path) => builder.with_client_cert_verifier(
                WebPkiClientVerifier::builder_with_provider(client_roots(path)?, provider)
                    // Other clients present a key.
                    .allow_unauthenticated()
                    .build()
                    .with_context(|| format!("{} cannot be used", path.display()))?,
            ),
        };
        let mut config = builder.with_single_cert(chain, key).with_context(|| {
            format!("{} and {} cannot be used together", self.certificate.display(), self.key.display())
        })?;
        config.alpn_protocols = PROTOCOLS.map(<[u8]>::to_vec).to_vec();
        Ok(Arc::new(config))
    }
}

fn certificates(path: &Path) -> anyhow::Result<Vec<CertificateDer<'static>>> {
    let chain = CertificateDer::pem_file_iter(path)
        .and_then(Iterator::collect::<Result<Vec<_>, _>>)
        .with_context(|| format!("cannot read certificates from {}", path.display()))?;
    anyhow::ensure!(!chain.is_empty(), "{} contains no certificate (PEM)", path.display());
    Ok(chain)
}

fn client_roots(path: &Path) -> anyhow::Result<Arc<RootCertStore>> {
    let mut roots = RootCertStore::empty();
    for certificate in certificates(path)? {
        roots.add(certificate).with_context(|| format!("{} is no authority", path.display()))?;
    }
    Ok(Arc::new(roots))
}
