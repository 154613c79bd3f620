//! Still pictures from the snapshot addresses of cameras.

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use bytes::Bytes;
use http_body_util::{BodyExt as _, Empty, Limited};
use hyper::Request;
use hyper::client::conn::http1;
use hyper::header::{ACCEPT, AUTHORIZATION, HOST, HeaderValue, USER_AGENT};
use hyper_util::rt::TokioIo;
use tokio_util::task::AbortOnDropHandle;

use super::credentials::{Credentials, PeerError};
use super::peer::{OPEN_TIME, connect, within};
use crate::app::App;
use crate::domain::{CameraId, Error, ErrorKind, Picture, PictureFormat, Result, SnapshotSource};
use crate::exchange::{Address, Scheme, Secrets, bracketed};

/// Fetches a picture from the snapshot address of a camera, stores it, and gives it back. Redirects are not followed.
///
/// # Errors
/// As [`App::begin_snapshot`] and [`App::set_picture`]; `SnapshotUnavailable` if the address gives no JPEG or PNG of at
/// most `limits.picture_bytes` within ten seconds.
pub async fn fetch_snapshot(app: &App, id: &CameraId) -> Result<Picture> {
    let source = app.begin_snapshot(id).await?;
    let fetched = within(OPEN_TIME, fetch(&source, app.limits.picture_bytes)).await;
    let picture =
        fetched.map_err(|error| Error::refused(ErrorKind::SnapshotUnavailable, error.to_string()))?;
    app.set_picture(id, Some(&picture)).await?;
    Ok(picture)
}

async fn fetch(source: &SnapshotSource, most_bytes: usize) -> Result<Picture, PeerError> {
    let address = Address::of_http(source.url())?;
    let secrets = Secrets::default();
    let credentials =
        Credentials { username: None, sasl_mechanism: None, ca_certificate: None, secrets: &secrets };
    let stream = connect(&address, address.scheme == Scheme::Https, &credentials).await?;
    let broken = |error: hyper::Error| PeerError(error.to_string());
    let (mut sender, connection) = http1::handshake(TokioIo::new(stream)).await.map_err(broken)?;
    let _connection = AbortOnDropHandle::new(tokio::spawn(async move { drop(connection.await) }));
    let answer = sender.send_request(request(source, &address)?).await.map_err(broken)?;
    let status = answer.status();
    if !status.is_success() {
        return Err(PeerError(format!("the address answered {status}")));
    }
    let body = Limited::new(answer.into_body(), most_bytes).collect().await;
    let too_large = |error| {
        PeerError(format!("the picture cannot be read, or has more than {most_bytes} bytes: {error}"))
    };
    let content = body.map_err(too_large)?.to_bytes();
    let format = PictureFormat::of_file(&content)?;
    Ok(Picture::new(format, content.into())?)
}

fn request(source: &SnapshotSource, address: &Address) -> Result<Request<Empty<Bytes>>, PeerError> {
    let mut request = Request::get(&address.path)
        .header(HOST, format!("{}:{}", bracketed(&address.host), address.port))
        .header(ACCEPT, "image/jpeg, image/png")
        .header(USER_AGENT, concat!("sightfix/", env!("CARGO_PKG_VERSION")));
    if let Some(username) = source.username() {
        let plain = format!("{username}:{}", source.password().unwrap_or_default());
        let basic = HeaderValue::from_str(&format!("Basic {}", STANDARD.encode(plain)));
        let mut basic = basic.map_err(|error| PeerError(error.to_string()))?;
        basic.set_sensitive(true);
        request = request.header(AUTHORIZATION, basic);
    }
    request.body(Empty::new()).map_err(|error| PeerError(error.to_string()))
}
