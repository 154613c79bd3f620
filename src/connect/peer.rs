//! Streams to the other end of a connection.

use std::sync::Arc;
use std::time::Duration;

use rustls::ClientConfig;
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::net::TcpStream;
use tokio_rustls::TlsConnector;

use super::credentials::{Credentials, PeerError};
use super::tls;
use crate::exchange::Address;

/// Time to open a connection, its handshakes included.
pub(super) const OPEN_TIME: Duration = Duration::from_secs(10);

/// A stream of bytes, plain or encrypted.
pub(super) trait ByteStream: AsyncRead + AsyncWrite + Send + Unpin {}
impl<S: AsyncRead + AsyncWrite + Send + Unpin> ByteStream for S {}

/// Opens a TCP connection, encrypted if the address is.
pub(super) async fn connect(
    address: &Address,
    credentials: &Credentials<'_>,
) -> Result<Box<dyn ByteStream>, PeerError> {
    let tls = address.is_encrypted.then(|| tls::peer_config(credentials)).transpose()?;
    dial(&address.host, address.port, tls).await
}

/// Opens a TCP connection to a port of a host, encrypted if a configuration is given.
pub(super) async fn dial(
    host: &str,
    port: u16,
    tls: Option<Arc<ClientConfig>>,
) -> Result<Box<dyn ByteStream>, PeerError> {
    let open = async {
        let stream = tcp(host, port).await?;
        match tls {
            Some(tls) => encrypt(stream, host, tls).await,
            None => Ok(Box::new(stream) as Box<dyn ByteStream>),
        }
    };
    within(OPEN_TIME, open).await
}

/// Opens a TCP connection to a port of a host.
pub(super) async fn tcp(host: &str, port: u16) -> Result<TcpStream, PeerError> {
    let stream = TcpStream::connect((host, port)).await?;
    stream.set_nodelay(true)?;
    Ok(stream)
}

/// Begins TLS with a host.
pub(super) async fn encrypt(
    stream: TcpStream,
    host: &str,
    tls: Arc<ClientConfig>,
) -> Result<Box<dyn ByteStream>, PeerError> {
    let name = tls::server_name(host)?;
    Ok(Box::new(TlsConnector::from(tls).connect(name, stream).await?))
}

/// The work, or an error when it takes longer.
pub(super) async fn within<T>(
    time: Duration,
    work: impl Future<Output = Result<T, PeerError>>,
) -> Result<T, PeerError> {
    match tokio::time::timeout(time, work).await {
        Ok(done) => done,
        Err(_) => Err(PeerError(format!("the peer did not answer within {} s", time.as_secs()))),
    }
}
