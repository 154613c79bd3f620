//! The samples of each target in order of time, divided at gaps, for estimates from sequences of fixes.

use crate::domain::Sample;
use crate::filters::Traverse;
use crate::geo::LocalPlane;

/// A gap longer than this ends a sequence, s.
const MAX_GAP_S: f64 = 10.0;

/// The samples of each target without gaps, in order of time.
pub(crate) fn sequences(samples: &[Sample]) -> Vec<Vec<&Sample>> {
    let mut sorted: Vec<&Sample> = samples.iter().collect();
    sorted.sort_by_key(|sample| (&sample.target_id, sample.time));
    let is_same = |one: &&Sample, next: &&Sample| {
        one.target_id == next.target_id && next.time.duration_since(one.time).as_secs_f64() <= MAX_GAP_S
    };
    sorted.chunk_by(is_same).map(<[&Sample]>::to_vec).collect()
}

/// The fixes of each of these sequences in a plane; times from 0 s.
#[must_use]
pub fn fix_sequences(samples: &[Sample], plane: &LocalPlane) -> Vec<Traverse> {
    sequences(samples)
        .into_iter()
        .map(|samples| {
            let elapsed_s = |sample: &&Sample| sample.time.duration_since(samples[0].time).as_secs_f64();
            let fixes = samples.iter().map(|sample| plane.to_plane(sample.fix.position)).collect();
            (samples.iter().map(elapsed_s).collect(), fixes)
        })
        .collect()
}
