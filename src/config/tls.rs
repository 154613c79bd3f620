//! Settings of TLS.

use std::path::{Path, PathBuf};

use anyhow::Context as _;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use crate::domain::{CameraId, Role, Scope};

/// Encryption of the port.
#[derive(Debug, Clone, Default, Serialize, Deserialize, ToSchema)]
#[serde(default, deny_unknown_fields)]
pub struct TlsSettings {
    /// File with the server's certificate chain (PEM); plain HTTP without.
    #[schema(value_type = Option<String>)]
    pub certificate: Option<PathBuf>,
    /// File with its private key (PEM).
    #[schema(value_type = Option<String>)]
    pub key: Option<PathBuf>,
    /// File with the authority of client certificates (PEM); none are asked for without.
    #[schema(value_type = Option<String>)]
    pub client_ca: Option<PathBuf>,
    /// The role of holders of client certificates: `viewer` if left out, `edge`, `operator`, `admin`.
    pub client_role: Option<String>,
    /// The cameras that the role `edge` is restricted to.
    pub client_camera_ids: Vec<String>,
}

impl TlsSettings {
    /// The files of the certificate and of its key; `None` for plain HTTP.
    ///
    /// # Errors
    /// Names the setting that is missing.
    pub fn certificate_and_key(&self) -> anyhow::Result<Option<(&Path, &Path)>> {
        match (&self.certificate, &self.key) {
            (Some(certificate), Some(key)) => Ok(Some((certificate, key))),
            (None, None) if self.client_ca.is_none() => Ok(None),
            _ => anyhow::bail!(
                "tls.certificate and tls.key must be given together, tls.client_ca only with them"
            ),
        }
    }

    /// Returns the scope of holders of client certificates.
    ///
    /// # Errors
    /// Names the setting that cannot be used.
    pub fn client_scope(&self) -> anyhow::Result<Scope> {
        let role = self.client_role.as_deref().map_or(Ok(Role::Viewer), str::parse);
        let role = role.context("the setting tls.client_role")?;
        let cameras = self.client_camera_ids.iter().map(|id| CameraId::new(id));
        let cameras = cameras.collect::<Result<_, _>>().context("the setting tls.client_camera_ids")?;
        Scope::new(role, cameras).context("the setting tls.client_camera_ids")
    }
}
