//! The operator's console at `/` and `/walk`: files that `console/` builds and this binary holds.
//!
//! The console uses the public REST interface and nothing else; nothing here is made for it but its files.

use std::sync::LazyLock;

use axum::Router;
use axum::body::Body;
use axum::response::Response;
use axum::routing::get;
use hyper::header::{
    ACCEPT_ENCODING, CACHE_CONTROL, CONTENT_ENCODING, CONTENT_SECURITY_POLICY, CONTENT_TYPE, ETAG,
    IF_NONE_MATCH, REFERRER_POLICY, VARY, X_FRAME_OPTIONS,
};
use hyper::http::{HeaderName, HeaderValue};
use hyper::{HeaderMap, StatusCode};
use sha2::{Digest as _, Sha256};

use crate::config::Console;
use crate::http::plumbing::state::Rest;

/// A file of `console/dist`, also compressed where that is smaller.
struct Asset {
    /// Path below `console/dist`.
    path: &'static str,
    content: &'static [u8],
    gzip: Option<&'static [u8]>,
    brotli: Option<&'static [u8]>,
}

// `static ASSETS: &[Asset]`, written by build.rs.
include!(concat!(env!("OUT_DIR"), "/console_assets.rs"));

/// Entity tags of the assets, in their order: the beginning of the content's SHA-256.
static ENTITY_TAGS: LazyLock<Vec<String>> = LazyLock::new(|| ASSETS.iter().map(entity_tag).collect());

fn entity_tag(asset: &Asset) -> String {
    let digest = Sha256::digest(asset.content);
    digest.iter().take(12).map(|byte| format!("{byte:02x}")).collect()
}

pub(super) fn routes(settings: &Console) -> Router<Rest> {
    #[expect(clippy::expect_used, reason = "the settings were checked at the start")]
    let policy =
        HeaderValue::from_str(&content_policy(settings.tile_origin())).expect("an origin of plain ASCII");
    let mut router = Router::new();
    for (index, asset) in ASSETS.iter().enumerate() {
        let policy = policy.clone();
        let answer = move |headers: HeaderMap| {
            let response = respond(asset, &ENTITY_TAGS[index], &headers, policy);
            async move { response }
        };
        router = router.route(&route_of(asset.path), get(answer));
    }
    router
}

/// `index.html` is `/`, any other page is its name without the ending.
fn route_of(path: &str) -> String {
    match path.strip_suffix(".html") {
        Some("index") => "/".to_owned(),
        Some(page) => format!("/{page}"),
        None => format!("/{path}"),
    }
}

/// The console runs its own scripts and styles and asks its own server. Images are its own, a picture that the
/// operator drops in (`blob:`), and map tiles where they are set, or offered to a user who agrees.
fn content_policy(tile_origin: Option<&str>) -> String {
    let tiles = tile_origin.map(|origin| format!(" {origin}")).unwrap_or_default();
    format!(
        "default-src 'none'; script-src 'self'; style-src 'self'; font-src 'self'; connect-src 'self'; \
         img-src 'self' data: blob:{tiles}; manifest-src 'self'; base-uri 'none'; form-action 'none'; \
         frame-ancestors 'none'"
    )
}

fn respond(asset: &Asset, tag: &str, headers: &HeaderMap, policy: HeaderValue) -> Response {
    let (encoding, content) = encoded(asset, headers);
    // One tag per encoding (RFC 9110, 8.8.3.3).
    let tag = format!("\"{tag}{}\"", encoding.map(|name| format!("-{name}")).unwrap_or_default());
    let is_known = headers
        .get_all(IF_NONE_MATCH)
        .iter()
        .filter_map(|value| value.to_str().ok())
        .flat_map(|value| value.split(','))
        .any(|known| known.trim().trim_start_matches("W/") == tag);
    let mut response = Response::new(if is_known { Body::empty() } else { Body::from(content) });
    if is_known {
        *response.status_mut() = StatusCode::NOT_MODIFIED;
    }
    let headers = response.headers_mut();
    let mut set =
        |name: HeaderName, value: &'static str| headers.insert(name, HeaderValue::from_static(value));
    set(VARY, "accept-encoding");
    set(CACHE_CONTROL, cache_control(asset.path));
    set(REFERRER_POLICY, "no-referrer");
    set(X_FRAME_OPTIONS, "DENY");
    if !is_known {
        set(CONTENT_TYPE, content_type(asset.path));
        if let Some(encoding) = encoding {
            set(CONTENT_ENCODING, encoding);
        }
    }
    headers.insert(CONTENT_SECURITY_POLICY, policy);
    headers.extend(HeaderValue::from_str(&tag).map(|tag| (ETAG, tag)));
    response
}

/// The content in the smallest encoding that the client accepts.
fn encoded(asset: &Asset, headers: &HeaderMap) -> (Option<&'static str>, &'static [u8]) {
    let accepts = |name: &str| {
        let accepted = headers.get_all(ACCEPT_ENCODING).iter().filter_map(|value| value.to_str().ok());
        accepted.flat_map(|value| value.split(',')).any(|item| {
            let (coding, weight) = item.split_once(';').unwrap_or((item, "q=1"));
            coding.trim().eq_ignore_ascii_case(name)
                && !matches!(weight.trim(), "q=0" | "q=0.0" | "q=0.00" | "q=0.000")
        })
    };
    match (asset.brotli, asset.gzip) {
        (Some(brotli), _) if accepts("br") => (Some("br"), brotli),
        (_, Some(gzip)) if accepts("gzip") => (Some("gzip"), gzip),
        _ => (None, asset.content),
    }
}

/// The names of files below `assets/` hold a hash of their content; all else may change with the next release.
fn cache_control(path: &str) -> &'static str {
    if path.starts_with("assets/") { "public, max-age=31536000, immutable" } else { "no-cache" }
}

fn content_type(path: &str) -> &'static str {
    match path.rsplit_once('.').map_or("", |(_, ending)| ending) {
        "html" => "text/html; charset=utf-8",
        "js" => "text/javascript; charset=utf-8",
        "css" => "text/css; charset=utf-8",
        "svg" => "image/svg+xml",
        "png" => "image/png",
        "json" => "application/json",
        "woff2" => "font/woff2",
        "webmanifest" => "application/manifest+json",
        "txt" => "text/plain; charset=utf-8",
        _ => "application/octet-stream",
    }
}
