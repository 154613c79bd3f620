//! Still pictures from the snapshot addresses of cameras.

use bytes::Bytes;
use http_body_util::{BodyExt as _, Full, Limited};
use hyper::body::Incoming;
use hyper::client::conn::http1;
use hyper::header::{ACCEPT, AUTHORIZATION, CONTENT_TYPE, HOST, HeaderValue, USER_AGENT, WWW_AUTHENTICATE};
use hyper::{Method, Request, Response, StatusCode};
use hyper_util::rt::TokioIo;
use tokio_util::task::AbortOnDropHandle;

use super::credentials::{Credentials, PeerError};
use super::peer::{OPEN_TIME, connect, within};
use super::sign_in::SignIn;
use crate::app::App;
use crate::domain::{CameraId, Error, ErrorKind, Picture, PictureFormat, Result, SnapshotSource};
use crate::exchange::{Address, OnvifRequest, SOAP, Secrets, bracketed};

/// Largest document of an ONVIF device, bytes.
const DOCUMENT_BYTES: usize = 1024 * 1024;

/// Fetches a picture from the snapshot address of a camera, stores it, and gives it back. Redirects are not followed.
///
/// # Errors
/// As [`begin_snapshot`](crate::app::Pictures::begin_snapshot) and [`set`](crate::app::Pictures::set) of pictures; `SnapshotUnavailable` if the address gives no JPEG or PNG of at
/// most `limits.picture_bytes` within ten seconds.
pub async fn fetch_snapshot(app: &App, id: &CameraId) -> Result<Picture> {
    let source = app.pictures().begin_snapshot(id).await?;
    let fetched = within(OPEN_TIME, fetch(&source, app.limits.picture_bytes)).await;
    let picture =
        fetched.map_err(|error| Error::refused(ErrorKind::SnapshotUnavailable, error.to_string()))?;
    app.pictures().set(id, Some(&picture)).await?;
    Ok(picture)
}

async fn fetch(source: &SnapshotSource, most_bytes: usize) -> Result<Picture, PeerError> {
    let sign_in = SignIn::new(source.username(), source.password());
    let mut camera = Camera { address: Address::of_http(&source.http_url())?, sign_in };
    if source.is_onvif() {
        camera.find_snapshot().await?;
    }
    let content = camera.ask(Method::GET, String::new(), most_bytes).await?;
    let format = PictureFormat::of_file(&content)?;
    Ok(Picture::new(format, content.into())?)
}

/// The peer of a snapshot address.
struct Camera {
    /// Where it is asked next.
    address: Address,
    sign_in: SignIn,
}

impl Camera {
    /// Asks the ONVIF device service at the address for that of the still picture.
    async fn find_snapshot(&mut self) -> Result<(), PeerError> {
        self.address.path = self.ask_device(&OnvifRequest::MediaService).await?;
        let profile = self.ask_device(&OnvifRequest::Profile).await?;
        self.address.path = self.ask_device(&OnvifRequest::SnapshotUri(profile)).await?;
        Ok(())
    }

    async fn ask_device(&mut self, request: &OnvifRequest) -> Result<String, PeerError> {
        let answer = self.ask(Method::POST, request.document(), DOCUMENT_BYTES).await?;
        request.answer(&String::from_utf8_lossy(&answer)).map_err(PeerError)
    }

    /// Sends a request and reads the body of its answer, signed in where the camera asks for it.
    async fn ask(&mut self, method: Method, body: String, most_bytes: usize) -> Result<Bytes, PeerError> {
        for is_second in [false, true] {
            let request = self.request(&method, body.clone())?;
            let (answer, _connection) = self.send(request).await?;
            match answer.status() {
                status if status.is_success() => return read(answer.into_body(), most_bytes).await,
                StatusCode::UNAUTHORIZED if !is_second => self.take_challenge(&answer)?,
                StatusCode::UNAUTHORIZED => break,
                status => return Err(PeerError(format!("the address answered {status}"))),
            }
        }
        Err("the address refuses the username or the password".into())
    }

    /// Sends a request by a connection of its own, which lasts as long as the second value.
    async fn send(
        &self,
        request: Request<Full<Bytes>>,
    ) -> Result<(Response<Incoming>, AbortOnDropHandle<()>), PeerError> {
        let secrets = Secrets::default();
        let stream = connect(&self.address, &Credentials::trusting(None, &secrets)).await?;
        let broken = |error: hyper::Error| PeerError(error.to_string());
        let (mut sender, connection) = http1::handshake(TokioIo::new(stream)).await.map_err(broken)?;
        let connection = AbortOnDropHandle::new(tokio::spawn(async move { drop(connection.await) }));
        Ok((sender.send_request(request).await.map_err(broken)?, connection))
    }

    fn request(&mut self, method: &Method, body: String) -> Result<Request<Full<Bytes>>, PeerError> {
        let Address { host, port, path, .. } = &self.address;
        let mut request = Request::builder()
            .method(method)
            .uri(path)
            .header(HOST, format!("{}:{port}", bracketed(host)))
            .header(USER_AGENT, concat!("sightfix/", env!("CARGO_PKG_VERSION")));
        request = match *method {
            Method::GET => request.header(ACCEPT, "image/jpeg, image/png"),
            _ => request.header(CONTENT_TYPE, SOAP),
        };
        let body = Bytes::from(body);
        if let Some(proof) = self.sign_in.authorization(method.as_str(), path, &body)? {
            let mut proof = HeaderValue::from_str(&proof).map_err(|error| PeerError(error.to_string()))?;
            proof.set_sensitive(true);
            request = request.header(AUTHORIZATION, proof);
        }
        request.body(Full::new(body)).map_err(|error| PeerError(error.to_string()))
    }

    fn take_challenge(&mut self, refusal: &Response<Incoming>) -> Result<(), PeerError> {
        let no_user = "the address asks for a user; give snapshot.username and snapshot.password";
        let challenges = refusal.headers().get_all(WWW_AUTHENTICATE).iter();
        let challenges: Vec<_> = challenges.filter_map(|challenge| challenge.to_str().ok()).collect();
        self.sign_in.take_challenge(&challenges.join(", "), no_user)
    }
}

async fn read(body: Incoming, most_bytes: usize) -> Result<Bytes, PeerError> {
    let read = Limited::new(body, most_bytes).collect().await;
    let read = read.map_err(|error| {
        PeerError(format!("the answer cannot be read, or has more than {most_bytes} bytes: {error}"))
    })?;
    Ok(read.to_bytes())
}
