//! The binary: parse, run, exit code.

use std::process::ExitCode;

/// Small, short-lived allocations are most of what a request does.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

fn main() -> ExitCode {
    match sightfix::cli::Cli::from_arguments().run() {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error:#}");
            sightfix::cli::exit_code(&error)
        }
    }
}
