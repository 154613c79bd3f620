//! Files of samples, observations, fixes and fused positions: CSV, NDJSON, JSON, GeoJSON,
//! NMEA, GPX and gpsd's log.
//!
//! REST, the command line and evaluation all use these readers and writers, so a file has the same
//! meaning everywhere. They stream: memory is bounded by one line or element of at most 64 KiB,
//! regardless of the length of the file. An invalid row does not affect the others: an error with its
//! line, field and reason takes its place. Numbers are checked by the constructors of
//! [`sightfix_domain`] only. Transports and storage are elsewhere; no clock is read here.
//!
//! | part | contents |
//! |---|---|
//! | [`read_samples`] and its like, [`FusedWriter`] and its like | whole files, row by row |
//! | [`decoder`], [`MessageItem`] | single messages of a source, in the formats of receivers, detectors and brokers |
//! | [`wire`] | the JSON objects that files, messages and REST have in common |
//! | [`ConnectionSettings`], [`Address`] | where messages come from and go to, as it is configured |
//! | [`Cursor`] | the key after which the next page of a list begins, as text |

#![warn(missing_docs)]
// Input of clients reaches this module: nothing in it may end the process.
#![warn(clippy::expect_used, clippy::panic, clippy::unreachable)]

mod address;
mod columns;
mod connection;
mod csv_header;
mod csv_layout;
mod csv_rows;
mod cursor;
mod elements;
mod feature;
mod file_row;
mod fit;
mod fix_quality;
mod fix_row;
mod fixes;
mod format;
mod formula_guard;
mod frame_files;
mod gnss_logger;
mod gpsd;
mod gpx;
mod history;
mod home_assistant;
mod json_errors;
mod json_violations;
pub mod kinds;
mod lines;
mod messages;
mod mot;
mod moving_features;
mod nmea_fixes;
mod objects_only;
mod onvif_device;
mod outgoing;
mod recording;
mod rows;
mod rtklib;
mod source_decoder;
#[cfg(test)]
mod tests;
mod track_files;
mod unix_time;
pub mod wire;
mod write;
mod xml;

pub use address::{Address, bracketed};
pub use connection::{
    CameraMapping, ConnectionDraft, ConnectionSettings, ImagePoint, OutgoingFormat, ReceiverFrom, Secrets,
    SinkSettings, SourceSettings,
};
pub use csv_layout::{BoxForm, BoxUnit, ColumnNames, CsvLayout, LaidOut};
pub use cursor::{Cursor, read_cursor, write_cursor};
pub use file_row::RowError;
pub use fixes::{TimedFix, read_fixes, read_received_fixes};
pub use format::{FixFormat, Format};
pub use frame_files::{FrameClock, FrameFileFormat, frame_number, read_frame_file};
pub use history::{HistoryFormat, HistoryWriter};
pub use home_assistant::{home_assistant_attributes, home_assistant_discovery};
pub use messages::{
    BoxMapping, DetectedBox, JsonMapping, MessageContext, MessageDecoder, MessageFormat, MessageItem,
    NamedDetection, Reading, decoder,
};
pub use mot::MotFrames;
pub use moving_features::{MovingFeature, MovingFeatures, MovingTarget, PathPoint};
pub use onvif_device::{OnvifRequest, SOAP};
pub use outgoing::{OutgoingPosition, cot_event, onvif_frame, position_json};
pub use recording::{read_recording, write_recording};
pub use rows::{
    ObservedRow, RowRules, read_detections, read_live_items, read_observation_features, read_observations,
    read_samples,
};
pub use source_decoder::source_decoder;
pub use track_files::{TrackFile, TrackFileFormat};
pub use write::{FusedWriter, MatchedSampleWriter, SampleWriter, write_fused, write_samples};

use sightfix_domain::{domain, geo};

/// Largest line of a CSV, NDJSON or NMEA file and largest element of a JSON array, bytes.
pub const MAX_ROW_BYTES: usize = 64 * 1024;
