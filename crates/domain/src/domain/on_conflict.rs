//! The rule of an import for samples that are stored already.

use strum::{Display, EnumString, IntoStaticStr};

use super::error::Error;

/// The rule for a sample whose camera, target and time are stored already.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, Display, EnumString, IntoStaticStr)]
#[strum(serialize_all = "snake_case", parse_err_ty = Error, parse_err_fn = unknown_choice)]
pub enum OnConflict {
    /// It is counted as a duplicate and the stored one stays; but a sample with a fix replaces one
    /// without.
    #[default]
    Keep,
    /// It replaces the stored one.
    Replace,
}

fn unknown_choice(_: &str) -> Error {
    Error::invalid("on_conflict", "must be keep or replace")
}
