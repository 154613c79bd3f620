//! What has happened to a change when it is acknowledged.

use std::fmt;
use std::str::FromStr;

use super::error::{Error, Result};

/// When stored samples are acknowledged. The order is that of the guarantee, the stronger last.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Default)]
pub enum Durability {
    /// After the commit. It survives a crash of the process; a power cut may undo the latest commits.
    Relaxed,
    /// After the commit has been flushed to the disk. It survives a power cut.
    #[default]
    Synced,
}

impl Durability {
    /// All of them.
    pub const ALL: [Self; 2] = [Self::Relaxed, Self::Synced];

    /// The one name used everywhere.
    #[must_use]
    pub const fn as_str(self) -> &'static str {
        match self {
            Self::Relaxed => "relaxed",
            Self::Synced => "synced",
        }
    }
}

impl fmt::Display for Durability {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        out.write_str(self.as_str())
    }
}

impl FromStr for Durability {
    type Err = Error;

    fn from_str(name: &str) -> Result<Self> {
        Self::ALL
            .into_iter()
            .find(|durability| durability.as_str() == name)
            .ok_or_else(|| Error::invalid("durability", "must be synced or relaxed"))
    }
}
