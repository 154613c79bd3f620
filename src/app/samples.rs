//! Samples: import, list, count, delete.

use std::io::Read;

use futures_util::{Stream, StreamExt as _};
use jiff::Timestamp;
use tokio::sync::mpsc;

use super::{App, Page, page_of};
use crate::domain::{CameraId, Durability, Error, Result, SampleCount, StoredSample, TargetId};
use crate::exchange::{self, Cursor, Format, RowError, RowRules};
use crate::store::{SampleFilter, SampleKey};

/// Rows that go to the store at once.
pub(super) const BATCH_ROWS: usize = 1_000;
/// Batches that are read ahead of the store.
const BATCHES_AHEAD: usize = 8;

/// What became of an import's rows.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct ImportReport {
    /// Stored now.
    pub accepted: u64,
    /// Of the accepted ones, those without a fix.
    pub without_fix: u64,
    /// The same camera, target and time were stored before, or stand twice in the import.
    pub duplicate: u64,
    /// Not stored for a fault of their own.
    pub rejected: u64,
    /// The first of them, with their reasons.
    pub rejected_rows: Vec<RejectedRow>,
}

/// A row that was not stored, and why.
pub type RejectedRow = RowError;

impl ImportReport {
    fn reject(&mut self, row: RowError, tell_at_most: usize) {
        self.rejected += 1;
        if self.rejected_rows.len() < tell_at_most {
            self.rejected_rows.push(row);
        }
    }
}

impl App {
    /// Stores the rows of a file. One bad row never loses the others; what is counted as accepted
    /// is committed.
    ///
    /// The file is read on a thread for blocking work, in batches, so memory is bounded whatever
    /// its size.
    ///
    /// # Errors
    /// `CameraNotFound`, before anything is read; `MalformedBody` for a file that cannot be read as
    /// its format, `InsufficientStorage`: batches before that place are stored, and the message tells
    /// how many rows.
    pub async fn import_file(
        &self,
        id: &CameraId,
        file: impl Read + Send + 'static,
        format: Format,
        durability: Durability,
    ) -> Result<ImportReport> {
        let rules = self.row_rules(id).await?;
        let (sender, mut batches) = mpsc::channel(BATCHES_AHEAD);
        let reading = tokio::task::spawn_blocking(move || read_batches(file, format, &rules, &sender));
        let mut report = ImportReport::default();
        while let Some(mut batch) = batches.recv().await {
            // What was read while the last batch was stored goes into one transaction.
            while let Ok(more) = batches.try_recv() {
                batch.extend(more);
            }
            let stored = self.store_batch(id, batch, durability, &mut report).await;
            stored.map_err(|error| told_what_is_stored(error, &report))?;
        }
        let read = reading.await.map_err(Error::fault)?;
        self.metrics.imported(report.accepted, report.duplicate, report.rejected);
        read.map_err(|error| told_what_is_stored(error, &report))?;
        Ok(report)
    }

    /// Stores rows that come one by one over a transport that has parsed them.
    ///
    /// # Errors
    /// `CameraNotFound`; the stream's own error, after the rows before it were stored; its message
    /// tells how many.
    pub async fn import_rows(
        &self,
        id: &CameraId,
        rows: impl Stream<Item = Result<Result<StoredSample, RowError>>> + Send,
        durability: Durability,
    ) -> Result<ImportReport> {
        self.active_camera(id).await?;
        let mut report = ImportReport::default();
        let mut batches = std::pin::pin!(rows.ready_chunks(BATCH_ROWS));
        while let Some(chunk) = batches.next().await {
            let mut broken = None;
            let mut batch = Vec::with_capacity(chunk.len());
            for row in chunk {
                match row {
                    Ok(row) => batch.push(row),
                    Err(error) => {
                        broken = Some(error);
                        break;
                    }
                }
            }
            let stored = self.store_batch(id, batch, durability, &mut report).await;
            stored.map_err(|error| told_what_is_stored(error, &report))?;
            if let Some(error) = broken {
                self.metrics.imported(report.accepted, report.duplicate, report.rejected);
                return Err(told_what_is_stored(error, &report));
            }
        }
        self.metrics.imported(report.accepted, report.duplicate, report.rejected);
        Ok(report)
    }

    /// What the rows of a camera must keep.
    ///
    /// # Errors
    /// `CameraNotFound`.
    pub async fn row_rules(&self, id: &CameraId) -> Result<RowRules> {
        Ok(self.active_camera(id).await?.row_rules(self.clock.now()))
    }

    /// Samples by time and target, from behind a cursor on.
    ///
    /// # Errors
    /// `CameraNotFound`.
    pub async fn samples(
        &self,
        id: &CameraId,
        filter: &SampleFilter,
        after: Option<SampleKey>,
        limit: u32,
    ) -> Result<Page<StoredSample, SampleKey>> {
        let samples = self.store.samples(id, filter, after, limit + 1).await?;
        Ok(page_of(samples, limit, SampleKey::of))
    }

    /// How many samples there are.
    ///
    /// # Errors
    /// `CameraNotFound`.
    pub async fn count_samples(&self, id: &CameraId, filter: &SampleFilter) -> Result<SampleCount> {
        let mut count = SampleCount::default();
        for has_fix in
            [true, false].into_iter().filter(|has_fix| filter.has_fix.is_none_or(|it| it == *has_fix))
        {
            let filter = SampleFilter { has_fix: Some(has_fix), ..filter.clone() };
            let rows = self.store.count_samples(id, &filter).await?;
            count.all += rows;
            count.without_fix += if has_fix { 0 } else { rows };
        }
        Ok(count)
    }

    /// Deletes samples and tells how many.
    ///
    /// # Errors
    /// `CameraNotFound`.
    pub async fn delete_samples(&self, id: &CameraId, filter: &SampleFilter) -> Result<u64> {
        self.store.delete_samples(id, filter, self.clock.now()).await
    }

    pub(super) async fn store_batch(
        &self,
        id: &CameraId,
        batch: Vec<Result<StoredSample, RowError>>,
        durability: Durability,
        report: &mut ImportReport,
    ) -> Result<()> {
        let mut samples = Vec::with_capacity(batch.len());
        for row in batch {
            match row {
                Ok(sample) => samples.push(sample),
                Err(row) => report.reject(row, self.limits.rejected_rows),
            }
        }
        if !samples.is_empty() {
            let inserted = self.store.insert_samples(id, samples, durability).await?;
            report.accepted += inserted.accepted;
            report.duplicate += inserted.duplicate;
            report.without_fix += inserted.without_fix;
        }
        Ok(())
    }
}

/// A sample's place in the list by time and target.
impl Cursor for SampleKey {
    const LIST: &'static str = "samples";

    fn to_key(&self) -> String {
        format!("{}:{}", self.time.as_microsecond(), self.target_id)
    }

    fn from_key(key: &str) -> Option<Self> {
        let (time_us, target_id) = key.split_once(':')?;
        Some(Self {
            time: Timestamp::from_microsecond(time_us.parse().ok()?).ok()?,
            target_id: TargetId::new(target_id).ok()?,
        })
    }
}

type Batch = Vec<Result<StoredSample, RowError>>;

fn read_batches(
    file: impl Read,
    format: Format,
    rules: &RowRules,
    batches: &mpsc::Sender<Batch>,
) -> Result<()> {
    let mut batch = Vec::with_capacity(BATCH_ROWS);
    for row in exchange::read_samples(file, format, rules)? {
        match row {
            Ok(row) => batch.push(row),
            Err(error) => {
                // What came before the break is stored; the receiver is gone only with its request.
                let _ = batches.blocking_send(batch);
                return Err(error);
            }
        }
        if batch.len() == BATCH_ROWS
            && batches.blocking_send(std::mem::replace(&mut batch, Vec::with_capacity(BATCH_ROWS))).is_err()
        {
            return Ok(());
        }
    }
    let _ = batches.blocking_send(batch);
    Ok(())
}

pub(super) fn told_what_is_stored(error: Error, report: &ImportReport) -> Error {
    match error {
        Error::Refused(mut refusal) if report.accepted + report.duplicate > 0 => {
            refusal.message = format!(
                "{}; {} rows before it are stored, sending them again does no harm",
                refusal.message,
                report.accepted + report.duplicate
            );
            Error::Refused(refusal)
        }
        error => error,
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::exchange::{read_cursor, write_cursor};

    proptest! {
        #[test]
        fn a_sample_is_found_again(time_us in -1_000_000_000_i64..4_000_000_000_000_000, name in "[a-z ./:é-]{0,20}[a-z]") {
            let Ok(target_id) = TargetId::new(&name) else { return Ok(()) };
            let key = SampleKey { time: Timestamp::from_microsecond(time_us).expect("in range"), target_id };
            prop_assert_eq!(read_cursor::<SampleKey>("cursor", &write_cursor(&key)).expect("its own"), key);
        }

        #[test]
        fn what_is_no_cursor_is_refused_or_read(text in ".{1,40}") {
            if let Err(error) = read_cursor::<SampleKey>("cursor", &text) {
                prop_assert!(error.to_string().starts_with("cursor"));
            }
        }
    }
}
