//! What is stored, an entity per file, with statements that both backends execute.

mod audit;
mod camera_contents;
mod camera_moves;
mod camera_runs;
mod cameras;
mod connections;
mod evaluations;
mod housekeeping;
mod idempotency;
mod jobs;
mod keys;
mod latest_runs;
mod models;
mod outbox;
mod pictures;
mod recordings;
mod retention;
mod runs;
mod sample_counts;
mod sample_retention;
mod samples;
mod site_runs;
mod sites;
mod source_offsets;
mod training;

pub(crate) use audit::record;
pub(crate) use camera_contents::all_versions;
pub(crate) use idempotency::insert_answer;
pub(crate) use keys::keys_version;
pub use runs::RunSubject;
pub(crate) use sample_counts::{count_all_samples, subtract};
pub(crate) use sample_retention::delete_oldest;
