//! Costs of keys, limits and TLS: fusions with them, against the same server without, and against a bare server over
//! rustls.

use std::net::SocketAddr;
use std::sync::Arc;

use bytes::Bytes;
use http_body_util::{BodyExt as _, Full};
use hyper::body::Incoming;
use hyper::service::service_fn;
use hyper::{Request, Response};
use hyper_util::rt::TokioIo;
use rcgen::{CertificateParams, KeyPair};
use rustls::pki_types::{PrivateKeyDer, ServerName};
use rustls::{ClientConfig, RootCertStore, ServerConfig};
use sightfix::config::Config;
use sightfix::domain::{NewKey, Role, Scope};
use tokio::net::{TcpListener, TcpStream};
use tokio_rustls::{TlsAcceptor, TlsConnector};

use crate::load;
use crate::ratio::{self, in_turn};
use crate::served::{Served, runtime};
use crate::transports::request_body;

/// Requests of each connection in a round.
const EACH: usize = 1_000;

pub(crate) fn run() {
    with_keys_and_limits();
    over_tls();
}

fn with_keys_and_limits() {
    let runtime = runtime();
    let open = runtime.block_on(Served::start());
    let guarded = runtime.block_on(Served::start_configured(1, |config: &mut Config| {
        // Counted, and never reached.
        config.limits.requests_per_s = 100_000_000;
    }));
    let secret = runtime.block_on(async {
        let scope = Scope::new(Role::Edge, vec![guarded.camera.clone()]).expect("one camera");
        let key = NewKey::new("bench", scope, None, guarded.app.clock.now()).expect("a name");
        guarded.app.keys().create(&key).await.expect("a new key").1
    });
    let body = request_body(&open.observations[..1]);
    let path = format!("/v1/cameras/{}/fusions", open.camera);
    let plain = load::post(&path, "application/json", &body);
    let signed = load::post_as(secret.reveal(), &path, "application/json", &body);
    ratio::head("REST with keys, a rate limit and the audit log, compared with an open server", "requests/s");
    let rate = |address, request: &[u8]| runtime.block_on(load::send(address, request, EACH)).0;
    let ratio = in_turn(|| rate(guarded.address, &signed), || rate(open.address, &plain));
    ratio::row("1 observation per request", &ratio);
    guarded.end();
    open.end();
}

/// A certificate for `localhost` with its key, in files of the server's form, and a client that trusts it.
fn certificate(folder: &std::path::Path) -> (Arc<ServerConfig>, TlsConnector) {
    let key = KeyPair::generate().expect("a key");
    let params = CertificateParams::new(vec!["localhost".to_owned()]).expect("a name");
    let certificate = params.self_signed(&key).expect("a certificate");
    std::fs::write(folder.join("cert.pem"), certificate.pem()).expect("a file");
    std::fs::write(folder.join("key.pem"), key.serialize_pem()).expect("a file");
    let provider = Arc::new(rustls::crypto::ring::default_provider());
    let private = PrivateKeyDer::try_from(key.serialize_der()).expect("a key");
    let server = ServerConfig::builder_with_provider(provider.clone())
        .with_safe_default_protocol_versions()
        .expect("protocol versions")
        .with_no_client_auth()
        .with_single_cert(vec![certificate.der().clone()], private)
        .expect("a certificate with its key");
    let mut roots = RootCertStore::empty();
    roots.add(certificate.der().clone()).expect("a certificate");
    let client = ClientConfig::builder_with_provider(provider)
        .with_safe_default_protocol_versions()
        .expect("protocol versions")
        .with_root_certificates(roots)
        .with_no_client_auth();
    (Arc::new(server), Arc::new(client).into())
}

/// A server over rustls that reads a request and writes a given answer.
async fn bare_rustls(config: Arc<ServerConfig>, answer: Bytes) -> SocketAddr {
    let listener = TcpListener::bind("127.0.0.1:0").await.expect("a free port");
    let address = listener.local_addr().expect("an address");
    let acceptor = TlsAcceptor::from(config);
    tokio::spawn(async move {
        loop {
            let Ok((stream, _)) = listener.accept().await else { continue };
            let (acceptor, answer) = (acceptor.clone(), answer.clone());
            tokio::spawn(async move {
                let _ = stream.set_nodelay(true);
                let Ok(stream) = acceptor.accept(stream).await else { return };
                let service = service_fn(move |request: Request<Incoming>| {
                    let answer = answer.clone();
                    async move {
                        let body = request.into_body().collect().await?.to_bytes();
                        let parsed: serde_json::Value =
                            serde_json::from_slice(&body).expect("the bench's own request");
                        assert!(parsed.is_object(), "something is asked");
                        Ok::<_, hyper::Error>(Response::new(Full::<Bytes>::from(answer)))
                    }
                });
                let connection = hyper::server::conn::http1::Builder::new();
                let _ = connection.serve_connection(TokioIo::new(stream), service).await;
            });
        }
    });
    address
}

fn over_tls() {
    let runtime = runtime();
    let folder = tempfile::tempdir().expect("a folder");
    let (server_config, connector) = certificate(folder.path());
    let tls = runtime.block_on(Served::start_configured(1, |config: &mut Config| {
        config.tls.certificate = Some(folder.path().join("cert.pem"));
        config.tls.key = Some(folder.path().join("key.pem"));
    }));
    let body = request_body(&tls.observations[..1]);
    let request = load::post(&format!("/v1/cameras/{}/fusions", tls.camera), "application/json", &body);
    // Plain HTTP is served to this machine.
    let answer = Bytes::from(runtime.block_on(load::one(tls.address, &request)));
    let bare = runtime.block_on(bare_rustls(server_config, answer));
    let connect = |address: SocketAddr| {
        let connector = connector.clone();
        move || {
            let connector = connector.clone();
            async move {
                let stream = TcpStream::connect(address).await.expect("the server listens");
                stream.set_nodelay(true).expect("a TCP stream");
                let name = ServerName::try_from("localhost").expect("a name");
                connector.connect(name, stream).await.expect("a handshake")
            }
        }
    };
    let rate = |address| runtime.block_on(load::send_over(connect(address), &request, EACH)).0;
    ratio::head("REST over TLS, compared with a bare server over rustls and with plain HTTP", "requests/s");
    ratio::row("bare rustls", &in_turn(|| rate(tls.address), || rate(bare)));
    let plain = || runtime.block_on(load::send(tls.address, &request, EACH)).0;
    ratio::row("the same server, plain", &in_turn(|| rate(tls.address), plain));
    tls.end();
}
