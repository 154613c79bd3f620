//! Domain values, valid by construction.
//!
//! Every check on a number is in a constructor here or in [`crate::geo`]; the layers above rely on
//! it and do not check again.

// Input of clients reaches this module: nothing in it may end the process.
#![warn(clippy::expect_used, clippy::panic, clippy::unreachable)]

mod access;
mod audit;
mod bounding_box;
mod camera;
mod checksum;
mod connection;
mod durability;
mod error;
mod evaluation;
mod gnss_error;
mod history;
mod idempotency;
mod image_area;
mod job;
mod known_point;
mod live_id;
mod method;
mod model_format;
mod motion;
mod names;
mod node;
mod noise;
mod observation;
mod on_conflict;
mod picture;
mod place;
mod receiver;
mod recipe;
mod recording_part;
mod sample;
mod sample_filter;
mod sample_overflow;
mod score;
mod site;
mod site_training;
mod snapshot;
mod time;
mod track_scope;
mod training_run;

pub use access::{ApiKey, KeyId, KeySecret, NewKey, Role, Scope, SecretDigest};
pub use audit::{Actor, AuditAction, AuditEntry, AuditNumber};
pub use bounding_box::{BoundingBox, ImageSize};
pub use camera::{Camera, CameraChange, CameraKey, CameraMoved, ExpectedVersion, NewCamera, Revision};
pub use checksum::model_sha256;
pub use connection::{
    Connection, ConnectionKey, DeadLetter, NewConnection, OutboxCounts, OutboxLog, OutboxMessage,
    SourceOffset,
};
pub use durability::Durability;
pub use error::{Error, ErrorKind, Fault, MOST_VIOLATIONS, Refusal, Result, Violation, convert_all};
pub use evaluation::{EvaluationJob, EvaluationPlan, EvaluationProgress, TimeRange, Truth};
pub use gnss_error::{GnssBiasSigma, GnssError, SigmaM};
pub use history::{ArchivedPosition, HistoryKey, HistorySettings, TRACK_GAP};
pub use idempotency::{IdempotencyKey, IdempotentRequest, RequestDigest, RequestHasher};
pub use image_area::ImageArea;
pub use job::{EvaluationId, JobState, RunId};
pub use known_point::KnownPoint;
pub use live_id::LiveId;
pub use method::{InferenceMode, Method};
pub use model_format::ModelFormat;
pub use motion::{Acceleration, Course, Motion, Velocity};
pub use names::{
    CameraId, ConnectionId, MAX_LABELS, PlaceId, ReceiverId, SiteId, TargetClass, TargetId, TrackerId,
    check_labels, check_text,
};
pub use node::{Node, NodeId, NodeProfile};
pub use noise::{GaussMarkovNoise, NoiseCorrelation, SessionBias};
pub use observation::{Confidences, Detection, Fix, Flag, FusedFix, LiveItem, Observation, ReceiverMatch};
pub use on_conflict::OnConflict;
pub use picture::{Picture, PictureFormat};
pub use place::{
    NewPlace, NewPlaceEvent, Place, PlaceCount, PlaceEventFilter, PlaceKey, StoredPlaceEvent,
    StoredPlaceEvents,
};
pub use receiver::{ClockOffset, ReceivedFix, Receiver, Receivers};
pub use recipe::Recipe;
pub use recording_part::{RecordingBounds, RecordingPart};
pub use sample::{Association, Sample, SampleCount, StoredSample};
pub use sample_filter::{SampleFilter, SampleKey};
pub use sample_overflow::SampleOverflow;
pub use score::Score;
pub use site::{NewSite, Site, SiteChange, SiteKey};
pub use site_training::{SiteCameraFinding, SiteTrainingOptions, SiteTrainingReport};
pub use snapshot::SnapshotSource;
pub use time::{TimeBounds, parse_time, parse_time_in, parse_time_zone};
pub use track_scope::TrackScope;
pub use training_run::{
    CandidateFinding, CandidateReport, EpochReport, FeatureScale, GnssErrorSource, HeldOutError,
    HeldOutSampleError, JointTraining, ModelMetadata, ModelVersion, OriginDeg, RunProgress, TrainingOptions,
    TrainingReport, TrainingRun, TrainingSubject,
};
