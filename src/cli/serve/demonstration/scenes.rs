//! The scenes of the demonstration: which cameras stand there, what they were trained on, and what they see.

use std::collections::{BTreeMap, BTreeSet};
use std::f64::consts::TAU;

use jiff::{SignedDuration, Timestamp};

use super::ais::ShipState;
use crate::domain::{Detection, Fix, LiveItem, ReceivedFix, ReceiverId, Sample, TargetId, TrackerId};
use crate::geo::{EastNorth, LocalPlane, Position};
use crate::simulation::{LabelledDetection, SimulatedCamera, SimulatedSite, SiteOptions, simulate_site};

/// Length of the simulation, s, which then begins again.
pub(super) const PERIOD_S: u32 = 1_200;
/// Length of the simulation that cameras are trained on, s.
const TRAINING_S: f64 = 240.0;
/// Added to the seeds of what cameras see to get those of what they are trained on.
const TRAINING_SEED: u64 = 100;

/// The last seconds of every minute, in which the first phone of the square has no GNSS.
const GNSS_LOSS_EVERY_S: i64 = 60;
const GNSS_LOSS_S: i64 = 20;

/// Station of the ship, a number that no ship has.
const SHIP_STATION: u32 = 276_000_001;
/// The ship goes back and forth along the quay: amplitude, distance from the cameras (m), and time of a round, s.
const SHIP_AMPLITUDE_M: f64 = 160.0;
const SHIP_NORTH_M: f64 = 70.0;
const SHIP_ROUND_S: f64 = 600.0;

/// How boxes and fixes are told to the server.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Identities {
    /// Boxes have a tracker's number; phones report their fixes to a connection.
    Phones,
    /// Boxes have a tracker's number, and fixes the name of their receiver.
    Receivers,
    /// Boxes of targets with a receiver have its fix.
    Targets,
}

/// A scene with its cameras, in the order of their masts.
pub(super) struct Scene {
    pub(super) cameras: &'static [(&'static str, &'static str)],
    pub(super) options: SiteOptions,
    pub(super) identities: Identities,
    /// False for a scene whose cameras learn by themselves.
    pub(super) is_trained: bool,
}

/// Three cameras whose views overlap, a dozen people and two carts. Two people carry a phone.
pub(super) fn square() -> Scene {
    Scene {
        cameras: &[
            ("demo", "Square, west"),
            ("demo-middle", "Square, middle"),
            ("demo-east", "Square, east"),
        ],
        options: SiteOptions {
            cameras_per_group: 3,
            walkers: 12,
            vehicles: 2,
            receiver_share: 0.17,
            ..options(1, 0.0)
        },
        identities: Identities::Phones,
        is_trained: true,
    }
}

/// A camera that is knocked in the middle and at the end of every period: every ten minutes.
pub(super) fn yard() -> Scene {
    Scene {
        cameras: &[("demo-yard", "Yard, knocked every ten minutes")],
        options: SiteOptions {
            cameras: 1,
            walkers: 6,
            vehicles: 0,
            receiver_share: 0.67,
            // As of receivers with two frequencies: the alarm must come long before the next knock.
            gnss_sigma_m: 1.2,
            pan_deg_from: Some((f64::from(PERIOD_S) / 2.0, 20.0)),
            ..options(2, 180.0)
        },
        identities: Identities::Targets,
        is_trained: true,
    }
}

/// A camera without a model, which learns from trackers' numbers and two phones.
pub(super) fn ramp() -> Scene {
    Scene {
        cameras: &[("demo-ramp", "Ramp, learns by itself")],
        options: SiteOptions {
            cameras: 1,
            walkers: 6,
            vehicles: 0,
            receiver_share: 0.34,
            ..options(5, -160.0)
        },
        identities: Identities::Receivers,
        is_trained: false,
    }
}

/// Those that all scenes have in common; the first mast is `east_m` east of the square's.
fn options(seed: u64, east_m: f64) -> SiteOptions {
    let square = SiteOptions::default();
    let origin = LocalPlane::new(square.origin).to_position(EastNorth { east_m, north_m: 0.0 });
    let duration_s = f64::from(PERIOD_S);
    SiteOptions { seed, camera_seed: seed, receiver_seed: seed, origin, duration_s, ..square }
}

/// The site that the cameras of a scene are trained on: all targets carry a receiver.
pub(super) fn training_site(scene: &Scene) -> SimulatedSite {
    simulate_site(&SiteOptions {
        seed: scene.options.seed + TRAINING_SEED,
        receiver_seed: scene.options.receiver_seed + TRAINING_SEED,
        receiver_share: 1.0,
        duration_s: TRAINING_S,
        ..scene.options.clone()
    })
}

/// The boxes of each camera that have a fix of the same target and instant.
pub(super) fn samples(site: &SimulatedSite) -> Vec<Vec<Sample>> {
    let fixes = fixes_of_targets(site);
    let of_camera = |camera: &SimulatedCamera| {
        camera.detections.iter().filter_map(|labelled| sample(labelled, &fixes)).collect()
    };
    site.cameras.iter().map(of_camera).collect()
}

fn sample(labelled: &LabelledDetection, fixes: &FixesOfTargets) -> Option<Sample> {
    let LabelledDetection { detection, target } = labelled.clone();
    let target_id = target?;
    let fix = *fixes.get(&(detection.time, target_id.clone()))?;
    let Detection { time, bounding_box, class, score, .. } = detection;
    Some(Sample { time, target_id, bounding_box, fix, class, score, truth: None })
}

type FixesOfTargets = BTreeMap<(Timestamp, TargetId), Fix>;

fn fixes_of_targets(site: &SimulatedSite) -> FixesOfTargets {
    let carriers: BTreeMap<&ReceiverId, &TargetId> =
        site.carriers.iter().map(|(id, who)| (id, who)).collect();
    let of_target = |received: &ReceivedFix| {
        let target = *carriers.get(received.receiver_id.as_ref()?)?;
        Some(((received.time, target.clone()), received.fix))
    };
    site.fixes.iter().filter_map(of_target).collect()
}

/// The items that the stream of each camera of a scene sends, in the order of time.
pub(super) fn items(scene: &Scene, site: &SimulatedSite) -> Vec<Vec<LiveItem>> {
    let fixes = fixes_of_targets(site);
    let carriers: BTreeSet<&TargetId> = site.carriers.iter().map(|(_, target)| target).collect();
    let of_camera = |camera: &SimulatedCamera| {
        let detections = camera.detections.iter();
        let mut items: Vec<LiveItem> = match scene.identities {
            Identities::Targets => detections.map(|it| named_box(it, &carriers, &fixes)).collect(),
            Identities::Phones | Identities::Receivers => {
                detections.map(|it| tracked_box(&it.detection)).collect()
            }
        };
        if scene.identities == Identities::Receivers {
            items.extend(site.fixes.iter().map(received));
            items.sort_by_key(|item| item.time);
        }
        items
    };
    site.cameras.iter().map(of_camera).collect()
}

fn item(time: Timestamp) -> LiveItem {
    LiveItem {
        time,
        target_id: None,
        tracker_id: None,
        receiver_id: None,
        bounding_box: None,
        fix: None,
        class: None,
        score: None,
    }
}

fn tracked_box(detection: &Detection) -> LiveItem {
    LiveItem {
        tracker_id: TrackerId::new(detection.target_id.as_str().trim_start_matches("track-")).ok(),
        bounding_box: Some(detection.bounding_box),
        class: detection.class.clone(),
        ..item(detection.time)
    }
}

/// The box with the target's name and fix, if it carries a receiver.
fn named_box(
    labelled: &LabelledDetection,
    carriers: &BTreeSet<&TargetId>,
    fixes: &FixesOfTargets,
) -> LiveItem {
    let item = tracked_box(&labelled.detection);
    let Some(target) = labelled.target.as_ref().filter(|target| carriers.contains(target)) else {
        return item;
    };
    let fix = fixes.get(&(item.time, target.clone())).copied();
    LiveItem { target_id: Some(target.clone()), tracker_id: None, fix, ..item }
}

fn received(fix: &ReceivedFix) -> LiveItem {
    LiveItem { receiver_id: fix.receiver_id.clone(), fix: Some(fix.fix), ..item(fix.time) }
}

/// A position that a device reports, that long after the start of the period.
pub(super) struct Report<T> {
    pub(super) after: SignedDuration,
    pub(super) state: T,
}

/// Reports of the phones of a scene, in the order of time: their names and positions.
pub(super) fn phone_reports(scene: &Scene, site: &SimulatedSite) -> Vec<Report<(ReceiverId, Position)>> {
    let first = site.carriers.first().map(|(receiver, _)| receiver);
    let report = |received: &ReceivedFix| {
        let after = received.time.duration_since(scene.options.start);
        let is_lost = received.receiver_id.as_ref() == first
            && after.as_secs() % GNSS_LOSS_EVERY_S >= GNSS_LOSS_EVERY_S - GNSS_LOSS_S;
        let state = (received.receiver_id.clone()?, received.fix.position);
        (!is_lost).then_some(Report { after, state })
    };
    site.fixes.iter().filter_map(report).collect()
}

/// Reports of the ship's transponder, every two seconds.
pub(super) fn ship_reports(scene: &Scene) -> Vec<Report<ShipState>> {
    let plane = LocalPlane::new(scene.options.origin);
    let report = |second: u32| {
        let phase = TAU * f64::from(second) / SHIP_ROUND_S;
        let east_m = SHIP_AMPLITUDE_M * phase.sin();
        let speed_m_s = SHIP_AMPLITUDE_M * TAU / SHIP_ROUND_S * phase.cos();
        let state = ShipState {
            station: SHIP_STATION,
            position: plane.to_position(EastNorth { east_m, north_m: SHIP_NORTH_M }),
            speed_m_s: speed_m_s.abs(),
            course_deg: if speed_m_s < 0.0 { 270.0 } else { 90.0 },
        };
        Report { after: SignedDuration::from_secs(second.into()), state }
    };
    (0..PERIOD_S).step_by(2).map(report).collect()
}
