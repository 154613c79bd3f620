//! Progress of long operations: a bar on a terminal, plain lines otherwise.

use std::io::IsTerminal as _;
use std::time::{Duration, Instant};

use indicatif::{ProgressBar, ProgressStyle};

use super::output::{is_quiet, print_note};

/// Interval between plain lines.
const LINE_INTERVAL: Duration = Duration::from_secs(2);

/// Shows progress on standard error.
pub(super) enum Progress {
    Bar(ProgressBar),
    Lines { printed_at: Option<Instant> },
    Hidden,
}

impl Progress {
    /// No progress yet. The template is that of the bar (indicatif).
    pub(super) fn new(template: &str) -> Self {
        if is_quiet() {
            Self::Hidden
        } else if std::io::stderr().is_terminal() {
            let style =
                ProgressStyle::with_template(template).unwrap_or_else(|_| ProgressStyle::default_bar());
            Self::Bar(ProgressBar::no_length().with_style(style))
        } else {
            Self::Lines { printed_at: None }
        }
    }

    /// Shows that `done` of `total` is complete, with a message; a total of 0 is one that is not known.
    pub(super) fn set(&mut self, done: u64, total: u64, message: &str) {
        match self {
            Self::Bar(bar) => {
                if total > 0 {
                    bar.set_length(total);
                }
                bar.set_position(done);
                bar.set_message(message.to_owned());
            }
            Self::Lines { printed_at } => {
                if printed_at.is_none_or(|at| at.elapsed() >= LINE_INTERVAL) {
                    *printed_at = Some(Instant::now());
                    match (done, total) {
                        (0, 0) => print_note(message),
                        (_, 0) => print_note(format_args!("{done} {message}")),
                        _ => print_note(format_args!("{done}/{total} {message}")),
                    }
                }
            }
            Self::Hidden => {}
        }
    }

    /// Removes the bar.
    pub(super) fn finish(self) {
        if let Self::Bar(bar) = self {
            bar.finish_and_clear();
        }
    }
}
