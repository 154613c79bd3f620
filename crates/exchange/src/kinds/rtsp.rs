//! Streams of cameras by RTSP.

use super::fields::{Login, SourceFields};
use crate::address::{Address, Scheme};
use crate::domain::Result;
use crate::messages::MessageFormat;

pub(super) const SCHEMES: &[Scheme] = &[Scheme::url("rtsp", 554), Scheme::url("rtsps", 322).encrypted()];

/// The ONVIF metadata of a stream.
#[derive(Debug, Clone)]
pub struct RtspSource {
    /// The stream.
    pub address: Address,
    /// The user of the camera.
    pub login: Login,
}

impl RtspSource {
    pub(super) fn new(address: Address, fields: &mut SourceFields) -> Result<Self> {
        fields.require_format(MessageFormat::Onvif, "must be onvif for an address of rtsp: or rtsps:")?;
        Ok(Self { address, login: fields.login.take()? })
    }
}
