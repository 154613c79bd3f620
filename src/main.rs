//! The binary: parse, run, exit code.

use std::io::Write as _;
use std::process::ExitCode;

/// Small, short-lived allocations are most of what a request does.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

fn main() -> ExitCode {
    match sightfix::cli::Cli::from_arguments().run() {
        Ok(()) => ExitCode::SUCCESS,
        // The reader of standard output wants nothing further: not a failure.
        Err(_) if sightfix::cli::reader_is_gone() => ExitCode::SUCCESS,
        Err(error) => {
            // Unlike `eprintln!`, no panic where standard error is closed or full.
            let _ = writeln!(std::io::stderr(), "error: {error:#}");
            sightfix::cli::exit_code(&error)
        }
    }
}
