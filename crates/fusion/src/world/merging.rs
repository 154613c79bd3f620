//! Which tracks are of one target: two tracks that stay at the same place while each camera sees only one of
//! them.

use std::collections::BTreeMap;

use super::frame::WorldTrackId;
use super::settings::WorldTrackSettings;
use super::world_track::{WorldTrack, seconds_from};

/// Squared Mahalanobis distance within which two tracks are at the same place: the 95 % quantile of chi-square
/// with 2 degrees of freedom.
const SAME_PLACE: f64 = 5.99;
/// Two tracks can only be compared while both are measured, s.
const RECENT_S: f64 = 1.0;
/// Frames of evidence for one target that one frame with both of them in one camera outweighs.
const SEPARATE_FRAMES: i32 = 12;

/// Frames in which a pair of tracks was at one place.
#[derive(Debug, Clone, Default)]
pub(super) struct MergeCandidates {
    common_frames: BTreeMap<(WorldTrackId, WorldTrackId), i32>,
}

impl MergeCandidates {
    /// Compares the tracks that a frame measured (by their indexes) with all others; returns the pairs of one
    /// target, the older track first.
    pub(super) fn compare(
        &mut self,
        tracks: &[WorldTrack],
        measured: &[usize],
        settings: &WorldTrackSettings,
    ) -> Vec<(WorldTrackId, WorldTrackId)> {
        let mut merged = Vec::new();
        for &at in measured {
            let one = &tracks[at];
            for (index, other) in tracks.iter().enumerate() {
                if index == at || !is_near(one, other) {
                    continue;
                }
                let key = (one.id.min(other.id), one.id.max(other.id));
                let in_same_frame = measured.contains(&index);
                let frames = self.common_frames.entry(key).or_insert(0);
                if in_same_frame {
                    *frames = -SEPARATE_FRAMES;
                } else if is_comparable(one, other) && are_at_one_place(one, other) {
                    *frames += 1;
                    if *frames >= settings.merging_frames as i32 {
                        merged.push(key);
                    }
                }
            }
        }
        merged.sort_unstable();
        merged.dedup();
        merged
    }

    /// Forgets the pairs of tracks that have ended.
    pub(super) fn retain(&mut self, is_live: impl Fn(WorldTrackId) -> bool) {
        self.common_frames.retain(|(one, other), _| is_live(*one) && is_live(*other));
    }
}

/// True if the distance may be within the gate: a quick test before the exact one.
fn is_near(one: &WorldTrack, other: &WorldTrack) -> bool {
    const FAR_M: f64 = 10.0;
    one.filter.position().distance_m(other.filter.position()) < FAR_M
}

/// A receiver's fixes are metres off: being near them for some frames does not tell who carries it.
fn is_comparable(one: &WorldTrack, other: &WorldTrack) -> bool {
    if one.is_measured_by_receiver() || other.is_measured_by_receiver() {
        return false;
    }
    let identities_differ =
        one.receiver.is_some() && other.receiver.is_some() && one.receiver != other.receiver;
    !identities_differ && seconds_from(other.last_seen, one.time) <= RECENT_S
}

fn are_at_one_place(one: &WorldTrack, other: &WorldTrack) -> bool {
    let difference = one.filter.position().minus(other.filter.position());
    let offsets_m2 = one.offset_covariance_m2.plus(other.offset_covariance_m2);
    let covariance = one.gating_covariance().plus(other.gating_covariance()).plus(offsets_m2);
    covariance.mahalanobis_squared(difference) <= SAME_PLACE
}
