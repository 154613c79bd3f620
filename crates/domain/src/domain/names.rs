//! Names chosen by operators, detectors and receivers.

use std::collections::BTreeMap;
use std::fmt;
use std::sync::Arc;

use super::error::{Error, Result};

/// Largest length of a name, bytes.
const MAX_NAME_BYTES: usize = 128;

/// A newtype for an id that the operator chooses: a slug of 1 to 63 of `a-z0-9-`, beginning and ending with a
/// letter or digit.
macro_rules! slug {
    ($(#[$doc:meta])* $name:ident) => {
        $(#[$doc])*
        #[derive(Debug, Clone, PartialEq, Eq, Hash, PartialOrd, Ord)]
        pub struct $name(Arc<str>);

        impl $name {
            /// # Errors
            /// Refuses what is not such a slug; the field is named `id`.
            pub fn new(id: &str) -> Result<Self> {
                check_slug(id)?;
                Ok(Self(id.into()))
            }

            /// The slug.
            #[must_use]
            pub fn as_str(&self) -> &str {
                &self.0
            }
        }

        /// Lets maps keyed by such ids be queried with text.
        impl std::borrow::Borrow<str> for $name {
            fn borrow(&self) -> &str {
                &self.0
            }
        }

        impl fmt::Display for $name {
            fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
                out.write_str(&self.0)
            }
        }
    };
}

slug!(
    /// Id of a camera: a slug of 1 to 63 of `a-z0-9-`, beginning and ending with a letter or digit.
    CameraId
);
slug!(
    /// Id of a site: a slug like that of a camera.
    SiteId
);
slug!(
    /// Id of a connection with another system: a slug like that of a camera.
    ConnectionId
);
slug!(
    /// Id of a place: a slug like that of a camera.
    PlaceId
);

fn check_slug(id: &str) -> Result<()> {
    let inner = |byte: u8| byte.is_ascii_lowercase() || byte.is_ascii_digit() || byte == b'-';
    let well_formed =
        (1..=63).contains(&id.len()) && id.bytes().all(inner) && !id.starts_with('-') && !id.ends_with('-');
    if well_formed {
        Ok(())
    } else {
        Err(Error::invalid("id", "must be 1 to 63 of a-z, 0-9 and -, not beginning or ending with -"))
    }
}

/// Before the id of a tracker in that of its target.
const TRACKER_PREFIX: &str = "tracker:";

/// A newtype for printable, trimmed text of limited length.
macro_rules! name {
    ($(#[$doc:meta])* $name:ident, $field:literal, $max_bytes:expr) => {
        $(#[$doc])*
        #[derive(Debug, Clone, PartialEq, Eq, Hash, PartialOrd, Ord)]
        pub struct $name(Arc<str>);

        impl $name {
            /// # Errors
            /// Refuses text that is empty, too long, padded, or contains control characters.
            pub fn new(text: &str) -> Result<Self> {
                check_text($field, text, $max_bytes)?;
                Ok(Self(text.into()))
            }

            /// The text.
            #[must_use]
            pub fn as_str(&self) -> &str {
                &self.0
            }
        }

        impl fmt::Display for $name {
            fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
                out.write_str(&self.0)
            }
        }
    };
}

name!(
    /// Id of a target, chosen by the detector or the receiver. 1 to 128 bytes.
    TargetId,
    "target_id",
    MAX_NAME_BYTES
);
name!(
    /// Id of a GNSS receiver, chosen by the operator or the receiver. 1 to 128 bytes.
    ReceiverId,
    "receiver_id",
    MAX_NAME_BYTES
);
name!(
    /// Number that a camera's tracker gave the boxes of one target. 1 to 120 bytes.
    TrackerId,
    "tracker_id",
    MAX_NAME_BYTES - TRACKER_PREFIX.len()
);
name!(
    /// Class of a target: `person`, `car`, `aircraft`. 1 to 128 bytes.
    TargetClass,
    "class",
    MAX_NAME_BYTES
);

/// A receiver that is not mapped to a target has its own id as target id.
impl From<ReceiverId> for TargetId {
    fn from(receiver_id: ReceiverId) -> Self {
        Self(receiver_id.0)
    }
}

impl TargetId {
    /// The number of the tracker as it was sent, if that names the target, else the target's name.
    #[must_use]
    pub fn as_sent(&self) -> &str {
        self.as_str().strip_prefix(TRACKER_PREFIX).unwrap_or(self.as_str())
    }
}

/// A box whose target is not known has a target of its own, which no receiver's fixes are taken for.
impl From<&TrackerId> for TargetId {
    fn from(tracker_id: &TrackerId) -> Self {
        Self(format!("{TRACKER_PREFIX}{tracker_id}").into())
    }
}

/// Where all receivers of a target count as one, the target's id names it.
impl From<TargetId> for ReceiverId {
    fn from(target_id: TargetId) -> Self {
        Self(target_id.0)
    }
}

/// Checks free text for a field.
///
/// # Errors
/// Names the field if the text is empty, longer than `max_bytes`, padded with white space, or
/// contains control characters.
pub fn check_text(field: &str, text: &str, max_bytes: usize) -> Result<()> {
    let fits = !text.is_empty() && text.len() <= max_bytes;
    if fits && text.trim() == text && !text.chars().any(char::is_control) {
        Ok(())
    } else {
        Err(Error::invalid(
            field,
            format!(
                "must be text of 1 to {max_bytes} bytes without control characters or white space around it"
            ),
        ))
    }
}

/// Labels that something may have.
pub const MAX_LABELS: usize = 64;

/// Checks free-form labels: at most [`MAX_LABELS`], keys of at most 63 bytes, values of at most 255.
///
/// # Errors
/// Names the invalid label under `labels`.
pub fn check_labels(labels: &BTreeMap<String, String>) -> Result<()> {
    if labels.len() > MAX_LABELS {
        return Err(Error::invalid("labels", format!("must be at most {MAX_LABELS}")));
    }
    for (key, value) in labels {
        check_text(&format!("labels.{key}"), key, 63)?;
        if value.len() > 255 || value.chars().any(char::is_control) {
            return Err(Error::invalid(
                format!("labels.{key}"),
                "must be at most 255 bytes without control characters",
            ));
        }
    }
    Ok(())
}
