//! Settings of sign-in by OpenID Connect.

use std::path::PathBuf;

use anyhow::Context as _;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use super::origin::url_origin;
use super::secret::Secret;

/// Sign-in of people by OpenID Connect; there is none without `issuer`.
#[derive(Debug, Clone, Serialize, Deserialize, ToSchema)]
#[serde(default, deny_unknown_fields)]
pub struct OpenIdSettings {
    /// Identifier of the provider, such as `https://login.example.org/realms/site`: where its discovery document is.
    pub issuer: Option<String>,
    /// As the provider knows this server.
    pub client_id: Option<String>,
    /// Secret of the client; left out for a public client.
    #[schema(value_type = Option<String>)]
    pub client_secret: Option<Secret>,
    /// File that contains that secret instead.
    #[schema(value_type = Option<String>)]
    pub client_secret_file: Option<PathBuf>,
    /// `https://HOST/v1/session/openid/callback`, as it is registered at the provider.
    pub redirect_url: Option<String>,
    /// Scopes that are asked for.
    pub scopes: Vec<String>,
    /// Claim of the ID token with the person's roles or groups: a text or a list of texts. Dots lead into objects
    /// (`realm_access.roles`).
    pub role_claim: String,
    /// Values of that claim that make an administrator.
    pub admins: Vec<String>,
    /// Values that make an operator.
    pub operators: Vec<String>,
    /// Values that make a viewer; `*` is everybody who signs in.
    pub viewers: Vec<String>,
    /// File with the authority of the provider's certificate (PEM), instead of the system's authorities.
    #[schema(value_type = Option<String>)]
    pub ca: Option<PathBuf>,
}

impl Default for OpenIdSettings {
    fn default() -> Self {
        Self {
            issuer: None,
            client_id: None,
            client_secret: None,
            client_secret_file: None,
            redirect_url: None,
            scopes: ["openid", "profile", "email"].map(str::to_owned).to_vec(),
            role_claim: "groups".to_owned(),
            admins: Vec::new(),
            operators: Vec::new(),
            viewers: Vec::new(),
            ca: None,
        }
    }
}

impl OpenIdSettings {
    /// The secret, from the setting itself or the file that it names.
    ///
    /// # Errors
    /// Names the file that cannot be read.
    pub fn secret(&self) -> anyhow::Result<Option<Secret>> {
        let Some(path) = &self.client_secret_file else { return Ok(self.client_secret.clone()) };
        let text = std::fs::read_to_string(path)
            .with_context(|| format!("cannot read openid.client_secret_file {}", path.display()))?;
        Ok(Some(Secret(text.trim().to_owned())))
    }

    pub(super) fn check(&self) -> anyhow::Result<()> {
        let Some(issuer) = &self.issuer else { return Ok(()) };
        let redirect_url = self.redirect_url.as_deref().context("openid.redirect_url is missing")?;
        anyhow::ensure!(self.client_id.is_some(), "openid.client_id is missing");
        anyhow::ensure!(
            self.client_secret.is_none() || self.client_secret_file.is_none(),
            "give openid.client_secret or openid.client_secret_file, not both"
        );
        for (name, url) in [("issuer", issuer.as_str()), ("redirect_url", redirect_url)] {
            anyhow::ensure!(
                url_origin(url).is_some_and(is_confidential),
                "openid.{name} must be an https URL (http on this machine only); `{url}` is none"
            );
        }
        anyhow::ensure!(
            redirect_url.ends_with("/v1/session/openid/callback"),
            "openid.redirect_url must end with /v1/session/openid/callback"
        );
        anyhow::ensure!(
            self.scopes.iter().any(|scope| scope == "openid"),
            "openid.scopes must contain openid"
        );
        anyhow::ensure!(
            [&self.admins, &self.operators, &self.viewers].iter().any(|values| !values.is_empty()),
            "openid.admins, openid.operators or openid.viewers must name a value of the claim {}, or nobody may \
             do anything",
            self.role_claim
        );
        Ok(())
    }
}

/// True if nobody between can read what is sent to an origin.
fn is_confidential(origin: &str) -> bool {
    let Some(host) = origin.strip_prefix("http://") else { return true };
    let host = host.rsplit_once(':').map_or(host, |(host, _)| host);
    matches!(host, "localhost" | "127.0.0.1" | "[::1]")
}
