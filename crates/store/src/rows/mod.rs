//! The rows, whatever the backend: the columns to select, the conversion into values of the domain, and
//! the rules that need no statement.

pub(super) mod audit;
pub(super) mod cameras;
pub(super) mod connections;
pub(super) mod evaluations;
pub(super) mod history;
pub(super) mod idempotency;
pub(super) mod keys;
pub(super) mod models;
pub(super) mod places;
pub(super) mod runs;
pub(super) mod samples;
pub(super) mod site_runs;
pub(super) mod sites;
