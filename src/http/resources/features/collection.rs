//! The collections, by their ids.

use std::fmt;
use std::str::FromStr;

use crate::app::App;
use crate::domain::{CameraId, Error, ErrorKind, Result};

/// A collection of features.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum CollectionId {
    Cameras,
    /// The samples of a camera.
    Samples(CameraId),
    /// The targets that are tracked in a camera's view.
    Tracks(CameraId),
}

const CAMERAS: &str = "cameras";
const SAMPLES: &str = "samples";
const TRACKS: &str = "tracks";

impl CollectionId {
    /// A title for people.
    pub(super) fn title(&self) -> String {
        match self {
            Self::Cameras => "Cameras".to_owned(),
            Self::Samples(camera) => format!("Samples of {camera}"),
            Self::Tracks(camera) => format!("Tracks of {camera}"),
        }
    }

    /// Returns the description of its features.
    pub(super) const fn description(&self) -> &'static str {
        match self {
            Self::Cameras => "Cameras; the geometry is the area on the ground that the active model covers",
            Self::Samples(_) => "Boxes that the camera learns from; the geometry is the fix",
            Self::Tracks(_) => "Targets that are tracked now; the geometry is the latest position",
        }
    }

    /// Refuses the collection of a camera that there is not.
    ///
    /// # Errors
    /// `CameraNotFound`.
    pub(super) async fn check(&self, app: &App) -> Result<()> {
        match self {
            Self::Cameras => Ok(()),
            Self::Samples(camera) | Self::Tracks(camera) => app.active_camera(camera).await.map(drop),
        }
    }
}

impl fmt::Display for CollectionId {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Cameras => out.write_str(CAMERAS),
            Self::Samples(camera) => write!(out, "{camera}.{SAMPLES}"),
            Self::Tracks(camera) => write!(out, "{camera}.{TRACKS}"),
        }
    }
}

impl FromStr for CollectionId {
    type Err = Error;

    fn from_str(text: &str) -> Result<Self> {
        let unknown = || {
            Error::refused(
                ErrorKind::RouteNotFound,
                "there is no such collection; /ogc/collections lists them",
            )
        };
        if text == CAMERAS {
            return Ok(Self::Cameras);
        }
        let (camera, kind) = text.rsplit_once('.').ok_or_else(unknown)?;
        let camera = CameraId::new(camera).map_err(|_| unknown())?;
        match kind {
            SAMPLES => Ok(Self::Samples(camera)),
            TRACKS => Ok(Self::Tracks(camera)),
            _ => Err(unknown()),
        }
    }
}

/// All collections.
pub(super) async fn all(app: &App) -> Result<Vec<CollectionId>> {
    let mut collections = vec![CollectionId::Cameras];
    let mut after: Option<CameraId> = None;
    loop {
        let page = app.cameras().list(None, after.as_ref(), app.limits.page_items).await?;
        for camera in page.items {
            let id = camera.id();
            collections.extend([CollectionId::Samples(id.clone()), CollectionId::Tracks(id.clone())]);
        }
        after = page.next;
        if after.is_none() {
            return Ok(collections);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ids_come_back_as_they_went() {
        for text in ["cameras", "gate.samples", "gate-2.tracks"] {
            assert_eq!(text.parse::<CollectionId>().expect("a collection").to_string(), text);
        }
        for text in ["", "gate", "gate.models", ".samples", "Gate.samples", "cameras.samples.samples"] {
            assert!(text.parse::<CollectionId>().is_err(), "{text}");
        }
    }
}
