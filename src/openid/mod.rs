//! Sign-in of people at a provider of OpenID Connect: the authorization code flow with PKCE (OpenID Connect Core 1.0,
//! RFC 7636, RFC 9700).
//!
//! [`Provider::authorization_url`] sends the browser to the provider, [`Provider::identity`] redeems the code that it
//! comes back with. Nothing is stored in between: state, nonce and PKCE verifier are derived from one random
//! [`SignInSecret`], which the browser keeps in a cookie. Does not contain sessions, nor HTTP of our own clients.

mod fetch;
mod id_token;

use std::sync::{Mutex, PoisonError};

use anyhow::Context as _;
use base64::Engine as _;
use base64::engine::general_purpose::{STANDARD, URL_SAFE_NO_PAD};
use form_urlencoded::Serializer;
use jiff::{SignedDuration, Timestamp};
use serde::Deserialize;
use serde_json::{Map, Value};
use sha2::{Digest as _, Sha256};
use subtle::ConstantTimeEq as _;

use self::fetch::Fetch;
use self::id_token::{Expected, KeySet};
use crate::config::OpenIdSettings;
use crate::domain::{Error, ErrorKind, Result, Role, Scope};

/// How long the provider's description of itself is used.
const DISCOVERY_TIME: SignedDuration = SignedDuration::from_mins(10);
/// Longest name of a person that is stored, in bytes.
const MAX_NAME_BYTES: usize = 128;

/// The secret that binds the two halves of a sign-in to one browser.
pub struct SignInSecret(String);

impl SignInSecret {
    /// A new secret from a source of random bytes.
    pub fn generate(fill_random: impl FnOnce(&mut [u8])) -> Self {
        let mut bytes = [0; 32];
        fill_random(&mut bytes);
        Self(URL_SAFE_NO_PAD.encode(bytes))
    }

    /// The secret of a cookie.
    #[must_use]
    pub fn of_cookie(text: &str) -> Self {
        Self(text.to_owned())
    }

    /// The text, for the cookie.
    #[must_use]
    pub fn reveal(&self) -> &str {
        &self.0
    }

    /// A value that shows nothing of the secret, nor of those for other purposes.
    fn derive(&self, purpose: &str) -> String {
        URL_SAFE_NO_PAD.encode(Sha256::digest(format!("{purpose}:{}", self.0)))
    }

    fn state(&self) -> String {
        self.derive("state")
    }

    fn nonce(&self) -> String {
        self.derive("nonce")
    }

    /// 43 characters, as RFC 7636 asks.
    fn verifier(&self) -> String {
        self.derive("verifier")
    }
}

/// Who has signed in.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Identity {
    /// As the audit log names them: the provider's id, and the name that they have there.
    pub name: String,
    /// The provider's address and its id of the person, who keeps it when names change.
    pub subject: String,
    /// The scope of the user.
    pub scope: Scope,
}

/// The provider's own description (OpenID Connect Discovery 1.0).
#[derive(Clone, Deserialize)]
struct Discovery {
    issuer: String,
    authorization_endpoint: String,
    token_endpoint: String,
    jwks_uri: String,
    #[serde(default)]
    token_endpoint_auth_methods_supported: Vec<String>,
}

#[derive(Deserialize)]
struct TokenAnswer {
    id_token: String,
}

/// A provider of identities, as the settings describe it.
pub struct Provider {
    issuer: String,
    client_id: String,
    client_secret: Option<String>,
    redirect_url: String,
    scopes: String,
    role_claim: String,
    /// Values of the claim by role, the most powerful first.
    roles: [(Role, Vec<String>); 3],
    fetch: Fetch,
    discovery: Mutex<Option<(Discovery, Timestamp)>>,
}

impl Provider {
    /// From the settings; `None` where they name no issuer.
    ///
    /// # Errors
    /// Names the setting or file that cannot be used.
    pub fn new(settings: &OpenIdSettings) -> anyhow::Result<Option<Self>> {
        let Some(issuer) = settings.issuer.clone() else { return Ok(None) };
        Ok(Some(Self {
            issuer,
            client_id: settings.client_id.clone().context("openid.client_id is missing")?,
            client_secret: settings.secret()?.map(|secret| secret.reveal().to_owned()),
            redirect_url: settings.redirect_url.clone().context("openid.redirect_url is missing")?,
            scopes: settings.scopes.join(" "),
            role_claim: settings.role_claim.clone(),
            roles: [
                (Role::Admin, settings.admins.clone()),
                (Role::Operator, settings.operators.clone()),
                (Role::Viewer, settings.viewers.clone()),
            ],
            fetch: Fetch::new(settings.ca.as_deref())?,
            discovery: Mutex::default(),
        }))
    }

    /// True if browsers reach this server by HTTPS, so that its cookies are for HTTPS alone.
    #[must_use]
    pub fn is_https(&self) -> bool {
        self.redirect_url.starts_with("https://")
    }

    /// Where the browser is sent to sign in.
    ///
    /// # Errors
    /// `SignInUnavailable` if the provider does not answer.
    pub async fn authorization_url(&self, secret: &SignInSecret, now: Timestamp) -> Result<String> {
        let endpoint = self.discovery(now).await?.authorization_endpoint;
        let challenge = URL_SAFE_NO_PAD.encode(Sha256::digest(secret.verifier()));
        let query = Serializer::new(String::new())
            .append_pair("response_type", "code")
            .append_pair("client_id", &self.client_id)
            .append_pair("redirect_uri", &self.redirect_url)
            .append_pair("scope", &self.scopes)
            .append_pair("state", &secret.state())
            .append_pair("nonce", &secret.nonce())
            .append_pair("code_challenge", &challenge)
            .append_pair("code_challenge_method", "S256")
            .finish();
        let separator = if endpoint.contains('?') { '&' } else { '?' };
        Ok(format!("{endpoint}{separator}{query}"))
    }

    /// Who has signed in, by the code that the provider gave the browser.
    ///
    /// # Errors
    /// `Unauthenticated` for a state of another browser, or a code or token that is not valid;
    /// `PermissionDenied` for a person without a role; `SignInUnavailable`.
    pub async fn identity(
        &self,
        secret: &SignInSecret,
        state: &str,
        code: &str,
        now: Timestamp,
    ) -> Result<Identity> {
        if !bool::from(secret.state().as_bytes().ct_eq(state.as_bytes())) {
            return Err(not_signed_in("the sign-in was not begun in this browser, or too long ago"));
        }
        let discovery = self.discovery(now).await?;
        let token = self.redeem(&discovery, code, secret).await?;
        let keys: KeySet = self.provided(self.fetch.get(&discovery.jwks_uri).await)?;
        let nonce = secret.nonce();
        let expected = Expected { issuer: &self.issuer, client_id: &self.client_id, nonce: &nonce, now };
        let claims = id_token::verify(&token, &keys, &expected).map_err(|reason| {
            tracing::warn!(reason, "the OpenID provider sent an ID token that is not valid");
            not_signed_in("the provider's ID token is not valid; the log says why")
        })?;
        let name = display_name(&claims);
        let Some(role) = self.role_of(&claims) else {
            let claim = &self.role_claim;
            tracing::info!(name, claim, "a person without a role tried to sign in");
            let message = format!("the claim {claim} of the person has no value that gives a role here");
            return Err(Error::refused(ErrorKind::PermissionDenied, message));
        };
        let id = claims.get("sub").and_then(Value::as_str).unwrap_or_default();
        let subject = format!("{} {id}", self.issuer);
        Ok(Identity { name, subject, scope: Scope::new(role, Vec::new())? })
    }

    async fn discovery(&self, now: Timestamp) -> Result<Discovery> {
        let known = self.discovery.lock().unwrap_or_else(PoisonError::into_inner).clone();
        if let Some((discovery, fetched_at)) = known
            && now.duration_since(fetched_at).abs() < DISCOVERY_TIME
        {
            return Ok(discovery);
        }
        let url = format!("{}/.well-known/openid-configuration", self.issuer.trim_end_matches('/'));
        let discovery: Discovery = self.provided(self.fetch.get(&url).await)?;
        if discovery.issuer != self.issuer {
            let found = &discovery.issuer;
            return self
                .provided(Err(anyhow::anyhow!("it calls itself {found}, openid.issuer says otherwise")));
        }
        *self.discovery.lock().unwrap_or_else(PoisonError::into_inner) = Some((discovery.clone(), now));
        Ok(discovery)
    }

    /// Exchanges the code for an ID token (RFC 6749, 4.1.3).
    async fn redeem(&self, discovery: &Discovery, code: &str, secret: &SignInSecret) -> Result<String> {
        let (authorization, form) = self.token_request(discovery, code, secret);
        let answer = self.fetch.post(&discovery.token_endpoint, authorization, form).await;
        let answer = self.provided(answer)?;
        if answer.error_name().as_deref() == Some("invalid_grant") {
            return Err(not_signed_in("the provider does not take the code: sign in again"));
        }
        let tokens: TokenAnswer = self.provided(answer.content())?;
        Ok(tokens.id_token)
    }

    /// Header and form of the request for a token, with the client's secret in either.
    fn token_request(
        &self,
        discovery: &Discovery,
        code: &str,
        secret: &SignInSecret,
    ) -> (Option<String>, String) {
        let mut form = Serializer::new(String::new());
        form.append_pair("grant_type", "authorization_code")
            .append_pair("code", code)
            .append_pair("redirect_uri", &self.redirect_url)
            .append_pair("code_verifier", &secret.verifier());
        let methods = &discovery.token_endpoint_auth_methods_supported;
        let takes_basic = methods.is_empty() || methods.iter().any(|method| method == "client_secret_basic");
        let authorization = match &self.client_secret {
            Some(client_secret) if takes_basic => {
                let [id, secret] = [&self.client_id, client_secret].map(|text| encoded(text));
                Some(format!("Basic {}", STANDARD.encode(format!("{id}:{secret}"))))
            }
            Some(client_secret) => {
                form.append_pair("client_id", &self.client_id).append_pair("client_secret", client_secret);
                None
            }
            None => {
                form.append_pair("client_id", &self.client_id);
                None
            }
        };
        (authorization, form.finish())
    }

    /// Returns the provider's answer. The reason of a failure is for the log alone.
    fn provided<T>(&self, answer: anyhow::Result<T>) -> Result<T> {
        answer.map_err(|error| {
            let error = format!("{error:#}");
            tracing::warn!(issuer = self.issuer, error, "the OpenID provider gave no usable answer");
            let message = "the OpenID provider gave no usable answer; the log of the server says why";
            Error::refused(ErrorKind::SignInUnavailable, message)
        })
    }

    /// The most powerful role that the claim gives.
    fn role_of(&self, claims: &Map<String, Value>) -> Option<Role> {
        let values = claim_texts(claims, &self.role_claim);
        let gives = |wanted: &Vec<String>| {
            wanted.iter().any(|wanted| wanted == "*" || values.contains(&wanted.as_str()))
        };
        self.roles.iter().find(|(_, wanted)| gives(wanted)).map(|(role, _)| *role)
    }
}

fn not_signed_in(message: &str) -> Error {
    Error::refused(ErrorKind::Unauthenticated, message)
}

fn encoded(text: &str) -> String {
    form_urlencoded::byte_serialize(text.as_bytes()).collect()
}

/// The texts of a claim: by its whole name, or by a path of names separated by dots.
fn claim_texts<'c>(claims: &'c Map<String, Value>, name: &str) -> Vec<&'c str> {
    let mut names = name.split('.');
    let value = claims.get(name).or_else(|| {
        let first = claims.get(names.next()?)?;
        names.try_fold(first, |value, name| value.get(name))
    });
    match value {
        Some(Value::String(text)) => vec![text],
        Some(Value::Array(items)) => items.iter().filter_map(Value::as_str).collect(),
        _ => Vec::new(),
    }
}

/// The subject identifies the person, the other claims only tell people who that is.
fn display_name(claims: &Map<String, Value>) -> String {
    let text = |name: &str| claims.get(name).and_then(Value::as_str).filter(|text| !text.is_empty());
    let subject = text("sub").unwrap_or_default();
    let name = ["preferred_username", "email", "name"].into_iter().find_map(text);
    let shown = name.map_or_else(|| subject.to_owned(), |name| format!("{subject} ({name})"));
    let mut shown: String = shown.chars().filter(|character| !character.is_control()).collect();
    let end = shown.floor_char_boundary(MAX_NAME_BYTES);
    shown.truncate(end);
    shown
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    fn provider(viewers: &str) -> Provider {
        let settings = OpenIdSettings {
            issuer: Some("https://issuer.example".to_owned()),
            client_id: Some("sightfix".to_owned()),
            redirect_url: Some("https://sight.example/v1/session/openid/callback".to_owned()),
            role_claim: "realm_access.roles".to_owned(),
            admins: vec!["boss".to_owned()],
            viewers: vec![viewers.to_owned()],
            ..OpenIdSettings::default()
        };
        Provider::new(&settings).expect("usable settings").expect("an issuer")
    }

    fn claims(value: Value) -> Map<String, Value> {
        value.as_object().expect("an object").clone()
    }

    #[test]
    fn the_most_powerful_role_of_the_claim_counts() {
        let provider = provider("guest");
        let of = |roles: Value| provider.role_of(&claims(json!({ "realm_access": { "roles": roles } })));
        assert_eq!(of(json!(["guest", "boss"])), Some(Role::Admin));
        assert_eq!(of(json!("guest")), Some(Role::Viewer));
        assert_eq!(of(json!(["Boss", 7, "bos"])), None);
        assert_eq!(provider.role_of(&claims(json!({ "realm_access.roles": ["boss"] }))), Some(Role::Admin));
        assert_eq!(provider.role_of(&claims(json!({}))), None);
        assert_eq!(super::tests::provider("*").role_of(&claims(json!({}))), Some(Role::Viewer));
    }

    #[test]
    fn what_leaves_the_browser_shows_nothing_of_its_secret() {
        let secret = SignInSecret::of_cookie("s");
        let derived = [secret.state(), secret.nonce(), secret.verifier()];
        assert!(derived.iter().all(|text| text.len() == 43));
        assert!(derived[0] != derived[1] && derived[1] != derived[2] && derived[0] != derived[2]);
        assert_ne!(SignInSecret::of_cookie("t").state(), derived[0]);
    }

    #[test]
    fn people_are_named_by_their_subject() {
        let name = |value| display_name(&claims(value));
        assert_eq!(name(json!({ "sub": "7", "email": "ada@example.org" })), "7 (ada@example.org)");
        assert_eq!(name(json!({ "sub": "7\n8" })), "78");
        assert!(name(json!({ "sub": "é".repeat(300) })).len() <= MAX_NAME_BYTES);
    }
}
