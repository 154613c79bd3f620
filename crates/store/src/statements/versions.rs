//! The versions of keys and cameras, which show if they have changed.

use crate::domain::Result;
use crate::query::{Session, query, query_as};
use crate::rows::cameras::{CameraVersion, read_version};
use crate::rows::keys::KeysVersion;

/// The version of the keys, which changes when a key does.
pub(crate) async fn keys_version(session: &mut dyn Session) -> Result<KeysVersion> {
    let (rows, revoked, latest) =
        query_as("SELECT count(*), count(revoked_at_us), max(id) FROM api_keys").fetch_one(session).await?;
    Ok(KeysVersion { rows, revoked, latest })
}

/// The version of every camera.
pub(crate) async fn all_versions(session: &mut dyn Session) -> Result<Vec<CameraVersion>> {
    let rows = query("SELECT id, key, revision, active_model FROM cameras").fetch_all(session).await?;
    rows.iter().map(read_version).collect()
}
