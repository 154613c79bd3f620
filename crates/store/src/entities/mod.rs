//! The stored entities, a file each, with statements that both backends execute.

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
mod place_counts;
mod place_events;
mod places;
mod recordings;
mod retention;
mod run_progress;
mod runs;
mod sample_retention;
mod samples;
mod site_runs;
mod sites;
mod source_offsets;

pub use runs::RunSubject;
