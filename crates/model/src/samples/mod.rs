//! Training samples as rows in a local plane, and the noise of their fixes over time.

pub(crate) mod mirroring;
pub(crate) mod rows;
pub(crate) mod second_differences;
pub(crate) mod sequences;
pub(crate) mod target_groups;
pub(crate) mod unpaired;
pub(crate) mod whitening;
