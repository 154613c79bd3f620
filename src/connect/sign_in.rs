//! Signing in by the challenge of HTTP, Digest or Basic (RFC 7616, RFC 7617), which RTSP has as well.

use http_auth::{PasswordClient, PasswordParams};

use super::credentials::PeerError;

/// A user, and how the peer wants the password to be proved.
pub(super) struct SignIn {
    user: Option<(String, String)>,
    challenge: Option<PasswordClient>,
}

impl SignIn {
    pub(super) fn new(username: Option<&str>, password: Option<&str>) -> Self {
        let password = password.unwrap_or_default();
        let user = username.map(|name| (name.to_owned(), password.to_owned()));
        Self { user, challenge: None }
    }

    /// Takes the challenges of a refusal, by its headers `www-authenticate`. Fails with `no_user` if there is none.
    pub(super) fn take_challenge(&mut self, challenges: &str, no_user: &str) -> Result<(), PeerError> {
        if self.user.is_none() {
            return Err(no_user.into());
        }
        let challenge = PasswordClient::try_from(challenges);
        self.challenge = Some(challenge.map_err(cannot_sign_in)?);
        Ok(())
    }

    /// The header `authorization` of a request, once the peer has asked for it.
    pub(super) fn authorization(
        &mut self,
        method: &str,
        uri: &str,
        body: &[u8],
    ) -> Result<Option<String>, PeerError> {
        let (Some((username, password)), Some(challenge)) = (&self.user, &mut self.challenge) else {
            return Ok(None);
        };
        let proof = challenge.respond(&PasswordParams { username, password, uri, method, body: Some(body) });
        proof.map(Some).map_err(cannot_sign_in)
    }
}

fn cannot_sign_in(error: String) -> PeerError {
    PeerError(format!("cannot sign in: {error}"))
}
