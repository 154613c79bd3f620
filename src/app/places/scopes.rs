//! The places of all scopes in memory.

use std::collections::HashMap;
use std::sync::Arc;

use crate::domain::{CameraId, Place, PlaceKey, Result, SiteId, TrackScope};
use crate::places::{self, PlaceIndex};
use crate::store::Store;

/// Places that are read at a time.
const PAGE: u32 = 1_000;

/// The places of all scopes, with the version of the store that they were read from.
#[derive(Default)]
pub(super) struct Scopes {
    cameras: HashMap<CameraId, Arc<PlaceIndex>>,
    sites: HashMap<SiteId, Arc<PlaceIndex>>,
    places: HashMap<PlaceKey, (TrackScope, Arc<places::Place>)>,
    mark: Option<[i64; 3]>,
}

impl Scopes {
    pub(super) fn of_camera(&self, id: &CameraId) -> Option<&Arc<PlaceIndex>> {
        self.cameras.get(id)
    }

    pub(super) fn of_site(&self, id: &SiteId) -> Option<&Arc<PlaceIndex>> {
        self.sites.get(id)
    }

    pub(super) fn of(&self, scope: &TrackScope) -> Option<&Arc<PlaceIndex>> {
        match scope {
            TrackScope::Camera(id) => self.of_camera(id),
            TrackScope::Site(id) => self.of_site(id),
        }
    }

    /// Reads what has changed in the store; `None` if nothing has.
    pub(super) async fn refreshed(&self, store: &Store) -> Result<Option<Self>> {
        let mark = store.places_mark().await?;
        if self.mark == Some(mark) {
            return Ok(None);
        }
        let mut places = HashMap::new();
        let mut after = None;
        loop {
            let page = store.places(None, after.as_ref(), PAGE).await?;
            after = page.last().map(|place| place.id().clone());
            let is_last = page.len() < PAGE as usize;
            for place in page {
                places.extend(self.prepared(&place).map(|it| (place.key, (place.profile.scope, it))));
            }
            if is_last {
                return Ok(Some(Self::of_places(places, mark)));
            }
        }
    }

    /// A place as it is known, or read anew; none if its settings cannot be evaluated.
    fn prepared(&self, place: &Place) -> Option<Arc<places::Place>> {
        let known = self.places.get(&place.key).map(|(_, known)| known);
        if let Some(known) = known.filter(|known| known.revision == place.revision) {
            return Some(known.clone());
        }
        let prepared = super::place_settings(place)
            .and_then(|settings| places::Place::new(place.key, place.id().clone(), place.revision, settings));
        prepared
            .map(Arc::new)
            .inspect_err(
                |error| tracing::error!(place.id = %place.id(), %error, "a stored place cannot be used"),
            )
            .ok()
    }

    fn of_places(places: HashMap<PlaceKey, (TrackScope, Arc<places::Place>)>, mark: [i64; 3]) -> Self {
        let mut by_scope: HashMap<&TrackScope, Vec<Arc<places::Place>>> = HashMap::new();
        for (scope, place) in places.values() {
            by_scope.entry(scope).or_default().push(place.clone());
        }
        let (mut cameras, mut sites) = (HashMap::new(), HashMap::new());
        for (scope, places) in by_scope {
            let index = Arc::new(PlaceIndex::new(places));
            match scope {
                TrackScope::Camera(id) => drop(cameras.insert(id.clone(), index)),
                TrackScope::Site(id) => drop(sites.insert(id.clone(), index)),
            }
        }
        Self { cameras, sites, places, mark: Some(mark) }
    }
}
