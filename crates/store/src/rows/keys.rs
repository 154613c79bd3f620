//! Rows of keys.

use crate::domain::{ApiKey, CameraId, Error, ErrorKind, Result, Role, Scope, SecretDigest};
use crate::row_decoder::{RowDecoder, StoredRow};

macro_rules! select_keys {
    ($rest:literal) => {
        concat!(
            "SELECT id, name, role, cameras, created_at_us, expires_at_us, last_used_at_us, revoked_at_us, \
             sha256 FROM api_keys ",
            $rest
        )
    };
}

/// Changes whenever a key is created, revoked or deleted.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct KeysVersion {
    pub(crate) rows: i64,
    pub(crate) revoked: i64,
    pub(crate) latest: Option<String>,
}

impl KeysVersion {
    /// True if no key was ever created.
    #[must_use]
    pub const fn is_empty(&self) -> bool {
        self.rows == 0
    }
}

pub(crate) fn read_key(row: &StoredRow) -> Result<(ApiKey, SecretDigest)> {
    let mut fields = RowDecoder::new("api_keys", row);
    let id = fields.parse(|id: &str| id.parse())?;
    let name = fields.get()?;
    let role = fields.parse(|role: &str| role.parse::<Role>())?;
    let scope = fields.parse(|cameras: &str| {
        let names: Vec<String> = serde_json::from_str(cameras).map_err(Error::fault)?;
        Scope::new(role, names.iter().map(|name| CameraId::new(name)).collect::<Result<_>>()?)
    })?;
    let key = ApiKey {
        id,
        name,
        scope,
        created_at: fields.timestamp()?,
        expires_at: fields.optional_timestamp()?,
        last_used_at: fields.optional_timestamp()?,
        revoked_at: fields.optional_timestamp()?,
    };
    let digest = fields.parse(|bytes: &[u8]| <[u8; 32]>::try_from(bytes))?;
    Ok((key, SecretDigest::from_bytes(digest)))
}

pub(crate) use select_keys;

/// Refuses a key if the largest number of keys is stored already.
pub(crate) fn check_limit(keys: i64, limit: u32) -> Result<()> {
    if keys < i64::from(limit) {
        return Ok(());
    }
    let message =
        format!("limits.keys is {limit}; revoke a key that is no longer needed, or raise the limit");
    Err(Error::refused(ErrorKind::InsufficientStorage, message))
}
