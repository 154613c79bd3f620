//! TLS on the shared port: both protocols, client certificates, certificates that change.

use std::net::SocketAddr;
use std::os::unix::fs::PermissionsExt as _;
use std::path::PathBuf;
use std::process::{Command, Stdio};
use std::sync::Arc;
use std::time::Duration;

use http_body_util::{BodyExt as _, Full};
use hyper::body::Bytes;
use hyper::header::HeaderValue;
use hyper::{Request, StatusCode};
use hyper_util::rt::{TokioExecutor, TokioIo};
use rcgen::{BasicConstraints, Certificate, CertificateParams, DnType, IsCa, Issuer, KeyPair};
use rustls::pki_types::pem::PemObject as _;
use rustls::pki_types::{CertificateDer, PrivateKeyDer, ServerName};
use rustls::{ClientConfig, RootCertStore};
use tempfile::TempDir;
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::TcpStream;
use tokio_rustls::TlsConnector;
use tokio_rustls::client::TlsStream;

use crate::harness::{TestServer, data_folder, run, sightfix};

/// An authority for certificates of servers and clients.
pub(crate) struct Authority {
    pub(crate) certificate: Certificate,
    issuer: Issuer<'static, KeyPair>,
}

impl Authority {
    pub(crate) fn new() -> Self {
        let mut params = CertificateParams::new(Vec::new()).expect("no names");
        params.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
        let key = KeyPair::generate().expect("a key");
        let certificate = params.self_signed(&key).expect("a certificate");
        Self { certificate, issuer: Issuer::new(params, key) }
    }

    /// A certificate for `localhost`, and its key.
    pub(crate) fn issue(&self) -> (Certificate, KeyPair) {
        let key = KeyPair::generate().expect("a key");
        let mut params = CertificateParams::new(vec!["localhost".to_owned()]).expect("a name");
        // OpenSSL takes a certificate whose subject is its issuer for one that signed itself.
        params.distinguished_name.push(DnType::CommonName, "localhost");
        (params.signed_by(&key, &self.issuer).expect("a certificate"), key)
    }
}

/// The files of a server's certificate.
struct Files {
    _folder: TempDir,
    certificate: PathBuf,
    key: PathBuf,
    client_ca: PathBuf,
}

impl Files {
    fn new(authority: &Authority) -> Self {
        let folder = data_folder();
        let path = |name: &str| folder.path().join(name);
        let (certificate, key, client_ca) = (path("cert.pem"), path("key.pem"), path("ca.pem"));
        std::fs::write(&client_ca, authority.certificate.pem()).expect("a file");
        let files = Self { _folder: folder, certificate, key, client_ca };
        files.replace(authority);
        files
    }

    fn replace(&self, authority: &Authority) {
        let (certificate, key) = authority.issue();
        std::fs::write(&self.key, key.serialize_pem()).expect("a file");
        std::fs::write(&self.certificate, certificate.pem()).expect("a file");
    }

    fn serve(&self, data: &TempDir) -> Command {
        let mut command = sightfix();
        command.args(["serve", "--listen", "127.0.0.1:0", "--data"]).arg(data.path());
        command.arg("--tls-cert").arg(&self.certificate).arg("--tls-key").arg(&self.key);
        command.stdout(Stdio::null());
        command
    }
}

/// A connection that trusts the authority, offers the protocols, and presents a certificate if there is one.
async fn connect(
    address: SocketAddr,
    authority: &Authority,
    protocols: &[&str],
    own: Option<(Certificate, KeyPair)>,
) -> std::io::Result<TlsStream<TcpStream>> {
    connect_with_root(address, authority.certificate.der().clone(), protocols, own).await
}

async fn connect_with_root(
    address: SocketAddr,
    root: CertificateDer<'static>,
    protocols: &[&str],
    own: Option<(Certificate, KeyPair)>,
) -> std::io::Result<TlsStream<TcpStream>> {
    let mut roots = RootCertStore::empty();
    roots.add(root).expect("an authority");
    let provider = Arc::new(rustls::crypto::ring::default_provider());
    let builder = ClientConfig::builder_with_provider(provider)
        .with_safe_default_protocol_versions()
        .expect("versions")
        .with_root_certificates(roots);
    let mut config = match own {
        None => builder.with_no_client_auth(),
        Some((certificate, key)) => {
            let chain: Vec<CertificateDer<'static>> = vec![certificate.der().clone()];
            let key = PrivateKeyDer::try_from(key.serialize_der()).expect("a key");
            builder.with_client_auth_cert(chain, key).expect("a certificate of its own")
        }
    };
    config.alpn_protocols = protocols.iter().map(|name| name.as_bytes().to_vec()).collect();
    let stream = TcpStream::connect(address).await.expect("the server listens");
    let name = ServerName::try_from("localhost").expect("a name");
    TlsConnector::from(Arc::new(config)).connect(name, stream).await
}

/// Asks for a path over HTTP/1.1 or, where it was agreed, HTTP/2.
async fn get(stream: TlsStream<TcpStream>, path: &str, key: Option<&str>) -> (StatusCode, String) {
    let mut request = Request::get(format!("https://localhost{path}"));
    if let Some(key) = key {
        request = request.header("authorization", format!("Bearer {key}"));
    }
    answer(stream, request.body(Full::default()).expect("a request")).await
}

async fn answer(stream: TlsStream<TcpStream>, mut request: Request<Full<Bytes>>) -> (StatusCode, String) {
    let is_h2 = stream.get_ref().1.alpn_protocol() == Some(b"h2");
    request.headers_mut().insert("host", HeaderValue::from_static("localhost"));
    let stream = TokioIo::new(stream);
    let answer = if is_h2 {
        let (mut sender, connection) =
            hyper::client::conn::http2::handshake(TokioExecutor::new(), stream).await.expect("HTTP/2");
        tokio::spawn(connection);
        sender.send_request(request).await
    } else {
        let (mut sender, connection) = hyper::client::conn::http1::handshake(stream).await.expect("HTTP/1.1");
        tokio::spawn(connection);
        sender.send_request(request).await
    };
    let (head, body) = answer.expect("an answer").into_parts();
    let body = body.collect().await.expect("a whole body").to_bytes();
    (head.status, String::from_utf8_lossy(&body).into_owned())
}

#[tokio::test]
async fn both_protocols_are_served_over_tls_and_plain_http_on_this_machine() {
    let (authority, data) = (Authority::new(), data_folder());
    let files = Files::new(&authority);
    let server = TestServer::run(files.serve(&data));
    for (offered, agreed) in
        [(&["h2", "http/1.1"][..], Some(&b"h2"[..])), (&["http/1.1"], Some(b"http/1.1")), (&[], None)]
    {
        let stream = connect(server.address, &authority, offered, None).await.expect("a handshake");
        assert_eq!(stream.get_ref().1.alpn_protocol(), agreed, "{offered:?}");
        assert_eq!(get(stream, "/livez", None).await, (StatusCode::OK, "alive\n".to_owned()), "{offered:?}");
    }
    server.get("/v1/cameras").await.expect(200);
    run(&["health", "--listen", &server.address.to_string()]);
    let foreign = connect(server.address, &Authority::new(), &["h2"], None).await;
    assert!(foreign.is_err(), "the client checks the certificate");
}

#[tokio::test]
async fn a_phone_that_trusts_the_made_authority_reaches_the_server() {
    let (data, folder) = (data_folder(), data_folder());
    let path = |name: &str| folder.path().join(name);
    let made = |days: &str| {
        let mut command = sightfix();
        command.args([
            "tls",
            "self-signed",
            "--host",
            "192.0.2.7",
            "--host",
            "localhost",
            "--days",
            days,
            "--out",
        ]);
        command.arg(folder.path()).output().expect("it runs")
    };
    assert_eq!(made("826").status.code(), Some(2), "phones refuse it");
    let output = made("825");
    let lines = String::from_utf8_lossy(&output.stdout);
    assert!(output.status.success() && lines.contains("sightfix serve --listen 0.0.0.0:8443"), "{lines}");
    let notes = String::from_utf8_lossy(&output.stderr);
    assert!(notes.contains("https://192.0.2.7:8443/walk"), "{notes}");
    assert!(!made("825").status.success(), "files that exist stay");
    let mode = path("key.pem").metadata().expect("a file").permissions().mode();
    assert_eq!(mode & 0o077, 0, "others cannot read the key");

    let authority = std::fs::read_to_string(path("authority.pem")).expect("a file");
    let root = CertificateDer::from_pem_slice(authority.as_bytes()).expect("a certificate");
    let mut command = sightfix();
    command.args(["serve", "--listen", "127.0.0.1:0", "--data"]).arg(data.path()).stdout(Stdio::null());
    command.arg("--tls-cert").arg(path("certificate.pem")).arg("--tls-key").arg(path("key.pem"));
    command.env("SIGHTFIX_CONSOLE__AUTHORITY", path("authority.pem"));
    let server = TestServer::run(command);
    let stream = connect_with_root(server.address, root, &["http/1.1"], None).await.expect("a handshake");
    assert_eq!(get(stream, "/authority.crt", None).await, (StatusCode::OK, authority));
}

#[tokio::test]
async fn a_server_without_an_authority_says_how_to_make_one() {
    let data = data_folder();
    let answer = TestServer::start(data.path()).get("/authority.crt").await.expect(404);
    assert!(answer.text().contains("sightfix tls self-signed"), "{}", answer.text());
}

#[tokio::test]
async fn a_handshake_that_does_not_go_on_is_ended() {
    let (authority, data) = (Authority::new(), data_folder());
    let files = Files::new(&authority);
    let mut command = files.serve(&data);
    command.env("SIGHTFIX_LIMITS__HEADER_S", "1");
    let server = TestServer::run(command);
    for begin in [&b""[..], &[0x16], &[0x16, 3, 1, 2, 0, 1, 0]] {
        let mut stream = TcpStream::connect(server.address).await.expect("the server listens");
        stream.write_all(begin).await.expect("sent");
        let mut rest = Vec::new();
        // A server that waits on would make the test wait without end; nextest and CI limit that.
        let ended = tokio::time::timeout(Duration::from_secs(30), stream.read_to_end(&mut rest)).await;
        assert!(ended.is_ok(), "{begin:?}: the connection stays open");
    }
    server.get("/livez").await.expect(200);
}

#[tokio::test]
async fn client_certificates_have_the_role_of_their_authority() {
    let (authority, data) = (Authority::new(), data_folder());
    let files = Files::new(&authority);
    let admin = run(&[
        "keys",
        "create",
        "--name",
        "a",
        "--role",
        "admin",
        "--data",
        data.path().to_str().expect("UTF-8"),
    ]);
    let mut command = files.serve(&data);
    command.arg("--tls-client-ca").arg(&files.client_ca).env("SIGHTFIX_TLS__CLIENT_ROLE", "operator");
    let server = TestServer::run(command);
    let open = |own| connect(server.address, &authority, &["h2"], own);
    let (status, text) = get(open(Some(authority.issue())).await.expect("open"), "/v1/session", None).await;
    assert_eq!(status, StatusCode::OK, "{text}");
    assert!(text.contains("\"operator\""), "{text}");
    let stream = open(Some(authority.issue())).await.expect("open");
    assert_eq!(get(stream, "/v1/keys", None).await.0, StatusCode::FORBIDDEN);
    let stream = open(None).await.expect("a key will do");
    assert_eq!(get(stream, "/v1/cameras", None).await.0, StatusCode::UNAUTHORIZED);
    let stream = open(None).await.expect("a key will do");
    assert_eq!(get(stream, "/v1/keys", Some(admin.trim())).await.0, StatusCode::OK);
    // One of another authority is refused in the handshake, which TLS 1.3 tells with the first answer.
    let foreign = open(Some(Authority::new().issue())).await;
    let is_refused = match foreign {
        Err(_) => true,
        Ok(mut stream) => stream.read(&mut [0; 64]).await.map_or(true, |bytes| bytes == 0),
    };
    assert!(is_refused, "a certificate of somebody else");
}

#[tokio::test]
async fn holders_of_certificates_have_idempotency_keys_of_their_own() {
    let (authority, data) = (Authority::new(), data_folder());
    let files = Files::new(&authority);
    let mut command = files.serve(&data);
    command.arg("--tls-client-ca").arg(&files.client_ca).env("SIGHTFIX_TLS__CLIENT_ROLE", "operator");
    let server = TestServer::run(command);
    let [ada, bob] = [(); 2].map(|()| {
        let (certificate, key) = authority.issue();
        move || (certificate.clone(), KeyPair::from_pem(&key.serialize_pem()).expect("its own"))
    });
    let post = async |own: (Certificate, KeyPair), path: &str, media_type: &str, body: String| {
        let stream = connect(server.address, &authority, &["h2"], Some(own)).await.expect("open");
        let request = Request::post(format!("https://localhost{path}"))
            .header("content-type", media_type)
            .header("idempotency-key", "import-1");
        answer(stream, request.body(body.into()).expect("a request")).await
    };
    let (status, text) = post(ada(), "/v1/cameras", "application/json", r#"{"id":"c"}"#.to_owned()).await;
    assert_eq!(status, StatusCode::CREATED, "{text}");
    let row = |second: u32| {
        format!(
            "time,target_id,left,top,width,height,longitude,latitude\n\
             2020-12-14T06:41:0{second}Z,a,10,11,28,77,103.98678,30.6280135\n"
        )
    };
    for (own, second, expected) in [
        (ada(), 1, StatusCode::OK),
        (bob(), 2, StatusCode::OK),
        (ada(), 1, StatusCode::OK),
        (bob(), 1, StatusCode::UNPROCESSABLE_ENTITY),
    ] {
        let (status, text) = post(own, "/v1/cameras/c/samples", "text/csv", row(second)).await;
        assert_eq!(status, expected, "{text}");
        assert!(!status.is_success() || text.contains("\"accepted\":1"), "{text}");
    }
}

/// True if the server presents a certificate of the authority.
async fn trusts(address: SocketAddr, authority: &Authority) -> bool {
    connect(address, authority, &["h2"], None).await.is_ok()
}

#[tokio::test]
async fn a_changed_certificate_is_loaded_and_a_broken_one_is_not() {
    let (first, second, data) = (Authority::new(), Authority::new(), data_folder());
    let files = Files::new(&first);
    let server = TestServer::run(files.serve(&data));
    let trusts = |authority| trusts(server.address, authority);
    assert!(trusts(&first).await);
    files.replace(&second);
    while !trusts(&second).await {
        tokio::time::sleep(Duration::from_millis(100)).await;
    }
    std::fs::write(&files.certificate, "no certificate").expect("a file");
    server.signal("-HUP");
    server
        .logged(|entry| entry["message"].as_str().is_some_and(|text| text.contains("cannot be used")))
        .await;
    assert!(trusts(&second).await, "the previous one stays");
    files.replace(&first);
    while !trusts(&first).await {
        tokio::time::sleep(Duration::from_millis(100)).await;
    }
}

#[test]
fn files_that_cannot_be_used_are_named() {
    let (authority, data) = (Authority::new(), data_folder());
    let files = Files::new(&authority);
    std::fs::write(&files.key, "no key").expect("a file");
    let refused = files.serve(&data).output().expect("the binary runs");
    let reported = String::from_utf8_lossy(&refused.stderr).into_owned();
    assert!(!refused.status.success() && reported.contains("key.pem"), "{reported}");
    let mut command = files.serve(&data);
    let refused = command.env("SIGHTFIX_TLS__CLIENT_ROLE", "edge").output().expect("the binary runs");
    let reported = String::from_utf8_lossy(&refused.stderr).into_owned();
    assert!(reported.contains("client_camera_ids"), "{reported}");
}
