//! The ids of a tracker that loses its targets and uses ids again.

use std::collections::{BTreeMap, VecDeque};

use jiff::Timestamp;
use rand::RngExt;
use rand_chacha::ChaCha8Rng;

use super::row::SimulatedRow;
use crate::domain::TargetId;

/// A target that was not seen for longer than this has left: it returns under another id.
const LOST_AFTER_S: f64 = 3.0;

/// An id in use.
struct Tracklet {
    number: usize,
    last_seen: Timestamp,
}

/// Replaces the ids of rows, which are in order of time, by those of a tracker. A tracklet ends when its
/// target leaves the view, or after a time that is exponentially distributed with that mean, s. Its id
/// goes to whichever other target needs one next.
pub(super) fn assign_ids(rows: &mut [SimulatedRow], mean_lifetime_s: f64, mut random: ChaCha8Rng) {
    let mut tracklets: BTreeMap<usize, Tracklet> = BTreeMap::new();
    let mut free: VecDeque<usize> = VecDeque::new();
    let mut used = 0;
    for row in rows {
        let since_s = |tracklet: &Tracklet| row.time.duration_since(tracklet.last_seen).as_secs_f64();
        let lost: Vec<usize> = tracklets
            .iter()
            .filter(|(_, tracklet)| since_s(tracklet) > LOST_AFTER_S)
            .map(|(&target, _)| target)
            .collect();
        free.extend(lost.iter().filter_map(|target| tracklets.remove(target)).map(|ended| ended.number));
        // The draw does not depend on the tracklets, so that another lifetime changes no other draw.
        let draw = random.random::<f64>();
        let breaks = tracklets
            .get(&row.target)
            .is_some_and(|own| draw < 1.0 - (-since_s(own) / mean_lifetime_s).exp());
        // The own id is freed only after the next one is taken: it goes to another target.
        let broken = if breaks { tracklets.remove(&row.target) } else { None };
        let tracklet = tracklets.entry(row.target).or_insert_with(|| {
            let number = free.pop_front().unwrap_or_else(|| {
                used += 1;
                used
            });
            Tracklet { number, last_seen: row.time }
        });
        free.extend(broken.map(|ended| ended.number));
        tracklet.last_seen = row.time;
        row.target_id = TargetId::new(&format!("track-{}", tracklet.number)).expect("short printable names");
    }
}
