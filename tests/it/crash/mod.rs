//! The real binary under a mixed load, killed again and again: it opens again, its database is whole, and
//! everything that it acknowledged is there.
//!
//! Ignored by default, since they take a minute each and need strace; `.ci/run` runs them as a step.

mod checks;
mod client;
mod kills;
mod load;
mod offline;
mod soak;

/// A number of the environment, for longer runs than the usual ones.
pub(crate) fn setting(name: &str, usual: u64) -> u64 {
    std::env::var(name).map_or(usual, |text| text.parse().unwrap_or_else(|_| panic!("{name}: {text}")))
}
