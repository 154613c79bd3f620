//! A site: several cameras along a street, in groups whose views overlap with gaps between the groups; walkers and
//! vehicles, some with a receiver; trackers whose ids break and swap; missed and false detections.
//!
//! A site is a function of its [`SiteOptions`] alone. Targets do not hide each other.

mod groups;
mod layout;
mod motion;
mod options;
mod still;
#[cfg(test)]
mod tests;
mod tracklets;

use jiff::{SignedDuration, Timestamp};
use rand::RngExt;
use rand_chacha::ChaCha8Rng;

use self::groups::Company;
use self::layout::SiteCamera;
use self::motion::Mover;
pub use self::options::SiteOptions;
pub use self::still::{Still, site_stills};
use self::tracklets::CameraTracker;
use super::noise::{SimulatedReceiver, standard_normal, stream};
use crate::domain::{
    BoundingBox, CameraId, Detection, Fix, GaussMarkovNoise, ImageSize, NoiseCorrelation, ReceivedFix,
    ReceiverId, TargetClass, TargetId,
};
use crate::geo::{EastNorth, LocalPlane, Position};

/// Width of the narrowest box that is detected, px.
const NARROWEST_BOX_PX: f64 = 1.0;
/// A phone's error: 8 % of its variance is white.
const RECEIVER_CORRELATION: NoiseCorrelation = NoiseCorrelation { white_share: 0.08, time_constant_s: 30.0 };
/// A box of which less than this share of a side is inside the image is not detected.
const MIN_VISIBLE_SHARE: f64 = 0.3;

/// A detection with the target that it is of.
#[derive(Debug, Clone, PartialEq)]
pub struct LabelledDetection {
    /// The detection under the id of the camera's tracker.
    pub detection: Detection,
    /// The target; `None` for a false detection.
    pub target: Option<TargetId>,
}

/// The detections of one camera in the order of time.
#[derive(Debug, Clone, PartialEq)]
pub struct SimulatedCamera {
    /// Its id.
    pub id: CameraId,
    /// The camera's detections.
    pub detections: Vec<LabelledDetection>,
}

/// A simulated site with its truth.
#[derive(Debug, Clone, PartialEq)]
pub struct SimulatedSite {
    /// Size of all cameras' images.
    pub image_size: ImageSize,
    /// Origin of the site's plane.
    pub origin: Position,
    /// The cameras.
    pub cameras: Vec<SimulatedCamera>,
    /// The fixes of all receivers in the order of time.
    pub fixes: Vec<ReceivedFix>,
    /// Who carries which receiver.
    pub carriers: Vec<(ReceiverId, TargetId)>,
    /// True positions of all targets at all instants of the frames.
    pub truth: Vec<(Timestamp, TargetId, Position)>,
}

/// Simulates the site of those options.
#[must_use]
pub fn simulate_site(options: &SiteOptions) -> SimulatedSite {
    let plane = LocalPlane::new(options.origin);
    let cameras = layout::cameras(options);
    let street_m = layout::street_length_m(options);
    let count = options.walkers + options.vehicles;
    let mut movers: Vec<Mover> = (0..count)
        .map(|index| {
            let is_vehicle = index >= options.walkers;
            let draw = |kind: u64| stream(options.seed, 64 + 4 * index as u64 + kind);
            Mover::new(is_vehicle, street_m, draw(0), draw(1))
        })
        .collect();
    let company = groups::drawn(options, &mut stream(options.seed, 3_000_000));
    let names: Vec<TargetId> =
        movers.iter().enumerate().map(|(index, mover)| name(&format!("{}-{index}", mover.class()))).collect();
    let mut carried = carried_receivers(options, &names);
    let mut site = SimulatedSite {
        image_size: cameras[0].image_size(),
        origin: options.origin,
        cameras: Vec::new(),
        fixes: Vec::new(),
        carriers: carried.iter().map(|it| (it.id.clone(), names[it.target].clone())).collect(),
        truth: Vec::new(),
    };
    let mut observers: Vec<Observer<'_>> = cameras
        .iter()
        .enumerate()
        .map(|(index, camera)| Observer::new(options, index, *camera, &names))
        .collect();
    let frames = (options.duration_s / options.frame_interval_s).floor() as u64;
    for frame in 0..=frames {
        let elapsed_s = frame as f64 * options.frame_interval_s;
        let time = later(options.start, elapsed_s);
        for index in 0..count {
            match company.get(index).copied().flatten() {
                Some(Company { leader, offset_m }) => {
                    let pose = movers[leader].pose();
                    movers[index].accompany(pose, offset_m);
                }
                None => movers[index].advance(if frame == 0 { 0.0 } else { options.frame_interval_s }),
            }
            site.truth.push((time, names[index].clone(), plane.to_position(movers[index].pose().position)));
        }
        for observer in &mut observers {
            observer.observe(time, elapsed_s, &mut movers);
        }
        for receiver in &mut carried {
            let truth = movers[receiver.target].pose().position;
            if let Some(measured) = receiver.measure(truth, elapsed_s) {
                let fix = Fix { position: plane.to_position(measured), sigma_m: None };
                site.fixes.push(ReceivedFix { time, receiver_id: Some(receiver.id.clone()), fix });
            }
        }
    }
    site.cameras = observers.into_iter().map(Observer::finish).collect();
    site
}

/// A receiver on its way.
struct CarriedReceiver {
    id: ReceiverId,
    target: usize,
    receiver: SimulatedReceiver,
    /// Time of its latest fix, s since the start.
    latest_s: Option<f64>,
}

impl CarriedReceiver {
    /// The measured position, once a second.
    fn measure(&mut self, truth: EastNorth, elapsed_s: f64) -> Option<EastNorth> {
        let since_s = self.latest_s.map_or(1.0, |latest_s| elapsed_s - latest_s);
        (since_s > 1.0 - 1e-6).then(|| {
            self.latest_s = Some(elapsed_s);
            self.receiver.measure(truth, since_s)
        })
    }
}

/// The receivers: the share of each kind of target.
fn carried_receivers(options: &SiteOptions, names: &[TargetId]) -> Vec<CarriedReceiver> {
    let share = |count: usize| (options.receiver_share * count as f64).round() as usize;
    let walkers = 0..share(options.walkers);
    let vehicles = options.walkers..options.walkers + share(options.vehicles);
    let error = GaussMarkovNoise::new(options.gnss_sigma_m, RECEIVER_CORRELATION);
    let carried = |target: usize| {
        let number = names[target].as_str().rsplit('-').next().unwrap_or_default();
        let random = stream(options.receiver_seed, 1_000_000 + target as u64);
        CarriedReceiver {
            id: ReceiverId::new(&format!("phone-{number}")).expect("short printable names"),
            target,
            receiver: SimulatedReceiver::new(error, EastNorth::default(), random),
            latest_s: None,
        }
    };
    walkers.chain(vehicles).map(carried).collect()
}

/// One camera with its detector and its tracker.
struct Observer<'a> {
    options: &'a SiteOptions,
    camera: SiteCamera,
    names: &'a [TargetId],
    tracker: CameraTracker,
    detector: ChaCha8Rng,
    false_detector: ChaCha8Rng,
    simulated: SimulatedCamera,
}

impl<'a> Observer<'a> {
    fn new(options: &'a SiteOptions, index: usize, camera: SiteCamera, names: &'a [TargetId]) -> Self {
        let draw = |kind: u64| stream(options.seed, 2_000_000 + 8 * index as u64 + kind);
        let id = CameraId::new(&format!("c{}", index + 1)).expect("a slug");
        Self {
            options,
            camera,
            names,
            tracker: CameraTracker::new(options, draw(0)),
            detector: draw(1),
            false_detector: draw(2),
            simulated: SimulatedCamera { id, detections: Vec::new() },
        }
    }

    /// Detects the targets in view at an instant.
    fn observe(&mut self, time: Timestamp, elapsed_s: f64, movers: &mut [Mover]) {
        let pan = self.options.pan_deg_from.filter(|(from_s, _)| elapsed_s >= *from_s);
        let camera = pan.map_or(self.camera, |(_, by_deg)| self.camera.panned(by_deg));
        let mut seen = Vec::new();
        for (target, mover) in movers.iter_mut().enumerate() {
            let Some(bounding_box) = self.detect(camera, mover) else { continue };
            // Drawn for every target in view, so that the share changes nothing else.
            if self.detector.random::<f64>() >= self.options.missed_share {
                seen.push((target, bounding_box, mover.pose().position));
            }
        }
        let positions: Vec<(usize, EastNorth)> = seen.iter().map(|(target, _, at)| (*target, *at)).collect();
        let ids = self.tracker.ids(time, &positions);
        let class_of = |target: usize| TargetClass::new(movers[target].class()).ok();
        let detection =
            |target_id, bounding_box, class| Detection { time, target_id, bounding_box, class, score: None };
        for ((target, bounding_box, _), id) in seen.into_iter().zip(ids) {
            let detection = detection(id, bounding_box, class_of(target));
            let target = Some(self.names[target].clone());
            self.simulated.detections.push(LabelledDetection { detection, target });
        }
        for bounding_box in self.false_boxes() {
            let detection = detection(self.tracker.fresh_id(), bounding_box, None);
            self.simulated.detections.push(LabelledDetection { detection, target: None });
        }
    }

    fn detect(&mut self, camera: SiteCamera, mover: &mut Mover) -> Option<BoundingBox> {
        let mut edges = camera.extents(&mover.body())?;
        for edge in &mut edges {
            *edge += self.options.box_noise_px * standard_normal(&mut self.detector);
        }
        let (width_px, height_px) = self.camera.size_px();
        let cut = [edges[0].max(0.0), edges[1].max(0.0), edges[2].min(width_px), edges[3].min(height_px)];
        let is_visible = cut[2] - cut[0] > MIN_VISIBLE_SHARE * (edges[2] - edges[0])
            && cut[3] - cut[1] > MIN_VISIBLE_SHARE * (edges[3] - edges[1]);
        let large_enough =
            edges[3] - edges[1] >= self.options.smallest_box_px && cut[2] - cut[0] >= NARROWEST_BOX_PX;
        BoundingBox::new(cut[0], cut[1], cut[2] - cut[0], cut[3] - cut[1])
            .ok()
            .filter(|_| is_visible && large_enough)
    }

    /// Boxes of a person's shape anywhere in the image, with the mean number per frame.
    fn false_boxes(&mut self) -> Vec<BoundingBox> {
        let whole = self.options.false_per_frame.floor();
        let more = self.false_detector.random::<f64>() < self.options.false_per_frame - whole;
        let (width_px, image_height_px) = self.camera.size_px();
        (0..whole as usize + usize::from(more))
            .filter_map(|_| {
                let height_px = self.false_detector.random_range(60.0..200.0);
                let left_px = self.false_detector.random::<f64>() * (width_px - 0.4 * height_px);
                let top_px = self.false_detector.random::<f64>() * (image_height_px - height_px);
                BoundingBox::new(left_px, top_px, 0.4 * height_px, height_px).ok()
            })
            .collect()
    }

    fn finish(self) -> SimulatedCamera {
        self.simulated
    }
}

fn name(text: &str) -> TargetId {
    TargetId::new(text).expect("short printable names")
}

fn later(time: Timestamp, seconds: f64) -> Timestamp {
    time.saturating_add(SignedDuration::from_micros((seconds * 1e6).round() as i64)).unwrap_or(time)
}
