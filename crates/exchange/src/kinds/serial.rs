//! Serial devices of the server's machine.

use crate::address::{Address, Scheme, invalid};
use crate::domain::Result;

pub(super) const SCHEMES: &[Scheme] = &[Scheme::device("serial")];

/// A serial device with the speed of its line.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SerialLine {
    /// Its path, below `/dev/`.
    pub path: std::path::PathBuf,
    /// Bits per second.
    pub baud: u32,
}

impl SerialLine {
    /// Speed of NMEA 0183; AIS receivers have 38400.
    const NMEA_BAUD: u32 = 4_800;
    const BAUDS: [u32; 9] = [4_800, 9_600, 19_200, 38_400, 57_600, 115_200, 230_400, 460_800, 921_600];

    /// The device of an address such as `serial:///dev/ttyUSB0?baud=4800`.
    pub(super) fn new(address: &Address) -> Result<Self> {
        let (path, query) = address
            .path
            .split_once('?')
            .map_or((address.path.as_str(), None), |(path, query)| (path, Some(query)));
        let is_device = path.strip_prefix("/dev/").is_some_and(|rest| {
            !rest.is_empty() && rest.split('/').all(|part| !matches!(part, "" | "." | ".."))
        });
        if !is_device || path.contains(char::is_control) {
            return Err(invalid("must name a device below /dev/, such as serial:///dev/ttyUSB0?baud=4800"));
        }
        let baud = match query {
            None => Some(Self::NMEA_BAUD),
            Some(query) => query.strip_prefix("baud=").and_then(|baud| baud.parse().ok()),
        };
        let baud = baud.filter(|baud| Self::BAUDS.contains(baud));
        let baud = baud.ok_or_else(|| {
            let known: Vec<String> = Self::BAUDS.iter().map(u32::to_string).collect();
            invalid(&format!("must end after the device, or with ?baud= and one of {}", known.join(", ")))
        })?;
        Ok(Self { path: path.into(), baud })
    }
}
