//! Ids of what exists in memory only.

use std::fmt;
use std::str::FromStr;

use super::error::{Error, Result};

/// Id of a world track or of an event of a site. Numbers rise within an epoch, which lasts from one start of the
/// server to the next; an id of an earlier epoch names nothing any more. As text: `3f9a02c1-17`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct LiveId {
    /// Drawn at random when the epoch begins.
    pub epoch: u32,
    /// Number within the epoch, from 1.
    pub number: u64,
}

impl fmt::Display for LiveId {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(out, "{:08x}-{}", self.epoch, self.number)
    }
}

impl FromStr for LiveId {
    type Err = Error;

    fn from_str(text: &str) -> Result<Self> {
        let parse = || {
            let (epoch, number) = text.split_once('-')?;
            Some(Self { epoch: u32::from_str_radix(epoch, 16).ok()?, number: number.parse().ok()? })
        };
        // One text per id: other spellings of the same numbers name nothing.
        parse()
            .filter(|id| id.to_string() == text)
            .ok_or_else(|| Error::invalid("id", "must be an id as this server gave it, such as 3f9a02c1-17"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_id_is_read_as_it_was_written() {
        let id = LiveId { epoch: 0x00a0_02c1, number: 17 };
        assert_eq!(id.to_string(), "00a002c1-17");
        assert_eq!("00a002c1-17".parse::<LiveId>().expect("its own"), id);
        for wrong in ["", "17", "00a002c1", "00a002c1-", "a002c1-17", "00a002c1-+17", "00A002C1-17"] {
            assert!(wrong.parse::<LiveId>().is_err(), "{wrong}");
        }
    }
}
