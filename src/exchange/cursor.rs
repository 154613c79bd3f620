//! Opaque pagination cursors.

use base64::Engine as _;
use base64::engine::general_purpose::URL_SAFE_NO_PAD;

use crate::domain::{Error, Result};

/// Largest accepted cursor, bytes.
const MAX_BYTES: usize = 512;

/// The cursor after the item with that key, for a list.
#[must_use]
pub fn write_cursor(list: &str, key: &str) -> String {
    URL_SAFE_NO_PAD.encode(format!("{list}:{key}"))
}

/// The key in a cursor of that list.
///
/// # Errors
/// Names the field `cursor` for text that is not a cursor of this list.
pub fn read_cursor(list: &str, cursor: &str) -> Result<String> {
    let key = (cursor.len() <= MAX_BYTES)
        .then(|| URL_SAFE_NO_PAD.decode(cursor).ok())
        .flatten()
        .and_then(|bytes| String::from_utf8(bytes).ok())
        .and_then(|text| text.strip_prefix(list)?.strip_prefix(':').map(str::to_owned));
    key.ok_or_else(foreign_cursor)
}

/// The refusal of text that is not a cursor of the list.
#[must_use]
pub fn foreign_cursor() -> Error {
    Error::invalid("cursor", "must be the next cursor returned with a page of this list")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_cursor_is_read_by_its_own_list_only() {
        let cursor = write_cursor("samples", "17:é");
        assert_eq!(read_cursor("samples", &cursor).expect("own"), "17:é");
        for foreign in ["", "*", "c2FtcGxlcw", cursor.as_str()] {
            assert!(read_cursor("cameras", foreign).is_err(), "{foreign}");
        }
    }
}
