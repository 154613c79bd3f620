//! Parameters of a replay.

use std::num::NonZeroU64;
use std::time::Duration;

use jiff::SignedDuration;

use super::fault_injection::FaultShares;
use super::paced_feed::Pace;
use crate::domain::{CameraId, KeySecret};

/// Parameters of a replay.
#[derive(Debug, Clone)]
pub struct ReplayOptions {
    /// Address of the server, such as `http://127.0.0.1:8080`.
    pub server: String,
    /// Key to present, if the server asks for one.
    pub key: Option<KeySecret>,
    /// Cameras of the server. Simulated cameras are assigned to them round robin; where several share
    /// one, their target ids get a suffix, so that they are distinct targets.
    pub camera_ids: Vec<CameraId>,
    /// Number of simulated cameras, each with its own stream.
    pub cameras: usize,
    /// Prefix of the streams' client names; the simulated camera's number follows.
    pub client_name: String,
    /// When items are sent.
    pub pace: Pace,
    /// Items that are due within this time from the beginning are sent at once.
    pub head_start: Duration,
    /// Repetitions of the recording, each shifted in time after the one before.
    pub repetitions: NonZeroU64,
    /// No item is sent after this time; `repetitions` is then ignored.
    pub duration: Option<Duration>,
    /// Added to every item's time.
    pub shift: SignedDuration,
    /// Largest number of unanswered items per camera.
    pub in_flight: usize,
    /// Capacity of the resend buffer per camera; while it is full no new item is sent.
    pub resend_buffer: usize,
    /// True if the server stores the items as training samples and must acknowledge them.
    pub store_samples: bool,
    /// Faults injected before items are sent.
    pub faults: FaultShares,
    /// Seed of faults, backoff and initial delays.
    pub seed: u64,
    /// Consecutive attempts to reconnect, without an answer in between, before a camera gives up.
    pub attempts: u32,
    /// A server that does not respond for this long, while a response is due, counts as unavailable.
    pub response_timeout: Duration,
}
