//! Statements on an open session that `entities` and the backends have in common.

pub(crate) mod audit;
pub(crate) mod idempotency;
pub(crate) mod sample_counts;
pub(crate) mod sample_retention;
pub(crate) mod versions;
