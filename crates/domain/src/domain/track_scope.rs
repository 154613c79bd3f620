//! Whose tracks.

use std::fmt;

use super::names::{CameraId, SiteId};

/// The camera or site whose tracks are meant.
#[derive(Debug, Clone, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum TrackScope {
    /// The world tracks of a site.
    Site(SiteId),
    /// The tracks of a camera.
    Camera(CameraId),
}

impl TrackScope {
    /// The id of the camera, if it is one.
    #[must_use]
    pub const fn camera(&self) -> Option<&CameraId> {
        match self {
            Self::Camera(id) => Some(id),
            Self::Site(_) => None,
        }
    }

    /// The id of the site, if it is one.
    #[must_use]
    pub const fn site(&self) -> Option<&SiteId> {
        match self {
            Self::Camera(_) => None,
            Self::Site(id) => Some(id),
        }
    }
}

impl fmt::Display for TrackScope {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Site(id) => write!(out, "site {id}"),
            Self::Camera(id) => write!(out, "camera {id}"),
        }
    }
}
