//! World tracks: one track per target of a site, from the detections of all its cameras and the fixes of its
//! receivers.
//!
//! Each camera's frame is assigned to the tracks as a whole (global nearest neighbour), tracks have two
//! constant-velocity modes, and two tracks that turn out to be of one target are merged. The error of a detection has
//! three parts: the noise of the box goes into the filter, what lasts of a camera's own error is a state per track and
//! camera, and what all cameras have in common is added to the output only, for it does not average out.
//! Does not use I/O, clocks, randomness, pixels or degrees.

pub mod assignment;
mod association_cost;
mod camera_clocks;
mod camera_moves;
mod camera_offset;
mod comparisons;
mod constant_velocity;
mod frame;
mod map_difference;
mod merging;
mod settings;
#[cfg(test)]
mod tests;
mod tracker;
mod world_track;

pub use frame::{
    CameraFrame, FixOutcome, FrameOutcome, MovedCamera, TimedEvent, WorldDetection, WorldEvent, WorldTrackId,
};
pub use settings::WorldTrackSettings;
pub use tracker::WorldTracker;
pub use world_track::{Sighting, TrackStatus, WorldState, WorldTrack};
