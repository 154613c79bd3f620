//! The encoders of the recipes: from a box to a position, and back to the box that belongs to it.

pub(crate) mod hybrid;
pub(crate) mod paper;
pub(crate) mod projection;
pub(crate) mod projective;
