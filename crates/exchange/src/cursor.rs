//! Opaque pagination cursors.

use base64::Engine as _;
use base64::engine::general_purpose::URL_SAFE_NO_PAD;
use jiff::Timestamp;

use crate::domain::{
    AuditNumber, CameraId, ConnectionId, Error, EvaluationId, HistoryKey, KeyId, PlaceId, Result, RunId,
    SampleKey, SiteId, TargetId,
};

/// Largest accepted cursor, bytes.
const MAX_BYTES: usize = 512;

/// The key of the last item of a page, after which the next page begins.
pub trait Cursor: Sized {
    /// Name of the list, so that no list takes the cursor of another.
    const LIST: &'static str;

    /// The key as text.
    fn to_key(&self) -> String;

    /// The key that [`Cursor::to_key`] wrote.
    fn from_key(key: &str) -> Option<Self>;
}

/// A cursor as text.
#[must_use]
pub fn write_cursor<C: Cursor>(cursor: &C) -> String {
    URL_SAFE_NO_PAD.encode(format!("{}:{}", C::LIST, cursor.to_key()))
}

/// The cursor in a text that [`write_cursor`] gave.
///
/// # Errors
/// `InvalidArgument`, naming the field, for text that no page of this list gave.
pub fn read_cursor<C: Cursor>(field: &str, text: &str) -> Result<C> {
    let cursor = (text.len() <= MAX_BYTES)
        .then(|| URL_SAFE_NO_PAD.decode(text).ok())
        .flatten()
        .and_then(|bytes| String::from_utf8(bytes).ok())
        .and_then(|text| C::from_key(text.strip_prefix(C::LIST)?.strip_prefix(':')?));
    cursor.ok_or_else(|| Error::invalid(field, "must be what the page of this list before gave for the next"))
}

impl Cursor for CameraId {
    const LIST: &'static str = "cameras";

    fn to_key(&self) -> String {
        self.as_str().to_owned()
    }

    fn from_key(key: &str) -> Option<Self> {
        Self::new(key).ok()
    }
}

/// A sample's place in the list by time and target.
impl Cursor for SampleKey {
    const LIST: &'static str = "samples";

    fn to_key(&self) -> String {
        format!("{}:{}", self.time.as_microsecond(), self.target_id)
    }

    fn from_key(key: &str) -> Option<Self> {
        let (time_us, target_id) = key.split_once(':')?;
        Some(Self {
            time: Timestamp::from_microsecond(time_us.parse().ok()?).ok()?,
            target_id: TargetId::new(target_id).ok()?,
        })
    }
}

/// The place of a position in a history.
impl Cursor for HistoryKey {
    const LIST: &'static str = "history";

    fn to_key(&self) -> String {
        format!("{}:{}", self.time.as_nanosecond(), self.track)
    }

    fn from_key(key: &str) -> Option<Self> {
        let (time_ns, track) = key.split_once(':')?;
        let time = Timestamp::from_nanosecond(time_ns.parse().ok()?).ok()?;
        Some(Self { time, track: track.to_owned() })
    }
}

/// Target of a track.
impl Cursor for TargetId {
    const LIST: &'static str = "tracks";

    fn to_key(&self) -> String {
        self.as_str().to_owned()
    }

    fn from_key(key: &str) -> Option<Self> {
        Self::new(key).ok()
    }
}

impl Cursor for SiteId {
    const LIST: &'static str = "sites";

    fn to_key(&self) -> String {
        self.as_str().to_owned()
    }

    fn from_key(key: &str) -> Option<Self> {
        Self::new(key).ok()
    }
}

impl Cursor for PlaceId {
    const LIST: &'static str = "sites";

    fn to_key(&self) -> String {
        self.as_str().to_owned()
    }

    fn from_key(key: &str) -> Option<Self> {
        Self::new(key).ok()
    }
}

impl Cursor for ConnectionId {
    const LIST: &'static str = "connections";

    fn to_key(&self) -> String {
        self.as_str().to_owned()
    }

    fn from_key(key: &str) -> Option<Self> {
        Self::new(key).ok()
    }
}

impl Cursor for RunId {
    const LIST: &'static str = "training-runs";

    fn to_key(&self) -> String {
        self.to_string()
    }

    fn from_key(key: &str) -> Option<Self> {
        key.parse().ok()
    }
}

impl Cursor for EvaluationId {
    const LIST: &'static str = "evaluations";

    fn to_key(&self) -> String {
        self.to_string()
    }

    fn from_key(key: &str) -> Option<Self> {
        key.parse().ok()
    }
}

impl Cursor for KeyId {
    const LIST: &'static str = "keys";

    fn to_key(&self) -> String {
        self.to_string()
    }

    fn from_key(key: &str) -> Option<Self> {
        key.parse().ok()
    }
}

impl Cursor for AuditNumber {
    const LIST: &'static str = "audit";

    fn to_key(&self) -> String {
        self.0.to_string()
    }

    fn from_key(key: &str) -> Option<Self> {
        key.parse().ok().map(Self)
    }
}

/// Number of a model version.
impl Cursor for u32 {
    const LIST: &'static str = "models";

    fn to_key(&self) -> String {
        self.to_string()
    }

    fn from_key(key: &str) -> Option<Self> {
        key.parse().ok()
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn a_sample_is_found_again(time_us in -1_000_000_000_i64..4_000_000_000_000_000, name in "[a-z ./:é-]{0,20}[a-z]") {
            let Ok(target_id) = TargetId::new(&name) else { return Ok(()) };
            let key = SampleKey { time: Timestamp::from_microsecond(time_us).expect("in range"), target_id };
            prop_assert_eq!(read_cursor::<SampleKey>("cursor", &write_cursor(&key)).expect("its own"), key);
        }

        #[test]
        fn what_is_no_cursor_is_refused_or_read(text in ".{1,40}") {
            if let Err(error) = read_cursor::<SampleKey>("cursor", &text) {
                prop_assert!(error.to_string().starts_with("cursor"));
            }
        }
    }

    #[test]
    fn a_cursor_is_read_by_its_own_list_only() {
        let cursor = write_cursor(&7_u32);
        assert_eq!(read_cursor::<u32>("cursor", &cursor).expect("own"), 7);
        for foreign in ["", "*", "c2FtcGxlcw", cursor.as_str()] {
            let error = read_cursor::<CameraId>("page_token", foreign).expect_err(foreign);
            assert!(error.to_string().starts_with("page_token: "), "{error}");
        }
    }
}
