//! Which rows are wanted.

use std::collections::BTreeSet;

use jiff::Timestamp;

use crate::domain::{ArchivedPosition, Error, Result, TargetClass, TargetId};
use crate::geo::{Outline, Position};

/// An area between two meridians and two parallels, degrees.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BoundingArea {
    west_deg: f64,
    south_deg: f64,
    east_deg: f64,
    north_deg: f64,
}

impl BoundingArea {
    /// From `[west, south, east, north]` in degrees, as GeoJSON orders them. West of an area across the antimeridian is
    /// greater than east.
    ///
    /// # Errors
    /// The field `bbox`, if the numbers are no such area.
    pub fn new([west_deg, south_deg, east_deg, north_deg]: [f64; 4]) -> Result<Self> {
        let corners = [Position::new(west_deg, south_deg), Position::new(east_deg, north_deg)];
        if corners.iter().any(|corner| corner.is_err()) || south_deg > north_deg {
            let message = "must be west,south,east,north in degrees: longitudes from -180 to 180, latitudes from -90 \
                           to 90, south at most north";
            return Err(Error::invalid("bbox", message));
        }
        Ok(Self { west_deg, south_deg, east_deg, north_deg })
    }

    pub(crate) fn contains(&self, longitude_deg: f64, latitude_deg: f64) -> bool {
        self.may_contain([longitude_deg; 2], [latitude_deg; 2])
    }

    /// False if it contains no position with a longitude and a latitude within those bounds.
    pub(crate) fn may_contain(&self, longitudes_deg: [f64; 2], latitudes_deg: [f64; 2]) -> bool {
        let reaches_west = longitudes_deg[1] >= self.west_deg;
        let reaches_east = longitudes_deg[0] <= self.east_deg;
        let longitude_fits = if self.west_deg <= self.east_deg {
            reaches_west && reaches_east
        } else {
            reaches_west || reaches_east
        };
        longitude_fits && latitudes_deg[1] >= self.south_deg && latitudes_deg[0] <= self.north_deg
    }
}

/// The rows that are wanted: those that every stated condition holds for.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Selection {
    /// Not before this instant.
    pub from: Option<Timestamp>,
    /// Before this instant.
    pub until: Option<Timestamp>,
    /// Within this area.
    pub area: Option<BoundingArea>,
    /// Within this area, of which `area` has the bounds.
    pub outline: Option<Outline>,
    /// Of this class.
    pub class: Option<TargetClass>,
    /// Of one of these targets; empty for all.
    pub targets: Vec<TargetId>,
    /// With targets: rows without a target are wanted too if they are of these tracks, whose target was known later.
    pub tracks_of_targets: BTreeSet<String>,
    /// Of this track.
    pub track: Option<String>,
}

impl Selection {
    pub(crate) fn contains(&self, row: &ArchivedPosition) -> bool {
        let position = row.position;
        self.from.is_none_or(|from| row.time >= from)
            && self.until.is_none_or(|until| row.time < until)
            && self.area.is_none_or(|it| it.contains(position.longitude_deg(), position.latitude_deg()))
            && self.outline.as_ref().is_none_or(|it| it.contains(position))
            && self.class.as_ref().is_none_or(|class| row.class.as_ref() == Some(class))
            && (self.targets.is_empty()
                || match &row.target {
                    Some(target) => self.targets.contains(target),
                    None => self.tracks_of_targets.contains(&row.track),
                })
            && self.track.as_ref().is_none_or(|track| row.track == *track)
    }
}
