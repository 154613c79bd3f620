//! How much may be stored: limits on rows and bytes, what happens on a full disk, and freed pages
//! given back to it.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};

use sqlx::{Sqlite, Transaction};

use super::Store;
use super::errors::failed;
use super::reserve::Reserve;
use super::writer::{Growth, WriterGuard};
use crate::domain::{CameraId, Durability, Error, ErrorKind, Result, SampleOverflow};

/// SQLite's own; the files of this store have never had another.
const PAGE_BYTES: u64 = 4_096;

/// Free pages that are left in the file for the next imports.
const FREE_PAGES_KEPT: u64 = 1_024;

/// A full database counts as such until so much is free again.
const ROOM_BYTES: u64 = 1 << 20;

/// What an operator allows the store to hold. The default allows everything and reserves nothing.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct StoreLimits {
    /// Cameras; more are refused.
    pub cameras: u32,
    /// Sites; more are refused.
    pub sites: u32,
    /// Connections with other systems; more are refused.
    pub outside_connections: u32,
    /// Waiting messages of one connection; beyond, the oldest is dropped.
    pub outbox_messages: u32,
    /// Dead letters of one connection; beyond, the oldest is deleted.
    pub dead_letters: u32,
    /// Samples of one camera.
    pub samples_per_camera: u64,
    /// What happens beyond that.
    pub sample_overflow: SampleOverflow,
    /// Samples of all cameras; more are refused.
    pub samples: u64,
    /// Model versions of one camera; beyond, the oldest that is not active is deleted.
    pub models_per_camera: u32,
    /// Ended training runs of one camera; beyond, the oldest is deleted.
    pub ended_runs_per_camera: u32,
    /// Ended evaluations of all cameras; beyond, the oldest is deleted.
    pub ended_evaluations: u32,
    /// Keys; those that no longer work make room for new ones, else more are refused.
    pub keys: u32,
    /// Entries of the audit log; beyond, the oldest is deleted.
    pub audit_entries: u32,
    /// Stored answers of repeatable changes; beyond, the oldest is deleted.
    pub idempotency_keys: u32,
    /// Seconds for which such an answer is repeated.
    pub idempotency_key_s: u32,
    /// Bytes of the database, if limited.
    pub database_bytes: Option<u64>,
    /// Bytes on the disk that are reserved for deletions when it is full.
    pub reserve_bytes: u64,
}

impl Default for StoreLimits {
    fn default() -> Self {
        Self {
            cameras: u32::MAX,
            sites: u32::MAX,
            outside_connections: u32::MAX,
            outbox_messages: u32::MAX,
            dead_letters: u32::MAX,
            samples_per_camera: u64::MAX,
            sample_overflow: SampleOverflow::Refuse,
            samples: u64::MAX,
            models_per_camera: u32::MAX,
            ended_runs_per_camera: u32::MAX,
            ended_evaluations: u32::MAX,
            keys: u32::MAX,
            audit_entries: u32::MAX,
            idempotency_keys: u32::MAX,
            idempotency_key_s: u32::MAX,
            database_bytes: None,
            reserve_bytes: 0,
        }
    }
}

/// How much is stored, and whether more can be.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct StorageStatus {
    /// Size of the database, without its write-ahead log.
    pub database_bytes: u64,
    /// Of these, free for new rows.
    pub free_bytes: u64,
    /// Left on the disk; `None` where the system does not tell.
    pub disk_available_bytes: Option<u64>,
    /// Samples of all cameras.
    pub samples: u64,
    /// Samples that wait to be stored, or are being stored.
    pub queued_rows: u32,
    /// The latest import was refused for want of space, and none has become free since.
    pub is_full: bool,
}

/// Limits and their state, shared by the store and the task that stores samples.
pub(super) struct Space {
    pub(super) limits: StoreLimits,
    reserve: Reserve,
    /// Samples of all cameras: those counted last, and those stored since.
    samples: AtomicU64,
    is_full: AtomicBool,
}

impl Space {
    pub(super) fn new(limits: StoreLimits, reserve: Reserve) -> Arc<Self> {
        let (samples, is_full) = (AtomicU64::new(0), AtomicBool::new(false));
        Arc::new(Self { limits, reserve, samples, is_full })
    }

    /// The size limit as SQLite counts it.
    pub(super) fn max_pages(limits: &StoreLimits) -> Option<u32> {
        limits.database_bytes.map(|bytes| u32::try_from(bytes / PAGE_BYTES).unwrap_or(u32::MAX - 1))
    }

    /// What one transaction may add.
    pub(super) fn quota(&self) -> SampleQuota<'_> {
        SampleQuota { limits: &self.limits, samples: self.samples.load(Ordering::Relaxed) }
    }

    /// Samples were committed.
    pub(super) fn stored(&self, accepted: u64) {
        self.samples.fetch_add(accepted, Ordering::Relaxed);
        if accepted > 0 {
            self.is_full.store(false, Ordering::Relaxed);
        }
    }

    /// Samples could not be committed.
    pub(super) fn failed(&self, error: &Error) {
        if error.kind() == ErrorKind::InsufficientStorage && !self.is_full.swap(true, Ordering::Relaxed) {
            tracing::error!("there is no space for more samples; imports are refused until some is freed");
        }
    }
}

/// Admits rows of one transaction.
pub(super) struct SampleQuota<'s> {
    limits: &'s StoreLimits,
    /// Stored, and admitted before.
    samples: u64,
}

impl SampleQuota<'_> {
    /// Admits a batch of a camera that has so many samples, and counts it. Rows that will turn out to
    /// be duplicates count, too.
    pub(super) fn admit(&mut self, id: &CameraId, of_camera: &mut u64, rows: u64) -> Result<()> {
        let StoreLimits { samples_per_camera, sample_overflow, samples, .. } = *self.limits;
        let is_refused = sample_overflow == SampleOverflow::Refuse;
        if is_refused && of_camera.saturating_add(rows) > samples_per_camera {
            return Err(limit_reached(format!(
                "camera {id} has {of_camera} samples, and limits.samples_per_camera is {samples_per_camera}"
            )));
        }
        if self.samples.saturating_add(rows) > samples {
            return Err(limit_reached(format!(
                "{} samples are stored, and limits.samples is {samples}",
                self.samples
            )));
        }
        *of_camera += rows;
        self.samples += rows;
        Ok(())
    }
}

fn limit_reached(found: String) -> Error {
    Error::refused(
        ErrorKind::InsufficientStorage,
        format!("{found}; delete samples that are no longer needed, or raise the limit"),
    )
}

/// The writer, locked to delete. On a full disk the reserve is released first, so that there is space
/// for the log of the deletion, and set aside again afterwards.
pub(super) struct Deletion<'s> {
    store: &'s Store,
    writer: WriterGuard<'s>,
    was_scarce: bool,
}

impl Deletion<'_> {
    pub(super) async fn begin(&mut self) -> Result<Transaction<'_, Sqlite>> {
        self.writer.begin().await
    }

    /// To be called after the commit: gives the freed space back at once where the disk has none.
    /// What fails here is tried again by [`Store::maintain`].
    pub(super) async fn reclaim(mut self) {
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
    pub(super) async fn growing(&self) -> Result<WriterGuard<'_>> {
        self.inner.writer.lock(Durability::Synced, Growth::Limited).await
    }

    /// The writer for a deletion.
    pub(super) async fn deletion(&self) -> Result<Deletion<'_>> {
        let mut writer = self.inner.writer.lock(Durability::Synced, Growth::Headroom).await?;
        let reserve = &self.inner.space.reserve;
        let was_scarce = reserve.is_disk_scarce().await?;
        if was_scarce {
            reserve.release().await?;
            // A log that has been copied back is written from its start again. If the space is not enough
            // for that, it may be for the deletion.
            if let Err(error) = writer.execute("PRAGMA wal_checkpoint(PASSIVE)").await {
                tracing::debug!(%error, "the log stays as it is");
            }
        }
        Ok(Deletion { store: self, writer, was_scarce })
    }

    /// Whether imports are refused for want of space, as far as is known without looking.
    #[must_use]
    pub fn is_full(&self) -> bool {
        self.inner.space.is_full.load(Ordering::Relaxed)
    }

    /// Housekeeping, to be called every few seconds: sets the reserve aside again, gives freed pages
    /// back to the disk, counts, and logs which other processes have come. Tells how much is stored.
    ///
    /// # Errors
    /// Faults only.
    pub async fn maintain(&self) -> Result<StorageStatus> {
        let space = &self.inner.space;
        self.log_newcomers();
        let is_reserved = space.reserve.ensure().await?;
        self.vacuum().await?;
        self.count_all_samples().await?;
        let (pages, free_pages) = self.pages().await?;
        let disk_available_bytes = space.reserve.available_bytes().await?;
        let used_bytes = (pages - free_pages.min(pages)) * PAGE_BYTES;
        let has_room = space.limits.database_bytes.is_none_or(|limit| used_bytes + ROOM_BYTES <= limit)
            && disk_available_bytes.is_none_or(|bytes| bytes + free_pages * PAGE_BYTES >= ROOM_BYTES);
        if is_reserved && has_room {
            space.is_full.store(false, Ordering::Relaxed);
        }
        Ok(StorageStatus {
            database_bytes: pages * PAGE_BYTES,
            free_bytes: free_pages * PAGE_BYTES,
            disk_available_bytes,
            samples: space.samples.load(Ordering::Relaxed),
            queued_rows: self.inner.samples.queued_rows(),
            is_full: self.is_full(),
        })
    }

    /// Gives some of the free pages back, few enough that nobody waits for long. Does nothing in files
    /// that were made before free pages could be given back.
    async fn vacuum(&self) -> Result<()> {
        let (_, free_pages) = self.pages().await?;
        if free_pages <= FREE_PAGES_KEPT {
            return Ok(());
        }
        let mut writer = self.relaxed().await?;
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
        let samples: i64 =
            sqlx::query_scalar("SELECT coalesce(sum(samples + without_fix), 0) FROM sample_counts")
                .fetch_one(self.readers())
                .await
                .map_err(failed)?;
        self.inner.space.samples.store(u64::try_from(samples).unwrap_or_default(), Ordering::Relaxed);
        Ok(())
    }

    /// Sets space aside when the store is opened.
    pub(super) async fn reserve_space(&self) {
        match self.inner.space.reserve.ensure().await {
            Ok(true) => {}
            Ok(false) => {
                tracing::warn!("the disk has no space for the reserve that deletions need when it is full")
            }
            Err(error) => tracing::warn!(%error, "no space is reserved for deletions on a full disk"),
        }
    }
}
