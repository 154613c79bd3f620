//! From samples to a model: candidates on held-out blocks of time, then the final fit.

pub(crate) mod candidates;
pub(crate) mod fit;
