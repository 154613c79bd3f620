//! Sites.

use super::site_registry::SiteRegistry;
use super::{App, Page, page_of};
use crate::clock::Clock;
use crate::domain::{ExpectedVersion, NewSite, Result, Site, SiteChange, SiteId, SiteKey};
use crate::store::Store;

/// The use cases of sites.
#[derive(Clone, Copy)]
pub struct Sites<'a> {
    store: &'a Store,
    site_registry: &'a SiteRegistry,
    clock: &'a Clock,
}

impl App {
    /// The use cases of sites.
    #[must_use]
    pub fn sites(&self) -> Sites<'_> {
        Sites { store: &self.store, site_registry: &self.site_registry, clock: &self.clock }
    }
}

impl Sites<'_> {
    /// Stores a new site.
    ///
    /// # Errors
    /// `SiteExists`; `InvalidArgument` naming the field; `InsufficientStorage` beyond the limit of sites.
    pub async fn create(&self, profile: NewSite) -> Result<Site> {
        let site = self.store.insert_site(&profile.check()?, self.clock.now()).await?;
        self.site_registry.refresh_site(self.store, site.id()).await?;
        Ok(site)
    }

    /// One site.
    ///
    /// # Errors
    /// `SiteNotFound`.
    pub async fn get(&self, id: &SiteId) -> Result<Site> {
        self.store.site(id).await
    }

    /// Sites by id, after a cursor.
    ///
    /// # Errors
    /// A fault of the store.
    pub async fn list(&self, after: Option<&SiteId>, limit: u32) -> Result<Page<Site, SiteId>> {
        let sites = self.store.sites(after, limit + 1).await?;
        Ok(page_of(sites, limit, |site| site.id().clone()))
    }

    /// Changes a site, from the revision that the caller saw (any, if `None`).
    ///
    /// # Errors
    /// `SiteNotFound`, `RevisionMismatch`, `InvalidArgument` naming the field.
    pub async fn change(
        &self,
        id: &SiteId,
        change: SiteChange,
        expected: Option<ExpectedVersion<SiteKey>>,
    ) -> Result<Site> {
        let site = self.store.site(id).await?;
        // Changing what was read needs the revision that was read, whatever the caller said, so that two
        // changes at once cannot undo each other.
        let expected = expected.unwrap_or(site.version());
        let profile = change.apply(site.profile)?;
        let site = self.store.replace_site(&profile, Some(expected), self.clock.now()).await?;
        self.site_registry.refresh_site(self.store, id).await?;
        Ok(site)
    }

    /// Deletes a site that no camera belongs to, with its tracks.
    ///
    /// # Errors
    /// `SiteNotFound`, `RevisionMismatch`, `SiteInUse`.
    pub async fn delete(&self, id: &SiteId, expected: Option<ExpectedVersion<SiteKey>>) -> Result<()> {
        self.store.delete_site(id, expected, self.clock.now()).await?;
        self.site_registry.forget_site(id).await;
        Ok(())
    }
}
