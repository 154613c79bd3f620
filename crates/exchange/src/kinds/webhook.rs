//! Receivers of HTTP requests.

use super::fields::SinkFields;
use crate::address::{Address, Scheme};
use crate::domain::Result;

pub(super) const SCHEMES: &[Scheme] = &[Scheme::url("http", 80), Scheme::url("https", 443).encrypted()];

/// A receiver of requests.
#[derive(Debug, Clone)]
pub struct WebhookSink {
    /// Its URL.
    pub address: Address,
    /// Authority of its certificate (PEM).
    pub ca_certificate: Option<String>,
}

impl WebhookSink {
    pub(super) fn new(address: Address, fields: &mut SinkFields) -> Self {
        Self { address, ca_certificate: fields.login.ca_certificate.take() }
    }
}

impl Address {
    /// Reads an address of HTTP or HTTPS.
    ///
    /// # Errors
    /// `InvalidArgument` naming `address`.
    pub fn of_http(text: &str) -> Result<Self> {
        Self::parse(text, &[(SCHEMES, ())]).map(|(address, ())| address)
    }
}
