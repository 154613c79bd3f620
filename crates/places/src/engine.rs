//! The tracks of one scope through its places.
//!
//! One state per track and place that it is near. Time is that of the measurements, so a recording that is played again
//! gives the same events. A track without a measurement for [`SILENT_S`] has ended where it was measured last.

use std::collections::{HashMap, HashSet};
use std::sync::Arc;

use jiff::Timestamp;

use crate::domain::{PlaceKey, TargetClass, TargetId, TrackScope, Velocity};
use crate::event::{Direction, PlaceEvent, event_id};
use crate::geo::{EastNorth, LocalPlane, PlaneCovariance, Position};
use crate::index::{Place, PlaceIndex};
use crate::normal::cumulative;
use crate::passage::{Change, Instant, Passage};
use crate::region::{BorderView, probability_within};
use crate::settings::{EventKind, Rule};
use crate::statistics::{CountFigure, Counts, CountsKey, MAX_CLASSES};

/// A track has ended when it was not measured for this long, s.
const SILENT_S: f64 = 10.0;
/// A receiver states a fix of its target, or a camera a box, if one came in this time, s.
const SENSOR_S: f64 = 5.0;
/// A place is evaluated within this many standard deviations of the position.
const MARGIN_SIGMAS: f64 = 6.0;
/// Tracks that another one is compared with for `near`.
const MAX_NEIGHBOURS: usize = 512;

/// Where a target is.
#[derive(Debug, Clone)]
pub struct Measurement {
    /// The instant measured.
    pub time: Timestamp,
    /// The id of the track, as events name it.
    pub track: Arc<str>,
    /// What identifies the track in every replay: a world track has another id after each start of the server.
    pub identity: Arc<str>,
    /// The target, if it is known.
    pub target_id: Option<TargetId>,
    /// The class of the target, if it is known.
    pub class: Option<TargetClass>,
    /// Estimated position.
    pub position: Position,
    /// Estimated velocity.
    pub velocity: Velocity,
    /// Covariance of the position's error, m2.
    pub covariance_m2: PlaneCovariance,
    /// Covariance of the velocity's error, m2/s2.
    pub velocity_covariance_m2_s2: PlaneCovariance,
    /// Probability that the target is stationary.
    pub stationary_probability: f64,
    /// True if a camera measured it.
    pub has_box: bool,
    /// True if a receiver measured it.
    pub has_fix: bool,
}

impl Measurement {
    /// Speed and its standard deviation, m/s.
    fn speed(&self) -> (f64, f64) {
        let speed_mps = self.velocity.speed_m_s();
        let variance = |[east, north]: [f64; 2]| {
            let PlaneCovariance { east_m2, north_m2, east_north_m2 } = self.velocity_covariance_m2_s2;
            east * east * east_m2 + north * north * north_m2 + 2.0 * east * north * east_north_m2
        };
        let along = if speed_mps > 0.0 {
            variance([self.velocity.east_m_s / speed_mps, self.velocity.north_m_s / speed_mps])
        } else {
            self.velocity_covariance_m2_s2.per_axis_m2()
        };
        (speed_mps, along.max(0.0).sqrt())
    }

    fn is_standing(&self) -> bool {
        self.stationary_probability > 0.5
    }

    fn margin_m(&self) -> f64 {
        MARGIN_SIGMAS * self.covariance_m2.principal_m2()[0].sqrt()
    }
}

/// The events and counts of some measurements.
#[derive(Debug, Default)]
pub struct Outcome {
    /// Events of rules.
    pub events: Vec<(PlaceKey, PlaceEvent)>,
    /// Counts to be added to those that are stored.
    pub counts: HashMap<CountsKey, Counts>,
}

/// The tracks of one scope.
pub struct Engine {
    scope: TrackScope,
    index: Arc<PlaceIndex>,
    tracks: HashMap<Arc<str>, Track>,
    max_tracks: usize,
    /// When silent tracks were looked for last.
    swept_at: Option<Timestamp>,
    outcome: Outcome,
}

struct Track {
    latest: Measurement,
    last_box_at: Option<Timestamp>,
    last_fix_at: Option<Timestamp>,
    passages: HashMap<PlaceKey, Passage>,
    /// The line that it crossed last.
    last_line: Option<Arc<Place>>,
    /// The rules by which it was reported near to other tracks.
    near: HashSet<(PlaceKey, usize, Arc<str>)>,
}

/// An event before it is given its id.
struct Finding {
    kind: EventKind,
    at: Instant,
    probability: f64,
    direction: Option<Direction>,
    dwell_s: Option<f64>,
    other: Option<(Arc<str>, f64, f64)>,
}

impl Finding {
    const fn new(kind: EventKind, at: Instant, probability: f64) -> Self {
        Self { kind, at, probability, direction: None, dwell_s: None, other: None }
    }
}

impl Engine {
    /// An engine for the places of a scope that follows at most `max_tracks` tracks.
    #[must_use]
    pub fn new(scope: TrackScope, index: Arc<PlaceIndex>, max_tracks: usize) -> Self {
        Self {
            scope,
            index,
            tracks: HashMap::new(),
            max_tracks: max_tracks.max(1),
            swept_at: None,
            outcome: Outcome::default(),
        }
    }

    /// Replaces the places. The tracks begin again at those that have changed.
    pub fn replace_index(&mut self, index: Arc<PlaceIndex>) {
        let is_same = |key: &PlaceKey| {
            let revisions = [&self.index, &index].map(|it| it.places.get(key).map(|place| place.revision));
            revisions[0].is_some() && revisions[0] == revisions[1]
        };
        for track in self.tracks.values_mut() {
            track.passages.retain(|key, _| is_same(key));
            track.near.retain(|(key, ..)| is_same(key));
            track.last_line = track.last_line.take().filter(|line| is_same(&line.key));
        }
        self.index = index;
    }

    /// Takes the events and counts since the last call.
    pub fn take_outcome(&mut self) -> Outcome {
        std::mem::take(&mut self.outcome)
    }

    /// The latest time of a measurement of the tracks that have not ended.
    #[must_use]
    pub fn measured_last(&self) -> Option<Timestamp> {
        self.tracks.values().map(|track| track.latest.time).max()
    }

    /// The number of targets in a place now.
    #[must_use]
    pub fn occupancy(&self, place: PlaceKey) -> CountFigure {
        let passages = self.tracks.values().filter_map(|track| track.passages.get(&place));
        CountFigure::of(passages.map(|passage| (passage.probability(), passage.is_inside())))
    }

    /// Takes a measurement. One that is older than the latest of its track is ignored; far older, it is of a recording that
    /// is played again, and the track begins anew.
    pub fn observe(&mut self, measurement: Measurement) {
        let (id, time) = (measurement.track.clone(), measurement.time);
        self.advance(time);
        if let Some(track) = self.tracks.get(&id) {
            let step_s = time.duration_since(track.latest.time).as_secs_f64();
            if step_s.abs() > SILENT_S {
                self.end(&id);
            } else if step_s <= 0.0 {
                return;
            }
        }
        let earlier = self.tracks.get(&id).map(|track| track.latest.clone());
        let mut track = self.tracks.remove(&id).unwrap_or_else(|| Track::new(measurement.clone()));
        track.measured(measurement);
        self.visit(&mut track, earlier.as_ref());
        if self.tracks.len() >= self.max_tracks {
            self.end_longest_silent();
        }
        self.tracks.insert(id, track);
    }

    /// Lets time pass: tracks that were not measured for too long have ended.
    pub fn advance(&mut self, now: Timestamp) {
        let age_s = |at: Timestamp| now.duration_since(at).as_secs_f64();
        if self.swept_at.is_some_and(|swept_at| (0.0..1.0).contains(&age_s(swept_at))) {
            return;
        }
        self.swept_at = Some(now);
        let is_silent = |track: &Track| age_s(track.latest.time) > SILENT_S;
        let silent = self.tracks.iter().filter(|(_, track)| is_silent(track)).map(|(id, _)| id.clone());
        let mut silent: Vec<_> = silent.collect();
        silent.sort();
        silent.iter().for_each(|id| self.end(id));
    }

    /// Continues a track under the id of another one: both were of one target.
    pub fn merge(&mut self, track: &Arc<str>, ended: &str) {
        let Some(ended) = self.tracks.remove(ended) else { return };
        match self.tracks.get_mut(track) {
            // The older track knows where the target was.
            Some(going_on) => {
                for (key, passage) in ended.passages {
                    let known = going_on.passages.entry(key).or_insert_with(|| passage.clone());
                    if known.is_unknown() {
                        *known = passage;
                    }
                }
                going_on.last_line = going_on.last_line.take().or(ended.last_line);
            }
            None => _ = self.tracks.insert(track.clone(), ended),
        }
    }

    fn end_longest_silent(&mut self) {
        let oldest = self.tracks.iter().min_by_key(|(id, track)| (track.latest.time, (*id).clone()));
        if let Some(id) = oldest.map(|(id, _)| id.clone()) {
            self.end(&id);
        }
    }

    /// Ends a track at its latest measurement.
    fn end(&mut self, id: &Arc<str>) {
        let Some(track) = self.tracks.remove(id) else { return };
        let mut passages: Vec<_> = track.passages.iter().filter(|(_, passage)| passage.is_inside()).collect();
        passages.sort_by_key(|(key, _)| **key);
        let index = self.index.clone();
        for (key, passage) in passages {
            let Some(place) = index.places.get(key).filter(|place| !place.region.is_line()) else { continue };
            let at = Instant { time: track.latest.time, sigma_s: 0.0 };
            let mut finding = Finding::new(EventKind::Lost, at, passage.probability());
            finding.dwell_s =
                passage.inside_since.map(|since| at.time.duration_since(since.time).as_secs_f64().max(0.0));
            self.report(place, &track, finding);
        }
    }

    /// Evaluates the places on the way from the measurement before.
    fn visit(&mut self, track: &mut Track, earlier: Option<&Measurement>) {
        let index = self.index.clone();
        let from = earlier.unwrap_or(&track.latest);
        let margin_m = from.margin_m().max(track.latest.margin_m());
        let mut places: Vec<_> = index.near(from.position, track.latest.position, margin_m).collect();
        let is_near: HashSet<_> = places.iter().map(|place| place.key).collect();
        let others = track.passages.keys().filter(|key| !is_near.contains(key));
        places.extend(others.filter_map(|key| index.places.get(key)));
        places.sort_unstable_by_key(|place| place.key);
        for place in places {
            self.visit_place(place, track, earlier);
            // A track that is far away begins again when it comes back.
            if !is_near.contains(&place.key)
                && track.passages.get(&place.key).is_some_and(|passage| {
                    place.region.is_line() || !(passage.is_inside() || passage.is_unknown())
                })
            {
                track.passages.remove(&place.key);
            }
        }
    }

    fn visit_place(&mut self, place: &Place, track: &mut Track, earlier: Option<&Measurement>) {
        let certainty = place.settings.probability;
        let mut passage = track.passages.remove(&place.key).unwrap_or_else(|| {
            let mut passage = Passage::new(track.latest.time);
            if let Some((earlier, view)) =
                earlier.and_then(|earlier| Some((earlier, view_of(place, earlier)?)))
            {
                passage.observe(earlier.time, view, (certainty, earlier.is_standing()));
            }
            passage
        });
        let Some(view) = view_of(place, &track.latest) else { return };
        let before = passage.observed_at();
        let (was_inside, was_unknown) = (passage.is_inside(), passage.is_unknown());
        let change = passage.observe(track.latest.time, view, (certainty, track.latest.is_standing()));
        if place.region.is_line() {
            if let Some(change) = change {
                self.crossed(place, track, change);
            }
        } else {
            self.count_presence(place, track, (was_inside, passage.is_inside()), before);
            if let Some(change) = change {
                self.changed_side(place, track, change);
            } else if was_unknown && passage.is_inside() && earlier.is_none() {
                let at = Instant { time: track.latest.time, sigma_s: 0.0 };
                self.report(place, track, Finding::new(EventKind::Appeared, at, view.probability));
            }
            if passage.is_inside() {
                self.check_conditions(place, track, &mut passage, before);
            }
        }
        track.passages.insert(place.key, passage);
    }

    /// Counts a crossing of a line, and reports it if it is certain enough.
    fn crossed(&mut self, place: &Place, track: &mut Track, change: Change) {
        let direction = if change.is_inside { Direction::RightToLeft } else { Direction::LeftToRight };
        let is_counted = change.probability >= crossing_certainty(place);
        let (speed_mps, _) = track.latest.speed();
        let origin = track.last_line.as_ref().filter(|line| line.key != place.key);
        let origin = origin.map(|line| line.id.to_string());
        let counts = self.counts(place, track, change.at.time);
        counts.crossings(direction).add(change.probability, is_counted);
        if !is_counted {
            return;
        }
        counts.speed_mps.add(speed_mps);
        if let Some(origin) = origin {
            counts.add_origin(origin, 1);
        }
        track.last_line = self.index.places.get(&place.key).cloned();
        let kinds = [EventKind::Cross, EventKind::WrongWay];
        for kind in kinds.into_iter().take(1 + usize::from(direction == Direction::RightToLeft)) {
            let mut finding = Finding::new(kind, change.at, change.probability);
            finding.direction = Some(direction);
            self.report(place, track, finding);
        }
        for rule in &place.settings.rules {
            if let Some(probability) = speed_probability(rule, &track.latest)
                && probability >= certainty_of(rule, place)
            {
                let mut finding = Finding::new(rule.kind, change.at, probability);
                finding.direction = Some(direction);
                self.emit(place, rule, track, finding);
            }
        }
    }

    /// Counts and reports that a target entered or left an area.
    fn changed_side(&mut self, place: &Place, track: &Track, change: Change) {
        let (speed_mps, _) = track.latest.speed();
        let counts = self.counts(place, track, change.at.time);
        if change.is_inside {
            counts.enters.add(change.probability, true);
            counts.speed_mps.add(speed_mps);
        } else {
            counts.leaves.add(change.probability, true);
            if let Some(dwell_s) = change.dwell_s {
                counts.dwell_s.add(dwell_s);
            }
        }
        let kind = if change.is_inside { EventKind::Enter } else { EventKind::Leave };
        let mut finding = Finding::new(kind, change.at, change.probability);
        finding.dwell_s = change.dwell_s.filter(|_| !change.is_inside);
        self.report(place, track, finding);
    }

    /// Adds the time since the measurement before for a target that was inside then or is now.
    fn count_presence(
        &mut self,
        place: &Place,
        track: &Track,
        (was_inside, is_inside): (bool, bool),
        before: Option<Timestamp>,
    ) {
        if let (true, Some(before)) = (was_inside || is_inside, before) {
            let step_s = track.latest.time.duration_since(before).as_secs_f64();
            let share = if was_inside && is_inside { 1.0 } else { 0.5 };
            self.counts(place, track, track.latest.time).occupied_s += share * step_s;
        }
    }

    /// Reports the rules whose condition holds now for a target inside, once until it does not hold any more.
    fn check_conditions(
        &mut self,
        place: &Place,
        track: &mut Track,
        passage: &mut Passage,
        before: Option<Timestamp>,
    ) {
        for (number, rule) in place.settings.rules.iter().enumerate() {
            if rule.kind == EventKind::Near {
                self.check_neighbours(place, (number, rule), track);
                continue;
            }
            let Some(mut finding) = condition(rule, track, passage) else { continue };
            let (bit, certainty) = (1 << number, certainty_of(rule, place));
            if passage.reported & bit == 0 && finding.probability >= certainty {
                passage.reported |= bit;
                // The condition has begun somewhere since the measurement before.
                if let (true, Some(before)) = (finding.kind.is_of_now(), before) {
                    let step = finding.at.time.duration_since(before);
                    finding.at.time = before.checked_add(step / 2).unwrap_or(before);
                    finding.at.sigma_s = step.as_secs_f64() / 12f64.sqrt();
                }
                self.emit(place, rule, track, finding);
            } else if finding.probability <= 1.0 - certainty {
                passage.reported &= !bit;
            }
        }
    }

    /// Reports other tracks that are near.
    fn check_neighbours(&mut self, place: &Place, (number, rule): (usize, &Rule), track: &mut Track) {
        let Some(limit_m) = rule.distance_m.filter(|_| rule.takes(track.latest.class.as_ref())) else {
            return;
        };
        let own = &track.latest;
        let plane = LocalPlane::new(own.position);
        let certainty = certainty_of(rule, place);
        let others = self.tracks.values().filter_map(|other| {
            let age_s = own.time.duration_since(other.latest.time).as_secs_f64();
            let position = plane.to_plane_within_range(other.latest.position)?;
            let velocity = other.latest.velocity;
            let moved = EastNorth { east_m: velocity.east_m_s * age_s, north_m: velocity.north_m_s * age_s };
            let grown = other.latest.velocity_covariance_m2_s2.scaled(age_s * age_s);
            let covariance = own.covariance_m2.plus(other.latest.covariance_m2).plus(grown);
            (age_s.abs() <= 1.0).then(|| (other.latest.track.clone(), position.plus(moved), covariance))
        });
        let mut near: Vec<_> = others
            .take(MAX_NEIGHBOURS)
            .map(|(id, difference, covariance)| {
                (probability_within(difference, covariance, limit_m), id, difference, covariance)
            })
            .filter(|(probability, ..)| *probability > 1.0 - certainty)
            .collect();
        near.sort_by(|a, b| a.1.cmp(&b.1));
        let still: HashSet<_> = near.iter().map(|(_, id, ..)| id.clone()).collect();
        track.near.retain(|(key, of, id)| (*key, *of) != (place.key, number) || still.contains(id));
        for (probability, id, difference, covariance) in near {
            if probability < certainty || !track.near.insert((place.key, number, id.clone())) {
                continue;
            }
            let is_reported = self
                .tracks
                .get_mut(&id)
                .is_some_and(|other| !other.near.insert((place.key, number, track.latest.track.clone())));
            if is_reported {
                continue;
            }
            let distance_m = difference.distance_m(EastNorth::default());
            let at = Instant { time: track.latest.time, sigma_s: 0.0 };
            let mut finding = Finding::new(EventKind::Near, at, probability);
            finding.other = Some((id, distance_m, covariance.per_axis_m2().sqrt()));
            self.emit(place, rule, track, finding);
        }
    }

    /// Makes an event of each rule of the finding's kind.
    fn report(&mut self, place: &Place, track: &Track, finding: Finding) {
        for rule in &place.settings.rules {
            let least = rule.probability.unwrap_or_default();
            if rule.kind == finding.kind && finding.probability >= least {
                self.emit(place, rule, track, Finding { other: finding.other.clone(), ..finding });
            }
        }
    }

    fn emit(&mut self, place: &Place, rule: &Rule, track: &Track, finding: Finding) {
        let latest = &track.latest;
        if !rule.takes(latest.class.as_ref()) {
            return;
        }
        let (site_id, camera_id) = match &self.scope {
            TrackScope::Site(id) => (Some(id.to_string()), None),
            TrackScope::Camera(id) => (None, Some(id.to_string())),
        };
        let scope = self.scope.to_string();
        let parts = [&*scope, place.id.as_str(), &rule.id, rule.kind.as_str(), &latest.identity];
        let (speed_mps, speed_sigma_mps) = latest.speed();
        let (other, distance) =
            finding.other.map(|(id, distance_m, sigma_m)| (id, (distance_m, sigma_m))).unzip();
        let event = PlaceEvent {
            id: event_id(&parts, finding.at.time),
            kind: rule.kind,
            place_id: place.id.to_string(),
            rule_id: rule.id.clone(),
            site_id,
            camera_id,
            time: finding.at.time,
            time_sigma_s: finding.at.sigma_s,
            probability: finding.probability,
            track_id: latest.track.to_string(),
            target_id: latest.target_id.as_ref().map(ToString::to_string),
            class: latest.class.as_ref().map(ToString::to_string),
            longitude_deg: latest.position.longitude_deg(),
            latitude_deg: latest.position.latitude_deg(),
            speed_mps,
            speed_sigma_mps,
            direction: finding.direction,
            dwell_s: finding.dwell_s,
            other_track_id: other.map(|id| id.to_string()),
            distance_m: distance.map(|(distance_m, _)| distance_m),
            distance_sigma_m: distance.map(|(_, sigma_m)| sigma_m),
        };
        self.outcome.events.push((place.key, event));
    }

    /// The counts of a place in the minute of an instant, for the class of a track.
    fn counts(&mut self, place: &Place, track: &Track, time: Timestamp) -> &mut Counts {
        let minute = time.as_second().div_euclid(60) * 60;
        let class = track.latest.class.as_ref().map_or_else(String::new, ToString::to_string);
        let key = (place.key, minute, class);
        if !self.outcome.counts.contains_key(&key) {
            let same = |other: &&CountsKey| (other.0, other.1) == (key.0, key.1);
            if self.outcome.counts.keys().filter(same).count() >= MAX_CLASSES {
                return self.outcome.counts.entry((key.0, key.1, String::new())).or_default();
            }
        }
        self.outcome.counts.entry(key).or_default()
    }
}

impl Track {
    fn new(first: Measurement) -> Self {
        Self {
            latest: first,
            last_box_at: None,
            last_fix_at: None,
            passages: HashMap::new(),
            last_line: None,
            near: HashSet::new(),
        }
    }

    fn measured(&mut self, mut measurement: Measurement) {
        if measurement.has_box {
            self.last_box_at = Some(measurement.time);
        }
        if measurement.has_fix {
            self.last_fix_at = Some(measurement.time);
        }
        // A fix states no class.
        measurement.class = measurement.class.or(self.latest.class.take());
        measurement.target_id = measurement.target_id.or(self.latest.target_id.take());
        self.latest = measurement;
    }
}

impl EventKind {
    /// True if a condition is evaluated at each measurement, and not from a time that is known.
    const fn is_of_now(self) -> bool {
        matches!(self, Self::SpeedAbove | Self::SpeedBelow)
    }
}

fn view_of(place: &Place, measurement: &Measurement) -> Option<BorderView> {
    let velocity = [measurement.velocity.east_m_s, measurement.velocity.north_m_s];
    place.region.view(measurement.position, velocity, measurement.covariance_m2)
}

/// Both sides of a crossing are certain, and so must be that it was between the ends of the line.
fn crossing_certainty(place: &Place) -> f64 {
    place.settings.probability.powi(3)
}

fn certainty_of(rule: &Rule, place: &Place) -> f64 {
    rule.probability.unwrap_or(place.settings.probability)
}

/// Probability of a rule on speed; `None` for other rules and classes.
fn speed_probability(rule: &Rule, measurement: &Measurement) -> Option<f64> {
    let limit_mps = rule.speed_mps.filter(|_| rule.takes(measurement.class.as_ref()))?;
    let (speed_mps, sigma_mps) = measurement.speed();
    let above = cumulative((speed_mps - limit_mps) / sigma_mps.max(1e-6));
    Some(if rule.kind == EventKind::SpeedAbove { above } else { 1.0 - above })
}

/// The condition of a rule for a target inside an area, with its probability; `None` for rules without one.
fn condition(rule: &Rule, track: &Track, passage: &Passage) -> Option<Finding> {
    let now = track.latest.time;
    let since = passage.inside_since?;
    let seconds = |at: Timestamp| now.duration_since(at).as_secs_f64();
    let at_now = Instant { time: now, sigma_s: 0.0 };
    let after = |instant: Instant| {
        let after = jiff::SignedDuration::try_from_secs_f64(rule.after_s?).ok()?;
        Some(Instant { time: instant.time.checked_add(after).ok()?, sigma_s: instant.sigma_s })
    };
    let silent = |present: Option<Timestamp>, absent: Option<Timestamp>| {
        let from = match absent {
            Some(at) if at > since.time => Instant { time: at, sigma_s: 0.0 },
            _ => since,
        };
        let at = after(from)?;
        let holds = seconds(at.time) >= 0.0 && present.is_some_and(|at| seconds(at) <= SENSOR_S);
        let probability = if holds { passage.probability() } else { 0.0 };
        Some(Finding::new(rule.kind, at, probability))
    };
    match rule.kind {
        EventKind::Dwell => {
            let at = after(since)?;
            let stayed = cumulative(seconds(at.time) / since.sigma_s.max(1e-6));
            let mut finding = Finding::new(rule.kind, at, stayed * passage.probability());
            finding.dwell_s = Some(seconds(since.time));
            Some(finding)
        }
        EventKind::SpeedAbove | EventKind::SpeedBelow => {
            Some(Finding::new(rule.kind, at_now, speed_probability(rule, &track.latest)?))
        }
        EventKind::ReceiverWithoutBox => silent(track.last_fix_at, track.last_box_at),
        EventKind::BoxWithoutReceiver => silent(track.last_box_at, track.last_fix_at),
        _ => None,
    }
}
