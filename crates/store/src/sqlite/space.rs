//! How much may be stored: limits on rows and bytes, what happens on a full disk, and freed pages
//! given back to it.

use std::sync::Arc;

use sqlx::{Sqlite, Transaction};

use super::Store;
use super::errors::failed;
use super::reserve::Reserve;
use super::writer::{Growth, WriterGuard};
use crate::domain::{Durability, Error, Result};
use crate::limits::{StorageStatus, StoreLimits, Usage};
use crate::statements::sample_counts::count_all_samples;

/// SQLite's own; the files of this store have never had another.
pub(super) const PAGE_BYTES: u64 = 4_096;

/// Free pages that are left in the file for the next imports.
const FREE_PAGES_KEPT: u64 = 1_024;

/// A full database counts as such until so much is free again.
const ROOM_BYTES: u64 = 1 << 20;

/// Limits and their state, shared by the store and the task that stores samples.
pub(super) struct Space {
    pub(super) usage: Usage,
    reserve: Reserve,
}

impl Space {
    pub(super) fn new(limits: StoreLimits, reserve: Reserve) -> Arc<Self> {
        Arc::new(Self { usage: Usage::new(limits), reserve })
    }

    /// On a full disk, releases the reserve, so that a server can open its database there: to be called with the
    /// server's lock, before anything is written.
    pub(super) async fn make_room_to_start(&self) -> Result<()> {
        let available_bytes = self.reserve.available_bytes().await?;
        if available_bytes.is_some_and(|bytes| bytes < ROOM_BYTES) {
            self.usage.found_full();
        }
        if self.reserve.is_disk_scarce().await? {
            let released_bytes = self.reserve.release().await?;
            tracing::warn!(
                available_bytes,
                released_bytes,
                "the disk is scarce: the reserve is released to start"
            );
        }
        Ok(())
    }

    /// Sets space aside when the database is open, before anything is stored.
    pub(super) async fn set_aside_at_start(&self) {
        match self.reserve.ensure().await {
            Ok(true) => {}
            Ok(false) => {
                tracing::warn!("the disk has no space for the reserve that deletions need when it is full")
            }
            Err(error) => tracing::warn!(%error, "no space is reserved for deletions on a full disk"),
        }
    }

    /// The size limit as SQLite counts it.
    pub(super) fn max_pages(limits: &StoreLimits) -> Option<u32> {
        limits.database_bytes.map(|bytes| u32::try_from(bytes / PAGE_BYTES).unwrap_or(u32::MAX - 1))
    }
}

/// The writer, locked to delete. On a full disk the reserve is released first, so that there is space
/// for the log of the deletion, and set aside again afterwards.
pub(crate) struct Deletion<'s> {
    store: &'s Store,
    writer: WriterGuard<'s>,
    was_scarce: bool,
}

impl Deletion<'_> {
    pub(crate) async fn begin(&mut self) -> Result<Transaction<'_, Sqlite>> {
        self.writer.begin().await
    }

    /// Gives the freed space back at once where the disk has none. To be called after the commit. After a failure here
    /// [`Store::maintain`] tries again.
    pub(crate) async fn reclaim(mut self) {
        let space = &self.store.inner.space;
        let reclaimed = async {
            if self.was_scarce {
                self.writer.execute("PRAGMA incremental_vacuum").await?;
                self.writer.execute("PRAGMA wal_checkpoint(TRUNCATE)").await?;
                space.reserve.ensure().await?;
            }
            self.store.count_all_samples().await
        };
        if let Err(error) = reclaimed.await {
            tracing::warn!(%error, "freed space could not be given back to the disk");
        }
    }
}

impl Store {
    /// The writer for a change that lets the database grow.
    pub(crate) async fn growing(&self) -> Result<WriterGuard<'_>> {
        self.inner.writer.lock(Durability::Synced, Growth::Limited).await
    }

    /// The writer for a deletion.
    pub(crate) async fn deletion(&self) -> Result<Deletion<'_>> {
        let mut writer = self.inner.writer.lock(Durability::Synced, Growth::Headroom).await?;
        let reserve = &self.inner.space.reserve;
        let was_scarce = reserve.is_disk_scarce().await?;
        if was_scarce {
            reserve.release().await?;
            // The log is copied back, and its space is free for the deletion when those who still read from it have
            // ended. If the space is not enough for the copy, it may be for the deletion.
            if let Err(error) = writer.execute("PRAGMA wal_checkpoint(TRUNCATE)").await {
                tracing::debug!(%error, "the log stays as it is");
            }
        }
        Ok(Deletion { store: self, writer, was_scarce })
    }

    /// True if imports are refused for want of space, as far as is known without looking.
    #[must_use]
    pub(crate) fn is_full(&self) -> bool {
        self.inner.space.usage.is_full()
    }

    pub(crate) async fn maintain(&self) -> Result<StorageStatus> {
        let space = &self.inner.space;
        self.log_newcomers();
        let is_reserved = self.set_space_aside().await?;
        self.vacuum().await?;
        self.count_all_samples().await?;
        let (pages, free_pages) = self.pages().await?;
        let disk_available_bytes = space.reserve.available_bytes().await?;
        let used_bytes = (pages - free_pages.min(pages)) * PAGE_BYTES;
        let has_room = space.usage.limits.database_bytes.is_none_or(|limit| used_bytes + ROOM_BYTES <= limit)
            && disk_available_bytes.is_none_or(|bytes| bytes + free_pages * PAGE_BYTES >= ROOM_BYTES);
        if is_reserved && has_room {
            space.usage.has_room();
        }
        Ok(StorageStatus {
            database_bytes: pages * PAGE_BYTES,
            free_bytes: free_pages * PAGE_BYTES,
            disk_available_bytes,
            samples: space.usage.samples(),
            queued_rows: self.inner.samples.queued_rows(),
            is_full: self.is_full(),
        })
    }

    /// Sets space aside while nobody writes: a deletion on a full disk needs what it has released until it ends.
    async fn set_space_aside(&self) -> Result<bool> {
        let _writer = self.changing(Durability::Relaxed).await?;
        self.inner.space.reserve.ensure().await
    }

    /// Gives some of the free pages back, few enough that nobody waits for long.
    async fn vacuum(&self) -> Result<()> {
        let (_, free_pages) = self.pages().await?;
        if free_pages <= FREE_PAGES_KEPT {
            return Ok(());
        }
        let mut writer = self.changing(Durability::Relaxed).await?;
        writer.execute("PRAGMA incremental_vacuum(4096)").await?;
        // The file becomes shorter when the log is copied back.
        writer.execute("PRAGMA wal_checkpoint(PASSIVE)").await
    }

    /// Pages of the database, and how many of them are free.
    async fn pages(&self) -> Result<(u64, u64)> {
        let (pages, free): (i64, i64) =
            sqlx::query_as("SELECT page_count, freelist_count FROM pragma_page_count, pragma_freelist_count")
                .fetch_one(self.readers())
                .await
                .map_err(failed)?;
        Ok((u64::try_from(pages).map_err(Error::fault)?, u64::try_from(free).map_err(Error::fault)?))
    }

    pub(super) async fn count_all_samples(&self) -> Result<()> {
        self.inner.space.usage.counted(count_all_samples(&mut *self.reader().await?).await?);
        Ok(())
    }
}
