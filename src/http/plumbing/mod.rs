//! The parts that resources share: how a request is read and an answer written.

pub(super) mod access;
pub(super) mod body;
pub(super) mod body_coding;
pub(super) mod body_error;
pub(super) mod description;
pub(super) mod etag;
pub(super) mod extract;
pub(super) mod idempotency;
pub(super) mod merge_patch;
pub(super) mod parts;
pub(super) mod path_key;
pub(super) mod problem;
pub(super) mod state;
pub(super) mod wire;
