//! The credentials that open a connection, and the reasons why it does not open.

use crate::exchange::Secrets;
use crate::exchange::kinds::{Login, SaslMechanism};

/// Why a connection does not work now; it is opened again.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub(super) struct PeerError(pub(super) String);

impl From<std::io::Error> for PeerError {
    fn from(error: std::io::Error) -> Self {
        Self(error.to_string())
    }
}

impl From<crate::domain::Error> for PeerError {
    fn from(error: crate::domain::Error) -> Self {
        Self(error.to_string())
    }
}

impl From<&str> for PeerError {
    fn from(message: &str) -> Self {
        Self(message.to_owned())
    }
}

/// The credentials and the trusted certificates that open connections.
pub(super) struct Credentials<'a> {
    pub(super) username: Option<&'a str>,
    /// How the user signs in to Kafka.
    pub(super) sasl_mechanism: Option<SaslMechanism>,
    pub(super) ca_certificate: Option<&'a str>,
    pub(super) secrets: &'a Secrets,
}

impl<'a> Credentials<'a> {
    /// Those of a user.
    pub(super) fn of(login: &'a Login, secrets: &'a Secrets) -> Self {
        let Login { username, ca_certificate } = login;
        Self { username: username.as_deref(), ..Self::trusting(ca_certificate.as_ref(), secrets) }
    }

    /// Those towards a peer without users, whose certificate is of that authority.
    pub(super) fn trusting(ca_certificate: Option<&'a String>, secrets: &'a Secrets) -> Self {
        let ca_certificate = ca_certificate.map(String::as_str);
        Self { username: None, sasl_mechanism: None, ca_certificate, secrets }
    }
}
