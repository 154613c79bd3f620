//! `/v1/keys`: keys that clients present.

use axum::extract::FromRequestParts;
use hyper::http::request::Parts;
use hyper::{StatusCode, Uri};
use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use crate::domain::{self, CameraId, KeyId, KeySecret, NewKey, Result, Scope, convert_all};
use crate::exchange::write_cursor;
use crate::http::plumbing::access::CallerApp;
use crate::http::plumbing::extract::{JsonBody, Params, path};
use crate::http::plumbing::problem::{ApiError, ApiResult};
use crate::http::plumbing::state::Rest;
use crate::http::plumbing::wire::{created, empty, instant, json};

pub(super) fn routes() -> OpenApiRouter<Rest> {
    OpenApiRouter::new().routes(routes!(create_key, list_keys)).routes(routes!(get_key, revoke_key))
}

/// The operations that a key allows.
#[derive(Clone, Copy, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub(super) enum Role {
    /// Read everything but keys and the audit log.
    Viewer,
    /// Fuse, stream and add samples, for the cameras that the key names.
    Edge,
    /// Everything but keys.
    Operator,
    /// Everything.
    Admin,
}

impl From<Role> for domain::Role {
    fn from(role: Role) -> Self {
        match role {
            Role::Viewer => Self::Viewer,
            Role::Edge => Self::Edge,
            Role::Operator => Self::Operator,
            Role::Admin => Self::Admin,
        }
    }
}

impl From<domain::Role> for Role {
    fn from(role: domain::Role) -> Self {
        match role {
            domain::Role::Viewer => Self::Viewer,
            domain::Role::Edge => Self::Edge,
            domain::Role::Operator => Self::Operator,
            domain::Role::Admin => Self::Admin,
        }
    }
}

/// A key to be created.
#[derive(Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
struct KeyDraft {
    /// The key's purpose, for people.
    #[schema(min_length = 1, max_length = 128, example = "camera box at the north gate")]
    name: String,
    /// The role of the key.
    role: Role,
    /// The cameras that the role `edge` is restricted to; none for the other roles.
    #[serde(default)]
    #[schema(max_items = 256, example = json!(["north-gate"]))]
    camera_ids: Vec<String>,
    /// When it stops working (RFC 3339); never if left out.
    #[schema(format = DateTime)]
    expires_at: Option<String>,
}

impl KeyDraft {
    fn into_domain(self, now: Timestamp) -> Result<NewKey> {
        let camera = |id: String| CameraId::new(&id).map_err(|error| error.at(""));
        let scope = Scope::new(self.role.into(), convert_all("camera_ids", self.camera_ids, camera)?)?;
        NewKey::new(&self.name, scope, instant("expires_at", self.expires_at.as_deref())?, now)
    }
}

/// A key, without its secret.
#[derive(Serialize, ToSchema)]
pub(super) struct Key {
    /// Its id, which is no secret.
    id: String,
    /// The key's purpose, for people.
    name: String,
    /// The role of the key.
    role: Role,
    /// The cameras that it is restricted to; empty for all.
    camera_ids: Vec<String>,
    /// When it was created.
    #[schema(value_type = String, format = DateTime)]
    created_at: Timestamp,
    /// When it stops working.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(value_type = Option<String>, format = DateTime)]
    expires_at: Option<Timestamp>,
    /// When it was used last, to about a minute.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(value_type = Option<String>, format = DateTime)]
    last_used_at: Option<Timestamp>,
    /// When it was revoked.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(value_type = Option<String>, format = DateTime)]
    revoked_at: Option<Timestamp>,
}

impl From<domain::ApiKey> for Key {
    fn from(key: domain::ApiKey) -> Self {
        Self {
            id: key.id.to_string(),
            name: key.name,
            role: key.scope.role().into(),
            camera_ids: camera_ids(&key.scope),
            created_at: key.created_at,
            expires_at: key.expires_at,
            last_used_at: key.last_used_at,
            revoked_at: key.revoked_at,
        }
    }
}

/// The cameras that a scope is restricted to, as text.
pub(super) fn camera_ids(scope: &Scope) -> Vec<String> {
    scope.cameras().iter().map(|camera| camera.as_str().to_owned()).collect()
}

/// A key that was just created.
#[derive(Serialize, ToSchema)]
struct CreatedKey {
    /// The key.
    #[serde(flatten)]
    key: Key,
    /// The secret, shown this once: send it as `authorization: Bearer sf_...`.
    #[schema(pattern = "^sf_[0-9A-Za-z]{36}$")]
    secret: String,
}

impl CreatedKey {
    fn new(key: domain::ApiKey, secret: &KeySecret) -> Self {
        Self { key: key.into(), secret: secret.reveal().to_owned() }
    }
}

/// A page of keys, newest first.
#[derive(Serialize, ToSchema)]
struct KeyPage {
    /// A page of keys.
    items: Vec<Key>,
    /// Asks for the next page; missing on the last.
    #[serde(skip_serializing_if = "Option::is_none")]
    next_cursor: Option<String>,
}

/// Create a key
///
/// The answer contains the secret, which is stored nowhere and cannot be shown again. From the first key
/// on, every request needs one.
#[utoipa::path(
    post, path = "/v1/keys", tag = "access", request_body = KeyDraft,
    responses(
        (status = 201, description = "The key with its secret", body = CreatedKey, headers(("location" = String, description = "Its path"))),
    )
)]
async fn create_key(CallerApp(app): CallerApp, body: JsonBody) -> ApiResult {
    let key = body.read::<KeyDraft>()?.into_domain(app.clock.now())?;
    let (key, secret) = app.keys().create(&key).await?;
    let location = format!("/v1/keys/{}", key.id);
    Ok(created(StatusCode::CREATED, &location, &CreatedKey::new(key, &secret))?)
}

/// List keys, newest first
///
/// Also those that were revoked or have expired. Secrets are not stored.
#[utoipa::path(
    get, path = "/v1/keys", tag = "access",
    params(
        ("limit" = Option<u32>, Query, description = "Items on a page, 100 if left out"),
        ("cursor" = Option<String>, Query, description = "`next_cursor` of the page before"),
    ),
    responses((status = 200, description = "A page of keys", body = KeyPage))
)]
async fn list_keys(CallerApp(app): CallerApp, uri: Uri) -> ApiResult {
    let mut params = Params::of(&uri)?;
    let limit = params.limit(app.limits.page_items)?;
    let before = params.cursor()?;
    params.end()?;
    let page = app.keys().list(before, limit).await?;
    Ok(json(&KeyPage {
        items: page.items.into_iter().map(Key::from).collect(),
        next_cursor: page.next.map(|id| write_cursor(&id)),
    })?)
}

/// Read a key
#[utoipa::path(
    get, path = "/v1/keys/{key}", tag = "access", params(("key" = String, Path, description = "The key's id")),
    responses((status = 200, description = "The key", body = Key))
)]
async fn get_key(CallerApp(app): CallerApp, KeyPath(id): KeyPath) -> ApiResult {
    Ok(json(&Key::from(app.keys().get(id).await?))?)
}

/// Revoke a key
///
/// It does not work from now on, and its open streams and sessions end. Revoking it again changes nothing.
#[utoipa::path(
    delete, path = "/v1/keys/{key}", tag = "access", params(("key" = String, Path, description = "The key's id")),
    responses((status = 204, description = "It is revoked"))
)]
async fn revoke_key(CallerApp(app): CallerApp, KeyPath(id): KeyPath) -> ApiResult {
    app.keys().revoke(id).await?;
    Ok(empty())
}

/// A key of the path.
struct KeyPath(KeyId);

impl<S: Send + Sync> FromRequestParts<S> for KeyPath {
    type Rejection = ApiError;

    async fn from_request_parts(parts: &mut Parts, state: &S) -> ApiResult<Self> {
        Ok(Self(path::<KeySegment, S>(parts, state).await?.key.parse()?))
    }
}

#[derive(Deserialize)]
struct KeySegment {
    key: String,
}
