//! The ids of a camera's tracker: they end with a gap, break now and then, and swap between neighbours.

use std::collections::BTreeMap;

use jiff::Timestamp;
use rand::RngExt;
use rand_chacha::ChaCha8Rng;

use super::options::SiteOptions;
use crate::domain::TargetId;
use crate::geo::EastNorth;

/// A target that was not seen for longer than this gets a new id, s.
const LOST_AFTER_S: f64 = 1.6;
/// Only ids of targets this close to each other are swapped, m.
const SWAP_WITHIN_M: f64 = 6.0;

/// The tracker of one camera.
pub(super) struct CameraTracker {
    lifetime_s: Option<f64>,
    swap_s: Option<f64>,
    frame_interval_s: f64,
    /// Id and time last seen, by target.
    current: BTreeMap<usize, (u64, Timestamp)>,
    used: u64,
    random: ChaCha8Rng,
}

impl CameraTracker {
    pub(super) fn new(options: &SiteOptions, random: ChaCha8Rng) -> Self {
        Self {
            lifetime_s: options.tracker_id_lifetime_s,
            swap_s: options.tracker_id_swap_s,
            frame_interval_s: options.frame_interval_s,
            current: BTreeMap::new(),
            used: 0,
            random,
        }
    }

    /// The ids of the targets that a frame shows, in their order.
    pub(super) fn ids(&mut self, time: Timestamp, seen: &[(usize, EastNorth)]) -> Vec<TargetId> {
        for (target, _) in seen {
            // Drawn whether or not it is used, so that another lifetime changes no other draw.
            let breaks = self.happens(self.lifetime_s);
            let is_lost = |last: Timestamp| time.duration_since(last).as_secs_f64() > LOST_AFTER_S;
            let number = match self.current.get(target) {
                Some(&(number, last)) if !breaks && !is_lost(last) => number,
                _ => self.take_number(),
            };
            self.current.insert(*target, (number, time));
        }
        if self.happens(self.swap_s) {
            self.swap_nearest(seen);
        }
        seen.iter().map(|(target, _)| id(self.current[target].0)).collect()
    }

    /// An id that no target has.
    pub(super) fn fresh_id(&mut self) -> TargetId {
        id(self.take_number())
    }

    fn swap_nearest(&mut self, seen: &[(usize, EastNorth)]) {
        let pairs = seen.iter().enumerate().flat_map(|(number, one)| {
            seen[number + 1..].iter().map(move |other| (one.1.distance_m(other.1), one.0, other.0))
        });
        let Some((distance_m, one, other)) = pairs.min_by(|a, b| a.0.total_cmp(&b.0)) else { return };
        if distance_m <= SWAP_WITHIN_M {
            let (first, second) = (self.current[&one], self.current[&other]);
            self.current.insert(one, second);
            self.current.insert(other, first);
        }
    }

    /// True if an event of that mean interval happens in this frame.
    fn happens(&mut self, mean_s: Option<f64>) -> bool {
        let draw = self.random.random::<f64>();
        mean_s.is_some_and(|mean_s| draw < 1.0 - (-self.frame_interval_s / mean_s).exp())
    }

    const fn take_number(&mut self) -> u64 {
        self.used += 1;
        self.used
    }
}

fn id(number: u64) -> TargetId {
    TargetId::new(&format!("track-{number}")).expect("short printable names")
}
