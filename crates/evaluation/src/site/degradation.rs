//! Worse detections than those recorded: missed ones, false ones, ids that swap, clocks that are late, and a camera that is knocked.

use std::collections::BTreeMap;

use jiff::{SignedDuration, Timestamp};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::recording::{LabelledBox, RecordedCamera, SiteRecording};
use crate::domain::{BoundingBox, ImageSize, TargetId};

/// The faults of the input, and how often they occur.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Degradation {
    /// Share of the boxes that are missed.
    pub missed_share: f64,
    /// Mean number of false detections per frame.
    pub false_per_frame: f64,
    /// Mean time between two swaps of ids in a camera, s.
    pub swap_s: f64,
    /// Time by which the first camera's clock is late, s.
    pub late_s: f64,
    /// Time by which the clocks of all receivers are late, s.
    pub receivers_late_s: f64,
    /// What the first camera's boxes are moved by towards the right from the middle of the recording on, in image widths.
    pub knock: f64,
}

impl Degradation {
    /// No fault.
    const NONE: Self = Self {
        missed_share: 0.0,
        false_per_frame: 0.0,
        swap_s: f64::INFINITY,
        late_s: 0.0,
        receivers_late_s: 0.0,
        knock: 0.0,
    };
    /// 10 % missed, a false detection in every second frame, a swap every ten seconds.
    pub const ROUGH: Self = Self { missed_share: 0.1, false_per_frame: 0.5, swap_s: 10.0, ..Self::NONE };
    /// The first camera's clock is late by half a second.
    pub const LATE: Self = Self { late_s: 0.5, ..Self::NONE };
    /// All receivers are late by a second.
    pub const LATE_RECEIVERS: Self = Self { receivers_late_s: 1.0, ..Self::NONE };
    /// The first camera is turned by 60 px of an image 1,920 px wide, and by 200 px.
    pub const KNOCKED: Self = Self { knock: 60.0 / 1_920.0, ..Self::NONE };
    /// See [`Self::KNOCKED`].
    pub const KNOCKED_HARD: Self = Self { knock: 200.0 / 1_920.0, ..Self::NONE };

    /// The recording with these errors, drawn from a seed.
    #[must_use]
    pub fn apply(&self, recording: &SiteRecording, seed: u64) -> SiteRecording {
        let mut degraded = recording.clone();
        for (index, camera) in degraded.cameras.iter_mut().enumerate() {
            let mut random = ChaCha8Rng::seed_from_u64(seed);
            random.set_stream(index as u64);
            self.degrade(camera, recording.image_size, &mut random);
        }
        let later = |time: &mut Timestamp, late_s: f64| {
            let late = SignedDuration::try_from_secs_f64(late_s).unwrap_or_default();
            *time = time.saturating_add(late).unwrap_or(*time);
        };
        let first = degraded.cameras.iter_mut().take(1).flat_map(|camera| &mut camera.boxes);
        first.for_each(|labelled| later(&mut labelled.time, self.late_s));
        degraded.fixes.iter_mut().for_each(|fix| later(&mut fix.time, self.receivers_late_s));
        self.knock(&mut degraded);
        degraded
    }

    /// When the first camera is knocked.
    #[must_use]
    pub fn knocked_at(&self, recording: &SiteRecording) -> Option<Timestamp> {
        let boxes = &recording.cameras.first().filter(|_| self.knock != 0.0)?.boxes;
        let (first, last) = (boxes.first()?.time, boxes.last()?.time);
        first.checked_add(last.duration_since(first) / 2).ok()
    }

    fn knock(&self, recording: &mut SiteRecording) {
        let (Some(knocked_at), Some(size)) = (self.knocked_at(recording), recording.image_size) else {
            return;
        };
        let by_px = self.knock * f64::from(size.width_px());
        let Some(camera) = recording.cameras.first_mut() else { return };
        // A box that leaves the image is not seen.
        let seen = |labelled: LabelledBox| {
            if labelled.time < knocked_at {
                return Some(labelled);
            }
            let own = labelled.bounding_box;
            let left_px = own.left_px() + by_px;
            let width_px = own.width_px().min(f64::from(size.width_px()) - left_px);
            let moved = BoundingBox::new(left_px, own.top_px(), width_px, own.height_px()).ok()?;
            Some(LabelledBox { bounding_box: moved, ..labelled })
        };
        camera.boxes = std::mem::take(&mut camera.boxes).into_iter().filter_map(seen).collect();
    }

    fn degrade(&self, camera: &mut RecordedCamera, image_size: Option<ImageSize>, random: &mut ChaCha8Rng) {
        let mut frames: BTreeMap<Timestamp, Vec<LabelledBox>> = BTreeMap::new();
        for labelled in camera.boxes.drain(..) {
            frames.entry(labelled.time).or_default().push(labelled);
        }
        let mut swaps = IdSwaps::default();
        let mut latest: Option<Timestamp> = None;
        let mut false_count = 0_u64;
        for (time, mut boxes) in frames {
            let elapsed_s = latest.map_or(0.0, |latest| time.duration_since(latest).as_secs_f64());
            latest = Some(time);
            if random.random::<f64>() < 1.0 - (-elapsed_s / self.swap_s).exp() {
                swaps.swap_nearest(&boxes);
            }
            let shape = boxes[random.random_range(0..boxes.len())].bounding_box;
            boxes.retain(|_| random.random::<f64>() >= self.missed_share);
            for labelled in &mut boxes {
                labelled.tracker_id = swaps.id_of(&labelled.tracker_id);
            }
            if random.random::<f64>() < self.false_per_frame {
                false_count += 1;
                boxes.extend(false_box(time, shape, image_size, false_count, random));
            }
            camera.boxes.extend(boxes);
        }
    }
}

/// A box of a given size anywhere in the image.
fn false_box(
    time: Timestamp,
    shape: BoundingBox,
    image_size: Option<ImageSize>,
    number: u64,
    random: &mut ChaCha8Rng,
) -> Option<LabelledBox> {
    let size = image_size?;
    let left_px = random.random::<f64>() * (f64::from(size.width_px()) - shape.width_px()).max(0.0);
    let top_px = random.random::<f64>() * (f64::from(size.height_px()) - shape.height_px()).max(0.0);
    let bounding_box = BoundingBox::new(left_px, top_px, shape.width_px(), shape.height_px()).ok()?;
    let tracker_id = TargetId::new(&format!("false-{number}")).ok()?;
    Some(LabelledBox { time, tracker_id, bounding_box, target: None })
}

/// Ids that a tracker has exchanged so far.
#[derive(Default)]
struct IdSwaps(BTreeMap<TargetId, TargetId>);

impl IdSwaps {
    fn id_of(&self, original: &TargetId) -> TargetId {
        self.0.get(original).unwrap_or(original).clone()
    }

    /// Exchanges the ids of the two boxes whose feet are nearest to each other.
    fn swap_nearest(&mut self, boxes: &[LabelledBox]) {
        let foot_distance_px = |one: &LabelledBox, other: &LabelledBox| {
            let foot = |it: &BoundingBox| [it.left_px() + 0.5 * it.width_px(), it.top_px() + it.height_px()];
            let (a, b) = (foot(&one.bounding_box), foot(&other.bounding_box));
            (a[0] - b[0]).hypot(a[1] - b[1])
        };
        let pairs = boxes.iter().enumerate().flat_map(|(index, one)| {
            boxes[index + 1..].iter().map(move |other| (foot_distance_px(one, other), one, other))
        });
        let Some((_, one, other)) = pairs.min_by(|a, b| a.0.total_cmp(&b.0)) else { return };
        let (first, second) = (self.id_of(&one.tracker_id), self.id_of(&other.tracker_id));
        self.0.insert(one.tracker_id.clone(), second);
        self.0.insert(other.tracker_id.clone(), first);
    }
}
