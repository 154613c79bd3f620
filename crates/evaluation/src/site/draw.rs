//! The same targets another time: other carriers of the receivers, other errors of the fixes, other boxes.

use std::collections::{BTreeMap, BTreeSet};

use jiff::{SignedDuration, Timestamp};
use rand::RngExt;
use rand_chacha::ChaCha8Rng;

use super::recording::{LabelledBox, RecordedCamera, RecordedFix, SiteRecording};
use crate::domain::{BoundingBox, GaussMarkovNoise, ImageSize, NoiseCorrelation, ReceiverId, TargetId};
use crate::geo::EastNorth;
use crate::simulation::{SimulatedReceiver, standard_normal, stream};

/// A carrier is seen by some camera for at least this time, s.
const LEAST_SEEN_S: f64 = 10.0;
/// Streams of a seed from this number on are those of receivers; those before, of carriers and cameras.
const FIRST_RECEIVER_STREAM: u64 = 1_000;
/// Interval of a receiver's fixes.
const FIX_INTERVAL: SignedDuration = SignedDuration::from_secs(1);
/// A phone's error per axis: Gauss-Markov and white, m, and the time constant of the former, s.
const COLOURED_M: f64 = 2.5;
const WHITE_M: f64 = 0.75;
const TIME_CONSTANT_S: f64 = 30.0;
/// Standard deviation of each edge of a box beside the noise that it was recorded with, in heights of the box.
const EDGE_SIGMA_HEIGHTS: f64 = 0.005;
/// An edge so near to the border of the image is cut by it, px.
const BORDER_PX: f64 = 1.0;
/// Share of the boxes that are missed.
const MISSED_SHARE: f64 = 0.03;
/// Mean time until a tracker gives a target another id, s.
const ID_LIFETIME_S: f64 = 60.0;

impl SiteRecording {
    /// The same targets with as many receivers, drawn from a seed: who carries them, the errors of their fixes, and the
    /// noise, gaps and ids of the boxes.
    #[must_use]
    pub fn redrawn(&self, seed: u64) -> Self {
        let carriers = self.drawn_carriers(&mut stream(seed, 0));
        let receivers: Vec<(ReceiverId, usize)> =
            self.receivers.iter().map(|own| own.0.clone()).zip(carriers).collect();
        let cameras = self.cameras.iter().zip(1..);
        Self {
            cameras: cameras
                .map(|(own, number)| redrawn_camera(own, self.image_size, stream(seed, number)))
                .collect(),
            fixes: self.drawn_fixes(&receivers, seed),
            receivers,
            ..self.clone()
        }
    }

    /// The same fixes with other errors at the true positions of their carriers, drawn from a seed.
    #[must_use]
    pub fn with_redrawn_fixes(&self, seed: u64) -> Self {
        let paths = self.true_paths();
        let mut drawn: BTreeMap<usize, (SimulatedReceiver, Timestamp)> = BTreeMap::new();
        let mut redrawn = self.clone();
        redrawn.fixes.retain_mut(|fix| {
            let target = self.receivers[fix.receiver].1;
            let Some(truth) = paths.get(&target).and_then(|path| position_at(path, fix.time)) else {
                return false;
            };
            let (receiver, latest) = drawn
                .entry(fix.receiver)
                .or_insert_with(|| (SimulatedReceiver::seeded(phone(), seed, fix.receiver as u64), fix.time));
            let since_s = fix.time.duration_since(*latest).as_secs_f64();
            *latest = fix.time;
            fix.position = receiver.measure(truth, since_s);
            true
        });
        redrawn
    }

    /// Targets that are seen for long enough, without repetition.
    fn drawn_carriers(&self, random: &mut ChaCha8Rng) -> Vec<usize> {
        let mut seen: BTreeMap<usize, BTreeSet<Timestamp>> = BTreeMap::new();
        for own in self.cameras.iter().flat_map(|camera| &camera.boxes) {
            if let Some(target) = own.target {
                seen.entry(target).or_default().insert(own.time);
            }
        }
        let length_s = |times: &BTreeSet<Timestamp>| match (times.first(), times.last()) {
            (Some(first), Some(last)) => last.duration_since(*first).as_secs_f64(),
            _ => 0.0,
        };
        seen.retain(|_, times| length_s(times) >= LEAST_SEEN_S);
        let mut targets: Vec<usize> = seen.into_keys().collect();
        let count = self.receivers.len().min(targets.len());
        for at in 0..count {
            let other = random.random_range(at..targets.len());
            targets.swap(at, other);
        }
        targets.truncate(count);
        targets
    }

    fn drawn_fixes(&self, receivers: &[(ReceiverId, usize)], seed: u64) -> Vec<RecordedFix> {
        let paths = self.true_paths();
        let of_receiver = |(receiver, (_, target)): (usize, &(ReceiverId, usize))| {
            let path = paths.get(target).map_or(&[][..], Vec::as_slice);
            drawn_fixes(receiver, path, seed)
        };
        let mut fixes: Vec<RecordedFix> = receivers.iter().enumerate().flat_map(of_receiver).collect();
        fixes.sort_by_key(|fix| (fix.time, fix.receiver));
        fixes
    }

    /// True positions by target, in the order of time.
    pub(super) fn true_paths(&self) -> BTreeMap<usize, Vec<(Timestamp, EastNorth)>> {
        let mut paths: BTreeMap<usize, Vec<(Timestamp, EastNorth)>> = BTreeMap::new();
        for ((time, target), position) in &self.truth {
            paths.entry(*target).or_default().push((*time, *position));
        }
        paths
    }
}

/// The error of a phone.
fn phone() -> GaussMarkovNoise {
    let variance_m2 = COLOURED_M.powi(2) + WHITE_M.powi(2);
    let correlation =
        NoiseCorrelation { white_share: WHITE_M.powi(2) / variance_m2, time_constant_s: TIME_CONSTANT_S };
    GaussMarkovNoise { variance_m2, correlation }
}

/// A fix per second along a path, from a drawn instant of the first second on.
fn drawn_fixes(receiver: usize, path: &[(Timestamp, EastNorth)], seed: u64) -> Vec<RecordedFix> {
    let Some((first, _)) = path.first() else { return Vec::new() };
    let number = FIRST_RECEIVER_STREAM + 2 * receiver as u64;
    let begin = *first + SignedDuration::from_millis(stream(seed, number).random_range(0..1_000));
    let mut measured = SimulatedReceiver::seeded(phone(), seed, number + 1);
    let times = (0..).map_while(|number| begin.checked_add(FIX_INTERVAL * number).ok());
    let along = times.map_while(|time| Some((time, position_at(path, time)?)));
    along
        .map(|(time, truth)| RecordedFix {
            receiver,
            time,
            position: measured.measure(truth, FIX_INTERVAL.as_secs_f64()),
        })
        .collect()
}

fn redrawn_camera(
    recorded: &RecordedCamera,
    image_size: Option<ImageSize>,
    mut random: ChaCha8Rng,
) -> RecordedCamera {
    let mut ids: BTreeMap<&TargetId, (TargetId, Timestamp)> = BTreeMap::new();
    let mut next = 0_u64;
    let mut boxes = Vec::with_capacity(recorded.boxes.len());
    for own in &recorded.boxes {
        let latest = ids.get(&own.tracker_id).map(|(_, time)| own.time.duration_since(*time).as_secs_f64());
        let is_lost =
            latest.is_none_or(|since_s| random.random::<f64>() < 1.0 - (-since_s / ID_LIFETIME_S).exp());
        if is_lost {
            next += 1;
        }
        let id = match ids.get(&own.tracker_id) {
            Some((id, _)) if !is_lost => id.clone(),
            _ => TargetId::new(&format!("t{next}")).unwrap_or_else(|_| own.tracker_id.clone()),
        };
        ids.insert(&own.tracker_id, (id.clone(), own.time));
        let bounding_box = redrawn_box(&own.bounding_box, image_size, &mut random);
        if random.random::<f64>() >= MISSED_SHARE {
            boxes.push(LabelledBox { tracker_id: id, bounding_box, ..own.clone() });
        }
    }
    RecordedCamera { boxes, ..recorded.clone() }
}

/// A box with noise on all edges but those at the border of the image, which cuts what is beyond.
fn redrawn_box(own: &BoundingBox, image_size: Option<ImageSize>, random: &mut ChaCha8Rng) -> BoundingBox {
    let sigma_px = EDGE_SIGMA_HEIGHTS * own.height_px();
    let size_px =
        image_size.map_or([f64::INFINITY; 2], |size| [size.width_px(), size.height_px()].map(f64::from));
    let [left_px, top_px, width_px, height_px] = own.sides_px();
    let edges_px = [left_px, top_px, left_px + width_px, top_px + height_px];
    let mut moved = |at: usize| {
        let noise_px = sigma_px * standard_normal(random);
        let (edge_px, last_px) = (edges_px[at], size_px[at % 2]);
        let is_cut = edge_px < BORDER_PX || edge_px > last_px - BORDER_PX;
        if is_cut { edge_px } else { (edge_px + noise_px).clamp(0.0, last_px) }
    };
    let [left_px, top_px, right_px, bottom_px] = [0, 1, 2, 3].map(&mut moved);
    BoundingBox::new(left_px, top_px, right_px - left_px, bottom_px - top_px).unwrap_or(*own)
}

/// A position on a path in the order of time, m; `None` beyond its ends.
#[must_use]
pub fn position_at(path: &[(Timestamp, EastNorth)], time: Timestamp) -> Option<EastNorth> {
    let next = path.partition_point(|(at, _)| *at < time);
    let (next_time, to) = *path.get(next)?;
    if next_time == time {
        return Some(to);
    }
    let (previous_time, from) = path[next.checked_sub(1)?];
    let part = time.duration_since(previous_time).as_secs_f64()
        / next_time.duration_since(previous_time).as_secs_f64();
    Some(EastNorth {
        east_m: from.east_m + part * (to.east_m - from.east_m),
        north_m: from.north_m + part * (to.north_m - from.north_m),
    })
}
