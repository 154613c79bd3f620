//! The credential of a request: a key, a browser's session, or the certificate of its connection.

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use hyper::Request;
use hyper::header::AUTHORIZATION;

use crate::app::access::{CertificateHolder, Credential};
use crate::http::{path_key, session_token};

/// The credential of a request. A key is stronger than a session, and a session than a certificate, so that
/// what the request names explicitly identifies the caller.
pub(super) fn credential<'r, B>(
    request: &'r Request<B>,
    certificate: Option<&'r CertificateHolder>,
    is_tls: bool,
    is_grpc: bool,
) -> Credential<'r> {
    let mut headers = request.headers().get_all(AUTHORIZATION).iter();
    if let Some(header) = headers.next() {
        let parts = header.to_str().ok().filter(|_| headers.next().is_none());
        return match parts.and_then(|text| text.split_once(' ')) {
            Some((scheme, key)) if scheme.eq_ignore_ascii_case("bearer") => {
                Credential::Key(key.trim().into())
            }
            Some((scheme, encoded)) if scheme.eq_ignore_ascii_case("basic") => {
                password(encoded.trim()).map_or(Credential::Unreadable, |key| Credential::Key(key.into()))
            }
            _ => Credential::Unreadable,
        };
    }
    if !is_grpc && let Some(key) = path_key(request.uri().path()) {
        return Credential::Key(key.into());
    }
    if !is_grpc && let Some(token) = session_token(request.headers(), is_tls) {
        return Credential::Session(token);
    }
    certificate.map_or(Credential::None, Credential::Certificate)
}

/// The password of Basic authentication (RFC 7617): the key, of clients that can send nothing else.
fn password(encoded: &str) -> Option<String> {
    let pair = String::from_utf8(STANDARD.decode(encoded).ok()?).ok()?;
    pair.split_once(':').map(|(_, password)| password.to_owned())
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::domain::{Role, Scope};

    /// The credential of a request with these headers over a connection with a certificate.
    fn shown(headers: &[(&str, &str)], is_grpc: bool) -> String {
        shown_over(headers, false, is_grpc)
    }

    fn shown_over(headers: &[(&str, &str)], is_tls: bool, is_grpc: bool) -> String {
        let holder = CertificateHolder {
            fingerprint: "00".into(),
            scope: Arc::new(Scope::new(Role::Viewer, Vec::new()).expect("all cameras")),
        };
        let mut request = Request::get("/");
        for (name, value) in headers {
            request = request.header(*name, *value);
        }
        let request = request.body(()).expect("a request");
        match credential(&request, Some(&holder), is_tls, is_grpc) {
            Credential::Key(key) => format!("key {key}"),
            Credential::Session(token) => format!("session {token}"),
            other => format!("{other:?}").split('(').next().unwrap_or_default().to_owned(),
        }
    }

    #[test]
    fn the_strongest_credential_counts() {
        let cookie = ("cookie", "theme=dark; sightfix_session=t0; x=y");
        assert_eq!(shown(&[], false), "Certificate");
        assert_eq!(shown(&[cookie], false), "session t0");
        assert_eq!(shown(&[cookie], true), "Certificate", "cookies are for pages");
        let own = ("cookie", "sightfix_session=t0; __Host-sightfix_session=t1");
        assert_eq!(shown(&[own], false), "session t1", "TLS may end at a proxy");
        assert_eq!(shown_over(&[own], true, false), "session t1");
        assert_eq!(shown_over(&[cookie], true, false), "Certificate", "another host can set it");
        assert_eq!(shown(&[cookie, ("authorization", "bearer  k")], false), "key k");
        assert_eq!(shown(&[("authorization", "Basic eDp5")], false), "key y", "x:y");
        for wrong in ["Basic eA==", "Basic =", "Digest eDp5"] {
            assert_eq!(shown(&[("authorization", wrong)], false), "Unreadable", "{wrong}");
        }
        assert_eq!(
            shown(&[("authorization", "Bearer a"), ("authorization", "Bearer b")], true),
            "Unreadable"
        );
    }
}
