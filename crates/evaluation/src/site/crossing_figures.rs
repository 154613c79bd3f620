//! Crossings of lines and visits of an area by tracks against those by true positions.

use std::collections::HashMap;
use std::sync::Arc;

use jiff::Timestamp;
use serde::Serialize;

use crate::domain::{PlaceId, PlaceKey, Revision, SiteId, TrackScope, Velocity};
use crate::fusion::world::WorldTrack;
use crate::geo::{EastNorth, LocalPlane, PlaneCovariance};
use crate::places::event::PlaceEvent;
use crate::places::settings::{EventKind, Geometry, PlaceSettings, Rule};
use crate::places::statistics::{CountFigure, Counts, CountsKey, Figures};
use crate::places::{Engine, Measurement, Place, PlaceIndex};
use crate::statistics::NORMAL_95;

/// Lines per direction, evenly spaced over the area where targets are.
const LINES: usize = 4;
/// Error that is assumed of true positions per axis, m, and of true velocities, m/s. The first is below the size of a person:
/// a target that sways on a line crosses it once.
const TRUTH_SIGMA_M: f64 = 0.1;
const TRUTH_SIGMA_MPS: f64 = 0.2;
/// A crossing is found if a track crosses the same line in the same direction within this time and distance.
const FOUND_WITHIN_S: f64 = 2.0;
const FOUND_WITHIN_M: f64 = 3.0;

/// Crossings of lines that are drawn over the area, in both directions.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct CrossingFigures {
    /// Crossings by true positions.
    pub true_crossings: usize,
    /// Crossings by tracks.
    pub reported: usize,
    /// True crossings that no track made, per 1,000.
    pub missed_per_1000: f64,
    /// Crossings by tracks that no target made, per 1,000 true ones.
    pub false_per_1000: f64,
    /// Mean distance of the reported from the true time, s.
    pub mean_error_s: f64,
    /// Share of true times inside the stated 95 % interval.
    pub coverage95: f64,
}

/// What a place counts over a recording.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct PlaceCounts {
    /// The place.
    pub place: String,
    /// What is counted, as the statistics of a place name it.
    pub counted: &'static str,
    /// By true positions.
    pub truth: u32,
    /// By tracks.
    pub tracked: CountFigure,
}

impl CrossingFigures {
    /// The figures over several draws; `None` without any.
    pub(super) fn over_draws(draws: impl Iterator<Item = Self>) -> Option<Self> {
        draws.reduce(|sum, draw| {
            let total = (sum.true_crossings + draw.true_crossings) as f64;
            let mean = |of: fn(&Self) -> f64| {
                (of(&sum) * sum.true_crossings as f64 + of(&draw) * draw.true_crossings as f64) / total
            };
            Self {
                missed_per_1000: mean(|it| it.missed_per_1000),
                false_per_1000: mean(|it| it.false_per_1000),
                mean_error_s: mean(|it| it.mean_error_s),
                coverage95: mean(|it| it.coverage95),
                true_crossings: sum.true_crossings + draw.true_crossings,
                reported: sum.reported + draw.reported,
            }
        })
    }
}

/// Feeds tracks and true positions to the same lines.
pub(super) struct CrossingRecorder {
    plane: LocalPlane,
    places: Vec<Arc<Place>>,
    tracked: Engine,
    truth: Engine,
    /// The latest true position of each target.
    latest: HashMap<usize, (Timestamp, EastNorth)>,
}

impl CrossingRecorder {
    /// Lines over the area of some positions, and the middle of it; `None` without an area.
    pub(super) fn over(plane: LocalPlane, positions: impl Iterator<Item = EastNorth>) -> Option<Self> {
        let site = TrackScope::Site(SiteId::new("evaluation").ok()?);
        let places = places(&plane, positions)?;
        let index = Arc::new(PlaceIndex::new(places.clone()));
        let engine = || Engine::new(site.clone(), index.clone(), usize::MAX);
        Some(Self { plane, places, tracked: engine(), truth: engine(), latest: HashMap::new() })
    }

    /// Takes the tracks that were measured at an instant, and the true positions of the targets in view.
    pub(super) fn observe<'t>(
        &mut self,
        time: Timestamp,
        tracks: impl Iterator<Item = &'t WorldTrack>,
        targets: &[(usize, EastNorth)],
    ) {
        for track in tracks {
            let state = track.state();
            let name: Arc<str> = track.id().0.to_string().into();
            self.tracked.observe(Measurement {
                time,
                track: name.clone(),
                identity: name,
                target_id: None,
                class: None,
                position: self.plane.to_position(state.position),
                velocity: state.velocity,
                covariance_m2: state.covariance_m2,
                velocity_covariance_m2_s2: state.velocity_covariance,
                stationary_probability: state.stationary_probability,
                has_box: true,
                has_fix: false,
            });
        }
        for (target, position) in targets {
            if let Some(measurement) = self.true_measurement(time, *target, *position) {
                self.truth.observe(measurement);
            }
        }
    }

    fn true_measurement(
        &mut self,
        time: Timestamp,
        target: usize,
        position: EastNorth,
    ) -> Option<Measurement> {
        let (before, from) = self.latest.insert(target, (time, position))?;
        let step_s = time.duration_since(before).as_secs_f64();
        let way = position.minus(from);
        let name: Arc<str> = target.to_string().into();
        (step_s > 0.0).then(|| Measurement {
            time,
            track: name.clone(),
            identity: name,
            target_id: None,
            class: None,
            position: self.plane.to_position(position),
            velocity: Velocity { east_m_s: way.east_m / step_s, north_m_s: way.north_m / step_s },
            covariance_m2: PlaneCovariance::isotropic(TRUTH_SIGMA_M * TRUTH_SIGMA_M),
            velocity_covariance_m2_s2: PlaneCovariance::isotropic(TRUTH_SIGMA_MPS * TRUTH_SIGMA_MPS),
            stationary_probability: 0.0,
            has_box: true,
            has_fix: false,
        })
    }

    /// The figures of all instants, without any if no target crossed a line, and the counts of all places.
    pub(super) fn figures(mut self) -> (Option<CrossingFigures>, Vec<PlaceCounts>) {
        let (truth, tracked) = (self.truth.take_outcome(), self.tracked.take_outcome());
        let events = |events: Vec<(PlaceKey, PlaceEvent)>| -> Vec<_> {
            events.into_iter().map(|(_, event)| event).collect()
        };
        let counts = self.counts(truth.counts, tracked.counts);
        (self.crossings(&events(truth.events), events(tracked.events)), counts)
    }

    fn counts(
        &self,
        truth: HashMap<CountsKey, Counts>,
        tracked: HashMap<CountsKey, Counts>,
    ) -> Vec<PlaceCounts> {
        let (truth, tracked) = (totals(truth), totals(tracked));
        let of_place = |place: &Arc<Place>| {
            let [truth, tracked] =
                [&truth, &tracked].map(|totals| totals.get(&place.key).cloned().unwrap_or_default());
            let place = place.id.to_string();
            named(&truth.figures(1.0)).into_iter().zip(named(&tracked.figures(1.0))).filter_map(
                move |((counted, truth), (_, tracked))| {
                    let truth = truth.count;
                    let is_any = truth > 0 || tracked.interval[1] > 0.0;
                    is_any.then(|| PlaceCounts { place: place.clone(), counted, truth, tracked })
                },
            )
        };
        self.places.iter().flat_map(of_place).collect()
    }

    fn crossings(&self, true_events: &[PlaceEvent], reported: Vec<PlaceEvent>) -> Option<CrossingFigures> {
        let mut reported: Vec<_> = reported.into_iter().map(Some).collect();
        let count = reported.len();
        let mut errors = Vec::new();
        for event in true_events {
            let candidates = reported.iter_mut().filter_map(|slot| {
                let distance = self.distance(event, slot.as_ref()?)?;
                Some((distance, slot))
            });
            let nearest = candidates.min_by(|a, b| a.0.abs().total_cmp(&b.0.abs()));
            if let Some((error_s, slot)) = nearest {
                errors.extend(slot.take().map(|found| (error_s.abs(), NORMAL_95 * found.time_sigma_s)));
            }
        }
        let (found, total) = (errors.len(), true_events.len());
        let per_1000 = |number: usize| 1_000.0 * number as f64 / total as f64;
        (found > 0).then(|| CrossingFigures {
            true_crossings: total,
            reported: count,
            missed_per_1000: per_1000(total - found),
            false_per_1000: per_1000(count - found),
            mean_error_s: errors.iter().map(|(error_s, _)| error_s).sum::<f64>() / found as f64,
            coverage95: errors.iter().filter(|(error_s, half_s)| error_s <= half_s).count() as f64
                / found as f64,
        })
    }

    /// Time from a true crossing to a reported one, s, if it can be the same.
    fn distance(&self, event: &PlaceEvent, reported: &PlaceEvent) -> Option<f64> {
        let is_same = event.place_id == reported.place_id && event.direction == reported.direction;
        let error_s = reported.time.duration_since(event.time).as_secs_f64();
        let at = |event: &PlaceEvent| {
            let position = crate::geo::Position::new(event.longitude_deg, event.latitude_deg).ok()?;
            Some(self.plane.to_plane(position))
        };
        let is_near = at(event)?.distance_m(at(reported)?) <= FOUND_WITHIN_M;
        (is_same && is_near && error_s.abs() <= FOUND_WITHIN_S).then_some(error_s)
    }
}

/// The counts of all minutes and classes by place.
fn totals(counts: HashMap<CountsKey, Counts>) -> HashMap<PlaceKey, Counts> {
    let mut totals = HashMap::<_, Counts>::new();
    for ((place, ..), counts) in counts {
        let total = totals.entry(place).or_default();
        counts.to_figures().iter().for_each(|(figure, value)| total.add_figure(figure, *value));
    }
    totals
}

/// Counts with their names.
const fn named(figures: &Figures) -> [(&'static str, CountFigure); 4] {
    [
        ("enters", figures.enters),
        ("leaves", figures.leaves),
        ("left_to_right", figures.left_to_right),
        ("right_to_left", figures.right_to_left),
    ]
}

/// Lines from south to north and from west to east over the area of some positions, and an area of half its width and
/// height in its middle.
fn places(plane: &LocalPlane, positions: impl Iterator<Item = EastNorth>) -> Option<Vec<Arc<Place>>> {
    let (mut low, mut high) = ([f64::INFINITY; 2], [f64::NEG_INFINITY; 2]);
    for position in positions {
        for (axis, value) in [position.east_m, position.north_m].into_iter().enumerate() {
            low[axis] = low[axis].min(value);
            high[axis] = high[axis].max(value);
        }
    }
    let degrees = |[east_m, north_m]: [f64; 2]| {
        let position = plane.to_position(EastNorth { east_m, north_m });
        [position.longitude_deg(), position.latitude_deg()]
    };
    let mut lines = Vec::new();
    for (axis, number) in (0..2).flat_map(|axis| (1..=LINES).map(move |number| (axis, number))) {
        let at = low[axis] + (high[axis] - low[axis]) * number as f64 / (LINES + 1) as f64;
        let (mut from, mut to) = (low, high);
        (from[axis], to[axis]) = (at, at);
        // Nothing passes beside its ends.
        from[1 - axis] -= 50.0;
        to[1 - axis] += 50.0;
        let name = format!("line-{}", lines.len());
        lines.push(place(lines.len(), &name, Geometry::LineString(vec![degrees(from), degrees(to)]))?);
    }
    let at = |share: f64, axis: usize| low[axis] + share * (high[axis] - low[axis]);
    let corners = [[0.25, 0.25], [0.75, 0.25], [0.75, 0.75], [0.25, 0.75], [0.25, 0.25]];
    let ring = corners.map(|[east, north]| degrees([at(east, 0), at(north, 1)])).to_vec();
    lines.push(place(lines.len(), "middle", Geometry::Polygon(vec![ring]))?);
    Some(lines)
}

fn place(number: usize, id: &str, geometry: Geometry) -> Option<Arc<Place>> {
    let settings = PlaceSettings {
        display_name: id.to_owned(),
        labels: std::collections::BTreeMap::new(),
        rules: if matches!(geometry, Geometry::LineString(_)) {
            vec![Rule::of(EventKind::Cross)]
        } else {
            Vec::new()
        },
        geometry,
        radius_m: None,
        probability: PlaceSettings::DEFAULT_PROBABILITY,
    };
    Place::new(PlaceKey(number as i64), PlaceId::new(id).ok()?, Revision(1), settings).ok().map(Arc::new)
}
