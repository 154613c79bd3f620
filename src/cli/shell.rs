//! `sightfix completions` and `sightfix man`: the command line described for shells and for `man`.

use std::io::Write as _;
use std::path::PathBuf;

use anyhow::Context as _;
use clap::{Args, CommandFactory as _};
use clap_complete::Shell;

use super::Cli;
use super::output::StandardOutput;

/// Print completions for a shell
///
/// For bash: sightfix completions bash > /etc/bash_completion.d/sightfix
#[derive(Args)]
pub(super) struct Completions {
    /// The shell
    #[arg(value_name = "SHELL")]
    shell: Shell,
}

impl Completions {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let mut script = Vec::new();
        clap_complete::generate(self.shell, &mut Cli::command(), "sightfix", &mut script);
        print(&script)
    }
}

/// Print the manual page, or write those of all subcommands to a folder
///
/// To read one: sightfix man | man -l -
#[derive(Args)]
pub(super) struct Man {
    /// Write a page per subcommand to this folder instead: sightfix.1, sightfix-import.1, ...
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
}

impl Man {
    pub(super) fn run(self) -> anyhow::Result<()> {
        if let Some(folder) = &self.out {
            let cannot = || format!("cannot write to {}", folder.display());
            std::fs::create_dir_all(folder).with_context(cannot)?;
            return clap_mangen::generate_to(Cli::command(), folder).with_context(cannot);
        }
        let mut page = Vec::new();
        clap_mangen::Man::new(Cli::command()).render(&mut page)?;
        print(&page)
    }
}

fn print(text: &[u8]) -> anyhow::Result<()> {
    let mut out = StandardOutput;
    out.write_all(text).and_then(|()| out.flush()).context("standard output cannot be written")
}
