//! Rows that were rejected: each reason once, with the lines that have it.

use super::output::print_note;
use crate::exchange::RowError;

/// Lines that are named per reason; the others are counted.
const MOST_LINES: usize = 3;
/// Rows of which the reasons are kept; the others are counted.
const MOST_ROWS: usize = 100;

/// The rejected rows of a file that is read row by row.
#[derive(Default)]
pub(super) struct RejectedRows {
    pub(super) count: u64,
    rows: Vec<RowError>,
}

impl RejectedRows {
    pub(super) fn push(&mut self, row: RowError) {
        self.count += 1;
        if self.rows.len() < MOST_ROWS {
            self.rows.push(row);
        }
    }

    /// Tells the reasons as notes, each after `prefix`.
    pub(super) fn print(&self, prefix: &str) {
        print_reasons(prefix, &self.rows, self.count);
    }
}

/// Tells the reasons of the first of `count` rows as notes, each after `prefix`.
pub(super) fn print_reasons<'a>(prefix: &str, rows: impl IntoIterator<Item = &'a RowError>, count: u64) {
    let mut shown = 0;
    for reason in reasons(rows.into_iter().inspect(|_| shown += 1)) {
        print_note(format_args!("{prefix}{reason}"));
    }
    if count > shown {
        print_note(format_args!("{prefix}... and {} more", count - shown));
    }
}

/// Sentences such as `lines 2, 6, 10 and 47 more: width: must be above 0`, in the order of their first lines.
pub(super) fn reasons<'a>(rows: impl IntoIterator<Item = &'a RowError>) -> Vec<String> {
    let mut reasons: Vec<(String, Vec<u64>)> = Vec::new();
    for RowError { line, field, reason } in rows {
        let reason = format!("{field}: {reason}");
        match reasons.iter_mut().find(|(known, _)| *known == reason) {
            Some((_, lines)) => lines.push(*line),
            None => reasons.push((reason, vec![*line])),
        }
    }
    reasons.iter().map(|(reason, lines)| format!("{}: {reason}", named(lines))).collect()
}

fn named(lines: &[u64]) -> String {
    let word = if lines.len() == 1 { "line" } else { "lines" };
    let shown: Vec<_> = lines.iter().take(MOST_LINES).map(u64::to_string).collect();
    let shown = shown.join(", ");
    match lines.len().saturating_sub(MOST_LINES) {
        0 => format!("{word} {shown}"),
        more => format!("{word} {shown} and {more} more"),
    }
}
