//! `/v1/session`: a browser's session instead of a key.

use axum::response::Response;
use hyper::HeaderMap;
use hyper::header::{COOKIE, ORIGIN, SET_COOKIE};
use hyper::http::HeaderValue;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use super::keys::{Role, camera_ids};
use crate::app::App;
use crate::app::access::{Principal, SESSION_TIME};
use crate::domain::{Error, Result};
use crate::http::plumbing::access::CallerApp;
use crate::http::plumbing::extract::JsonBody;
use crate::http::plumbing::problem::{ApiResult, Problem};
use crate::http::plumbing::state::Rest;
use crate::http::plumbing::wire::{empty, json};

/// Name of the cookie that carries a session's token.
pub(in crate::http) const SESSION_COOKIE: &str = "sightfix_session";
/// Begins the name of a cookie that no other host and no page over plain HTTP can set (RFC 6265bis, 4.1.3.2).
pub(super) const HOST_PREFIX: &str = "__Host-";

pub(super) fn routes() -> OpenApiRouter<Rest> {
    OpenApiRouter::new().routes(routes!(start_session, get_session, end_session))
}

/// A sign-in.
#[derive(Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
struct SessionDraft {
    /// The secret of a key.
    #[schema(example = "sf_...")]
    key: String,
}

/// Who asks, and what they may do.
#[derive(Serialize, ToSchema)]
struct Session {
    /// The role of the caller.
    role: Role,
    /// Name of the caller's key, or of the person who has signed in.
    #[serde(skip_serializing_if = "Option::is_none")]
    name: Option<String>,
    /// Id of the caller's key.
    #[serde(skip_serializing_if = "Option::is_none")]
    key_id: Option<String>,
    /// The cameras that the caller is restricted to; empty for all.
    camera_ids: Vec<String>,
    /// True if everybody may do everything, because no key was created yet.
    open_access: bool,
}

impl Session {
    fn of(principal: &Principal) -> Self {
        let key = match principal {
            Principal::Key(key) => Some(key.key()),
            _ => None,
        };
        let user = match principal {
            Principal::User(user) => Some(user.name().to_string()),
            _ => None,
        };
        let scope = principal.scope();
        Self {
            role: scope.map_or(Role::Admin, |scope| scope.role().into()),
            name: key.map(|key| key.name.clone()).or(user),
            key_id: key.map(|key| key.id.to_string()),
            camera_ids: scope.map(camera_ids).unwrap_or_default(),
            open_access: matches!(principal, Principal::Everyone),
        }
    }
}

/// Sign in with a key
///
/// Sets a cookie (`HttpOnly`, `SameSite=Strict`, over HTTPS also `Secure` and with `__Host-` before its name) that stands
/// for the key for twelve hours, or until the key is revoked or the server restarts. A session that the browser had
/// before ends, and so does the key's oldest beyond the limit `sessions_per_key`. Changes with the cookie are taken
/// from pages of this server only.
#[utoipa::path(
    post, path = "/v1/session", tag = "access", request_body = SessionDraft,
    responses(
        (status = 200, description = "Who has signed in", body = Session, headers(("set-cookie" = String, description = "The session"))),
        (status = 401, description = "The key does not work", body = Problem, content_type = "application/problem+json"),
    )
)]
async fn start_session(CallerApp(app): CallerApp, headers: HeaderMap, body: JsonBody) -> ApiResult {
    let SessionDraft { key } = body.read()?;
    let (token, principal) = app.sessions().start(&key).await?;
    end_former(&app, &headers);
    let response = json(&Session::of(&principal))?;
    Ok(with_cookie(response, is_https(&headers), token.reveal(), SESSION_TIME.as_secs())?)
}

/// Who asks, and what they may do
#[utoipa::path(
    get, path = "/v1/session", tag = "access",
    responses((status = 200, description = "The caller", body = Session))
)]
async fn get_session(CallerApp(app): CallerApp) -> ApiResult {
    Ok(json(&Session::of(app.caller().principal()))?)
}

/// Sign out
#[utoipa::path(
    delete, path = "/v1/session", tag = "access",
    responses((status = 204, description = "The session has ended"))
)]
async fn end_session(CallerApp(app): CallerApp, headers: HeaderMap) -> ApiResult {
    end_former(&app, &headers);
    Ok(with_cookie(empty(), is_https(&headers), "", 0)?)
}

/// Ends the session that the browser has.
pub(super) fn end_former(app: &App, headers: &HeaderMap) {
    if let Some(token) = session_token(headers, false) {
        app.access.end_session(token);
    }
}

/// The token of the session's cookie. Over TLS the name without the prefix counts for nothing: a page of another host
/// of the same domain can set it.
#[must_use]
pub fn session_token(headers: &HeaderMap, is_tls: bool) -> Option<&str> {
    let secure = host_cookie(headers, SESSION_COOKIE);
    if is_tls { secure } else { secure.or_else(|| cookie(headers, SESSION_COOKIE)) }
}

/// The value of a cookie with the prefix before its name.
pub(super) fn host_cookie<'h>(headers: &'h HeaderMap, wanted: &str) -> Option<&'h str> {
    find_cookie(headers, |name| name.strip_prefix(HOST_PREFIX) == Some(wanted))
}

/// The value of a cookie.
pub(super) fn cookie<'h>(headers: &'h HeaderMap, wanted: &str) -> Option<&'h str> {
    find_cookie(headers, |name| name == wanted)
}

fn find_cookie(headers: &HeaderMap, is_wanted: impl Fn(&str) -> bool) -> Option<&str> {
    let cookies = headers.get_all(COOKIE).iter().filter_map(|header| header.to_str().ok());
    cookies.flat_map(|cookies| cookies.split(';')).find_map(|cookie| {
        let (name, value) = cookie.trim().split_once('=')?;
        is_wanted(name).then_some(value)
    })
}

/// The browser names the scheme that it sees, whether TLS ends here or at a proxy.
fn is_https(headers: &HeaderMap) -> bool {
    headers.get(ORIGIN).is_some_and(|origin| origin.as_bytes().starts_with(b"https://"))
}

/// The response with the session's cookie; an empty token of age 0 removes it.
pub(super) fn with_cookie(
    mut response: Response,
    is_https: bool,
    token: &str,
    age_s: i64,
) -> Result<Response> {
    let (prefix, secure) = if is_https { (HOST_PREFIX, "; Secure") } else { ("", "") };
    let cookie = format!(
        "{prefix}{SESSION_COOKIE}={token}; Path=/; Max-Age={age_s}; HttpOnly; SameSite=Strict{secure}"
    );
    response.headers_mut().append(SET_COOKIE, HeaderValue::from_str(&cookie).map_err(Error::fault)?);
    Ok(response)
}
