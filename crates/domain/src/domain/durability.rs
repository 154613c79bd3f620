//! The guarantee for stored samples when they are acknowledged.

use strum::{Display, EnumString, IntoStaticStr};

use super::error::Error;

/// When stored samples are acknowledged. The order is that of the guarantees, the stronger last.
#[derive(
    Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Default, Display, EnumString, IntoStaticStr,
)]
#[strum(serialize_all = "snake_case", parse_err_ty = Error, parse_err_fn = unknown_durability)]
pub enum Durability {
    /// After the commit. Survives a crash of the process; a power cut may undo the latest commits.
    Relaxed,
    /// After the commit has been flushed to the disk. Survives a power cut.
    #[default]
    Synced,
}

fn unknown_durability(_: &str) -> Error {
    Error::invalid("durability", "must be synced or relaxed")
}
