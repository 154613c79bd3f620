//! Where a still picture of what a camera sees is fetched.

use std::borrow::Cow;
use std::fmt;

use super::error::{Error, Result};
use super::names::check_text;

/// Longest address, and longest name and password, bytes.
const MAX_URL_BYTES: usize = 512;
const MAX_CREDENTIAL_BYTES: usize = 256;

/// Begins the address of an ONVIF device.
const ONVIF: &str = "onvif://";
/// The path of an ONVIF device service (Core Specification, 5.1.1).
const DEVICE_SERVICE: &str = "/onvif/device_service";

/// The address that answers with a still picture, such as Frigate's `/api/<camera>/latest.jpg`, or that of an ONVIF camera,
/// which knows where its pictures are. The password is never shown.
#[derive(Clone, PartialEq, Eq)]
pub struct SnapshotSource {
    url: String,
    username: Option<String>,
    password: Option<String>,
}

impl SnapshotSource {
    /// An address of HTTP, HTTPS or ONVIF (`onvif://HOST`, with a port or path where they are not the usual ones), with the
    /// name and password of HTTP's Digest or Basic authentication.
    ///
    /// # Errors
    /// `InvalidArgument` naming `snapshot.url`, `snapshot.username` or `snapshot.password`.
    pub fn new(url: &str, username: Option<String>, password: Option<String>) -> Result<Self> {
        check_text("snapshot.url", url, MAX_URL_BYTES)?;
        if !["http://", "https://", ONVIF].iter().any(|scheme| url.starts_with(scheme)) {
            return Err(Error::invalid("snapshot.url", "must begin with http://, https:// or onvif://"));
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

    /// True if the address is that of an ONVIF device.
    #[must_use]
    pub fn is_onvif(&self) -> bool {
        self.url.starts_with(ONVIF)
    }

    /// The address by HTTP: of the picture, or of the ONVIF device service.
    #[must_use]
    pub fn http_url(&self) -> Cow<'_, str> {
        match self.url.strip_prefix(ONVIF) {
            Some(device) if device.contains('/') => Cow::Owned(format!("http://{device}")),
            Some(device) => Cow::Owned(format!("http://{device}{DEVICE_SERVICE}")),
            None => Cow::Borrowed(&self.url),
        }
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
    fn a_device_is_asked_at_its_service() {
        for (url, expected) in [
            ("onvif://192.0.2.7", "http://192.0.2.7/onvif/device_service"),
            ("onvif://192.0.2.7:8899", "http://192.0.2.7:8899/onvif/device_service"),
            ("onvif://camera/own/service", "http://camera/own/service"),
            ("https://192.0.2.7/still.jpg", "https://192.0.2.7/still.jpg"),
        ] {
            assert_eq!(source(url, None).http_url(), expected);
        }
    }

    #[test]
    fn other_schemes_and_a_password_without_a_name_are_refused() {
        for url in ["file:///etc/passwd", "rtsp://192.0.2.7/", "192.0.2.7", ""] {
            SnapshotSource::new(url, None, None).expect_err(url);
        }
        SnapshotSource::new("http://192.0.2.7/", None, Some("s3cret".to_owned())).expect_err("no name");
    }
}
