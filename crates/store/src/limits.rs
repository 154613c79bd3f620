//! How much may be stored, how much is stored, and what one transaction may add.

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};

use crate::domain::{CameraId, Error, ErrorKind, Result, SampleOverflow};

/// The limits that an operator sets for the store. The default allows everything and reserves nothing.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct StoreLimits {
    /// Cameras; more are refused.
    pub cameras: u32,
    /// Sites; more are refused.
    pub sites: u32,
    /// Places; more are refused.
    pub places: u32,
    /// Events of all places; beyond, the oldest are deleted.
    pub place_events: u32,
    /// Days that the counts of a place by minutes are kept, before its newest ones.
    pub place_minute_days: u32,
    /// Days that its counts by hours are kept.
    pub place_hour_days: u32,
    /// Connections with other systems; more are refused.
    pub outside_connections: u32,
    /// Waiting messages of one connection; beyond, the oldest is dropped.
    pub outbox_messages: u32,
    /// Dead letters of one connection; beyond, the oldest is deleted.
    pub dead_letters: u32,
    /// Samples of one camera.
    pub samples_per_camera: u64,
    /// The rule for samples beyond that.
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
            places: u32::MAX,
            place_events: u32::MAX,
            place_minute_days: 36_500,
            place_hour_days: 36_500,
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
    /// Bytes of these that are free for new rows.
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

/// Admits rows of one transaction.
pub(super) struct SampleQuota<'s> {
    limits: &'s StoreLimits,
    /// Stored, and admitted before.
    samples: u64,
}

impl SampleQuota<'_> {
    /// Admits a batch of a camera that has `of_camera` samples, and counts it. Rows that will turn out to
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

/// Limits and what is known of their use, shared by a store and its task that stores samples.
pub(super) struct Usage {
    pub(super) limits: StoreLimits,
    /// Samples of all cameras: those counted last, and those stored since.
    samples: AtomicU64,
    is_full: AtomicBool,
}

impl Usage {
    pub(super) const fn new(limits: StoreLimits) -> Self {
        Self { limits, samples: AtomicU64::new(0), is_full: AtomicBool::new(false) }
    }

    /// The limits of one transaction, with the number of samples stored.
    pub(super) fn quota(&self) -> SampleQuota<'_> {
        SampleQuota { limits: &self.limits, samples: self.samples() }
    }

    /// Samples of all cameras, as far as is known without counting.
    pub(super) fn samples(&self) -> u64 {
        self.samples.load(Ordering::Relaxed)
    }

    /// All samples were counted.
    pub(super) fn counted(&self, samples: i64) {
        self.samples.store(u64::try_from(samples).unwrap_or_default(), Ordering::Relaxed);
    }

    /// True if the latest import was refused for want of space, and none has become free since.
    pub(super) fn is_full(&self) -> bool {
        self.is_full.load(Ordering::Relaxed)
    }

    /// There is space again.
    pub(super) fn has_room(&self) {
        self.is_full.store(false, Ordering::Relaxed);
    }

    /// Samples were committed.
    pub(super) fn stored(&self, accepted: u64) {
        self.samples.fetch_add(accepted, Ordering::Relaxed);
        if accepted > 0 {
            self.has_room();
        }
    }

    /// Samples could not be committed.
    pub(super) fn failed(&self, error: &Error) {
        if error.kind() == ErrorKind::InsufficientStorage {
            self.found_full();
        }
    }

    /// No space is left.
    pub(super) fn found_full(&self) {
        if !self.is_full.swap(true, Ordering::Relaxed) {
            tracing::error!("there is no space for more samples; imports are refused until some is freed");
        }
    }
}
