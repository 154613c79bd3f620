//! The methods of [`Store`], each with what it promises.
//!
//! A new method is added here and to `entities` under the same signature, with cases in `tests`. PostgreSQL may end a transaction in favour of another one; then the method is called again, so what it commits before its last
//! transaction must bear repetition.

use std::time::Duration;

use jiff::Timestamp;

use super::postgres::repeated;
use super::{
    CameraContent, CameraVersions, ChangeMark, Claim, Heartbeat, IdempotencyRecord, JobCounts, JobEnd,
    KeysVersion, RunSubject, SampleFilter, SampleKey, StorageStatus, Store, StoredAnswer, StoredHeldOutError,
};
#[cfg(doc)]
use crate::domain::ErrorKind;
use crate::domain::{
    ApiKey, AuditEntry, AuditNumber, Camera, CameraId, CameraKey, CameraMoved, Connection, ConnectionId,
    ConnectionKey, DeadLetter, Detection, Durability, EpochReport, EvaluationId, EvaluationJob,
    EvaluationPlan, EvaluationProgress, ExpectedVersion, IdempotencyKey, JobState, KeyId, ModelMetadata,
    ModelVersion, NewCamera, NewConnection, NewKey, NewPlace, NewPlaceEvent, NewSite, OutboxCounts,
    OutboxLog, OutboxMessage, Picture, Place, PlaceCount, PlaceEventFilter, PlaceId, PlaceKey,
    RecordingBounds, RecordingPart, Result, Revision, RunId, RunProgress, SecretDigest, Site, SiteId,
    SiteKey, SourceOffset, StoredPlaceEvent, StoredPlaceEvents, StoredSample, TrackScope, TrainingRun,
};
use crate::geo::Position;

macro_rules! contract {
    ($($(#[$attribute:meta])* fn $name:ident $(<$subject:ident: $bound:ident>)?(&self $(, $argument:ident: $type:ty)*) -> $output:ty;)*) => {
        impl Store {
            $(
                $(#[$attribute])*
                pub async fn $name $(<$subject: $bound>)? (&self $(, $argument: $type)*) -> $output {
                    repeated!(self.0.$name $(::<$subject>)? ($(Clone::clone(&$argument)),*))
                }
            )*
        }
    };
}

contract! {
    /// Stores a new camera with revision 1.
    ///
    /// # Errors
    /// [`ErrorKind::CameraExists`]; [`ErrorKind::InvalidArgument`] naming `site` if there is no such site;
    /// [`ErrorKind::InsufficientStorage`] beyond the limit of cameras.
    fn insert_camera(&self, profile: &NewCamera, now: Timestamp) -> Result<Camera>;

    /// One camera.
    ///
    /// # Errors
    /// [`ErrorKind::CameraNotFound`].
    fn camera(&self, id: &CameraId) -> Result<Camera>;

    /// A page of cameras, of a site or of all, ordered by id, after an id.
    ///
    /// # Errors
    /// Faults only.
    fn cameras(&self, site: Option<&SiteId>, after: Option<&CameraId>, limit: u32) -> Result<Vec<Camera>>;

    /// The cameras that have changed since a mark, or all without one: enough to see which ones to read. Misses nothing
    /// that is committed, for deletions that are a day old at most.
    ///
    /// # Errors
    /// Faults only.
    fn camera_versions(&self, since: Option<ChangeMark>) -> Result<CameraVersions>;

    /// The contents needed to answer for each of some cameras, in their order.
    ///
    /// # Errors
    /// Faults only; for one camera [`ErrorKind::CameraNotFound`], or a fault of its rows.
    fn camera_contents(&self, ids: &[CameraId]) -> Result<Vec<Result<CameraContent>>>;

    /// Replaces the stored profile and counts its revision up, if the stored
    /// revision is the expected one.
    ///
    /// # Errors
    /// [`ErrorKind::CameraNotFound`], [`ErrorKind::RevisionMismatch`]; [`ErrorKind::InvalidArgument`] naming
    /// `site` if there is no such site.
    fn replace_camera(&self, profile: &NewCamera, expected: Option<ExpectedVersion>, now: Timestamp) -> Result<Camera>;

    /// Deletes a camera with its samples, runs and models, if its revision is the expected one.
    ///
    /// # Errors
    /// [`ErrorKind::CameraNotFound`], [`ErrorKind::RevisionMismatch`], [`ErrorKind::RunLive`] while a
    /// training run has not ended.
    fn delete_camera(&self, id: &CameraId, expected: Option<ExpectedVersion>, now: Timestamp) -> Result<()>;

    /// A page of cameras ordered by id, after an id, each with its latest training run and that run's state.
    ///
    /// # Errors
    /// Faults only.
    fn cameras_with_latest_run(&self, after: Option<&CameraId>, limit: u32) -> Result<Vec<(Camera, Option<(RunId, JobState)>)>>;

    /// Stores a pose change, unless one was stored for that model version before; returns whether it is new.
    ///
    /// # Errors
    /// [`ErrorKind::CameraNotFound`].
    fn insert_move(&self, camera: &CameraId, moved: &CameraMoved) -> Result<bool>;

    /// The pose change that was detected with a model version.
    ///
    /// # Errors
    /// Faults only.
    fn camera_move(&self, camera: &CameraId, model_version: u32) -> Result<Option<CameraMoved>>;

    /// State of the run that was started last because of the pose change found with a model version; `None` if
    /// there was none, or it was deleted.
    ///
    /// # Errors
    /// Faults only.
    fn retraining_state(&self, camera: &CameraId, model_version: u32) -> Result<Option<JobState>>;

    /// Stores which run was started because of a pose change.
    ///
    /// # Errors
    /// [`ErrorKind::CameraNotFound`].
    fn note_retraining(&self, camera: &CameraId, model_version: u32, run: RunId) -> Result<()>;

    /// Stores a new site with revision 1.
    ///
    /// # Errors
    /// [`ErrorKind::SiteExists`]; [`ErrorKind::InsufficientStorage`] beyond the limit of sites.
    fn insert_site(&self, profile: &NewSite, now: Timestamp) -> Result<Site>;

    /// One site.
    ///
    /// # Errors
    /// [`ErrorKind::SiteNotFound`].
    fn site(&self, id: &SiteId) -> Result<Site>;

    /// A page of sites ordered by id, after an id.
    ///
    /// # Errors
    /// Faults only.
    fn sites(&self, after: Option<&SiteId>, limit: u32) -> Result<Vec<Site>>;

    /// Id, key and revision of every site: enough to see what has changed.
    ///
    /// # Errors
    /// Faults only.
    fn site_versions(&self) -> Result<Vec<(SiteId, SiteKey, Revision)>>;

    /// Replaces the stored profile and counts its revision up, if the stored revision is the
    /// expected one.
    ///
    /// # Errors
    /// [`ErrorKind::SiteNotFound`], [`ErrorKind::RevisionMismatch`].
    fn replace_site(&self, profile: &NewSite, expected: Option<ExpectedVersion<SiteKey>>, now: Timestamp) -> Result<Site>;

    /// Deletes a site that no camera belongs to, if its revision is the expected one.
    ///
    /// # Errors
    /// [`ErrorKind::SiteNotFound`], [`ErrorKind::RevisionMismatch`], [`ErrorKind::SiteInUse`] while cameras
    /// belong to it.
    fn delete_site(&self, id: &SiteId, expected: Option<ExpectedVersion<SiteKey>>, now: Timestamp) -> Result<()>;

    /// Stores a new place with revision 1.
    ///
    /// # Errors
    /// [`ErrorKind::PlaceExists`]; [`ErrorKind::InvalidArgument`] naming `site_id` or `camera_id` if there is no such one;
    /// [`ErrorKind::InsufficientStorage`] beyond the limit of places.
    fn insert_place(&self, profile: &NewPlace, now: Timestamp) -> Result<Place>;

    /// One place.
    ///
    /// # Errors
    /// [`ErrorKind::PlaceNotFound`].
    fn place(&self, id: &PlaceId) -> Result<Place>;

    /// A page of places, of a scope or of all, ordered by id, after an id.
    ///
    /// # Errors
    /// Faults only.
    fn places(&self, scope: Option<&TrackScope>, after: Option<&PlaceId>, limit: u32) -> Result<Vec<Place>>;

    /// Numbers that change with every change of a place: how many there are, their largest key and the sum of their
    /// revisions.
    ///
    /// # Errors
    /// Faults only.
    fn places_mark(&self) -> Result<[i64; 3]>;

    /// Replaces the settings of a place and counts its revision up, if the stored revision is the expected one. Its scope
    /// stays.
    ///
    /// # Errors
    /// [`ErrorKind::PlaceNotFound`], [`ErrorKind::RevisionMismatch`].
    fn replace_place(&self, profile: &NewPlace, expected: Option<ExpectedVersion<PlaceKey>>, now: Timestamp) -> Result<Place>;

    /// Deletes a place with its events and counts, if its revision is the expected one.
    ///
    /// # Errors
    /// [`ErrorKind::PlaceNotFound`], [`ErrorKind::RevisionMismatch`].
    fn delete_place(&self, id: &PlaceId, expected: Option<ExpectedVersion<PlaceKey>>, now: Timestamp) -> Result<()>;

    /// Stores events, puts those that are new into the outboxes of sinks, and adds counts; all of it or nothing. Returns the
    /// numbers of new events and of messages beyond the limits of outboxes. Events and counts of places that were deleted are passed over; the oldest events beyond the limit
    /// are deleted, and counts that are too old.
    ///
    /// # Errors
    /// [`ErrorKind::InsufficientStorage`].
    fn insert_place_events(&self, events: &[NewPlaceEvent], counts: &[PlaceCount], now: Timestamp) -> Result<StoredPlaceEvents>;

    /// A page of events in the order of their commits, after a number.
    ///
    /// # Errors
    /// Faults only.
    fn place_events(&self, filter: &PlaceEventFilter, after: i64, limit: u32) -> Result<Vec<StoredPlaceEvent>>;

    /// The number of the newest event and of the oldest one that is kept; 0 without one.
    ///
    /// # Errors
    /// Faults only.
    fn place_event_bounds(&self) -> Result<(i64, i64)>;

    /// Counts of a place by intervals of `step_s` that begin in a range of seconds since 1970, oldest first; of one class or
    /// of all.
    ///
    /// # Errors
    /// Faults only.
    fn place_counts(&self, place: PlaceKey, step_s: u32, range_s: (i64, i64), class: Option<&str>) -> Result<Vec<PlaceCount>>;

    /// A page of samples ordered by time and target, after a key.
    ///
    /// # Errors
    /// [`ErrorKind::CameraNotFound`].
    fn samples(&self, id: &CameraId, filter: &SampleFilter, after: Option<SampleKey>, limit: u32) -> Result<Vec<StoredSample>>;

    /// At most `most` of the boxes without a fix that a filter selects, in order of time and target. Of
    /// more, one of every few consecutive ones is taken, at a place that changes from few to few, so that
    /// none of several simultaneous targets is preferred.
    ///
    /// # Errors
    /// [`ErrorKind::CameraNotFound`].
    fn thinned_detections(&self, id: &CameraId, filter: &SampleFilter, most: u32) -> Result<Vec<Detection>>;

    /// Number of samples that a filter selects.
    ///
    /// # Errors
    /// [`ErrorKind::CameraNotFound`].
    fn count_samples(&self, id: &CameraId, filter: &SampleFilter) -> Result<u64>;

    /// Number of samples with a fix that a filter selects and that state the truth.
    ///
    /// # Errors
    /// [`ErrorKind::CameraNotFound`].
    fn count_truths(&self, id: &CameraId, filter: &SampleFilter) -> Result<u64>;

    /// Time of the sample with a fix that has this number before it, in order of time; `None` after the last.
    ///
    /// # Errors
    /// [`ErrorKind::CameraNotFound`].
    fn sample_time(&self, id: &CameraId, before: u64) -> Result<Option<Timestamp>>;

    /// Number of samples with a fix that a filter selects, and the corners of the ground they cover (south-west,
    /// north-east in degrees; across the antimeridian, of the whole parallel).
    ///
    /// # Errors
    /// [`ErrorKind::CameraNotFound`].
    fn sample_extent(&self, id: &CameraId, filter: &SampleFilter) -> Result<(u64, Option<[Position; 2]>)>;

    /// Deletes the samples that a filter selects; returns how many.
    ///
    /// # Errors
    /// [`ErrorKind::CameraNotFound`].
    fn delete_samples(&self, id: &CameraId, filter: &SampleFilter, now: Timestamp) -> Result<u64>;

    /// Queues a run of a camera, or over all cameras of a site; of several requests with the same record, the first
    /// queues a run and the others get it.
    ///
    /// # Errors
    /// [`ErrorKind::CameraNotFound`] or [`ErrorKind::SiteNotFound`]; [`ErrorKind::RunLive`] if the camera or the site
    /// has a run that has not ended, [`ErrorKind::Overloaded`] if all of its kind together have `max_live` of them;
    /// [`ErrorKind::IdempotencyKeyReused`] for a key of another request.
    fn insert_run<S: RunSubject>(&self, run: RunId, subject: &S, options: &S::Options, max_live: u32, record: Option<&IdempotencyRecord>, now: Timestamp) -> Result<TrainingRun<S>>;

    /// One run of a camera or a site.
    ///
    /// # Errors
    /// [`ErrorKind::CameraNotFound`] or [`ErrorKind::SiteNotFound`]; [`ErrorKind::RunNotFound`].
    fn run<S: RunSubject>(&self, subject: &S, run: RunId) -> Result<TrainingRun<S>>;

    /// A page of runs of a camera or a site, newest first, before an id.
    ///
    /// # Errors
    /// [`ErrorKind::CameraNotFound`] or [`ErrorKind::SiteNotFound`].
    fn runs<S: RunSubject>(&self, subject: &S, before: Option<RunId>, limit: u32) -> Result<Vec<TrainingRun<S>>>;

    /// Claims the oldest run that is queued or whose lease has expired. Its attempt and fence go up by
    /// one; its curve and progress are reset. Leases of all jobs are measured by the clock of the database's server, or
    /// by `now` in a data folder.
    ///
    /// # Errors
    /// Faults only.
    fn claim_run<S: RunSubject>(&self, lease: Duration, now: Timestamp) -> Result<Option<Claim<TrainingRun<S>>>>;

    /// Renews the lease and stores the run's progress.
    ///
    /// # Errors
    /// Faults only.
    fn heartbeat_run<S: RunSubject>(&self, run: RunId, fence: i64, progress: &RunProgress, lease: Duration, now: Timestamp) -> Result<Heartbeat>;

    /// Cancels a run: at once where no worker holds a live lease on it, otherwise at its worker's next
    /// heartbeat. Once this has returned, the run produces no model any more.
    ///
    /// # Errors
    /// [`ErrorKind::CameraNotFound`] or [`ErrorKind::SiteNotFound`]; [`ErrorKind::RunNotFound`],
    /// [`ErrorKind::RunEnded`].
    fn cancel_run<S: RunSubject>(&self, subject: &S, run: RunId, now: Timestamp) -> Result<TrainingRun<S>>;

    /// Ends a run, or returns it to the queue, if the worker still owns its lease; `None` if it lost it,
    /// and then nothing was changed. The models, their activation and the run's state are one transaction. A
    /// run whose cancellation was requested is cancelled even if it succeeded or was returned. The run of a site fails,
    /// and nothing else is stored, if a camera was deleted, has left the site, or has another active version than
    /// its model was compared with.
    ///
    /// # Errors
    /// Faults only.
    fn finish_run<S: RunSubject>(&self, run: RunId, fence: i64, end: JobEnd<S::Output<'_>>, now: Timestamp) -> Result<Option<TrainingRun<S>>>;

    /// Adds points to the curve of a run. An epoch that is there already is replaced. Does nothing
    /// once the lease was lost or the run has ended, which the next heartbeat reports.
    ///
    /// # Errors
    /// Faults only.
    fn append_epochs(&self, run: RunId, fence: i64, epochs: &[EpochReport]) -> Result<()>;

    /// Adds a line to the log of a run, which keeps its latest 1,000 lines of 4,000 bytes over all
    /// attempts. Does nothing once the lease was lost.
    ///
    /// # Errors
    /// Faults only.
    fn append_log(&self, run: RunId, fence: i64, now: Timestamp, line: &str) -> Result<()>;

    /// The curve of a run's latest attempt, by epoch.
    ///
    /// # Errors
    /// [`ErrorKind::RunNotFound`].
    fn epochs(&self, run: RunId) -> Result<Vec<EpochReport>>;

    /// The log of a run, oldest line first.
    ///
    /// # Errors
    /// [`ErrorKind::RunNotFound`].
    fn log(&self, run: RunId) -> Result<Vec<(Timestamp, String)>>;

    /// Stores an imported model as the camera's next version; it does not become active.
    ///
    /// # Errors
    /// [`ErrorKind::CameraNotFound`].
    fn insert_model(&self, camera: &CameraId, metadata: &ModelMetadata, weights: &[u8], now: Timestamp) -> Result<ModelVersion>;

    /// One version, without its weights.
    ///
    /// # Errors
    /// [`ErrorKind::CameraNotFound`], [`ErrorKind::ModelNotFound`].
    fn model(&self, camera: &CameraId, number: u32) -> Result<ModelVersion>;

    /// The picture of what a camera sees; `None` if nobody has set one.
    ///
    /// # Errors
    /// [`ErrorKind::CameraNotFound`].
    fn picture(&self, camera: &CameraId) -> Result<Option<Picture>>;

    /// Sets the picture of what a camera sees, or removes it.
    ///
    /// # Errors
    /// [`ErrorKind::CameraNotFound`]; [`ErrorKind::InsufficientStorage`].
    fn set_picture(&self, camera: &CameraId, picture: Option<&Picture>, now: Timestamp) -> Result<()>;

    /// Metadata and weights of one version, as they were stored.
    ///
    /// # Errors
    /// [`ErrorKind::CameraNotFound`], [`ErrorKind::ModelNotFound`]; [`ErrorKind::ModelUnusable`] where what
    /// is stored does not match its checksum or cannot be read.
    fn model_content(&self, camera: &CameraId, number: u32) -> Result<(ModelMetadata, Vec<u8>)>;

    /// The held-out errors that were stored with a version, each with its sample as long as that is
    /// stored; by time and target.
    ///
    /// # Errors
    /// [`ErrorKind::CameraNotFound`].
    fn held_out_errors(&self, camera: &CameraId, number: u32) -> Result<Vec<StoredHeldOutError>>;

    /// A page of versions, newest first, before a number.
    ///
    /// # Errors
    /// [`ErrorKind::CameraNotFound`].
    fn models(&self, camera: &CameraId, before: Option<u32>, limit: u32) -> Result<Vec<ModelVersion>>;

    /// Makes a version the active one. Naming the active one changes nothing.
    ///
    /// # Errors
    /// [`ErrorKind::CameraNotFound`], [`ErrorKind::ModelNotFound`].
    fn activate_model(&self, camera: &CameraId, number: u32, now: Timestamp) -> Result<Camera>;

    /// Makes the version active that was before the active one. Repeated calls go further back.
    ///
    /// # Errors
    /// [`ErrorKind::CameraNotFound`], [`ErrorKind::NoModel`] if none is active, [`ErrorKind::NoEarlierModel`]
    /// if none was active before.
    fn roll_back(&self, camera: &CameraId, now: Timestamp) -> Result<Camera>;

    /// The cameras that have an active model, with its number.
    ///
    /// # Errors
    /// Faults only.
    fn active_models(&self) -> Result<Vec<(CameraId, u32)>>;

    /// Deletes a model version that is not the active one. Its number is never assigned again.
    ///
    /// # Errors
    /// [`ErrorKind::CameraNotFound`], [`ErrorKind::ModelNotFound`], [`ErrorKind::ModelActive`].
    fn delete_model(&self, camera: &CameraId, number: u32, now: Timestamp) -> Result<()>;

    /// Deletes a training run that has ended, with its log and its curve. The model version that it
    /// yielded stays.
    ///
    /// # Errors
    /// [`ErrorKind::CameraNotFound`], [`ErrorKind::RunNotFound`], [`ErrorKind::RunLive`].
    fn delete_run(&self, camera: &CameraId, run: RunId, now: Timestamp) -> Result<()>;

    /// Queues an evaluation.
    ///
    /// # Errors
    /// [`ErrorKind::CameraNotFound`], [`ErrorKind::Overloaded`] if all cameras together have
    /// `max_live` of them that have not ended.
    fn insert_evaluation(&self, id: EvaluationId, camera: &CameraId, plan: &EvaluationPlan, max_live: u32, now: Timestamp) -> Result<EvaluationJob>;

    /// One evaluation.
    ///
    /// # Errors
    /// [`ErrorKind::EvaluationNotFound`].
    fn evaluation(&self, id: EvaluationId) -> Result<EvaluationJob>;

    /// The report of an evaluation as it was stored, `None` unless it has succeeded.
    ///
    /// # Errors
    /// [`ErrorKind::EvaluationNotFound`].
    fn evaluation_report(&self, id: EvaluationId) -> Result<Option<String>>;

    /// A page of evaluations, of a camera or of all, newest first, before an id.
    ///
    /// # Errors
    /// [`ErrorKind::CameraNotFound`].
    fn evaluations(&self, camera: Option<&CameraId>, before: Option<EvaluationId>, limit: u32) -> Result<Vec<EvaluationJob>>;

    /// Claims the oldest evaluation that is queued or whose lease has expired. Its attempt and fence go
    /// up by one; its progress is reset.
    ///
    /// # Errors
    /// Faults only.
    fn claim_evaluation(&self, lease: Duration, now: Timestamp) -> Result<Option<Claim<EvaluationJob>>>;

    /// Renews the lease and stores the evaluation's progress.
    ///
    /// # Errors
    /// Faults only.
    fn heartbeat_evaluation(&self, id: EvaluationId, fence: i64, progress: &EvaluationProgress, lease: Duration, now: Timestamp) -> Result<Heartbeat>;

    /// Cancels an evaluation: at once where no worker holds a live lease on it, otherwise at its worker's
    /// next heartbeat. Once this has returned, it produces no report any more.
    ///
    /// # Errors
    /// [`ErrorKind::EvaluationNotFound`], [`ErrorKind::EvaluationEnded`].
    fn cancel_evaluation(&self, id: EvaluationId, now: Timestamp) -> Result<EvaluationJob>;

    /// Ends an evaluation, or returns it to the queue, if the worker still owns its lease; `None` if it
    /// lost it, and then nothing was changed. One whose cancellation was requested is cancelled even if it
    /// succeeded or was returned.
    ///
    /// # Errors
    /// Faults only.
    fn finish_evaluation(&self, id: EvaluationId, fence: i64, end: JobEnd<String>, now: Timestamp) -> Result<Option<EvaluationJob>>;

    /// Deletes an evaluation, whatever its state; its worker learns of it by its next heartbeat.
    ///
    /// # Errors
    /// [`ErrorKind::EvaluationNotFound`].
    fn delete_evaluation(&self, id: EvaluationId, now: Timestamp) -> Result<()>;

    /// Number of jobs that have not ended.
    ///
    /// # Errors
    /// Faults only.
    fn job_counts(&self) -> Result<JobCounts>;

    /// Stores a key. The oldest keys that no longer work make room for it. Where a key with the same secret is stored
    /// already, also by another process at the same time, nothing is changed and that key is returned.
    ///
    /// # Errors
    /// [`ErrorKind::InsufficientStorage`] if as many keys as allowed are in use.
    fn insert_key(&self, id: KeyId, key: &NewKey, digest: &SecretDigest, now: Timestamp) -> Result<ApiKey>;

    /// One key.
    ///
    /// # Errors
    /// [`ErrorKind::KeyNotFound`].
    fn key(&self, id: KeyId) -> Result<ApiKey>;

    /// A page of keys, newest first, before an id.
    ///
    /// # Errors
    /// Faults only.
    fn keys(&self, before: Option<KeyId>, limit: u32) -> Result<Vec<ApiKey>>;

    /// The keys that were not revoked, with their digests.
    ///
    /// # Errors
    /// Faults only.
    fn unrevoked_keys(&self) -> Result<Vec<(ApiKey, SecretDigest)>>;

    /// The key with a digest, whether it still works or not.
    ///
    /// # Errors
    /// Faults only.
    fn key_by_digest(&self, digest: &SecretDigest) -> Result<Option<ApiKey>>;

    /// The version of the keys, which changes when a key does.
    ///
    /// # Errors
    /// Faults only.
    fn keys_version(&self) -> Result<KeysVersion>;

    /// Revokes a key. One that is revoked already stays as it is.
    ///
    /// # Errors
    /// [`ErrorKind::KeyNotFound`].
    fn revoke_key(&self, id: KeyId, now: Timestamp) -> Result<ApiKey>;

    /// Records in the audit log that the caller has signed in. A power cut may undo it.
    ///
    /// # Errors
    /// Faults only.
    fn record_sign_in(&self, now: Timestamp) -> Result<()>;

    /// Stores when keys were used last. A power cut may undo it.
    ///
    /// # Errors
    /// Faults only.
    fn note_key_uses(&self, uses: &[(KeyId, Timestamp)]) -> Result<()>;

    /// A page of the audit log, of a camera or of all, newest first, before a number.
    ///
    /// # Errors
    /// Faults only.
    fn audit_log(&self, camera: Option<&CameraId>, before: Option<AuditNumber>, limit: u32) -> Result<Vec<AuditEntry>>;

    /// The answer that is stored under a key of the caller, if there is one that has not expired.
    ///
    /// # Errors
    /// Faults only.
    fn stored_answer(&self, key: &IdempotencyKey, now: Timestamp) -> Result<Option<StoredAnswer>>;

    /// Housekeeping, to be called every few seconds: sets the reserve aside again, gives freed pages
    /// back to the disk, counts, and logs which other processes have come. Tells how much is stored.
    ///
    /// # Errors
    /// Faults only.
    fn maintain(&self) -> Result<StorageStatus>;

    /// The time for everything that is stored: of the clock of a database's server, which all processes share; for a
    /// data folder, of the clock of its process, which is handed in.
    ///
    /// # Errors
    /// Faults only.
    fn time(&self, now: Timestamp) -> Result<Timestamp>;

    /// Time of the newest sample of all cameras; `None` if there is none.
    ///
    /// # Errors
    /// Faults only.
    fn newest_sample(&self) -> Result<Option<Timestamp>>;

    /// Makes room for the samples of the weeks to come, where they are stored by week, and deletes those of before an
    /// instant; there, weeks that are over at that instant. The audit log says so. Returns how many.
    ///
    /// # Errors
    /// [`ErrorKind::Overloaded`] while others use what is to be dropped. The next call goes on.
    fn retain_samples(&self, since: Option<Timestamp>, now: Timestamp) -> Result<u64>;

    /// Appends to the recording of a camera, and deletes its oldest parts beyond the bounds. Appends nothing to a camera that
    /// was deleted.
    ///
    /// # Errors
    /// [`ErrorKind::InsufficientStorage`].
    fn append_recording(&self, camera: CameraKey, part: &RecordingPart, bounds: RecordingBounds) -> Result<()>;

    /// The contents of a camera's recording, oldest part first.
    ///
    /// # Errors
    /// Faults only.
    fn recording(&self, camera: CameraKey) -> Result<Vec<Vec<u8>>>;

    /// Deletes what was recorded before an instant, and all of cameras that have a model or do not learn automatically; the
    /// number of parts.
    ///
    /// # Errors
    /// Faults only.
    fn retain_recordings(&self, since: Timestamp) -> Result<u64>;

    /// Stores a new connection with revision 1.
    ///
    /// # Errors
    /// [`ErrorKind::ConnectionExists`]; [`ErrorKind::InsufficientStorage`] beyond the limit of connections.
    fn insert_connection(&self, profile: &NewConnection, now: Timestamp) -> Result<Connection>;

    /// One connection, with its secrets.
    ///
    /// # Errors
    /// [`ErrorKind::ConnectionNotFound`].
    fn connection(&self, id: &ConnectionId) -> Result<Connection>;

    /// A page of connections ordered by id, after an id.
    ///
    /// # Errors
    /// Faults only.
    fn connections(&self, after: Option<&ConnectionId>, limit: u32) -> Result<Vec<Connection>>;

    /// Replaces the stored profile and counts its revision up, if the stored revision is the
    /// expected one.
    ///
    /// # Errors
    /// [`ErrorKind::ConnectionNotFound`], [`ErrorKind::RevisionMismatch`].
    fn replace_connection(&self, profile: &NewConnection, expected: Option<ExpectedVersion<ConnectionKey>>, now: Timestamp) -> Result<Connection>;

    /// Deletes a connection with its outbox, if its revision is the expected one.
    ///
    /// # Errors
    /// [`ErrorKind::ConnectionNotFound`], [`ErrorKind::RevisionMismatch`].
    fn delete_connection(&self, id: &ConnectionId, expected: Option<ExpectedVersion<ConnectionKey>>, now: Timestamp) -> Result<()>;

    /// Appends messages of a process's log, in the order of their numbers, but for those that were appended before; how
    /// many of the oldest were dropped for the limit. Without messages only the log is noted. A connection that was deleted
    /// takes none.
    ///
    /// # Errors
    /// [`ErrorKind::InsufficientStorage`]; then none is stored.
    fn append_to_outbox(&self, key: ConnectionKey, log: &OutboxLog, messages: &[OutboxMessage]) -> Result<u64>;

    /// Connections whose logs were left open by processes that have ended: messages of theirs may be lost. Each is returned
    /// once. Where several processes share the database, one has ended when it has not been registered for ten seconds.
    ///
    /// # Errors
    /// Faults only.
    fn lost_outbox_logs(&self, own: &OutboxLog) -> Result<Vec<ConnectionKey>>;

    /// Notes that all messages of a process's log are in the outboxes of these connections, and that none will come.
    ///
    /// # Errors
    /// Faults only.
    fn close_outbox_logs(&self, own: &OutboxLog, connections: &[ConnectionKey]) -> Result<()>;

    /// The oldest waiting messages.
    ///
    /// # Errors
    /// Faults only.
    fn outbox(&self, key: ConnectionKey, limit: u32) -> Result<Vec<OutboxMessage>>;

    /// Removes what was delivered, and sets aside what was refused, with the reason. The oldest dead letters beyond
    /// the limit are deleted. A power cut may undo it; then the messages are delivered again.
    ///
    /// # Errors
    /// Faults only.
    fn settle_outbox(&self, key: ConnectionKey, outcomes: &[(i64, Result<(), String>)]) -> Result<()>;

    /// Dead letters of a connection, oldest first, after a number.
    ///
    /// # Errors
    /// Faults only.
    fn dead_letters(&self, key: ConnectionKey, after: i64, limit: u32) -> Result<Vec<DeadLetter>>;

    /// Puts all dead letters of a connection back among the waiting messages; how many.
    ///
    /// # Errors
    /// Faults only.
    fn retry_dead_letters(&self, connection: &Connection, now: Timestamp) -> Result<u64>;

    /// Deletes all dead letters of a connection; how many.
    ///
    /// # Errors
    /// Faults only.
    fn delete_dead_letters(&self, connection: &Connection, now: Timestamp) -> Result<u64>;

    /// The numbers of messages in the outbox of a connection.
    ///
    /// # Errors
    /// Faults only.
    fn outbox_counts(&self, key: ConnectionKey) -> Result<OutboxCounts>;

    /// How far a source has read the partitions of its topics.
    ///
    /// # Errors
    /// Faults only.
    fn source_offsets(&self, key: ConnectionKey) -> Result<Vec<SourceOffset>>;

    /// Stores how far a source has read partitions, all or none. A connection that was deleted has no offsets. A power cut
    /// may undo what is stored as `relaxed`; then messages are read again.
    ///
    /// # Errors
    /// [`ErrorKind::InsufficientStorage`]; then none is stored.
    fn store_source_offsets(&self, key: ConnectionKey, offsets: &[SourceOffset], durability: Durability) -> Result<()>;
}
