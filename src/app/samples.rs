//! Samples: import, list, count, delete.

use std::io::Read;
use std::sync::Arc;

use futures_util::{Stream, StreamExt as _};
use serde::{Deserialize, Serialize};
use tokio::sync::{Semaphore, mpsc};

use super::access::{Caller, Permission};
use super::active_cameras::ActiveCameras;
use super::idempotency::{first_answer, record_of, stored_answer};
use super::swapped_columns::PlaceCheck;
use super::{App, Page, page_of};
use crate::clock::Clock;
use crate::config::Limits;
use crate::domain::{
    CameraId, Durability, Error, IdempotentRequest, OnConflict, Result, SampleCount, StoredSample,
};
use crate::exchange::{self, CsvLayout, Format, RowError, RowRules};
use crate::store::{Completion, InsertOptions, Inserted, SampleFilter, SampleKey, Store};
use crate::telemetry::Metrics;

/// Rows that go to the store at once.
pub(super) const BATCH_ROWS: usize = 1_000;
/// Batches that are read ahead of the store.
const BATCHES_AHEAD: usize = 8;

/// How rows are imported.
#[derive(Debug, Clone, Default)]
pub struct ImportOptions {
    /// When they are acknowledged.
    pub durability: Durability,
    /// The rule for samples that are stored already.
    pub on_conflict: OnConflict,
    /// Given if the client may send the same import again.
    pub idempotent: Option<IdempotentRequest>,
}

/// The counts of an import's rows.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct ImportReport {
    /// Number of samples stored now.
    pub accepted: u64,
    /// Number of accepted samples without a fix.
    pub without_fix: u64,
    /// The same camera, target and time were stored before, or stand twice in the import.
    pub duplicate: u64,
    /// Number of accepted samples that replaced a stored sample on request.
    pub replaced: u64,
    /// Not stored for a fault of their own.
    pub rejected: u64,
    /// The first of them, with their reasons.
    pub rejected_rows: Vec<RejectedRow>,
    /// Probable faults of the rows as a whole, each with its remedy.
    #[serde(default)]
    pub warnings: Vec<String>,
}

/// A row that was not stored, and why.
pub type RejectedRow = RowError;

impl ImportReport {
    /// The report with a batch more.
    fn and(self, inserted: &Inserted) -> Self {
        Self {
            accepted: self.accepted + inserted.accepted,
            without_fix: self.without_fix + inserted.without_fix,
            duplicate: self.duplicate + inserted.duplicate,
            replaced: self.replaced + inserted.replaced,
            ..self
        }
    }

    fn to_json(&self) -> String {
        // Numbers and texts are always JSON.
        serde_json::to_string(self).unwrap_or_default()
    }

    fn reject(&mut self, row: RowError, tell_at_most: usize) {
        self.rejected += 1;
        if self.rejected_rows.len() < tell_at_most {
            self.rejected_rows.push(row);
        }
    }
}

/// The use cases of samples.
#[derive(Clone, Copy)]
pub struct Samples<'a> {
    pub(super) store: &'a Store,
    pub(super) cameras: ActiveCameras<'a>,
    pub(super) clock: &'a Clock,
    pub(super) limits: &'a Limits,
    pub(super) metrics: &'a Metrics,
    pub(super) pairings: &'a Arc<Semaphore>,
    caller: &'a Caller,
}

impl App {
    /// The use cases of samples.
    #[must_use]
    pub fn samples(&self) -> Samples<'_> {
        Samples {
            store: &self.store,
            cameras: self.active_cameras(),
            clock: &self.clock,
            limits: &self.limits,
            metrics: &self.metrics,
            pairings: &self.pairings,
            caller: &self.caller,
        }
    }
}

impl Samples<'_> {
    /// Stores the rows of a file. One bad row never loses the others; what is counted as accepted
    /// is committed.
    ///
    /// The file is read on a thread for blocking work, in batches, so memory is bounded whatever
    /// its size.
    ///
    /// # Errors
    /// `CameraNotFound`, before anything is read; `MalformedBody` for a file that cannot be read as
    /// its format, `InsufficientStorage`: batches before that place are stored, and the message tells
    /// how many rows; `PermissionDenied` for a caller who may not replace; `IdempotencyKeyReused`.
    pub async fn import_file(
        &self,
        id: &CameraId,
        file: impl Read + Send + 'static,
        (format, layout): (Format, CsvLayout),
        options: ImportOptions,
    ) -> Result<ImportReport> {
        let rules = self.row_rules(id).await?;
        if let Some(first) = self.repeated_import(&options).await? {
            return Ok(first);
        }
        let mut import = Import::new(*self, id, options)?;
        let (sender, mut batches) = mpsc::channel(BATCHES_AHEAD);
        let reading =
            tokio::task::spawn_blocking(move || read_batches(file, format, &layout, &rules, &sender));
        while let Some(mut batch) = batches.recv().await {
            // Rows that were read while the last batch was stored go into one transaction.
            while let Ok(more) = batches.try_recv() {
                batch.extend(more);
            }
            import.push(batch).await?;
        }
        let read = reading.await.map_err(Error::fault)?;
        import.finish(read).await
    }

    /// Stores rows that come one by one over a transport that has parsed them.
    ///
    /// # Errors
    /// `CameraNotFound`; the stream's own error, after the rows before it were stored; its message
    /// tells how many; `PermissionDenied` for a caller who may not replace; `IdempotencyKeyReused`.
    pub async fn import_rows(
        &self,
        id: &CameraId,
        rows: impl Stream<Item = Result<Result<StoredSample, RowError>>> + Send,
        options: ImportOptions,
    ) -> Result<ImportReport> {
        self.cameras.get(id).await?;
        let mut batches = std::pin::pin!(rows.ready_chunks(BATCH_ROWS));
        if let Some(request) = &options.idempotent
            && stored_answer(self.store, self.clock, request).await?.is_some()
        {
            // The request is known once all of it has come.
            while let Some(chunk) = batches.next().await {
                chunk.into_iter().try_for_each(|row| row.map(drop))?;
            }
        }
        if let Some(first) = self.repeated_import(&options).await? {
            return Ok(first);
        }
        let mut import = Import::new(*self, id, options)?;
        let mut end = Ok(());
        while let Some(chunk) = batches.next().await {
            let mut batch = Vec::with_capacity(chunk.len());
            for row in chunk {
                match row {
                    Ok(row) => batch.push(row),
                    Err(error) => {
                        end = Err(error);
                        break;
                    }
                }
            }
            import.push(batch).await?;
            if end.is_err() {
                break;
            }
        }
        import.finish(end).await
    }

    /// The report of an import that was made under the same key before, if any.
    ///
    /// # Errors
    /// `IdempotencyKeyReused` if that was another one.
    pub(super) async fn repeated_import(&self, options: &ImportOptions) -> Result<Option<ImportReport>> {
        let Some(request) = &options.idempotent else { return Ok(None) };
        let first = first_answer(self.store, self.clock, request).await?;
        first.map(|report| serde_json::from_str(&report).map_err(Error::fault)).transpose()
    }

    /// The rules for rows of a camera.
    ///
    /// # Errors
    /// `CameraNotFound`.
    pub async fn row_rules(&self, id: &CameraId) -> Result<RowRules> {
        Ok(self.cameras.get(id).await?.row_rules(self.clock.now()))
    }

    /// Samples by time and target, after a cursor.
    ///
    /// # Errors
    /// `CameraNotFound`.
    pub async fn list(
        &self,
        id: &CameraId,
        filter: &SampleFilter,
        after: Option<SampleKey>,
        limit: u32,
    ) -> Result<Page<StoredSample, SampleKey>> {
        let samples = self.store.samples(id, filter, after, limit + 1).await?;
        Ok(page_of(samples, limit, SampleKey::of))
    }

    /// Number of samples.
    ///
    /// # Errors
    /// `CameraNotFound`.
    pub async fn count(&self, id: &CameraId, filter: &SampleFilter) -> Result<SampleCount> {
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
    pub async fn delete(&self, id: &CameraId, filter: &SampleFilter) -> Result<u64> {
        self.store.delete_samples(id, filter, self.clock.now()).await
    }
}

/// An import under way. If the client may repeat it, the latest batch waits, so that the last one is known when
/// it is stored: with it goes the answer.
pub(super) struct Import<'a> {
    samples: Samples<'a>,
    id: &'a CameraId,
    options: ImportOptions,
    waiting: Option<Batch>,
    places: PlaceCheck,
    report: ImportReport,
}

impl<'a> Import<'a> {
    /// # Errors
    /// `PermissionDenied` for a caller who may not replace samples.
    pub(super) fn new(samples: Samples<'a>, id: &'a CameraId, options: ImportOptions) -> Result<Self> {
        if options.on_conflict == OnConflict::Replace {
            // Replacing loses the stored samples, as deleting does.
            samples.caller.authorize(Permission::Operate)?;
        }
        Ok(Self {
            samples,
            id,
            options,
            waiting: None,
            places: PlaceCheck::default(),
            report: ImportReport::default(),
        })
    }

    /// Stores the batch, or the one before it if this one may be the last that the answer goes with.
    ///
    /// # Errors
    /// As the store; the message tells how many rows are stored.
    pub(super) async fn push(&mut self, batch: Batch) -> Result<()> {
        let ready = if self.options.idempotent.is_some() { self.waiting.replace(batch) } else { Some(batch) };
        match ready {
            Some(ready) => self.store(ready, false).await,
            None => Ok(()),
        }
    }

    /// Stores the last batch, after which the rows ended as `end` says.
    ///
    /// # Errors
    /// That of `end`, and as the store; the message tells how many rows are stored.
    pub(super) async fn finish(mut self, end: Result<()>) -> Result<ImportReport> {
        let last = self.waiting.take().unwrap_or_default();
        let stored = self.store(last, end.is_ok()).await;
        let ImportReport { accepted, duplicate, rejected, .. } = self.report;
        self.samples.metrics.imported(accepted, duplicate, rejected);
        stored?;
        end.map_err(|error| with_stored_rows(error, &self.report))?;
        // The answer that was stored: that of another request with the same key, if it came first.
        Ok(self.samples.repeated_import(&self.options).await?.unwrap_or(self.report))
    }

    async fn store(&mut self, batch: Batch, is_last: bool) -> Result<()> {
        let mut samples = Vec::with_capacity(batch.len());
        for row in batch {
            match row {
                Ok(sample) => samples.push(sample),
                Err(row) => self.reject(row),
            }
        }
        let camera = self.samples.cameras.get(self.id).await?;
        self.places.see(self.samples.store, &camera, &samples).await?;
        if is_last {
            self.report.warnings = self.places.warnings();
        }
        let completion = self.options.idempotent.as_ref().filter(|_| is_last).map(|request| {
            let before = self.report.clone();
            let answer = move |inserted: &Inserted| before.clone().and(inserted).to_json();
            Completion { record: record_of(request), answer: Arc::new(answer) }
        });
        if samples.is_empty() && completion.is_none() {
            return Ok(());
        }
        let ImportOptions { durability, on_conflict, .. } = self.options;
        let options = InsertOptions { durability, on_conflict, completion, now: self.samples.clock.now() };
        let inserted = self.samples.store.insert_samples(self.id, samples, options).await;
        let inserted = inserted.map_err(|error| with_stored_rows(error, &self.report))?;
        self.report = std::mem::take(&mut self.report).and(&inserted);
        Ok(())
    }

    fn reject(&mut self, row: RowError) {
        self.report.reject(row, self.samples.limits.rejected_rows);
    }
}

pub(super) type Batch = Vec<Result<StoredSample, RowError>>;

fn read_batches(
    file: impl Read,
    format: Format,
    layout: &CsvLayout,
    rules: &RowRules,
    batches: &mpsc::Sender<Batch>,
) -> Result<()> {
    let mut batch = Vec::with_capacity(BATCH_ROWS);
    for row in exchange::read_samples(file, (format, layout), rules)? {
        match row {
            Ok(row) => batch.push(row),
            Err(error) => {
                // Rows that came before the break are stored; the receiver is gone only with its request.
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

fn with_stored_rows(error: Error, report: &ImportReport) -> Error {
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
