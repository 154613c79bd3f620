//! `/v1/session/openid`: sign-in of people at the provider of the settings.

use axum::Router;
use axum::response::Response;
use axum::routing::get;
use hyper::header::{ACCEPT, CACHE_CONTROL, LOCATION, SET_COOKIE};
use hyper::http::HeaderValue;
use hyper::{HeaderMap, StatusCode, Uri};
use serde::Serialize;
use utoipa::ToSchema;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use super::session::{HOST_PREFIX, cookie, end_former, host_cookie, with_cookie};
use crate::app::App;
use crate::app::access::SESSION_TIME;
use crate::domain::{Error, ErrorKind, Result};
use crate::http::plumbing::access::CallerApp;
use crate::http::plumbing::problem::{ApiResult, Problem};
use crate::http::plumbing::state::Rest;
use crate::http::plumbing::wire::{empty, json};
use crate::openid::{Provider, SignInSecret};

/// Cookie that binds a sign-in to the browser that began it.
const SIGN_IN_COOKIE: &str = "sightfix_sign_in";
/// Time for a person to sign in at the provider, s.
const SIGN_IN_TIME_S: u32 = 600;

pub(super) fn routes() -> OpenApiRouter<Rest> {
    OpenApiRouter::new().routes(routes!(get_sign_in_methods)).routes(routes!(begin_sign_in))
}

/// Where the provider sends the browser back to. It is no part of the description: which parameters come is the
/// provider's choice, and clients ignore those that they do not know (RFC 6749, 4.1.2).
pub(super) fn callback() -> Router<Rest> {
    Router::new().route("/v1/session/openid/callback", get(finish_sign_in))
}

/// How browsers sign in here.
#[derive(Serialize, ToSchema)]
struct SignInMethods {
    /// True if `/v1/session/openid` leads to a provider where people sign in.
    openid: bool,
}

/// How browsers sign in here
///
/// For the sign-in page. Keys are always taken (`POST /v1/session`).
#[utoipa::path(
    get, path = "/v1/session/methods", tag = "access",
    responses((status = 200, description = "The methods", body = SignInMethods))
)]
async fn get_sign_in_methods(CallerApp(app): CallerApp) -> ApiResult {
    Ok(json(&SignInMethods { openid: app.access.openid().is_some() })?)
}

/// Sign in by OpenID Connect
///
/// A page of this server links here. Leads the browser to the provider of the settings, which leads it back; then it
/// has a session like that of a key, with the role that the provider's claim gives, and is led to `/`. A browser that asks
/// for HTML is led to the console where this fails; it says what failed.
#[utoipa::path(
    get, path = "/v1/session/openid", tag = "access",
    responses(
        (status = 303, description = "To the provider", headers(("location" = String, description = "Its authorization endpoint"))),
        (status = 404, description = "No provider is set up", body = Problem, content_type = "application/problem+json"),
        (status = 502, description = "The provider gives no usable answer", body = Problem, content_type = "application/problem+json"),
    )
)]
async fn begin_sign_in(CallerApp(app): CallerApp, headers: HeaderMap) -> ApiResult {
    Ok(answer_person(begin(&app).await, &headers)?)
}

async fn finish_sign_in(CallerApp(app): CallerApp, uri: Uri, headers: HeaderMap) -> ApiResult {
    Ok(answer_person(finish(&app, &uri, &headers).await, &headers)?)
}

/// The answer by what the request accepts. A person sees the console, which names the kind of refusal in their language; a program
/// gets the problem. Faults stay as they are, so that they are logged.
fn answer_person(answer: Result<Response>, headers: &HeaderMap) -> Result<Response> {
    let reads_html = |accepted: &HeaderValue| accepted.to_str().is_ok_and(|it| it.contains("text/html"));
    match answer {
        Err(Error::Refused(refusal)) if headers.get_all(ACCEPT).iter().any(reads_html) => {
            see_other(&format!("/#/sign-in/{}", refusal.kind.as_str()))
        }
        answer => answer,
    }
}

async fn begin(app: &App) -> Result<Response> {
    let (secret, url) = app.sessions().begin_sign_in().await?;
    let response = see_other(&url)?;
    let is_https = app.access.openid().is_some_and(Provider::is_https);
    with_sign_in_cookie(response, is_https, secret.reveal(), SIGN_IN_TIME_S)
}

async fn finish(app: &App, uri: &Uri, headers: &HeaderMap) -> Result<Response> {
    let parameter = |wanted: &str| {
        let query = uri.query().unwrap_or_default().as_bytes();
        form_urlencoded::parse(query).find(|(name, _)| name == wanted).map(|(_, value)| value.into_owned())
    };
    if let Some(error) = parameter("error") {
        let shown: String = error.chars().filter(|it| it.is_ascii_graphic()).take(64).collect();
        let message = format!("the provider did not sign the person in: {shown}");
        return Err(Error::refused(ErrorKind::Unauthenticated, message));
    }
    let missing = || Error::refused(ErrorKind::Unauthenticated, "the sign-in was not begun in this browser");
    let is_https = app.access.openid().is_some_and(Provider::is_https);
    let read = if is_https { host_cookie } else { cookie };
    let secret = SignInSecret::of_cookie(read(headers, SIGN_IN_COOKIE).ok_or_else(missing)?);
    let (state, code) = parameter("state").zip(parameter("code")).ok_or_else(missing)?;
    let token = app.sessions().finish_sign_in(&secret, &state, &code).await?;
    end_former(app, headers);
    // The address has the code, which no page is to learn.
    let response = with_cookie(see_other("/")?, is_https, token.reveal(), SESSION_TIME.as_secs())?;
    with_sign_in_cookie(response, is_https, "", 0)
}

fn see_other(url: &str) -> Result<Response> {
    let mut response = empty();
    *response.status_mut() = StatusCode::SEE_OTHER;
    let headers = response.headers_mut();
    headers.insert(LOCATION, HeaderValue::from_str(url).map_err(Error::fault)?);
    headers.insert(CACHE_CONTROL, HeaderValue::from_static("no-store"));
    Ok(response)
}

/// `Lax`, since the browser comes back from a page of the provider.
fn with_sign_in_cookie(mut response: Response, is_https: bool, secret: &str, age_s: u32) -> Result<Response> {
    // The prefix is for cookies of all paths.
    let (prefix, path, secure) =
        if is_https { (HOST_PREFIX, "/", "; Secure") } else { ("", "/v1/session/openid", "") };
    let cookie = format!(
        "{prefix}{SIGN_IN_COOKIE}={secret}; Path={path}; Max-Age={age_s}; HttpOnly; SameSite=Lax{secure}"
    );
    response.headers_mut().append(SET_COOKIE, HeaderValue::from_str(&cookie).map_err(Error::fault)?);
    Ok(response)
}
