//! Links, which are absolute: clients of the standard need not resolve others.

use hyper::header::HOST;
use hyper::http::request::Parts;
use serde::Serialize;
use utoipa::ToSchema;

use crate::http::plumbing::problem::ApiError;
use crate::request::RequestContext;

pub(super) const JSON: &str = "application/json";

/// A link (RFC 8288).
#[derive(Serialize, ToSchema)]
pub(super) struct Link {
    /// Where it leads.
    href: String,
    /// The relation of that resource to this one.
    #[schema(value_type = String, example = "self")]
    rel: &'static str,
    /// Its media type.
    #[schema(value_type = String, example = "application/json")]
    r#type: &'static str,
}

/// Scheme and host by which the client reached the server.
pub(super) struct BaseUrl(String);

impl BaseUrl {
    /// A link below `/ogc`.
    pub(super) fn link(&self, rel: &'static str, media_type: &'static str, path: &str) -> Link {
        let slash = if path.is_empty() { "" } else { "/" };
        Link { href: format!("{}/ogc{slash}{path}", self.0), rel, r#type: media_type }
    }

    /// A link to a path of the server.
    pub(super) fn root_link(&self, rel: &'static str, media_type: &'static str, path: &str) -> Link {
        Link { href: format!("{}/{path}", self.0), rel, r#type: media_type }
    }
}

impl<S: Send + Sync> axum::extract::FromRequestParts<S> for BaseUrl {
    type Rejection = ApiError;

    async fn from_request_parts(parts: &mut Parts, _state: &S) -> Result<Self, ApiError> {
        let scheme = RequestContext::of(&parts.extensions)?.scheme();
        // Checked by the server's layers: there is one, and this server answers for it.
        let header = || parts.headers.get(HOST).and_then(|host| host.to_str().ok());
        let host = parts.uri.authority().map(|authority| authority.as_str()).or_else(header);
        Ok(Self(format!("{scheme}://{}", host.unwrap_or("localhost"))))
    }
}

/// A text as a segment of a path or as a value of a query.
pub(super) fn segment(text: &str) -> String {
    let mut escaped = String::with_capacity(text.len());
    for byte in text.bytes() {
        match byte {
            b'A'..=b'Z' | b'a'..=b'z' | b'0'..=b'9' | b'-' | b'.' | b'_' | b'~' => escaped.push(byte.into()),
            _ => escaped.push_str(&format!("%{byte:02X}")),
        }
    }
    escaped
}
