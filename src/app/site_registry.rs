//! Sites in memory, read without a lock.

use std::collections::HashMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use arc_swap::ArcSwap;
use tokio::sync::Mutex;

use super::live::site::state::SiteLive;
use crate::clock::Randomness;
use crate::domain::{ErrorKind, Result, Revision, Site, SiteId, SiteKey, TrackScope};
use crate::store::Store;

/// A site that exists.
pub struct ActiveSite {
    /// Which one of those that had this id.
    pub(super) key: SiteKey,
    /// Revision of the profile that this was made from.
    revision: Revision,
    /// Its tracks and events; the same as long as the site exists.
    pub(super) live: Arc<SiteLive>,
}

/// All sites, by id.
pub struct SiteRegistry {
    sites: ArcSwap<HashMap<SiteId, Arc<ActiveSite>>>,
    /// Held from reading the store to replacing the map, so that no change undoes a later one.
    change: Mutex<()>,
    /// True if the known sites may be of a history that the database has not; they are read again, whatever revision.
    is_distrusted: AtomicBool,
    randomness: Randomness,
    /// Events of a site that a reader may continue after.
    events_per_site: usize,
}

impl SiteRegistry {
    pub(super) fn new(randomness: Randomness, events_per_site: usize) -> Self {
        Self {
            sites: ArcSwap::default(),
            change: Mutex::default(),
            is_distrusted: AtomicBool::default(),
            randomness,
            events_per_site,
        }
    }

    /// A site; `None` if there is none of that id, or it was created a moment ago by another process.
    pub(super) fn get(&self, id: &SiteId) -> Option<Arc<ActiveSite>> {
        self.sites.load().get(id).cloned()
    }

    /// Brings one site up to date with the store.
    ///
    /// # Errors
    /// `SiteNotFound`; a fault if the store cannot be read.
    pub async fn refresh_site(&self, store: &Store, id: &SiteId) -> Result<Arc<ActiveSite>> {
        let _change = self.change.lock().await;
        match store.site(id).await {
            Ok(site) => Ok(self.insert(&site)),
            Err(error) => {
                if error.kind() == ErrorKind::SiteNotFound {
                    self.remove(id);
                }
                Err(error)
            }
        }
    }

    /// Brings all sites up to date, including changes of another process on the same file.
    ///
    /// # Errors
    /// A fault if the store cannot be read.
    pub async fn refresh(&self, store: &Store) -> Result<()> {
        let _change = self.change.lock().await;
        let is_distrusted = self.is_distrusted.swap(false, Ordering::AcqRel);
        let refreshed = self.read_all(store, is_distrusted).await;
        if refreshed.is_err() {
            self.is_distrusted.fetch_or(is_distrusted, Ordering::AcqRel);
        }
        refreshed
    }

    async fn read_all(&self, store: &Store, is_distrusted: bool) -> Result<()> {
        let versions = store.site_versions().await?;
        let keys: HashMap<_, _> = versions.iter().map(|(id, key, _)| (id, *key)).collect();
        let known = self.sites.load_full();
        for (id, _) in known.iter().filter(|(id, site)| keys.get(id) != Some(&site.key)) {
            self.remove(id);
        }
        for (id, key, revision) in &versions {
            let is_current = |site: &Arc<ActiveSite>| (site.key, site.revision) == (*key, *revision);
            if !is_distrusted && known.get(id).is_some_and(is_current) {
                continue;
            }
            match store.site(id).await {
                Ok(site) => drop(self.insert(&site)),
                Err(error) if error.kind() == ErrorKind::SiteNotFound => self.remove(id),
                Err(error) => return Err(error),
            }
        }
        Ok(())
    }

    /// Lets the next refresh read every site again, as [`super::Registry::distrust`] does.
    pub(super) fn distrust(&self) {
        self.is_distrusted.store(true, Ordering::Release);
    }

    /// Clears a site's tracks and events, since another node had its cameras in between.
    ///
    /// # Errors
    /// As [`SiteRegistry::refresh_site`].
    pub(super) async fn reset(&self, store: &Store, id: &SiteId) -> Result<()> {
        self.forget_site(id).await;
        self.refresh_site(store, id).await.map(drop)
    }

    /// Removes a deleted site and ends what listens to it.
    pub async fn forget_site(&self, id: &SiteId) {
        let _change = self.change.lock().await;
        self.remove(id);
    }

    /// Ends the tasks of all sites, for the server ends.
    pub(super) fn close(&self) {
        self.sites.load().values().for_each(|site| site.live.end());
    }

    fn insert(&self, site: &Site) -> Arc<ActiveSite> {
        let known = self.get(site.id());
        let same = known.as_ref().filter(|known| known.key == site.key);
        if let (Some(replaced), None) = (&known, same) {
            replaced.live.end();
        }
        let live = same.map_or_else(
            || {
                let mut epoch = [0; 4];
                self.randomness.fill(&mut epoch);
                SiteLive::new(u32::from_le_bytes(epoch), self.events_per_site)
            },
            |known| known.live.clone(),
        );
        live.set_origin(site.profile.origin);
        let scope = || TrackScope::Site(site.id().clone());
        live.set_history(site.profile.history.map(|settings| (scope(), settings)));
        let site = (site.id().clone(), Arc::new(ActiveSite { key: site.key, revision: site.revision, live }));
        self.sites.rcu(|sites| {
            let mut sites = HashMap::clone(sites);
            sites.insert(site.0.clone(), site.1.clone());
            sites
        });
        site.1
    }

    fn remove(&self, id: &SiteId) {
        if let Some(site) = self.get(id) {
            site.live.end();
        }
        self.sites.rcu(|sites| {
            let mut sites = HashMap::clone(sites);
            sites.remove(id);
            sites
        });
    }
}
