//! Keys in paths, which are shown nowhere.

use std::borrow::Cow;

/// The key at the end of a path, of clients that cannot set headers: `/v1/connections/{connection}/messages/{key}`.
#[must_use]
pub fn path_key(path: &str) -> Option<&str> {
    let (messages, key) = path.rsplit_once('/')?;
    let connection = messages.strip_prefix("/v1/connections/")?.strip_suffix("/messages")?;
    (!connection.contains('/') && !key.is_empty()).then_some(key)
}

/// A path as it may be shown: without its key.
#[must_use]
pub fn shown_path(path: &str) -> Cow<'_, str> {
    match path_key(path).and_then(|key| path.strip_suffix(key)) {
        Some(before) => format!("{before}{{key}}").into(),
        None => path.into(),
    }
}
