//! `/ogc`: OGC API Features, part 1 (OGC 17-069r4), to read: cameras, and of each camera its samples and tracks.
//!
//! The collections are `cameras`, `{camera}.samples` and `{camera}.tracks`. What the standard demands of the core
//! and of GeoJSON is there; the conformance class of OpenAPI 3.0 is not declared, since the description is 3.1.

mod collection;
mod links;
mod query;
mod sources;

use hyper::Uri;
use hyper::http::request::Parts;
use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};
use utoipa::ToSchema;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use self::collection::CollectionId;
use self::links::{BaseUrl, JSON, Link};
use self::query::Selection;
use self::sources::{Feature, FeaturePage};
use crate::http::plumbing::access::CallerApp;
use crate::http::plumbing::extract::{Params, path};
use crate::http::plumbing::problem::{ApiError, ApiResult, Problem};
use crate::http::plumbing::state::Rest;
use crate::http::plumbing::wire::{GEOJSON, geojson, json};

/// Requirements classes of the standard that are satisfied.
const CONFORMANCE: [&str; 2] = [
    "http://www.opengis.net/spec/ogcapi-features-1/1.0/conf/core",
    "http://www.opengis.net/spec/ogcapi-features-1/1.0/conf/geojson",
];
/// Longitude and latitude, WGS 84, in that order.
const CRS84: &str = "http://www.opengis.net/def/crs/OGC/1.3/CRS84";

pub(super) fn routes() -> OpenApiRouter<Rest> {
    OpenApiRouter::new()
        .routes(routes!(landing_page))
        .routes(routes!(conformance))
        .routes(routes!(list_collections))
        .routes(routes!(get_collection))
        .routes(routes!(list_features))
        .routes(routes!(get_feature))
}

/// Where the interface begins.
#[derive(Serialize, ToSchema)]
struct LandingPage {
    /// Title of the interface.
    title: &'static str,
    /// A description of the data.
    description: &'static str,
    /// Where its parts are.
    links: Vec<Link>,
}

/// Requirements classes that are satisfied.
#[derive(Serialize, ToSchema)]
struct Conformance {
    /// URIs of the conformance classes.
    #[serde(rename = "conformsTo")]
    conforms_to: [&'static str; 2],
}

/// All collections.
#[derive(Serialize, ToSchema)]
struct Collections {
    /// Where this is.
    links: Vec<Link>,
    /// Collections of features.
    collections: Vec<Collection>,
}

/// A collection of features.
#[derive(Serialize, ToSchema)]
struct Collection {
    /// Its id: `cameras`, `{camera}.samples` or `{camera}.tracks`.
    id: String,
    /// Title of the collection.
    title: String,
    /// The description of its features.
    description: &'static str,
    /// `feature`.
    #[serde(rename = "itemType")]
    item_type: &'static str,
    /// The coordinate reference system of its geometries.
    crs: [&'static str; 1],
    /// Where its features are.
    links: Vec<Link>,
}

impl Collection {
    fn new(id: &CollectionId, base: &BaseUrl) -> Self {
        let path = format!("collections/{id}");
        let links =
            vec![base.link("self", JSON, &path), base.link("items", GEOJSON, &format!("{path}/items"))];
        Self {
            id: id.to_string(),
            title: id.title(),
            description: id.description(),
            item_type: "feature",
            crs: [CRS84],
            links,
        }
    }
}

/// Features as a GeoJSON feature collection (RFC 7946).
#[derive(Serialize, ToSchema)]
struct FeatureCollection {
    /// `FeatureCollection`.
    #[schema(example = "FeatureCollection")]
    r#type: &'static str,
    /// When the answer was made.
    #[serde(rename = "timeStamp")]
    #[schema(value_type = String, format = DateTime)]
    time_stamp: Timestamp,
    /// Number of features in this answer.
    #[serde(rename = "numberReturned")]
    number_returned: usize,
    /// This answer, and the next if there may be one.
    links: Vec<Link>,
    /// The features.
    features: Vec<GeoJsonFeature>,
}

/// A feature (RFC 7946).
#[derive(Serialize, ToSchema)]
struct GeoJsonFeature {
    /// `Feature`.
    #[schema(example = "Feature")]
    r#type: &'static str,
    /// Its id in the collection.
    id: String,
    /// Its geometry; null where none is known.
    #[schema(value_type = Option<Object>)]
    geometry: Value,
    /// Properties of the feature.
    #[schema(value_type = Object)]
    properties: Map<String, Value>,
    /// Links of a single feature: to itself and to its collection.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    links: Vec<Link>,
}

impl GeoJsonFeature {
    fn new(feature: Feature, links: Vec<Link>) -> Self {
        let Feature { id, geometry, properties } = feature;
        Self { r#type: "Feature", id, geometry: geometry.to_geojson(), properties, links }
    }
}

/// Where the interface for GIS begins
#[utoipa::path(
    get, path = "/ogc", tag = "features",
    responses((status = 200, description = "Title and links", body = LandingPage))
)]
async fn landing_page(base: BaseUrl) -> ApiResult {
    let links = vec![
        base.link("self", JSON, ""),
        base.root_link("service-desc", "application/vnd.oai.openapi+json;version=3.1", "openapi.json"),
        base.root_link("service-doc", "text/html", "docs"),
        base.link("conformance", JSON, "conformance"),
        base.link("data", JSON, "collections"),
    ];
    let description = "Cameras with the areas that their models cover, the samples that they learn from, and the \
                       targets that they track.";
    Ok(json(&LandingPage { title: "sightfix", description, links })?)
}

/// Read which requirements classes are satisfied
#[utoipa::path(
    get, path = "/ogc/conformance", tag = "features",
    responses((status = 200, description = "Requirements classes", body = Conformance))
)]
async fn conformance() -> ApiResult {
    Ok(json(&Conformance { conforms_to: CONFORMANCE })?)
}

/// List the collections of features
///
/// `cameras`, and of each camera `{camera}.samples` and `{camera}.tracks`.
#[utoipa::path(
    get, path = "/ogc/collections", tag = "features",
    responses((status = 200, description = "All collections", body = Collections))
)]
async fn list_collections(CallerApp(app): CallerApp, base: BaseUrl) -> ApiResult {
    let ids = collection::all(&app).await?;
    Ok(json(&Collections {
        links: vec![base.link("self", JSON, "collections")],
        collections: ids.iter().map(|id| Collection::new(id, &base)).collect(),
    })?)
}

/// Read what a collection of features is
#[utoipa::path(
    get, path = "/ogc/collections/{collection}", tag = "features",
    params(("collection" = String, Path, description = "`cameras`, `{camera}.samples` or `{camera}.tracks`")),
    responses(
        (status = 200, description = "The collection", body = Collection),
        (status = 404, description = "There is no such collection", body = Problem, content_type = "application/problem+json"),
    )
)]
async fn get_collection(
    CallerApp(app): CallerApp,
    base: BaseUrl,
    CollectionPath(id): CollectionPath,
) -> ApiResult {
    id.check(&app).await?;
    Ok(json(&Collection::new(&id, &base))?)
}

/// List features of a collection
///
/// As GeoJSON. A page may hold fewer features than `limit` although there are more: as long as there is a link
/// `next`, it leads on. Samples have the place of their fix, tracks their latest position, cameras the area that
/// their model covers.
#[utoipa::path(
    get, path = "/ogc/collections/{collection}/items", tag = "features",
    params(
        ("collection" = String, Path, description = "`cameras`, `{camera}.samples` or `{camera}.tracks`"),
        ("bbox" = Option<String>, Query, description = "Only features that intersect it: west,south,east,north in degrees; west may be greater than east, across the antimeridian"),
        ("datetime" = Option<String>, Query, description = "Only features of this instant or interval (RFC 3339): an instant, or begin/end, where `..` is open"),
        ("limit" = Option<u32>, Query, minimum = 1, description = "Features on a page, 100 if left out; more than the server's own limit counts as that"),
        ("cursor" = Option<String>, Query, description = "Where the page begins, from the link `next`"),
    ),
    responses(
        (status = 200, description = "Features", body = FeatureCollection, content_type = "application/geo+json"),
        (status = 400, description = "A parameter cannot be used", body = Problem, content_type = "application/problem+json"),
        (status = 404, description = "There is no such collection", body = Problem, content_type = "application/problem+json"),
    )
)]
async fn list_features(
    CallerApp(app): CallerApp,
    base: BaseUrl,
    CollectionPath(id): CollectionPath,
    uri: Uri,
) -> ApiResult {
    let mut params = Params::of(&uri)?;
    let selection = Selection::take(&mut params, app.limits.page_items)?;
    let cursor = params.take("cursor", |text| Ok(text.to_owned()))?;
    params.end()?;
    let FeaturePage { features, next } = sources::page(&app, &id, &selection, cursor.as_deref()).await?;
    let path = format!("collections/{id}/items");
    let own = uri.query().map_or_else(|| path.clone(), |query| format!("{path}?{query}"));
    let mut links = vec![base.link("self", GEOJSON, &own)];
    if let Some(next) = next {
        links.push(base.link("next", GEOJSON, &format!("{path}?{}", selection.to_query(&next))));
    }
    Ok(geojson(&FeatureCollection {
        r#type: "FeatureCollection",
        time_stamp: app.clock.now(),
        number_returned: features.len(),
        links,
        features: features.into_iter().map(|feature| GeoJsonFeature::new(feature, Vec::new())).collect(),
    })?)
}

/// Read a feature
#[utoipa::path(
    get, path = "/ogc/collections/{collection}/items/{feature}", tag = "features",
    params(
        ("collection" = String, Path, description = "`cameras`, `{camera}.samples` or `{camera}.tracks`"),
        ("feature" = String, Path, description = "The feature's id"),
    ),
    responses(
        (status = 200, description = "The feature", body = GeoJsonFeature, content_type = "application/geo+json"),
        (status = 404, description = "There is no such feature", body = Problem, content_type = "application/problem+json"),
    )
)]
async fn get_feature(
    CallerApp(app): CallerApp,
    base: BaseUrl,
    FeaturePath(id, feature): FeaturePath,
) -> ApiResult {
    let feature = sources::one(&app, &id, &feature).await?;
    let collection = format!("collections/{id}");
    let links = vec![
        base.link("self", GEOJSON, &format!("{collection}/items/{}", links::segment(&feature.id))),
        base.link("collection", JSON, &collection),
    ];
    Ok(geojson(&GeoJsonFeature::new(feature, links))?)
}

#[derive(Deserialize)]
struct CollectionSegment {
    collection: String,
}

#[derive(Deserialize)]
struct FeatureSegments {
    collection: String,
    feature: String,
}

/// A collection of the path.
struct CollectionPath(CollectionId);

impl<S: Send + Sync> axum::extract::FromRequestParts<S> for CollectionPath {
    type Rejection = ApiError;

    async fn from_request_parts(parts: &mut Parts, state: &S) -> ApiResult<Self> {
        Ok(Self(path::<CollectionSegment, S>(parts, state).await?.collection.parse()?))
    }
}

/// A feature of the path.
struct FeaturePath(CollectionId, String);

impl<S: Send + Sync> axum::extract::FromRequestParts<S> for FeaturePath {
    type Rejection = ApiError;

    async fn from_request_parts(parts: &mut Parts, state: &S) -> ApiResult<Self> {
        let FeatureSegments { collection, feature } = path(parts, state).await?;
        Ok(Self(collection.parse()?, feature))
    }
}
