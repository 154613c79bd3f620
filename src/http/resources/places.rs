//! `/v1/places`: areas and lines on the ground, with rules for events; statistics of a place.

use std::collections::BTreeMap;

use hyper::{HeaderMap, StatusCode, Uri};
use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use serde_json::Value;
use utoipa::ToSchema;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use crate::app::{PlaceStatistics, StatisticsInterval, StatisticsRequest, place_settings};
use crate::domain::{self, Error, PlaceId, Result, TrackScope};
use crate::exchange::wire::parse_json;
use crate::exchange::write_cursor;
use crate::http::plumbing::access::CallerApp;
use crate::http::plumbing::etag::{self, unless_known, with_etag};
use crate::http::plumbing::extract::{
    JsonBody, Params, PlacePath, camera_of, media_type, negotiate, scope_of, site_of,
};
use crate::http::plumbing::merge_patch::{self, JsonObject};
use crate::http::plumbing::problem::{ApiResult, Problem};
use crate::http::plumbing::state::Rest;
use crate::http::plumbing::wire::{GEOJSON, created, empty, geojson, json};
use crate::places::settings::{Geometry, PlaceSettings, Rule};
use crate::places::statistics::{CountFigure, Figures};

/// Names of the fields that can be changed.
const FIELDS: [&str; 6] = ["display_name", "labels", "geometry", "radius_m", "probability", "rules"];

pub(super) fn routes() -> OpenApiRouter<Rest> {
    OpenApiRouter::new()
        .routes(routes!(create_place, list_places))
        .routes(routes!(get_place, change_place, delete_place))
        .routes(routes!(get_statistics))
}

/// A place to be stored, of a site or of a camera.
#[derive(Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
struct PlaceDraft {
    /// A slug: 1 to 63 of `a-z`, `0-9` and `-`.
    #[schema(pattern = "^[a-z0-9]([a-z0-9-]{0,61}[a-z0-9])?$", example = "gate")]
    id: String,
    /// The site whose world tracks are evaluated; either this or `camera_id`.
    #[schema(example = "harbour")]
    site_id: Option<String>,
    /// The camera whose tracks are evaluated.
    camera_id: Option<String>,
    /// The name for people; the id if left out.
    #[schema(max_length = 200, example = "Gate")]
    display_name: Option<String>,
    /// Free-form labels.
    #[serde(default, deserialize_with = "crate::http::plumbing::wire::labels")]
    labels: BTreeMap<String, String>,
    /// Where it is.
    geometry: Geometry,
    /// Radius of a point's place, m.
    #[schema(exclusive_minimum = 0.0, maximum = 10000.0)]
    radius_m: Option<f64>,
    /// The probability at which a target counts as inside, or on one side of a line; 0.95 if left out.
    #[schema(minimum = 0.6, maximum = 0.999)]
    probability: Option<f64>,
    /// Which events are made of what happens there.
    #[serde(default)]
    #[schema(max_items = 32)]
    rules: Vec<Rule>,
}

impl PlaceDraft {
    fn scope(&self) -> Result<TrackScope> {
        match (&self.site_id, &self.camera_id) {
            (Some(id), None) => site_of(id).map(TrackScope::Site),
            (None, Some(id)) => camera_of(id).map(TrackScope::Camera),
            _ => Err(Error::invalid("site_id", "give either site_id or camera_id")),
        }
    }

    fn settings(self) -> PlaceSettings {
        PlaceSettings {
            display_name: self.display_name.unwrap_or(self.id),
            labels: self.labels,
            geometry: self.geometry,
            radius_m: self.radius_m,
            probability: self.probability.unwrap_or(PlaceSettings::DEFAULT_PROBABILITY),
            rules: self.rules,
        }
    }
}

/// A place as a GeoJSON feature (RFC 7946); the properties are the other fields of a place.
#[derive(Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
struct PlaceFeature {
    /// `Feature`.
    #[schema(example = "Feature")]
    r#type: FeatureType,
    /// The place's id.
    id: String,
    /// Where it is.
    #[schema(value_type = Geometry)]
    geometry: Value,
    /// The other fields of a place.
    #[schema(value_type = Object)]
    properties: JsonObject,
}

/// The type of a feature.
#[derive(Serialize, Deserialize, ToSchema)]
enum FeatureType {
    /// A feature.
    Feature,
}

impl PlaceFeature {
    fn of(place: &Place) -> Result<Self> {
        let Value::Object(mut properties) = serde_json::to_value(place).map_err(Error::fault)? else {
            return Err(Error::fault("a place is an object"));
        };
        let geometry = properties.remove("geometry").unwrap_or_default();
        properties.remove("id");
        Ok(Self { r#type: FeatureType::Feature, id: place.id.clone(), geometry, properties })
    }

    /// The same as the JSON of a draft.
    fn into_draft(mut self) -> Result<Vec<u8>> {
        self.properties.insert("id".to_owned(), Value::String(self.id));
        self.properties.insert("geometry".to_owned(), self.geometry);
        serde_json::to_vec(&self.properties).map_err(Error::fault)
    }
}

/// Places as a GeoJSON feature collection (RFC 7946).
#[derive(Serialize, ToSchema)]
struct PlaceFeatures {
    /// `FeatureCollection`.
    #[schema(example = "FeatureCollection")]
    r#type: &'static str,
    /// One per place.
    features: Vec<PlaceFeature>,
    /// Asks for the next page; missing on the last.
    #[serde(skip_serializing_if = "Option::is_none")]
    next_cursor: Option<String>,
}

/// Changes to a place (a merge patch, RFC 7396): what is left out stays, null restores the default, and objects are merged.
/// Its site or camera stays.
#[derive(ToSchema)]
#[expect(dead_code, reason = "the shape of a patch, for the description alone")]
struct PlaceChange {
    /// New name; null is the id.
    #[schema(max_length = 200)]
    display_name: Option<String>,
    /// Labels to be set; a label that is null is removed, null removes all.
    labels: Option<BTreeMap<String, Option<String>>>,
    /// New geometry.
    geometry: Option<Geometry>,
    /// New radius of a point's place, m.
    radius_m: Option<f64>,
    /// New confidence; null is 0.95.
    probability: Option<f64>,
    /// New rules; they replace all.
    rules: Option<Vec<Rule>>,
}

/// A stored place.
#[derive(Serialize, ToSchema)]
struct Place {
    /// The slug that the operator chose.
    #[schema(example = "gate")]
    id: String,
    /// The site whose world tracks are evaluated.
    #[serde(skip_serializing_if = "Option::is_none")]
    site_id: Option<String>,
    /// The camera whose tracks are evaluated.
    #[serde(skip_serializing_if = "Option::is_none")]
    camera_id: Option<String>,
    #[serde(flatten)]
    settings: PlaceSettings,
    /// Counts the changes of the place, from 1.
    revision: u64,
    /// When it was created.
    #[schema(value_type = String, format = DateTime)]
    created_at: Timestamp,
    /// When it was changed last.
    #[schema(value_type = String, format = DateTime)]
    updated_at: Timestamp,
}

impl Place {
    fn of(place: &domain::Place) -> Result<Self> {
        let (site_id, camera_id) = match &place.profile.scope {
            TrackScope::Site(id) => (Some(id.to_string()), None),
            TrackScope::Camera(id) => (None, Some(id.to_string())),
        };
        Ok(Self {
            id: place.id().to_string(),
            site_id,
            camera_id,
            settings: place_settings(place)?,
            revision: place.revision.0,
            created_at: place.created_at,
            updated_at: place.updated_at,
        })
    }
}

/// A page of places, by id.
#[derive(Serialize, ToSchema)]
struct PlacePage {
    /// A page of places.
    items: Vec<Place>,
    /// Asks for the next page; missing on the last.
    #[serde(skip_serializing_if = "Option::is_none")]
    next_cursor: Option<String>,
}

#[derive(Clone, Copy)]
enum Form {
    Json,
    GeoJson,
}

fn form(headers: &HeaderMap) -> Result<Form> {
    negotiate(headers, &[("application/json", Form::Json), (GEOJSON, Form::GeoJson)])
}

/// Store a new place
///
/// A polygon, a line or a point with a radius, in which the tracks of a site or of a camera are evaluated. With the content
/// type `application/geo+json` a feature whose properties are the other fields.
#[utoipa::path(
    post, path = "/v1/places", tag = "places",
    request_body(content((PlaceDraft = "application/json"), (PlaceFeature = "application/geo+json"))),
    responses(
        (status = 201, description = "The stored place", body = Place,
            headers(("location" = String, description = "Its path"), ("etag" = String, description = "Names this state of this place"))),
        (status = 409, description = "A place of that id exists", body = Problem, content_type = "application/problem+json"),
    )
)]
async fn create_place(CallerApp(app): CallerApp, headers: HeaderMap, body: JsonBody) -> ApiResult {
    let draft = if media_type(&headers).is_some_and(|it| it.eq_ignore_ascii_case(GEOJSON)) {
        parse_json::<PlaceDraft>(&body.read::<PlaceFeature>()?.into_draft()?)?
    } else {
        body.read::<PlaceDraft>()?
    };
    let (id, scope) = (PlaceId::new(&draft.id)?, draft.scope()?);
    let place = app.places().create(id, scope, &draft.settings()).await?;
    let (location, version) = (format!("/v1/places/{}", place.id()), place.version());
    Ok(with_etag(created(StatusCode::CREATED, &location, &Place::of(&place)?)?, version).await?)
}

/// List places by id
///
/// JSON, or GeoJSON by `accept: application/geo+json`.
#[utoipa::path(
    get, path = "/v1/places", tag = "places",
    params(
        ("site" = Option<String>, Query, description = "Only places of this site"),
        ("camera" = Option<String>, Query, description = "Only places of this camera"),
        ("limit" = Option<u32>, Query, description = "Items on a page, 100 if left out"),
        ("cursor" = Option<String>, Query, description = "`next_cursor` of the page before"),
    ),
    responses(
        (status = 200, description = "A page of places", content(
            (PlacePage = "application/json"), (PlaceFeatures = "application/geo+json")
        )),
        (status = 404, description = "No such camera or site", body = Problem, content_type = "application/problem+json"),
    )
)]
async fn list_places(CallerApp(app): CallerApp, headers: HeaderMap, uri: Uri) -> ApiResult {
    let form = form(&headers)?;
    let mut params = Params::of(&uri)?;
    let scope = scope_of(&mut params)?;
    let limit = params.limit(app.limits.page_items)?;
    let after = params.cursor()?;
    params.end()?;
    let page = app.places().list(scope.as_ref(), after.as_ref(), limit).await?;
    let items = page.items.iter().map(Place::of).collect::<Result<Vec<_>>>()?;
    let next_cursor = page.next.map(|id| write_cursor(&id));
    Ok(match form {
        Form::Json => json(&PlacePage { items, next_cursor })?,
        Form::GeoJson => {
            let features = items.iter().map(PlaceFeature::of).collect::<Result<_>>()?;
            geojson(&PlaceFeatures { r#type: "FeatureCollection", features, next_cursor })?
        }
    })
}

/// Read a place
///
/// JSON, or a GeoJSON feature by `accept: application/geo+json`.
#[utoipa::path(
    get, path = "/v1/places/{place}", tag = "places",
    params(
        ("place" = String, Path, description = "The place's id"),
        ("if-none-match" = Option<String>, Header, description = "An `etag` that was read; the answer is 304 while it is current"),
    ),
    responses(
        (status = 200, description = "The place", content((Place = "application/json"), (PlaceFeature = "application/geo+json")),
            headers(("etag" = String, description = "Names this state of this place"))),
        (status = 304, description = "As the client knows it"),
    )
)]
async fn get_place(CallerApp(app): CallerApp, PlacePath(id): PlacePath, headers: HeaderMap) -> ApiResult {
    let form = form(&headers)?;
    let stored = app.places().get(&id).await?;
    let place = Place::of(&stored)?;
    let answer = match form {
        Form::Json => json(&place)?,
        Form::GeoJson => geojson(&PlaceFeature::of(&place)?)?,
    };
    Ok(unless_known(&headers, with_etag(answer, stored.version()).await?))
}

/// Change a place
///
/// A merge patch (RFC 7396): what is left out stays, null restores the default, objects such as labels are merged. The change
/// is based on a revision, named by the header `if-match` with the `etag` that was read; `if-match: *` changes whatever is
/// there. Tracks begin again at a place that was changed: targets inside appear anew.
#[utoipa::path(
    patch, path = "/v1/places/{place}", tag = "places",
    params(
        ("place" = String, Path, description = "The place's id"),
        ("if-match" = String, Header, description = "The `etag` that was read, or `*`"),
    ),
    request_body(content((PlaceChange = "application/merge-patch+json"), (PlaceChange = "application/json"))),
    responses(
        (status = 200, description = "The changed place", body = Place, headers(("etag" = String, description = "Names its new state"))),
        (status = 412, description = "The place has another revision", body = Problem, content_type = "application/problem+json"),
        (status = 428, description = "`if-match` is missing", body = Problem, content_type = "application/problem+json"),
    )
)]
async fn change_place(
    CallerApp(app): CallerApp,
    PlacePath(id): PlacePath,
    headers: HeaderMap,
    body: JsonBody,
) -> ApiResult {
    let expected = etag::required(&headers)?;
    let patch = body.read::<JsonObject>()?;
    let change = || async {
        let place = app.places().get(&id).await?;
        let document = merge_patch::merged(&Place::of(&place)?, &patch, &FIELDS)?;
        let settings = parse_json::<PlaceDraft>(&document)?.settings();
        app.places().change(&place, &settings, expected).await
    };
    let changed = merge_patch::retried(expected.is_some(), change).await?;
    Ok(with_etag(json(&Place::of(&changed)?)?, changed.version()).await?)
}

/// Delete a place with its events and counts
#[utoipa::path(
    delete, path = "/v1/places/{place}", tag = "places",
    params(
        ("place" = String, Path, description = "The place's id"),
        ("if-match" = Option<String>, Header, description = "Delete only at this revision"),
    ),
    responses(
        (status = 204, description = "It is gone"),
        (status = 412, description = "The place has another revision", body = Problem, content_type = "application/problem+json"),
    )
)]
async fn delete_place(CallerApp(app): CallerApp, PlacePath(id): PlacePath, headers: HeaderMap) -> ApiResult {
    app.places().delete(&id, etag::optional(&headers)?).await?;
    Ok(empty())
}

/// Statistics of a place.
#[derive(Serialize, ToSchema)]
struct Statistics {
    /// The number of targets in it now.
    occupancy: CountFigure,
    /// The figures over all of the time.
    total: Figures,
    /// The intervals in which something was counted, oldest first.
    intervals: Vec<Interval>,
}

/// The figures of an interval.
#[derive(Serialize, ToSchema)]
struct Interval {
    /// Its beginning.
    #[schema(value_type = String, format = DateTime)]
    from: Timestamp,
    #[serde(flatten)]
    figures: Figures,
}

impl From<PlaceStatistics> for Statistics {
    fn from(statistics: PlaceStatistics) -> Self {
        let PlaceStatistics { occupancy, total, intervals } = statistics;
        let interval = |StatisticsInterval { from, figures }| Interval { from, figures };
        Self { occupancy, total, intervals: intervals.into_iter().map(interval).collect() }
    }
}

/// The length of intervals.
#[derive(ToSchema)]
#[schema(rename_all = "snake_case")]
#[expect(dead_code, reason = "the values of a parameter, for the description alone")]
enum IntervalLength {
    /// A minute.
    Minute,
    /// An hour.
    Hour,
}

/// Read the statistics of a place
///
/// Counts, occupancy, dwell times, speeds and origins by minutes or hours, each with an interval that holds the true value with
/// 95 % probability.
#[utoipa::path(
    get, path = "/v1/places/{place}/statistics", tag = "places",
    params(
        ("place" = String, Path, description = "The place's id"),
        ("from" = Option<String>, Query, description = "From the interval that holds this instant (RFC 3339); an hour of minutes, or a day of hours, before `until` if left out"),
        ("until" = Option<String>, Query, description = "Before this instant; now if left out"),
        ("interval" = inline(Option<IntervalLength>), Query, description = "`minute` (if left out) or `hour`"),
        ("class" = Option<String>, Query, description = "Only targets of this class; empty for those without one"),
    ),
    responses(
        (status = 200, description = "The statistics", body = Statistics),
        (status = 307, description = "Another node evaluates the place; `location` is the same at that node", body = Problem, content_type = "application/problem+json"),
    )
)]
async fn get_statistics(CallerApp(app): CallerApp, PlacePath(id): PlacePath, uri: Uri) -> ApiResult {
    let mut params = Params::of(&uri)?;
    let request = StatisticsRequest {
        from: params.time("from")?,
        until: params.time("until")?,
        step: params.take("interval", str::parse)?.unwrap_or_default(),
        class: params.take("class", |text| Ok(text.to_owned()))?,
    };
    params.end()?;
    Ok(json(&Statistics::from(app.places().statistics(&id, &request).await?))?)
}
