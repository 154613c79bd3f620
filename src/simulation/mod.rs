//! Synthetic cameras, targets and receivers.
