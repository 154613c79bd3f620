//! Text cells of CSV that a spreadsheet would run as a formula.
//!
//! Spreadsheets take a cell that begins with `=`, `+`, `-` or `@` for a formula, and ids come from
//! clients. Such a text is written after an apostrophe and read back without it; what begins with
//! apostrophes before one of these gets one more, so that every text comes back as it went.

use std::borrow::Cow;

const GUARD: char = '\'';

/// The text as a cell that no spreadsheet runs.
pub(super) fn guarded(text: &str) -> Cow<'_, str> {
    if begins_formula(text) { Cow::Owned(format!("{GUARD}{text}")) } else { Cow::Borrowed(text) }
}

/// The text of a cell that [`guarded`] may have written.
pub(super) fn unguarded(cell: &str) -> &str {
    cell.strip_prefix(GUARD).filter(|text| begins_formula(text)).unwrap_or(cell)
}

fn begins_formula(text: &str) -> bool {
    text.trim_start_matches(GUARD).starts_with(['=', '+', '-', '@'])
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn every_text_comes_back_and_none_is_a_formula(text in "['=+@a-]{0,6}") {
            let cell = guarded(&text);
            prop_assert_eq!(unguarded(&cell), text.as_str());
            prop_assert!(!cell.starts_with(['=', '+', '-', '@']), "{}", cell);
        }
    }
}
