//! Where a still picture of what a camera sees is fetched.

use std::fmt;

use super::error::{Error, Result};
use super::names::check_text;

/// Longest address, and longest name and password, bytes.
const MAX_URL_BYTES: usize = 512;
const MAX_CREDENTIAL_BYTES: usize = 256;

/// The address that answers with a still picture, such as ONVIF's snapshot URI or Frigate's
/// `/api/<camera>/latest.jpg`. The password is never shown.
#[derive(Clone, PartialEq, Eq)]
pub struct SnapshotSource {
    url: String,
    username: Option<String>,
    password: Option<String>,
}

impl SnapshotSource {
    /// An address of HTTP or HTTPS with the name and password of HTTP's Basic authentication.
    ///
    /// # Errors
    /// `InvalidArgument` naming `snapshot.url`, `snapshot.username` or `snapshot.password`.
    pub fn new(url: &str, username: Option<String>, password: Option<String>) -> Result<Self> {
        check_text("snapshot.url", url, MAX_URL_BYTES)?;
        if !url.starts_with("http://") && !url.starts_with("https://") {
            return Err(Error::invalid("snapshot.url", "must begin with http:// or https://"));
        }
        for (field, text) in [("snapshot.username", &username), ("snapshot.password", &password)] {
            text.as_deref().map_or(Ok(()), |text| check_text(field, text, MAX_CREDENTIAL_BYTES))?;
        }
        if username.is_none() && password.is_some() {
            return Err(Error::invalid("snapshot.username", "is missing; a password needs it"));
        }
        Ok(Self { url: url.to_owned(), username, password })
    }

    /// The address.
    #[must_use]
    pub fn url(&self) -> &str {
        &self.url
    }

    /// The name to sign in with.
    #[must_use]
    pub fn username(&self) -> Option<&str> {
        self.username.as_deref()
    }

    /// The password, for the peer and the store alone.
    #[must_use]
    pub fn password(&self) -> Option<&str> {
        self.password.as_deref()
    }

    /// The same with the password that is known for this address and name, unless it has one: who reads a profile and
    /// writes it back does not know the password.
    #[must_use]
    pub fn with_known_password(mut self, known: Option<&Self>) -> Self {
        let is_same = |known: &&Self| known.url == self.url && known.username == self.username;
        if self.password.is_none() {
            self.password = known.filter(is_same).and_then(|known| known.password.clone());
        }
        self
    }
}

impl fmt::Debug for SnapshotSource {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        out.debug_struct("SnapshotSource")
            .field("url", &self.url)
            .field("username", &self.username)
            .finish_non_exhaustive()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn source(url: &str, password: Option<&str>) -> SnapshotSource {
        SnapshotSource::new(url, Some("viewer".to_owned()), password.map(str::to_owned)).expect("valid")
    }

    #[test]
    fn a_password_is_kept_for_its_own_address_alone_and_is_not_shown() {
        let known = source("http://192.0.2.7/still.jpg", Some("s3cret"));
        let again = source("http://192.0.2.7/still.jpg", None).with_known_password(Some(&known));
        assert_eq!(again.password(), Some("s3cret"));
        let elsewhere = source("http://192.0.2.8/still.jpg", None).with_known_password(Some(&known));
        assert_eq!(elsewhere.password(), None);
        assert!(!format!("{known:?}").contains("s3cret"), "{known:?}");
    }

    #[test]
    fn other_schemes_and_a_password_without_a_name_are_refused() {
        for url in ["file:///etc/passwd", "rtsp://192.0.2.7/", "192.0.2.7", ""] {
            SnapshotSource::new(url, None, None).expect_err(url);
        }
        SnapshotSource::new("http://192.0.2.7/", None, Some("s3cret".to_owned())).expect_err("no name");
    }
}
