//! Pages of lists: sizes, and tokens of the next page.

use crate::config::Limits;
use crate::domain::{Error, Result};
use crate::exchange::{Cursor, read_cursor, write_cursor};

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

/// The token of the next page; empty on the last.
pub(super) fn token<C: Cursor>(next: Option<&C>) -> String {
    next.map(write_cursor).unwrap_or_default()
}

/// Where the page begins; from the start for no token.
pub(super) fn cursor<C: Cursor>(token: &str) -> Result<Option<C>> {
    if token.is_empty() { Ok(None) } else { read_cursor("page_token", token).map(Some) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pages_have_a_size() {
        let limits = Limits { page_items: 50, ..Limits::default() };
        assert_eq!(size(0, &limits).expect("left open"), 50);
        assert_eq!(size(7, &limits).expect("small"), 7);
        assert!(size(51, &limits).is_err());
    }
}
