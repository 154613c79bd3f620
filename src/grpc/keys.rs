//! `KeyService`.

use super::convert::{instant, required, timestamp};
use super::pages;
use super::proto;
use super::proto::key_service_server::KeyService;
use super::statuses::{Reply, answer};
use crate::app::App;
use crate::domain::{ApiKey, CameraId, Error, KeyId, NewKey, Result, Role, Scope, convert_all};

pub(super) struct Keys {
    app: App,
}

impl Keys {
    pub(super) fn new(app: &App) -> Self {
        Self { app: app.clone() }
    }
}

#[tonic::async_trait]
impl KeyService for Keys {
    async fn create_key(
        &self,
        request: tonic::Request<proto::CreateKeyRequest>,
    ) -> Reply<proto::CreateKeyResponse> {
        answer(&self.app, request, |app, asked| async move {
            let role = required(role(asked.role)?, "role")?;
            let camera = |id: String| CameraId::new(&id).map_err(|error| error.at(""));
            let scope = Scope::new(role, convert_all("camera_ids", asked.camera_ids, camera)?)?;
            let expires_at = instant(asked.expires_at, "expires_at")?;
            let key = NewKey::new(&asked.name, scope, expires_at, app.clock.now())?;
            let (key, secret) = app.keys().create(&key).await?;
            Ok(proto::CreateKeyResponse { key: Some(key.into()), secret: secret.reveal().to_owned() })
        })
        .await
    }

    async fn get_key(&self, request: tonic::Request<proto::GetKeyRequest>) -> Reply<proto::GetKeyResponse> {
        answer(&self.app, request, |app, asked| async move {
            let key = app.keys().get(asked.key_id.parse()?).await?;
            Ok(proto::GetKeyResponse { key: Some(key.into()) })
        })
        .await
    }

    async fn list_keys(
        &self,
        request: tonic::Request<proto::ListKeysRequest>,
    ) -> Reply<proto::ListKeysResponse> {
        answer(&self.app, request, |app, asked| async move {
            let size = pages::size(asked.page_size, &app.limits)?;
            let page = app.keys().list(pages::cursor::<KeyId>(&asked.page_token)?, size).await?;
            Ok(proto::ListKeysResponse {
                next_page_token: pages::token(page.next.as_ref()),
                keys: page.items.into_iter().map(Into::into).collect(),
            })
        })
        .await
    }

    async fn revoke_key(
        &self,
        request: tonic::Request<proto::RevokeKeyRequest>,
    ) -> Reply<proto::RevokeKeyResponse> {
        answer(&self.app, request, |app, asked| async move {
            let key = app.keys().revoke(asked.key_id.parse()?).await?;
            Ok(proto::RevokeKeyResponse { key: Some(key.into()) })
        })
        .await
    }
}

/// The role, if one is given.
fn role(role: i32) -> Result<Option<Role>> {
    match proto::Role::try_from(role) {
        Ok(proto::Role::Unspecified) => Ok(None),
        Ok(proto::Role::Viewer) => Ok(Some(Role::Viewer)),
        Ok(proto::Role::Edge) => Ok(Some(Role::Edge)),
        Ok(proto::Role::Operator) => Ok(Some(Role::Operator)),
        Ok(proto::Role::Admin) => Ok(Some(Role::Admin)),
        Err(_) => Err(Error::invalid("role", format!("has no value {role}"))),
    }
}

impl From<Role> for proto::Role {
    fn from(role: Role) -> Self {
        match role {
            Role::Viewer => Self::Viewer,
            Role::Edge => Self::Edge,
            Role::Operator => Self::Operator,
            Role::Admin => Self::Admin,
        }
    }
}

impl From<ApiKey> for proto::Key {
    fn from(key: ApiKey) -> Self {
        Self {
            id: key.id.to_string(),
            name: key.name,
            role: proto::Role::from(key.scope.role()).into(),
            camera_ids: key.scope.cameras().iter().map(|camera| camera.as_str().to_owned()).collect(),
            created_at: Some(timestamp(key.created_at)),
            expires_at: key.expires_at.map(timestamp),
            last_used_at: key.last_used_at.map(timestamp),
            revoked_at: key.revoked_at.map(timestamp),
        }
    }
}
