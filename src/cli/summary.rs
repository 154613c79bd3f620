//! The summary that a command prints when it is done: lines for people, or one JSON document for programs.

use std::fmt::Display;
use std::io::{self, Write as _};
use std::path::Path;

use clap::Args;

use super::files;
use super::output::{print_line, print_note};

/// The form of the summary that a command prints when it is done.
#[derive(Args)]
pub(super) struct SummaryFlags {
    /// Print the summary as one JSON document
    #[arg(long)]
    json: bool,
}

/// Where a summary goes: to standard error where standard output has the rows.
pub(super) struct Summary {
    as_json: bool,
    to_stderr: bool,
}

impl SummaryFlags {
    /// The summary of a command that writes its rows to a file, if it does.
    pub(super) fn summary(&self, rows: Option<&Path>) -> Summary {
        Summary { as_json: self.json, to_stderr: rows.is_some_and(files::is_standard) }
    }
}

impl Summary {
    /// Prints a line for people.
    pub(super) fn line(&self, text: &impl Display) -> anyhow::Result<()> {
        match (self.as_json, self.to_stderr) {
            (true, _) => Ok(()),
            (false, true) => {
                print_note(text);
                Ok(())
            }
            (false, false) => print_line(text),
        }
    }

    /// Prints the document for programs.
    pub(super) fn document(&self, document: &serde_json::Value) -> anyhow::Result<()> {
        match (self.as_json, self.to_stderr) {
            (false, _) => Ok(()),
            (true, true) => {
                let _ = writeln!(io::stderr().lock(), "{document}");
                Ok(())
            }
            (true, false) => print_line(document),
        }
    }
}
