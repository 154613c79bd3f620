//! Tracks on their way to the places of their scope, and the task that evaluates them.
//!
//! Answers hand measurements to one task and never wait for it. Events, the messages that sinks are to have of them and
//! counts are stored in one transaction, which is tried again until the store has taken it.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, Weak};
use std::time::Duration;

use arc_swap::ArcSwap;
use jiff::{SignedDuration, Timestamp};
use tokio::sync::{mpsc, watch};
use tokio_util::sync::CancellationToken;

use super::scopes::Scopes;
use crate::app::live::sync::lock;
use crate::app::live::{TrackPoint, WorldTrackPoint};
use crate::app::{App, Parts};
use crate::domain::{
    CameraId, LiveId, NewPlaceEvent, Observation, PlaceCount, PlaceKey, SiteId, TargetClass, TrackScope,
};
use crate::places::event::PlaceEvent;
use crate::places::statistics::{CountFigure, Counts, CountsKey};
use crate::places::{Engine, Measurement, Outcome};
use crate::telemetry::Metrics;

/// Measurements that are taken together, if they are there. With the pause this bounds what evaluation takes from answers:
/// 40,000 measurements a second.
const BATCH: usize = 2_048;
/// The pause in which measurements are gathered, so that the task does not wake for each.
const GATHERING: Duration = Duration::from_millis(50);
/// How often time passes for scopes in which nothing is measured, and places that have changed are looked for.
const TICK: Duration = Duration::from_secs(1);
/// How often counts are stored where no event is.
const COUNTS_EVERY: Duration = Duration::from_secs(5);
/// Time until what the store did not take is offered again.
const RETRY: Duration = Duration::from_millis(500);

/// The places of all scopes, and the tracks at them.
pub struct PlaceMonitor {
    scopes: ArcSwap<Scopes>,
    queue: mpsc::Sender<Item>,
    engines: Mutex<HashMap<TrackScope, ScopeEngine>>,
    max_tracks: usize,
    /// Counts the transactions that stored events.
    pub(super) stored: watch::Sender<u64>,
    closed: CancellationToken,
    metrics: Metrics,
}

/// The engine of a scope.
struct ScopeEngine {
    engine: Engine,
    /// Reading of the monotonic clock at its latest measurement.
    measured_at: Duration,
}

/// Something that happened to a track. Answers hand over what they have; the task makes measurements of it.
enum Item {
    OfCamera {
        camera: CameraId,
        point: Arc<TrackPoint>,
        class: Option<TargetClass>,
        has_box: bool,
        has_fix: bool,
    },
    OfSite {
        site: SiteId,
        point: Arc<WorldTrackPoint>,
        class: Option<TargetClass>,
        has_box: bool,
    },
    Merged {
        site: SiteId,
        track: LiveId,
        ended: LiveId,
    },
}

/// The measurements that wait for the task.
pub(in crate::app) struct WaitingMeasurements(mpsc::Receiver<Item>);

/// Events and counts that wait for the store.
#[derive(Default)]
struct Unstored {
    events: Vec<(TrackScope, PlaceKey, PlaceEvent)>,
    counts: HashMap<CountsKey, Counts>,
}

impl PlaceMonitor {
    /// A monitor without places, and what waits for its task. At most `queue` measurements wait; more are dropped, and
    /// counted.
    pub(in crate::app) fn new(
        queue: usize,
        max_tracks: usize,
        metrics: Metrics,
    ) -> (Arc<Self>, WaitingMeasurements) {
        let (sender, receiver) = mpsc::channel(queue.max(1));
        let monitor = Self {
            scopes: ArcSwap::default(),
            queue: sender,
            engines: Mutex::default(),
            max_tracks,
            stored: watch::channel(0).0,
            closed: CancellationToken::new(),
            metrics,
        };
        (Arc::new(monitor), WaitingMeasurements(receiver))
    }

    /// Ends the task once it has stored what waits now.
    pub(in crate::app) fn close(&self) {
        self.closed.cancel();
    }

    /// Waits until the task was told to end.
    pub(super) async fn closed(&self) {
        self.closed.cancelled().await;
    }

    /// A target was measured by a camera.
    pub(in crate::app) fn measured_by_camera(
        &self,
        camera: &CameraId,
        observation: &Observation,
        point: &Arc<TrackPoint>,
    ) {
        self.push(|scopes| {
            scopes.of_camera(camera).map(|_| Item::OfCamera {
                camera: camera.clone(),
                point: point.clone(),
                class: observation.class().cloned(),
                has_box: observation.bounding_box().is_some(),
                has_fix: observation.fix().is_some() || point.receiver_match.is_some(),
            })
        });
    }

    /// The target of a world track was measured by a box, or else by a fix.
    pub(in crate::app) fn measured_at_site(
        &self,
        site: &SiteId,
        point: &Arc<WorldTrackPoint>,
        class: Option<TargetClass>,
        has_box: bool,
    ) {
        self.push(|scopes| {
            let (site, point) = (site.clone(), point.clone());
            scopes.of_site(&site)?;
            Some(Item::OfSite { site, point, class, has_box })
        });
    }

    /// Two world tracks were of one target.
    pub(in crate::app) fn merged_at_site(&self, site: &SiteId, track: LiveId, ended: LiveId) {
        self.push(|scopes| scopes.of_site(site).map(|_| Item::Merged { site: site.clone(), track, ended }));
    }

    /// The number of targets in a place now.
    pub(super) fn occupancy(&self, scope: &TrackScope, place: PlaceKey) -> CountFigure {
        let engines = lock(&self.engines);
        let of_scope = engines.get(scope).map(|scope| scope.engine.occupancy(place));
        of_scope.unwrap_or_else(|| CountFigure::of(std::iter::empty()))
    }

    /// Hands an item over if a scope has places.
    fn push(&self, item: impl FnOnce(&Scopes) -> Option<Item>) {
        let Some(item) = item(&self.scopes.load()) else { return };
        if self.queue.try_send(item).is_err() {
            self.metrics.place_measurement_dropped();
        }
    }

    fn evaluate(&self, items: impl Iterator<Item = Item>, now: Duration, unstored: &mut Unstored) {
        let scopes = self.scopes.load_full();
        let mut engines = lock(&self.engines);
        for item in items {
            let (scope, measurement) = match item {
                Item::OfCamera { camera, point, class, has_box, has_fix } => {
                    let measurement = of_camera(&point, class, (has_box, has_fix));
                    (TrackScope::Camera(camera), measurement)
                }
                Item::OfSite { site, point, class, has_box } => {
                    (TrackScope::Site(site), of_site(&point, class, has_box))
                }
                Item::Merged { site, track, ended } => {
                    if let Some(of_scope) = engines.get_mut(&TrackScope::Site(site)) {
                        of_scope.engine.merge(&track.to_string().into(), &ended.to_string());
                    }
                    continue;
                }
            };
            let Some(index) = scopes.of(&scope) else { continue };
            let of_scope = engines.entry(scope).or_insert_with_key(|scope| ScopeEngine {
                engine: Engine::new(scope.clone(), index.clone(), self.max_tracks),
                measured_at: now,
            });
            of_scope.measured_at = now;
            of_scope.engine.observe(measurement);
        }
        for (scope, of_scope) in engines.iter_mut() {
            unstored.add(scope, of_scope.engine.take_outcome());
        }
    }

    /// Lets time pass by the monotonic clock where nothing was measured, so that tracks end.
    fn advance(&self, now: Duration) {
        for of_scope in lock(&self.engines).values_mut() {
            let idle = SignedDuration::try_from(now.saturating_sub(of_scope.measured_at));
            if let (Some(latest), Ok(idle)) = (of_scope.engine.measured_last(), idle)
                && let Ok(time) = latest.checked_add(idle)
            {
                of_scope.engine.advance(time);
            }
        }
    }

    fn replace_scopes(&self, scopes: Scopes) {
        let mut engines = lock(&self.engines);
        engines.retain(|scope, _| scopes.of(scope).is_some());
        for (scope, of_scope) in engines.iter_mut() {
            if let Some(index) = scopes.of(scope) {
                of_scope.engine.replace_index(index.clone());
            }
        }
        drop(engines);
        self.scopes.store(Arc::new(scopes));
    }
}

fn of_camera(
    point: &TrackPoint,
    class: Option<TargetClass>,
    (has_box, has_fix): (bool, bool),
) -> Measurement {
    let state = &point.state;
    Measurement {
        time: state.time,
        track: point.target_id.as_str().into(),
        identity: point.target_id.as_str().into(),
        target_id: Some(point.target_id.clone()),
        class,
        position: point.position,
        velocity: state.velocity,
        covariance_m2: state.normal_covariance(),
        velocity_covariance_m2_s2: state.velocity_covariance,
        stationary_probability: state.stationary_probability,
        has_box,
        has_fix,
    }
}

fn of_site(point: &WorldTrackPoint, class: Option<TargetClass>, has_box: bool) -> Measurement {
    Measurement {
        time: point.time,
        track: point.id.to_string().into(),
        identity: point.started_at.as_microsecond().to_string().into(),
        target_id: point.target_id.clone(),
        class,
        position: point.position,
        velocity: point.velocity,
        covariance_m2: point.covariance_m2,
        velocity_covariance_m2_s2: point.velocity_covariance_m2_s2,
        stationary_probability: point.motion.stationary_probability,
        has_box,
        has_fix: !has_box || point.receiver_match.is_some(),
    }
}

impl WaitingMeasurements {
    /// Evaluates measurements until the application is closed or dropped.
    pub(in crate::app) async fn run(mut self, app: Weak<Parts>) {
        let mut items = Vec::with_capacity(BATCH);
        let mut unstored = Unstored::default();
        let mut stored_at = Duration::ZERO;
        let Some((monitor, clock)) = app.upgrade().map(|it| (it.place_monitor.clone(), it.clock.clone()))
        else {
            return;
        };
        let mut looked_at = None;
        loop {
            let is_closed = tokio::select! {
                biased;
                () = monitor.closed() => true,
                _ = self.0.recv_many(&mut items, BATCH) => false,
                () = tokio::time::sleep(TICK) => false,
            };
            if is_closed {
                items.extend(std::iter::from_fn(|| self.0.try_recv().ok()));
            }
            let Some(parts) = app.upgrade() else { return };
            let app = App::of_program(parts, "places");
            let now = clock.monotonic();
            if looked_at.is_none_or(|at| now.saturating_sub(at) >= TICK) {
                app.refresh_places().await;
                monitor.advance(now);
                looked_at = Some(now);
            }
            monitor.evaluate(items.drain(..), now, &mut unstored);
            let is_due = !unstored.events.is_empty() || now.saturating_sub(stored_at) >= COUNTS_EVERY;
            if is_due || is_closed {
                app.store_outcome(&mut unstored).await;
                stored_at = now;
            }
            if is_closed {
                return;
            }
            drop(app);
            tokio::time::sleep(GATHERING).await;
        }
    }
}

impl Unstored {
    fn add(&mut self, scope: &TrackScope, outcome: Outcome) {
        let events = outcome.events.into_iter().map(|(place, event)| (scope.clone(), place, event));
        self.events.extend(events);
        for (key, counts) in outcome.counts {
            let sum = self.counts.entry(key).or_default();
            counts.to_figures().iter().for_each(|(figure, value)| sum.add_figure(figure, *value));
        }
    }

    fn figures(&self) -> Vec<PlaceCount> {
        let figures = self.counts.iter().flat_map(|((place, from_s, class), counts)| {
            counts.to_figures().into_iter().map(move |(figure, value)| PlaceCount {
                place: *place,
                from_s: *from_s,
                class: class.clone(),
                figure,
                value,
            })
        });
        figures.collect()
    }
}

impl App {
    async fn refresh_places(&self) {
        let known = self.place_monitor.scopes.load_full();
        match known.refreshed(&self.store).await {
            Ok(Some(scopes)) => self.place_monitor.replace_scopes(scopes),
            Ok(None) => {}
            Err(error) => tracing::error!(%error, "cannot look for changed places"),
        }
    }

    /// Stores events and counts; tries again until it is done, or the application ends.
    async fn store_outcome(&self, unstored: &mut Unstored) {
        if unstored.events.is_empty() && unstored.counts.is_empty() {
            return;
        }
        let now = self.clock.now();
        let events: Vec<_> = unstored.events.iter().map(|it| self.new_event(it, now)).collect();
        let counts = unstored.figures();
        let outcome = loop {
            match self.store.insert_place_events(&events, &counts, self.clock.now()).await {
                Ok(outcome) => break outcome,
                Err(error) => {
                    tracing::error!(%error, "events of places wait for the store; it is tried again");
                }
            }
            if self.place_monitor.closed.is_cancelled() {
                return;
            }
            tokio::time::sleep(RETRY).await;
        };
        self.metrics.place_messages_dropped(outcome.dropped);
        if !events.is_empty() {
            self.place_monitor.stored.send_modify(|stored| *stored += 1);
        }
        *unstored = Unstored::default();
    }

    fn new_event(
        &self,
        (scope, place, event): &(TrackScope, PlaceKey, PlaceEvent),
        now: Timestamp,
    ) -> NewPlaceEvent {
        // Numbers, texts and a time can always be written.
        let content = serde_json::to_string(event).unwrap_or_default();
        let messages = self.sink_feeds.messages_of_event(scope, event, &content, now);
        NewPlaceEvent { place: *place, id: event.id.clone(), kind: event.kind.as_str(), content, messages }
    }
}
