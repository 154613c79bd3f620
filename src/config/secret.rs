//! Settings that are never shown.

use serde::{Deserialize, Serialize};

/// A setting that is never shown.
#[derive(Clone, PartialEq, Eq, Deserialize)]
#[serde(transparent)]
pub struct Secret(pub(super) String);

impl Secret {
    /// Returns the secret text.
    #[must_use]
    pub fn reveal(&self) -> &str {
        &self.0
    }
}

impl From<String> for Secret {
    fn from(text: String) -> Self {
        Self(text)
    }
}

const HIDDEN: &str = "(hidden)";

impl std::fmt::Debug for Secret {
    fn fmt(&self, out: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        out.write_str(HIDDEN)
    }
}

impl Serialize for Secret {
    fn serialize<S: serde::Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_str(HIDDEN)
    }
}

/// A connection with another system, by the JSON of its description. Its secrets are never shown.
#[derive(Clone, PartialEq, Deserialize)]
#[serde(transparent)]
pub struct DeclaredConnection(serde_json::Map<String, serde_json::Value>);

impl DeclaredConnection {
    /// The description as JSON, with its secrets.
    ///
    /// # Errors
    /// It cannot be written.
    pub fn json(&self) -> serde_json::Result<Vec<u8>> {
        serde_json::to_vec(&self.0)
    }

    fn without_secrets(&self) -> serde_json::Map<String, serde_json::Value> {
        let mut shown = self.0.clone();
        if let Some(secrets) = shown.get_mut("secrets") {
            *secrets = HIDDEN.into();
        }
        shown
    }
}

impl std::fmt::Debug for DeclaredConnection {
    fn fmt(&self, out: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        std::fmt::Debug::fmt(&self.without_secrets(), out)
    }
}

impl Serialize for DeclaredConnection {
    fn serialize<S: serde::Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        self.without_secrets().serialize(serializer)
    }
}
