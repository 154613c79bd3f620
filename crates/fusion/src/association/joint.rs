//! Boxes matched with receivers where the camera has no model: both are found together.
//!
//! Boxes alone give the ground plane up to place and direction ([`GroundCamera`], one per focal length).
//! [`PlacementSearch`] finds these by the fixes of all receivers, without knowing their carriers. Probable pieces and groups then
//! train a model in the normal way, which matches again, until both stay. A world is accepted only on
//! evidence that identities which are certainly wrong cannot have.

use std::collections::BTreeMap;
use std::ops::ControlFlow;

use jiff::SignedDuration;
use rand::Rng;

use super::cancellation::Cancellation;
use super::carriers::{CarrierBox, Matching};
use super::evidence::EvidenceModel;
use super::matching::{
    Located, MatchSettings, check_size, clock_grid, match_located, match_scene, receiver_noise,
};
use super::placement::{Density, GroundPrior, Placement, PlacementSearch};
use super::recording::Scene;
use super::tracklet::{SceneMotion, TimedFix, TrackPoint, Tracklet};
use crate::domain::{
    BoundingBox, Detection, Error, ErrorKind, GnssError, ImageSize, ReceivedFix, Receivers, Recipe, Result,
    Sample, TargetClass, TargetId,
};
use crate::geo::{EastNorth, LocalPlane};
use crate::model::{FitEvent, FitInput, FitOptions, GroundCamera, Regressor, fit};
use crate::pairing::{PairingRule, PairingSettings, pair};

/// Shifts of the receivers' clocks as shares of the recording, for identities that are certainly wrong.
const SHIFTS: [f64; 6] = [0.21, 0.33, 0.45, 0.57, 0.69, 0.81];
/// Shifts are at least this long, s: beyond the memory of walks and of receivers' errors.
const LEAST_SHIFT_S: f64 = 25.0;
/// The score of the best world exceeds that of all wrong ones by at least this; where the scale is unknown, too, by more:
/// a single straight way fits many worlds.
const MIN_MARGIN: f64 = 8.0;
const MIN_MARGIN_OF_UNKNOWN_SCALE: f64 = 25.0;
/// The best world exceeds every other world of the same recording by at least this.
const MIN_MODE_MARGIN: f64 = 3.0;
/// Two placements closer than this are one world, in the standard deviation of the ground.
const SAME_WORLD: f64 = 6.0;
/// Sure pieces at least: one or two straight walks fit more than one place and direction.
const MIN_PIECES: usize = 3;
/// So many groups count for one of them: at another place of the camera, too, a receiver is mostly near one of several.
const GROUPS_FOR_A_PIECE: usize = 10;
/// The trained model departs from the placement by at most this number of standard deviations of the latter in the
/// mean.
const MAX_DEPARTURE: f64 = 5.0;
/// The prior of the ground for targets of known height: people and cars.
const GROUND_OF_KNOWN_HEIGHT: GroundPrior =
    GroundPrior { map_sigma_m: 1.0, scale_sigma: 0.06, density: Density::Fixes };
/// The same of all others, such as ships: the antenna stands somewhere on a large target, far away near the horizon.
const GROUND_OF_UNKNOWN_HEIGHT: GroundPrior =
    GroundPrior { map_sigma_m: 25.0, scale_sigma: 1.5, density: Density::GroundPoints };
/// Rounds of training and matching at most.
const ROUNDS: usize = 4;
/// Rounds end when the model moves positions by less than this in the mean, in the standard deviation of the ground.
const STABLE: f64 = 0.1;
/// Posterior probability from which on pieces are sure where nothing else is asked for: with fewer receivers the model of the samples
/// is worse than the less sure ones make it, for those are mostly of a neighbour.
const MIN_PROBABILITY: f64 = 0.8;
/// Posterior probability from which on tracklets, and groups of them, train the model that matches.
const TRAINING_PROBABILITY: f64 = 0.5;
/// Receivers from which on each half of them trains a model of its own.
const MIN_HALVED_RECEIVERS: usize = 4;
/// Models of both halves are at most so far from each other in the mean, in standard deviations of the ground: twice the
/// error that is accepted.
const MAX_HALVES_DISTANCE: f64 = 3.0;
/// Placements kept per ground camera.
const MODES: usize = 12;

/// The match, and the evidence for the camera's place.
#[derive(Debug, Clone)]
pub struct JointMatch {
    /// Which boxes show which receivers' carriers.
    pub matching: Matching,
    /// Score of the world, of the best one with shifted clocks, and of the second best.
    pub scores: WorldScores,
}

/// Scores of placements: sums over receivers of the log of prior plus evidence.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct WorldScores {
    /// The score of the world found.
    pub best: f64,
    /// The score of the best world with clocks shifted.
    pub best_shifted: f64,
    /// The score of the best other world, with true clocks; negative infinity if there is none.
    pub second: f64,
}

/// One candidate world.
#[derive(Clone, Copy)]
struct World {
    camera: usize,
    placement: Placement,
}

/// Matches detections with fixes and trains a model, where nothing is known but the image's size.
///
/// # Errors
/// `NotIdentifiable`, with the reason and what to record, where another assignment explains the recording
/// as well; `TooLarge` beyond the settings' bounds; `Cancelled`.
pub fn match_without_model(
    detections: &[Detection],
    fixes: &[ReceivedFix],
    receivers: &Receivers,
    image_size: ImageSize,
    settings: &MatchSettings,
    random: &mut impl Rng,
    cancellation: Cancellation<'_>,
) -> Result<JointMatch> {
    let scene = Scene::new(detections, fixes, receivers, cancellation);
    check_size(&scene, settings)?;
    let search = JointSearch::new(&scene, image_size, settings)?;
    let (world, scores) = search.accepted_world()?;
    search.trained(&world, scores, random)
}

struct JointSearch<'a> {
    scene: &'a Scene<'a>,
    settings: MatchSettings,
    image_size: ImageSize,
    model: EvidenceModel,
    ground: GroundPrior,
    cameras: Vec<GroundCamera>,
    fixes: Vec<Vec<TimedFix>>,
    plane: LocalPlane,
}

impl<'a> JointSearch<'a> {
    fn new(scene: &'a Scene<'a>, image_size: ImageSize, settings: &MatchSettings) -> Result<Self> {
        let Some(plane) = scene.plane() else {
            return Err(not_identifiable("no fix names a receiver", "name the receiver of every fix"));
        };
        let class = most_frequent_class(scene.detections);
        let mut boxes = Vec::with_capacity(scene.detections.len());
        for (at, seen) in scene.tracklets.iter().enumerate() {
            boxes.extend(seen.detections.iter().map(|own| (at as u32, scene.detections[*own].bounding_box)));
        }
        let cameras = GroundCamera::of_boxes(&boxes, image_size, class.as_ref());
        if cameras.is_empty() {
            return Err(not_identifiable(
                "too few boxes show whole targets",
                "record targets that are not cut by the image's border, near and far",
            ));
        }
        let fixes = scene.fixes(&plane);
        let gnss = settings.gnss.unwrap_or_else(|| receiver_noise(None));
        let has_known_height = class.as_ref().is_none_or(GroundCamera::knows_height_of);
        let (ground, motion) = if has_known_height {
            (GROUND_OF_KNOWN_HEIGHT, common_motion(scene, &cameras, &GROUND_OF_KNOWN_HEIGHT))
        } else {
            // Boxes do not tell the scale, so the motion is that of the receivers.
            (GROUND_OF_UNKNOWN_HEIGHT, motion_of_receivers(&fixes))
        };
        Ok(Self {
            scene,
            settings: MatchSettings {
                min_probability: settings.min_probability.or(Some(MIN_PROBABILITY)),
                ..*settings
            },
            image_size,
            model: EvidenceModel { gnss, motion },
            ground,
            cameras,
            fixes,
            plane,
        })
    }

    fn on_ground(&self, camera: usize) -> Vec<Tracklet> {
        on_ground(self.scene, &self.cameras[camera], &self.ground)
    }

    /// The best worlds of these cameras for such fixes, the best first.
    fn worlds(&self, cameras: impl IntoIterator<Item = usize>, fixes: &[Vec<TimedFix>]) -> Vec<World> {
        let mut worlds = Vec::new();
        for camera in cameras {
            let search = self.search(camera, fixes);
            worlds.extend(
                search
                    .search(MODES, self.same_world_m(), self.scene.cancellation)
                    .into_iter()
                    .map(|placement| World { camera, placement }),
            );
        }
        worlds.sort_by(|one, other| other.placement.score.total_cmp(&one.placement.score));
        worlds
    }

    fn search(&self, camera: usize, fixes: &[Vec<TimedFix>]) -> PlacementSearch {
        let tracklets = self.on_ground(camera);
        let log_prior = self.cameras[camera].log_prior();
        PlacementSearch::new(
            &tracklets,
            fixes,
            &clock_grid(&self.settings),
            &self.model,
            &self.ground,
            log_prior,
        )
    }

    /// The best world, if it is better than all that must be wrong and all others that may be right.
    fn accepted_world(&self) -> Result<(World, WorldScores)> {
        let worlds = self.worlds(0..self.cameras.len(), &self.fixes);
        // A cancelled match has found nothing.
        self.scene.cancellation.check()?;
        let Some(best) = worlds.first().copied() else {
            return Err(not_identifiable(
                "no receiver has three fixes while a tracklet is seen",
                "record boxes and fixes at the same time, with targets in view for 20 s and more",
            ));
        };
        let shifted = self.shifts_s().filter_map(|shift_s| {
            // The focal length hardly changes how well wrong identities fit.
            self.worlds([best.camera], &self.shifted_fixes(shift_s))
                .first()
                .map(|world| world.placement.score)
        });
        let scores = WorldScores {
            best: best.placement.score,
            best_shifted: shifted.fold(f64::NEG_INFINITY, f64::max),
            second: self.second(&best, &worlds),
        };
        self.scene.cancellation.check()?;
        check_scores(&scores, self.min_margin())?;
        Ok((best, scores))
    }

    /// Distance of placements that are one world, m.
    fn same_world_m(&self) -> f64 {
        SAME_WORLD * self.ground.map_sigma_m
    }

    fn min_margin(&self) -> f64 {
        match self.ground.density {
            Density::Fixes => MIN_MARGIN,
            Density::GroundPoints => MIN_MARGIN_OF_UNKNOWN_SCALE,
        }
    }

    /// Score of the best world that is another one than the best.
    fn second(&self, best: &World, worlds: &[World]) -> f64 {
        let other = worlds.iter().find(|world| {
            self.mean_distance_m(|own| Some(self.placed(world, own)?.distance_m(self.placed(best, own)?)))
                > self.same_world_m()
        });
        other.map_or(f64::NEG_INFINITY, |world| world.placement.score)
    }

    /// Position of a box in a world; `None` where its foot is not on the ground.
    fn placed(&self, world: &World, bounding_box: &BoundingBox) -> Option<EastNorth> {
        let point = self.cameras[world.camera].ground_point(bounding_box)?;
        let [east_m, north_m] = world.placement.apply(point.right_m, point.forward_m);
        Some(EastNorth { east_m, north_m })
    }

    /// Mean of a distance over some of the boxes, m.
    fn mean_distance_m(&self, distance_m: impl Fn(&BoundingBox) -> Option<f64>) -> f64 {
        let some = self.scene.detections.iter().step_by(20);
        let distances: Vec<f64> = some.filter_map(|own| distance_m(&own.bounding_box)).collect();
        distances.iter().sum::<f64>() / distances.len().max(1) as f64
    }

    /// Shifts of clocks that leave no true identity.
    fn shifts_s(&self) -> impl Iterator<Item = f64> {
        let length_s = self.scene.length_s();
        SHIFTS.iter().map(move |share| (share * length_s).max(LEAST_SHIFT_S))
    }

    /// The fixes with all clocks shifted, around the recording's end: as many meet boxes as without.
    fn shifted_fixes(&self, shift_s: f64) -> Vec<Vec<TimedFix>> {
        let length_s = self.scene.length_s().max(2.0 * LEAST_SHIFT_S);
        let shifted = |fixes: &Vec<TimedFix>| {
            let mut own: Vec<TimedFix> = fixes
                .iter()
                .filter(|fix| (0.0..=length_s).contains(&fix.time_s))
                .map(|fix| TimedFix { time_s: (fix.time_s + shift_s) % length_s, ..*fix })
                .collect();
            own.sort_by(|one, other| one.time_s.total_cmp(&other.time_s));
            own
        };
        self.fixes.iter().map(shifted).collect()
    }

    fn matched(&self, world: &World, settings: &MatchSettings, random: &mut impl Rng) -> Result<Matching> {
        let (tracklets, points) = self.scene.located(|bounding_box| {
            let box_variance_m2 = self.cameras[world.camera].ground_point(bounding_box)?.box_variance_m2;
            Some((self.placed(world, bounding_box)?, box_variance_m2, self.ground.map_sigma_m.powi(2)))
        });
        let located =
            Located { tracklets: &tracklets, detections: &points, fixes: &self.fixes, gnss: self.model.gnss };
        match_located(self.scene, &located, settings, random)
    }

    /// Trains on the probable carriers and matches by the model, in turn.
    fn trained(&self, world: &World, scores: WorldScores, random: &mut impl Rng) -> Result<JointMatch> {
        let probable = &MatchSettings { min_probability: Some(TRAINING_PROBABILITY), ..self.settings };
        let mut matching = self.matched(world, probable, random)?;
        let mut regressor = self.fit(&matching, |_| true)?;
        for _ in 1..ROUNDS {
            matching = match_scene(self.scene, &regressor, self.model.gnss, probable, random)?;
            let next = self.fit(&matching, |_| true)?;
            let moved_m = self.distance_m(&regressor, &next);
            regressor = next;
            if moved_m < STABLE * self.ground.map_sigma_m {
                break;
            }
        }
        matching = match_scene(self.scene, &regressor, self.model.gnss, probable, random)?;
        let halves_m = self.halves_distance_m(&matching)?;
        if let Some(halves_m) =
            halves_m.filter(|halves_m| *halves_m > MAX_HALVES_DISTANCE * self.ground.map_sigma_m)
        {
            return Err(not_identifiable(
                &format!("models of one half of the receivers and of the other are {halves_m:.1} m apart"),
                "record longer, with more receivers carried across the whole view",
            ));
        }
        let departure_m = self.departure_m(world, &regressor);
        if departure_m > MAX_DEPARTURE * self.ground.map_sigma_m {
            return Err(not_identifiable(
                &format!("training leads {departure_m:.0} m away from the place that was found"),
                "record longer, with receivers carried across the whole view",
            ));
        }
        matching = match_scene(self.scene, &regressor, self.model.gnss, &self.settings, random)?;
        let (pieces, groups) = (matching.sure().count(), matching.groups.len());
        if GROUPS_FOR_A_PIECE * pieces + groups < GROUPS_FOR_A_PIECE * MIN_PIECES {
            return Err(not_identifiable(
                &format!("only {pieces} tracklets and {groups} groups of them have a sure receiver"),
                "record longer, with receivers carried across the whole view, best by people who walk alone",
            ));
        }
        Ok(JointMatch { matching, scores })
    }

    /// Mean distance between placed and regressed positions, m.
    fn departure_m(&self, world: &World, regressor: &Regressor) -> f64 {
        self.mean_distance_m(|own| {
            let placed = self.plane.to_position(self.placed(world, own)?);
            let regressed = regressor.regress(own, None).regressed;
            Some(regressor.plane().to_plane(placed).distance_m(regressed))
        })
    }

    /// Mean distance between the positions that two models regress, m.
    fn distance_m(&self, one: &Regressor, other: &Regressor) -> f64 {
        self.mean_distance_m(|own| {
            let position = |model: &Regressor| model.plane().to_position(model.regress(own, None).regressed);
            Some(crate::geo::distance_m(position(one), position(other)))
        })
    }

    /// Mean distance between two models, each trained on the carriers of half of the receivers, m: about twice the
    /// error of the model that is trained on all of them (delete-group jackknife with two groups). `None` with too few
    /// receivers.
    fn halves_distance_m(&self, matching: &Matching) -> Result<Option<f64>> {
        let mut counts: BTreeMap<TargetId, usize> = BTreeMap::new();
        for own in matching.carrier_boxes(self.scene.detections) {
            *counts.entry(own.detection.target_id).or_default() += 1;
        }
        if counts.len() < MIN_HALVED_RECEIVERS {
            return Ok(None);
        }
        let mut by_count: Vec<(TargetId, usize)> = counts.into_iter().collect();
        by_count.sort_by_key(|(_, count)| std::cmp::Reverse(*count));
        // In turn, so that both halves have as many boxes: 0 1 1 0 0 1 1 0.
        let half_of =
            |id: &TargetId| by_count.iter().position(|own| own.0 == *id).map(|at| at.div_ceil(2) % 2);
        let [one, other] = [0, 1].map(|half| self.fit(matching, |id| half_of(id) == Some(half)));
        Ok(Some(self.distance_m(&one?, &other?)))
    }

    /// Trains on the carriers of some of the receivers.
    fn fit(&self, matching: &Matching, is_used: impl Fn(&TargetId) -> bool) -> Result<Regressor> {
        let (samples, unpaired) = training_samples(self.scene, matching, is_used);
        let options = FitOptions {
            recipe: Recipe::GaussianProcess,
            seed: 1,
            epochs: None,
            image_size: Some(self.image_size),
            gnss_error: GnssError::Unknown,
            gnss_bias_sigma_m: None,
        };
        let input = FitInput { samples: &samples, unpaired: &unpaired, known_points: &[] };
        let cancellation = self.scene.cancellation;
        let mut observer = |_: FitEvent<'_>| {
            if cancellation.is_cancelled() { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
        };
        let fitted = fit(input, &options, &mut observer);
        cancellation.check()?;
        let fitted = fitted.map_err(|error| {
            // Boxes of wrong carriers may have no fit at all, which is no fault of the program.
            not_identifiable(
                &format!("the matched boxes cannot train a model: {error}"),
                "record longer, with receivers carried across the whole view",
            )
        })?;
        fitted.load()
    }
}

/// Checks that a world is better than those that must be wrong and all others.
fn check_scores(scores: &WorldScores, min_margin: f64) -> Result<()> {
    if scores.best < scores.best_shifted + min_margin {
        return Err(not_identifiable(
            &format!(
                "identities shifted in time explain it about as well (score {:.1} against {:.1}): too few \
                 or too short visits, or too many candidates",
                scores.best, scores.best_shifted
            ),
            "record longer, with receivers carried across the whole view, best while few others are there",
        ));
    }
    if scores.best < scores.second + MIN_MODE_MARGIN {
        return Err(not_identifiable(
            &format!(
                "another place and direction of the camera explains it about as well (score {:.1} against \
                 {:.1}): paths are parallel or too much alike",
                scores.best, scores.second
            ),
            "record walks in different directions, with turns",
        ));
    }
    Ok(())
}

/// Tracklets on the ground of a camera: right and forward instead of east and north.
fn on_ground(scene: &Scene<'_>, camera: &GroundCamera, ground: &GroundPrior) -> Vec<Tracklet> {
    let located = scene.located(|bounding_box| {
        let point = camera.ground_point(bounding_box)?;
        let position = EastNorth { east_m: point.right_m, north_m: point.forward_m };
        Some((position, point.box_variance_m2, ground.map_sigma_m.powi(2)))
    });
    located.0
}

/// Motion of the targets, the same for all cameras, so that their scores can be compared: the geometric mean.
fn common_motion(scene: &Scene<'_>, cameras: &[GroundCamera], ground: &GroundPrior) -> SceneMotion {
    let motions: Vec<SceneMotion> =
        cameras.iter().map(|camera| SceneMotion::of(&on_ground(scene, camera, ground))).collect();
    let mean = |of: fn(&SceneMotion) -> f64| {
        (motions.iter().map(|motion| of(motion).ln()).sum::<f64>() / motions.len().max(1) as f64).exp()
    };
    let speed_m_s = mean(|own| own.speed_m_s);
    // The search takes one speed for all.
    SceneMotion { spread_m: mean(|own| own.spread_m), speed_m_s, speeds_m_s: [speed_m_s; 3] }
}

fn motion_of_receivers(fixes: &[Vec<TimedFix>]) -> SceneMotion {
    let point = |fix: &TimedFix| TrackPoint {
        time_s: fix.time_s,
        position: fix.position,
        box_variance_m2: 0.0,
        map_variance_m2: 0.0,
    };
    let tracks: Vec<Tracklet> =
        fixes.iter().map(|own| Tracklet { points: own.iter().map(point).collect() }).collect();
    SceneMotion::of(&tracks)
}

/// How boxes that were matched without a model are paired with the fixes of their receivers.
#[must_use]
pub fn joint_pairing() -> PairingSettings {
    PairingSettings {
        rule: PairingRule::Interpolated,
        // Ships report every few seconds and move straight in between.
        longest_gap: SignedDuration::from_secs(10),
        ..PairingSettings::default()
    }
}

/// Samples of the boxes of some receivers' carriers, under the receivers' ids, and all other boxes.
fn training_samples(
    scene: &Scene<'_>,
    matching: &Matching,
    is_used: impl Fn(&TargetId) -> bool,
) -> (Vec<Sample>, Vec<Detection>) {
    let mut is_used_box = vec![false; scene.detections.len()];
    let mut used = Vec::new();
    for CarrierBox { detection, at, .. } in matching.carrier_boxes(scene.detections) {
        if is_used(&detection.target_id) {
            at.into_iter().for_each(|at| is_used_box[at] = true);
            used.push(detection);
        }
    }
    let receivers = matching.receivers_of(scene.received, scene.receivers);
    let samples = pair(used, scene.received.to_vec(), &receivers, &joint_pairing()).samples;
    let others = scene.detections.iter().zip(&is_used_box).filter(|(_, is_used)| !**is_used);
    (samples, others.map(|(own, _)| own.clone()).collect())
}

fn most_frequent_class(detections: &[Detection]) -> Option<TargetClass> {
    let mut counts: BTreeMap<Option<&str>, (usize, Option<&TargetClass>)> = BTreeMap::new();
    for own in detections {
        let class = own.class.as_ref();
        counts.entry(class.map(TargetClass::as_str)).or_insert((0, class)).0 += 1;
    }
    counts.into_values().max_by_key(|(count, _)| *count).and_then(|(_, class)| class.cloned())
}

/// The refusal of a recording that does not say whose the fixes are.
fn not_identifiable(reason: &str, remedy: &str) -> Error {
    let message = format!("whose fixes belong to whose boxes is not identifiable: {reason}; {remedy}");
    Error::refused(ErrorKind::NotIdentifiable, message)
}
