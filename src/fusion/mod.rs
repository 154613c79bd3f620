//! Confidences, two-step fusion, pairing and tracks: pure functions and values.
