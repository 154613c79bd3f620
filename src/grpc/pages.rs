//! Pages of lists: sizes, and tokens that say where the next page begins.

use base64::Engine as _;
use base64::engine::general_purpose::URL_SAFE_NO_PAD;
use jiff::Timestamp;

use crate::config::Limits;
use crate::domain::{CameraId, Error, Result, RunId, TargetId};
use crate::store::SampleKey;

/// Items on a page whose size the client leaves open.
const PAGE_ITEMS: u32 = 100;

/// Items on the page that is asked for.
pub(super) fn size(page_size: u32, limits: &Limits) -> Result<u32> {
    let most = limits.page_items;
    match page_size {
        0 => Ok(PAGE_ITEMS.min(most)),
        size if size <= most => Ok(size),
        _ => Err(Error::invalid("page_size", format!("must be at most {most}; 0 leaves it to the server"))),
    }
}

/// A place in a list, as text that clients only hand back.
pub(super) trait Cursor: Sized {
    fn to_text(&self) -> String;
    fn from_text(text: &str) -> Option<Self>;
}

/// The token of the next page; empty on the last.
pub(super) fn token<C: Cursor>(next: Option<&C>) -> String {
    next.map(|cursor| URL_SAFE_NO_PAD.encode(cursor.to_text())).unwrap_or_default()
}

/// Where the page begins; from the start for no token.
pub(super) fn cursor<C: Cursor>(token: &str) -> Result<Option<C>> {
    if token.is_empty() {
        return Ok(None);
    }
    let text = URL_SAFE_NO_PAD.decode(token).ok().and_then(|bytes| String::from_utf8(bytes).ok());
    match text.and_then(|text| C::from_text(&text)) {
        Some(cursor) => Ok(Some(cursor)),
        None => Err(Error::invalid("page_token", "must be the next_page_token of the page before")),
    }
}

impl Cursor for CameraId {
    fn to_text(&self) -> String {
        self.as_str().to_owned()
    }

    fn from_text(text: &str) -> Option<Self> {
        Self::new(text).ok()
    }
}

impl Cursor for RunId {
    fn to_text(&self) -> String {
        self.to_string()
    }

    fn from_text(text: &str) -> Option<Self> {
        text.parse().ok()
    }
}

/// Number of a model version.
impl Cursor for u32 {
    fn to_text(&self) -> String {
        self.to_string()
    }

    fn from_text(text: &str) -> Option<Self> {
        text.parse().ok()
    }
}

impl Cursor for SampleKey {
    fn to_text(&self) -> String {
        format!("{} {}", self.time.as_microsecond(), self.target_id)
    }

    fn from_text(text: &str) -> Option<Self> {
        let (time_us, target_id) = text.split_once(' ')?;
        Some(Self {
            time: Timestamp::from_microsecond(time_us.parse().ok()?).ok()?,
            target_id: TargetId::new(target_id).ok()?,
        })
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn a_sample_is_found_again(time_us in -1_000_000_000_i64..4_000_000_000_000_000, name in "[a-z ./é-]{0,20}[a-z]") {
            let Ok(target_id) = TargetId::new(&name) else { return Ok(()) };
            let key = SampleKey { time: Timestamp::from_microsecond(time_us).expect("in range"), target_id };
            prop_assert_eq!(cursor(&token(Some(&key))).expect("its own token"), Some(key));
        }

        #[test]
        fn what_is_no_token_is_refused_or_read(text in ".{1,40}") {
            if let Err(error) = cursor::<SampleKey>(&text) {
                prop_assert!(error.to_string().starts_with("page_token"));
            }
        }
    }

    #[test]
    fn pages_have_a_size() {
        let limits = Limits { page_items: 50, ..Limits::default() };
        assert_eq!(size(0, &limits).expect("left open"), 50);
        assert_eq!(size(7, &limits).expect("small"), 7);
        assert!(size(51, &limits).is_err());
    }
}
