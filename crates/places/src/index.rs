//! The places of one scope, found by where a track goes.

use std::collections::HashMap;
use std::sync::Arc;

use rstar::primitives::{GeomWithData, Rectangle};
use rstar::{AABB, RTree};

use crate::domain::{PlaceId, PlaceKey, Result, Revision};
use crate::geo::Position;
use crate::region::Region;
use crate::settings::PlaceSettings;

/// Metres of a degree of latitude, at least.
const METRES_PER_DEGREE: f64 = 110_500.0;

/// A place, ready to be evaluated.
#[derive(Debug, Clone)]
pub struct Place {
    /// Which one of those that had this id.
    pub key: PlaceKey,
    /// Its id.
    pub id: PlaceId,
    /// The revision of its settings.
    pub revision: Revision,
    /// Geometry, confidence and rules.
    pub settings: PlaceSettings,
    pub(crate) region: Region,
}

impl Place {
    /// A place of checked settings.
    ///
    /// # Errors
    /// `InvalidArgument`, naming the field of the settings that is wrong.
    pub fn new(key: PlaceKey, id: PlaceId, revision: Revision, settings: PlaceSettings) -> Result<Self> {
        let region = settings.check()?;
        Ok(Self { key, id, revision, settings, region })
    }

    /// Checks settings for a place that is not stored yet.
    ///
    /// # Errors
    /// As [`Place::new`].
    pub fn check(settings: &PlaceSettings) -> Result<()> {
        settings.check().map(drop)
    }
}

/// The places of one scope.
#[derive(Debug, Default)]
pub struct PlaceIndex {
    pub(crate) places: HashMap<PlaceKey, Arc<Place>>,
    tree: RTree<GeomWithData<Rectangle<[f64; 2]>, PlaceKey>>,
}

impl PlaceIndex {
    /// An index of places.
    #[must_use]
    pub fn new(places: impl IntoIterator<Item = Arc<Place>>) -> Self {
        let places: HashMap<_, _> = places.into_iter().map(|place| (place.key, place)).collect();
        let boxes = places.values().map(|place| {
            let [from, to] = place.region.bounds_deg();
            GeomWithData::new(Rectangle::from_corners(from, to), place.key)
        });
        Self { tree: RTree::bulk_load(boxes.collect()), places }
    }

    /// The places whose bounds a way from one position to another may touch, within a margin, m.
    pub(crate) fn near(
        &self,
        from: Position,
        to: Position,
        margin_m: f64,
    ) -> impl Iterator<Item = &Arc<Place>> {
        let margin_deg = margin_m / METRES_PER_DEGREE;
        let latitude_deg = from.latitude_deg().abs().max(to.latitude_deg().abs());
        let wide_deg = margin_deg / latitude_deg.min(89.0).to_radians().cos();
        let least = [
            from.longitude_deg().min(to.longitude_deg()) - wide_deg,
            from.latitude_deg().min(to.latitude_deg()) - margin_deg,
        ];
        let most = [
            from.longitude_deg().max(to.longitude_deg()) + wide_deg,
            from.latitude_deg().max(to.latitude_deg()) + margin_deg,
        ];
        let found = self.tree.locate_in_envelope_intersecting(&AABB::from_corners(least, most));
        found.filter_map(|it| self.places.get(&it.data))
    }
}
