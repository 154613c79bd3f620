//! Progress of long work: a bar on a terminal, plain lines elsewhere.

use std::io::IsTerminal as _;
use std::time::{Duration, Instant};

use indicatif::{ProgressBar, ProgressStyle};

/// Between two plain lines.
const LINE_EVERY: Duration = Duration::from_secs(2);

/// Shows how far a piece of work has come, on standard error.
pub(super) enum Progress {
    Bar(ProgressBar),
    Lines { said: Option<Instant> },
}

impl Progress {
    /// Nothing is done yet. The template says how the bar looks.
    pub(super) fn new(template: &str) -> Self {
        if std::io::stderr().is_terminal() {
            let style =
                ProgressStyle::with_template(template).unwrap_or_else(|_| ProgressStyle::default_bar());
            Self::Bar(ProgressBar::no_length().with_style(style))
        } else {
            Self::Lines { said: None }
        }
    }

    /// So much is done of so much, in words too.
    pub(super) fn set(&mut self, done: u64, of: u64, words: &str) {
        match self {
            Self::Bar(bar) => {
                bar.set_length(of);
                bar.set_position(done);
                bar.set_message(words.to_owned());
            }
            Self::Lines { said } => {
                if said.is_none_or(|said| said.elapsed() >= LINE_EVERY) {
                    *said = Some(Instant::now());
                    eprintln!("{done}/{of} {words}");
                }
            }
        }
    }

    /// The bar goes, the last line stays.
    pub(super) fn finish(self) {
        if let Self::Bar(bar) = self {
            bar.finish_and_clear();
        }
    }
}
