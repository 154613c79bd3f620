//! Rows of the audit log.

use std::net::IpAddr;

use crate::domain::{Actor, AuditAction, AuditEntry, AuditNumber, CameraId, KeyId, Result};
use crate::row_decoder::{RowDecoder, StoredRow};

/// A change, for the audit log.
pub struct Change<'a> {
    pub(crate) action: AuditAction,
    pub(crate) camera: Option<&'a CameraId>,
    pub(crate) subject: Option<String>,
}

impl<'a> Change<'a> {
    /// A change of a camera, or of something that belongs to it.
    pub(crate) fn of_camera(action: AuditAction, camera: &'a CameraId, subject: Option<String>) -> Self {
        Self { action, camera: Some(camera), subject }
    }

    /// Any other change.
    pub(crate) const fn of(action: AuditAction, subject: String) -> Self {
        Self { action, camera: None, subject: Some(subject) }
    }
}

/// A model version as the subject of a change.
pub(crate) fn version(number: impl std::fmt::Display) -> String {
    format!("version {number}")
}

pub(crate) fn read_entry(row: &StoredRow) -> Result<AuditEntry> {
    let mut fields = RowDecoder::new("audit_log", row);
    Ok(AuditEntry {
        number: AuditNumber(fields.parse(|number: i64| u64::try_from(number))?),
        time: fields.timestamp()?,
        actor: Actor {
            name: fields.get::<String>()?.into(),
            key_id: fields.parse_optional(|id: &str| id.parse::<KeyId>())?,
            identity: None,
            address: fields.parse_optional(|address: &str| address.parse::<IpAddr>())?,
            request_id: fields.get::<Option<String>>()?.map(Into::into),
        },
        action: fields.parse(|action: &str| action.parse::<AuditAction>())?,
        camera_id: fields.parse_optional(CameraId::new)?,
        subject: fields.get()?,
    })
}
