//! `PlaceService`: places, their events and statistics.

use std::pin::Pin;

use futures_util::{Stream, StreamExt as _, stream};
use tonic::Status;

use super::convert::{instant, of_field, position, required, timestamp, track_scope};
use super::mask::named_fields;
use super::pages;
use super::proto;
use super::proto::place_geometry::Shape;
use super::proto::place_service_server::PlaceService;
use super::proto::track_scope::Scope;
use super::statuses::{Reply, answer, context, to_status};
use crate::admission::Lease;
use crate::app::{
    App, PlaceEvents, StatisticsInterval, StatisticsRequest, StoredEvent, event_kind, place_settings,
};
use crate::domain::{Error, ErrorKind, Place, PlaceEventFilter, PlaceId, Result, Revision, convert_all};
use crate::places::event::{Direction, PlaceEvent};
use crate::places::settings::{Geometry, PlaceSettings, Rule};
use crate::places::statistics::{CountFigure, Figures, Quantile};
use crate::shutdown::Shutdown;
use crate::telemetry::RequestId;

pub(super) struct Places {
    app: App,
    shutdown: Shutdown,
}

impl Places {
    pub(super) fn new(app: &App, shutdown: &Shutdown) -> Self {
        Self { app: app.clone(), shutdown: shutdown.clone() }
    }
}

/// Events as they come.
pub(super) type Events =
    Pin<Box<dyn Stream<Item = std::result::Result<proto::WatchPlaceEventsResponse, Status>> + Send>>;

#[tonic::async_trait]
impl PlaceService for Places {
    async fn create_place(
        &self,
        request: tonic::Request<proto::CreatePlaceRequest>,
    ) -> Reply<proto::CreatePlaceResponse> {
        answer(&self.app, request, |app, asked| async move {
            let id = PlaceId::new(&asked.id)?;
            let scope = required(track_scope(asked.scope)?, "scope")?;
            let settings = settings(&id, required(asked.profile, "profile")?);
            let settings = settings.map_err(|error| error.under("profile"))?;
            let created = app.places().create(id, scope, &settings).await;
            let place = created.map_err(|error| of_profile(error, &["id", "site_id", "camera_id"]))?;
            Ok(proto::CreatePlaceResponse { place: Some(message(&place)?) })
        })
        .await
    }

    async fn get_place(
        &self,
        request: tonic::Request<proto::GetPlaceRequest>,
    ) -> Reply<proto::GetPlaceResponse> {
        answer(&self.app, request, |app, asked| async move {
            let place = app.places().get(&place_id(&asked.place_id)?).await?;
            Ok(proto::GetPlaceResponse { place: Some(message(&place)?) })
        })
        .await
    }

    async fn list_places(
        &self,
        request: tonic::Request<proto::ListPlacesRequest>,
    ) -> Reply<proto::ListPlacesResponse> {
        answer(&self.app, request, |app, asked| async move {
            let size = pages::size(asked.page_size, &app.limits)?;
            let after = pages::cursor::<PlaceId>(&asked.page_token)?;
            let scope = track_scope(asked.scope)?;
            let page = app.places().list(scope.as_ref(), after.as_ref(), size).await?;
            Ok(proto::ListPlacesResponse {
                next_page_token: pages::token(page.next.as_ref()),
                places: page.items.iter().map(message).collect::<Result<_>>()?,
            })
        })
        .await
    }

    async fn update_place(
        &self,
        request: tonic::Request<proto::UpdatePlaceRequest>,
    ) -> Reply<proto::UpdatePlaceResponse> {
        answer(&self.app, request, |app, asked| async move {
            let expected = asked.expected_revision.map(|revision| Revision(revision).into());
            let place = app.places().get(&place_id(&asked.place_id)?).await?;
            let settings = changed(&place, required(asked.profile, "profile")?, asked.update_mask)?;
            let changed = app.places().change(&place, &settings, expected).await;
            let place = changed.map_err(|error| of_field(error, "profile"))?;
            Ok(proto::UpdatePlaceResponse { place: Some(message(&place)?) })
        })
        .await
    }

    async fn delete_place(
        &self,
        request: tonic::Request<proto::DeletePlaceRequest>,
    ) -> Reply<proto::DeletePlaceResponse> {
        answer(&self.app, request, |app, asked| async move {
            let expected = asked.expected_revision.map(|revision| Revision(revision).into());
            app.places().delete(&place_id(&asked.place_id)?, expected).await?;
            Ok(proto::DeletePlaceResponse {})
        })
        .await
    }

    async fn get_place_statistics(
        &self,
        request: tonic::Request<proto::GetPlaceStatisticsRequest>,
    ) -> Reply<proto::GetPlaceStatisticsResponse> {
        answer(&self.app, request, |app, asked| async move {
            let step = Some(&*asked.interval).filter(|text| !text.is_empty()).map(str::parse);
            let request = StatisticsRequest {
                from: instant(asked.from, "from")?,
                until: instant(asked.until, "until")?,
                step: step.transpose()?.unwrap_or_default(),
                class: asked.class,
            };
            let statistics = app.places().statistics(&place_id(&asked.place_id)?, &request).await?;
            let interval = |StatisticsInterval { from, figures }| proto::PlaceInterval {
                from: Some(timestamp(from)),
                figures: Some(figures.into()),
            };
            Ok(proto::GetPlaceStatisticsResponse {
                occupancy: Some(statistics.occupancy.into()),
                total: Some(statistics.total.into()),
                intervals: statistics.intervals.into_iter().map(interval).collect(),
            })
        })
        .await
    }

    async fn list_place_events(
        &self,
        request: tonic::Request<proto::ListPlaceEventsRequest>,
    ) -> Reply<proto::ListPlaceEventsResponse> {
        answer(&self.app, request, |app, asked| async move {
            let filter = filter(asked.filter.unwrap_or_default())?;
            let after = event_number("after", &asked.after)?;
            let size = pages::size(asked.page_size, &app.limits)?;
            let page = app.places().events(&filter, after, size).await?;
            let last = page.items.last().map(|event| event.number).or(after);
            Ok(proto::ListPlaceEventsResponse {
                last_event_id: last.map(|number| number.to_string()).unwrap_or_default(),
                has_more: page.next.is_some(),
                events: page.items.into_iter().map(|stored| stored.event.into()).collect(),
            })
        })
        .await
    }

    type WatchPlaceEventsStream = Events;

    async fn watch_place_events(
        &self,
        request: tonic::Request<proto::WatchPlaceEventsRequest>,
    ) -> Reply<Events> {
        let context = context(request.extensions())?;
        let (id, client) = (context.id().clone(), context.client());
        answer(&self.app, request, |app, asked| async move {
            let filter = filter(asked.filter.unwrap_or_default())?;
            let after = event_number("resume_after", &asked.resume_after)?;
            let lease = app.quotas.event_streams.try_acquire(client, 1)?;
            let source = app.places().watch(filter, after).await?;
            Ok(events(source, lease, self.shutdown.clone(), id))
        })
        .await
    }
}

/// Ends with the server, which is reported as an error.
fn events(source: PlaceEvents, lease: Lease, shutdown: Shutdown, id: RequestId) -> Events {
    stream::unfold(Some((source, lease)), move |watched| {
        let (shutdown, id) = (shutdown.clone(), id.clone());
        async move {
            let (mut source, lease) = watched?;
            let next = tokio::select! {
                biased;
                () = shutdown.draining() => {
                    let message = "the server is ending; continue after the last event when it is back";
                    Err(Error::refused(ErrorKind::ShuttingDown, message))
                }
                next = source.next() => next,
            };
            Some(match next {
                Ok(event) => (Ok(event.into()), Some((source, lease))),
                Err(error) => (Err(to_status(&error, &id)), None),
            })
        }
    })
    .boxed()
}

fn place_id(text: &str) -> Result<PlaceId> {
    PlaceId::new(text).map_err(|_| Error::refused(ErrorKind::PlaceNotFound, "that is not the id of a place"))
}

fn event_number(field: &str, text: &str) -> Result<Option<i64>> {
    if text.is_empty() {
        return Ok(None);
    }
    let number = text.parse().ok().filter(|number| *number >= 0);
    number.map(Some).ok_or_else(|| Error::invalid(field, "must be an event's id as this server gave it"))
}

/// The refusal of a profile, but for fields that are not of it.
fn of_profile(error: Error, others: &[&str]) -> Error {
    match &error {
        Error::Refused(refusal) if refusal.violations.iter().any(|it| others.contains(&&*it.field)) => error,
        _ => of_field(error, "profile"),
    }
}

fn filter(filter: proto::PlaceEventFilter) -> Result<PlaceEventFilter> {
    let place = Some(filter.place_id).filter(|id| !id.is_empty());
    let kind = Some(filter.kind).filter(|kind| !kind.is_empty());
    Ok(PlaceEventFilter {
        scope: track_scope(filter.scope)?,
        place: place.map(|id| place_id(&id)).transpose()?,
        kind: kind.map(|kind| event_kind(&kind)).transpose()?,
    })
}

fn coordinates(field: &str, positions: Vec<proto::Position>) -> Result<Vec<[f64; 2]>> {
    let convert = |point| position(point).map(|it| [it.longitude_deg(), it.latitude_deg()]);
    convert_all("positions", positions, convert).map_err(|error| error.under(field))
}

/// Geometry, and the radius of a disc.
fn geometry(geometry: Option<proto::PlaceGeometry>) -> Result<(Geometry, Option<f64>)> {
    let shape = required(geometry.and_then(|geometry| geometry.shape), "geometry")?;
    Ok(match shape {
        Shape::Polygon(polygon) => {
            let rings = polygon.rings.into_iter();
            let rings = rings.map(|ring| coordinates("geometry.polygon.rings", ring.positions));
            (Geometry::Polygon(rings.collect::<Result<_>>()?), None)
        }
        Shape::Line(line) => (Geometry::LineString(coordinates("geometry.line", line.positions)?), None),
        Shape::Disc(disc) => {
            let centre = position(required(disc.centre, "geometry.disc.centre")?)?;
            (Geometry::Point([centre.longitude_deg(), centre.latitude_deg()]), Some(disc.radius_m))
        }
    })
}

fn rule(rule: proto::PlaceRule) -> Result<Rule> {
    Ok(Rule {
        kind: rule.kind.parse()?,
        id: rule.id,
        classes: rule.classes,
        after_s: rule.after_s,
        speed_mps: rule.speed_mps,
        distance_m: rule.distance_m,
        probability: rule.probability,
    })
}

fn settings(id: &PlaceId, profile: proto::PlaceProfile) -> Result<PlaceSettings> {
    let (geometry, radius_m) = geometry(profile.geometry)?;
    let name = Some(profile.display_name).filter(|name| !name.is_empty());
    Ok(PlaceSettings {
        display_name: name.unwrap_or_else(|| id.to_string()),
        labels: profile.labels.into_iter().collect(),
        geometry,
        radius_m,
        probability: profile.probability.unwrap_or(PlaceSettings::DEFAULT_PROBABILITY),
        rules: convert_all("rules", profile.rules, rule)?,
    })
}

/// The settings of a place after a change of the fields that the mask names, or that the profile has.
fn changed(
    place: &Place,
    mut profile: proto::PlaceProfile,
    mask: Option<prost_types::FieldMask>,
) -> Result<PlaceSettings> {
    const FIELDS: [&str; 5] = ["display_name", "labels", "geometry", "probability", "rules"];
    let stored = place_settings(place)?;
    let has = [
        ("display_name", !profile.display_name.is_empty()),
        ("labels", !profile.labels.is_empty()),
        ("geometry", profile.geometry.is_some()),
        ("probability", profile.probability.is_some()),
        ("rules", !profile.rules.is_empty()),
    ];
    let present = has.into_iter().filter_map(|(field, has)| has.then_some(field)).collect();
    let is_named = named_fields(mask, &FIELDS, present)?;
    if !is_named("geometry") {
        profile.geometry = Some(geometry_message(&stored));
    }
    let new = settings(place.id(), profile).map_err(|error| error.under("profile"))?;
    Ok(PlaceSettings {
        display_name: if is_named("display_name") { new.display_name } else { stored.display_name },
        labels: if is_named("labels") { new.labels } else { stored.labels },
        geometry: new.geometry,
        radius_m: new.radius_m,
        probability: if is_named("probability") { new.probability } else { stored.probability },
        rules: if is_named("rules") { new.rules } else { stored.rules },
    })
}

fn position_message([longitude_deg, latitude_deg]: [f64; 2]) -> proto::Position {
    proto::Position { longitude_deg: Some(longitude_deg), latitude_deg: Some(latitude_deg) }
}

fn geometry_message(settings: &PlaceSettings) -> proto::PlaceGeometry {
    let list = |points: &Vec<[f64; 2]>| proto::PositionList {
        positions: points.iter().copied().map(position_message).collect(),
    };
    let shape = match &settings.geometry {
        Geometry::Polygon(rings) => {
            Shape::Polygon(proto::PlacePolygon { rings: rings.iter().map(list).collect() })
        }
        Geometry::LineString(points) => Shape::Line(list(points)),
        Geometry::Point(centre) => Shape::Disc(proto::PlaceDisc {
            centre: Some(position_message(*centre)),
            radius_m: settings.radius_m.unwrap_or_default(),
        }),
    };
    proto::PlaceGeometry { shape: Some(shape) }
}

fn message(place: &Place) -> Result<proto::Place> {
    let settings = place_settings(place)?;
    let geometry = Some(geometry_message(&settings));
    let rule = |rule: Rule| proto::PlaceRule {
        id: rule.id,
        kind: rule.kind.as_str().to_owned(),
        classes: rule.classes,
        after_s: rule.after_s,
        speed_mps: rule.speed_mps,
        distance_m: rule.distance_m,
        probability: rule.probability,
    };
    Ok(proto::Place {
        id: place.id().to_string(),
        scope: Some((&place.profile.scope).into()),
        profile: Some(proto::PlaceProfile {
            display_name: settings.display_name,
            labels: settings.labels.into_iter().collect(),
            geometry,
            probability: Some(settings.probability),
            rules: settings.rules.into_iter().map(rule).collect(),
        }),
        revision: place.revision.0,
        created_at: Some(timestamp(place.created_at)),
        updated_at: Some(timestamp(place.updated_at)),
    })
}

fn interval([low, high]: [f64; 2]) -> proto::Interval {
    proto::Interval { low, high }
}

impl From<CountFigure> for proto::CountFigure {
    fn from(figure: CountFigure) -> Self {
        Self { count: figure.count, expected: figure.expected, interval: Some(interval(figure.interval)) }
    }
}

impl From<Quantile> for proto::Quantile {
    fn from(quantile: Quantile) -> Self {
        let Quantile { percent, value, interval: bounds } = quantile;
        Self { percent, value, interval: Some(interval(bounds)) }
    }
}

impl From<Figures> for proto::PlaceFigures {
    fn from(figures: Figures) -> Self {
        Self {
            enters: Some(figures.enters.into()),
            leaves: Some(figures.leaves.into()),
            left_to_right: Some(figures.left_to_right.into()),
            right_to_left: Some(figures.right_to_left.into()),
            mean_occupancy: figures.mean_occupancy,
            dwell_s: figures.dwell_s.into_iter().map(Into::into).collect(),
            speed_mps: figures.speed_mps.into_iter().map(Into::into).collect(),
            origins: figures.origins.into_iter().collect(),
        }
    }
}

impl From<StoredEvent> for proto::WatchPlaceEventsResponse {
    fn from(stored: StoredEvent) -> Self {
        Self { event_id: stored.number.to_string(), event: Some(stored.event.into()) }
    }
}

impl From<PlaceEvent> for proto::PlaceEvent {
    fn from(event: PlaceEvent) -> Self {
        let scope = event.site_id.map(Scope::SiteId).or(event.camera_id.map(Scope::CameraId));
        Self {
            id: event.id,
            kind: event.kind.as_str().to_owned(),
            place_id: event.place_id,
            rule_id: event.rule_id,
            scope: Some(proto::TrackScope { scope }),
            time: Some(timestamp(event.time)),
            time_sigma_s: event.time_sigma_s,
            probability: event.probability,
            track_id: event.track_id,
            target_id: event.target_id,
            class: event.class,
            position: Some(position_message([event.longitude_deg, event.latitude_deg])),
            speed_mps: event.speed_mps,
            speed_sigma_mps: event.speed_sigma_mps,
            direction: event.direction.map(|direction| Direction::as_str(direction).to_owned()),
            dwell_s: event.dwell_s,
            other_track_id: event.other_track_id,
            distance_m: event.distance_m,
            distance_sigma_m: event.distance_sigma_m,
        }
    }
}
