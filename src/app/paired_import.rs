//! An import of two files that are paired on the way.

use std::io::Read;
use std::sync::Arc;

use tokio_util::sync::CancellationToken;

use super::ImportReport;
use super::matching::{MatchReport, MatchRequest};
use super::recording::{PairingCounts, Part, Recording, RecordingLimits, RejectedParts, of_part};
use super::samples::{BATCH_ROWS, Import, ImportOptions, Samples};
use crate::domain::{
    CameraId, Error, ImageSize, Receiver, ReceiverId, Receivers, Result, StoredSample, TargetId,
};
use crate::exchange::{self, CsvLayout, FixFormat, Format, RowRules};
use crate::fusion::association::{Cancellation, MatchSettings};
use crate::fusion::clock_offset::OffsetEstimate;
use crate::fusion::pairing::PairingSettings;
use crate::model::Regressor;

/// Two files to be paired, and how.
pub struct PairedImport<D, F> {
    /// Rows of boxes.
    pub detections: D,
    pub detections_format: Format,
    /// Rows of fixes.
    pub fixes: F,
    pub fixes_format: FixFormat,
    /// How a box finds its fix.
    pub settings: PairingSettings,
    /// The target of boxes that name none.
    pub target_id: Option<TargetId>,
    /// The receiver of fixes that name none.
    pub receiver_id: Option<ReceiverId>,
    /// True if boxes that find no fix are stored as samples without one.
    pub keeps_unpaired: bool,
    /// How the samples are stored.
    pub options: ImportOptions,
    /// How CSV files are laid out.
    pub layout: CsvLayout,
    /// True if the clock offsets are estimated, too. They are reported, never applied.
    pub estimates_offsets: bool,
    /// How boxes are matched with receivers first; `None` where their targets have the same ids.
    pub matching: Option<MatchSettings>,
}

/// The report of an import of two files.
#[derive(Debug, Clone, PartialEq)]
pub struct PairedReport {
    /// The counts of samples.
    pub samples: ImportReport,
    /// The counts of rows.
    pub counts: PairingCounts,
    /// Rows that are none.
    pub rejected: RejectedParts,
    /// Whose the fixes are that name no receiver, if there are any and somebody claims them.
    pub unnamed_fixes_of: Option<Receiver>,
    /// Clock offsets by receiver, if they were asked for; `None` where the files do not show them.
    pub clock_offsets: Vec<(Receiver, Option<OffsetEstimate>)>,
    /// The report of the match, if one was requested.
    pub matching: Option<MatchReport>,
}

/// The camera's settings for fixes and boxes.
struct CameraContext {
    receivers: Receivers,
    regressor: Option<Arc<Regressor>>,
    image_size: Option<ImageSize>,
}

/// The same files are matched in the same way whenever they are sent.
const MATCH_SEED: u64 = 1;

/// Paired rows before they are stored.
struct Work {
    samples: Vec<StoredSample>,
    report: PairedReport,
}

impl Samples<'_> {
    /// Pairs two files by the receivers of the camera's profile and stores the samples. One bad row
    /// never loses the others.
    ///
    /// Both files are held in memory while they are paired, so their rows have a limit and so has
    /// the number of imports that do it at the same time.
    ///
    /// # Errors
    /// `CameraNotFound`, before anything is read; `MalformedBody` and `TooLarge`, naming the file,
    /// before anything is stored.
    pub async fn import_paired(
        &self,
        id: &CameraId,
        import: PairedImport<impl Read + Send + 'static, impl Read + Send + 'static>,
    ) -> Result<PairedReport> {
        let rules = self.row_rules(id).await?;
        let active = self.cameras.get(id).await?;
        let camera = CameraContext {
            receivers: active.receivers.clone(),
            regressor: active.model.as_ref().map(|(regressor, _)| regressor.clone()),
            image_size: active.image_size,
        };
        let limits =
            RecordingLimits { rows: self.limits.pairing_rows, rejected_rows: self.limits.rejected_rows };
        let options = import.options.clone();
        let place = self.pairings.clone().acquire_owned().await.map_err(Error::fault)?;
        // Dropped with this future when the client leaves; the work then ends, and until it has its place is taken.
        let cancel = CancellationToken::new();
        let _guard = cancel.clone().drop_guard();
        let pairing = tokio::task::spawn_blocking(move || {
            let _place = place;
            import.paired(&rules, &camera, limits, &|| cancel.is_cancelled())
        });
        let Work { samples, mut report } = pairing.await.map_err(Error::fault)??;
        // The same files pair alike, so of a repeated import only what became of the samples is stored.
        report.samples = match self.repeated_import(&options).await? {
            Some(first) => first,
            None => self.store_paired(id, samples, options).await?,
        };
        self.metrics.imported(0, 0, report.rejected.count);
        Ok(report)
    }

    pub(super) async fn store_paired(
        &self,
        id: &CameraId,
        mut samples: Vec<StoredSample>,
        options: ImportOptions,
    ) -> Result<ImportReport> {
        let mut import = Import::new(*self, id, options)?;
        while !samples.is_empty() {
            let rest = samples.split_off(samples.len().min(BATCH_ROWS));
            let batch = std::mem::replace(&mut samples, rest);
            import.push(batch.into_iter().map(Ok).collect()).await?;
        }
        import.finish(Ok(())).await
    }
}

impl<D: Read, F: Read> PairedImport<D, F> {
    fn paired(
        self,
        rules: &RowRules,
        camera: &CameraContext,
        limits: RecordingLimits,
        is_cancelled: &dyn Fn() -> bool,
    ) -> Result<Work> {
        let receivers = &camera.receivers;
        let boxes = exchange::read_detections(
            self.detections,
            (self.detections_format, &self.layout),
            rules,
            self.target_id,
        )
        .map_err(|error| of_part(Part::Detections, error))?;
        let fixes =
            exchange::read_received_fixes(self.fixes, (self.fixes_format, &self.layout), rules.time_bounds)
                .map_err(|error| of_part(Part::Fixes, error))?;
        let mut recording = Recording::read(boxes, fixes, limits)?;
        let unnamed_fixes_of = recording.name_fixes(self.fixes_format, receivers, self.receiver_id)?;
        let clock_offsets =
            if self.estimates_offsets { recording.clock_offsets(receivers) } else { Vec::new() };
        let (recording, receivers, matching) = match self.matching {
            None => (recording, receivers.clone(), None),
            Some(settings) => {
                let regressor = camera.regressor.as_deref();
                let request = MatchRequest {
                    regressor,
                    image_size: camera.image_size,
                    settings,
                    seed: MATCH_SEED,
                    cancellation: Cancellation::new(is_cancelled),
                };
                let matched = recording.matched(receivers, &request)?;
                (matched.recording, matched.receivers, Some(matched.report))
            }
        };
        let (paired, counts, rejected) = recording.paired(&receivers, &self.settings);
        let samples = ImportReport::default();
        let report = PairedReport { samples, counts, rejected, unnamed_fixes_of, clock_offsets, matching };
        Ok(Work { samples: paired.into_samples(self.keeps_unpaired), report })
    }
}
