//! The daemon of GNSS receivers, gpsd.

use super::fields::SourceFields;
use crate::address::{Address, Scheme};
use crate::domain::Result;
use crate::messages::MessageFormat;

pub(super) const SCHEMES: &[Scheme] = &[Scheme::host("gpsd", Some(2947))];

/// Reports of a daemon.
#[derive(Debug, Clone)]
pub struct GpsdSource {
    /// Where it listens.
    pub address: Address,
}

impl GpsdSource {
    pub(super) fn new(address: Address, fields: &SourceFields) -> Result<Self> {
        fields.require_format(MessageFormat::Gpsd, "must be gpsd for an address of gpsd:")?;
        Ok(Self { address })
    }
}
