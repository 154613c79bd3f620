//! `/v1/cameras`: profiles.

use std::collections::BTreeMap;

use hyper::{HeaderMap, StatusCode, Uri};
use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use super::history::HistorySettings;
use super::receivers::{Receiver, receivers, shown};
use crate::app::App;
use crate::domain::{
    self, CameraId, Error, GnssBiasSigma, NewCamera, Recipe, Result, SigmaM, SiteId, TargetClass,
};
use crate::exchange::wire::{Position, parse_document};
use crate::exchange::write_cursor;
use crate::http::plumbing::access::CallerApp;
use crate::http::plumbing::etag::{self, unless_known, with_etag};
use crate::http::plumbing::extract::{CameraPath, JsonBody, Params, site_of};
use crate::http::plumbing::merge_patch::{self, JsonObject};
use crate::http::plumbing::problem::{ApiResult, Problem};
use crate::http::plumbing::state::Rest;
use crate::http::plumbing::wire::{created, empty, json};

pub(super) fn routes() -> OpenApiRouter<Rest> {
    OpenApiRouter::new().routes(routes!(create_camera, list_cameras)).routes(routes!(
        get_camera,
        change_camera,
        delete_camera
    ))
}

/// Size of a camera's image.
#[derive(Clone, Copy, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub(super) struct ImageSize {
    /// Number of columns.
    #[schema(minimum = 1, maximum = 131_072, example = 1920)]
    width_px: u32,
    /// Number of rows.
    #[schema(minimum = 1, maximum = 131_072, example = 1080)]
    height_px: u32,
}

impl ImageSize {
    fn to_domain(self) -> Result<domain::ImageSize> {
        domain::ImageSize::new(self.width_px, self.height_px).map_err(|error| error.under("image_size"))
    }
}

/// A receiver's error: `"unknown"` (then it is estimated from the training samples), or its
/// standard deviation per horizontal axis in metres.
#[derive(Clone, Copy, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub(super) enum GnssError {
    /// To be estimated.
    Unknown,
    /// Metres per axis, 0.001 to 10,000.
    SigmaM(f64),
}

impl GnssError {
    fn to_domain(self) -> Result<domain::GnssError> {
        match self {
            Self::Unknown => Ok(domain::GnssError::Unknown),
            Self::SigmaM(sigma_m) => {
                SigmaM::new(sigma_m).map(domain::GnssError::Known).map_err(|error| error.under("gnss_error"))
            }
        }
    }
}

impl From<domain::GnssError> for GnssError {
    fn from(error: domain::GnssError) -> Self {
        match error {
            domain::GnssError::Known(sigma) => Self::SigmaM(sigma.metres()),
            domain::GnssError::Unknown => Self::Unknown,
        }
    }
}

/// Where a still picture of what a camera sees is fetched.
#[derive(Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub(super) struct SnapshotSource {
    /// An address of HTTP or HTTPS that answers with a JPEG or PNG, such as ONVIF's snapshot URI or Frigate's
    /// `/api/<camera>/latest.jpg`.
    #[schema(max_length = 512, example = "http://frigate.example.org:5000/api/gate/latest.jpg")]
    url: String,
    /// The name for HTTP's Basic authentication, where the camera asks for one.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(max_length = 256)]
    username: Option<String>,
    /// The password. It is never shown; without it, that of the same `url` and `username` is kept.
    #[serde(skip_serializing)]
    #[schema(max_length = 256, write_only)]
    password: Option<String>,
}

impl SnapshotSource {
    fn into_domain(self) -> Result<domain::SnapshotSource> {
        domain::SnapshotSource::new(&self.url, self.username, self.password)
    }

    fn shown(source: &domain::SnapshotSource) -> Self {
        let username = source.username().map(str::to_owned);
        Self { url: source.url().to_owned(), username, password: None }
    }
}

/// A point of the ground whose place in the image and on the earth is known, such as the corner of a kerb.
#[derive(Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub(super) struct KnownPoint {
    /// From the left of the image, px.
    #[schema(minimum = 0.0, example = 512.5)]
    x_px: f64,
    /// From the top of the image, px.
    #[schema(minimum = 0.0, example = 640.0)]
    y_px: f64,
    /// Where it is on the earth.
    position: Position,
    /// Standard deviation of that position per axis, m, 0.001 to 10,000; 0.5 if left out.
    #[serde(default = "KnownPoint::default_sigma_m")]
    #[schema(minimum = 0.001, maximum = 10_000.0, default = 0.5)]
    sigma_m: f64,
}

impl KnownPoint {
    const fn default_sigma_m() -> f64 {
        domain::KnownPoint::DEFAULT_SIGMA_M
    }

    fn to_domain(&self) -> Result<domain::KnownPoint> {
        Ok(domain::KnownPoint {
            image_px: [self.x_px, self.y_px],
            position: self.position.to_domain().map_err(|error| error.under("position"))?,
            sigma_m: SigmaM::new(self.sigma_m)?,
        })
    }
}

impl From<domain::KnownPoint> for KnownPoint {
    fn from(point: domain::KnownPoint) -> Self {
        let [x_px, y_px] = point.image_px;
        Self { x_px, y_px, position: point.position.into(), sigma_m: point.sigma_m.metres() }
    }
}

fn known_points(given: &[KnownPoint]) -> Result<Vec<domain::KnownPoint>> {
    let point = |(index, given): (usize, &KnownPoint)| {
        given.to_domain().map_err(|error| error.under(&format!("known_points[{index}]")))
    };
    given.iter().enumerate().map(point).collect()
}

/// A camera to be stored. Nothing but the id is needed; no calibration is ever asked for.
#[derive(Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
struct CameraDraft {
    /// A slug: 1 to 63 of `a-z`, `0-9` and `-`.
    #[schema(pattern = "^[a-z0-9]([a-z0-9-]{0,61}[a-z0-9])?$", example = "north-gate")]
    id: String,
    /// The name for people; the id if left out.
    #[schema(max_length = 200, example = "North gate")]
    display_name: Option<String>,
    /// Without it, boxes cut by the right or lower border cannot be recognised.
    image_size: Option<ImageSize>,
    /// `"unknown"` if left out.
    gnss_error: Option<GnssError>,
    /// Rough position of the camera itself. An import tells of fixes that are far from it, and of swapped coordinates.
    location: Option<Position>,
    /// Standard deviation per axis, m, of the bias that all fixes have in common, which no sample can show;
    /// without it, the model has a prior of its own.
    #[schema(exclusive_minimum = 0.0, maximum = 100.0, example = 1.5)]
    gnss_bias_sigma_m: Option<f64>,
    /// The server's default if left out.
    recipe: Option<Recipe>,
    /// Classes that the camera is used for; none means all.
    #[serde(default)]
    #[schema(max_items = 64, example = json!(["person"]))]
    target_classes: Vec<String>,
    /// Free-form labels.
    #[serde(default, deserialize_with = "crate::http::plumbing::wire::labels")]
    labels: BTreeMap<String, String>,
    /// Whose the GNSS receivers are; one that is not named here carries its own id as target id.
    #[serde(default)]
    #[schema(max_items = 1_024)]
    receivers: Vec<Receiver>,
    /// True if a training run starts automatically once the camera is found to have moved.
    #[serde(default)]
    retrain_when_moved: bool,
    /// True if the camera, while it has no model, records boxes of trackers and fixes of receivers, and is trained on
    /// those that certainly belong together (`GET .../learning`); true if left out.
    learn_automatically: Option<bool>,
    /// The site whose world tracks the camera contributes to; it must exist.
    #[schema(example = "harbour")]
    site: Option<String>,
    /// Where a still picture is fetched, if the camera or another program offers one.
    snapshot: Option<SnapshotSource>,
    /// How finished tracks are kept; none are if left out.
    history: Option<HistorySettings>,
    /// Points of the ground whose place is known: evidence of training beside the fixes.
    #[serde(default)]
    #[schema(max_items = 100)]
    known_points: Vec<KnownPoint>,
}

impl CameraDraft {
    fn into_domain(self) -> Result<NewCamera> {
        let blank = NewCamera::named(CameraId::new(&self.id)?);
        let location = self.location.map(Position::to_domain).transpose();
        Ok(NewCamera {
            display_name: self.display_name.unwrap_or(blank.display_name),
            image_size: self.image_size.map(ImageSize::to_domain).transpose()?,
            gnss_error: self.gnss_error.map_or(Ok(blank.gnss_error), GnssError::to_domain)?,
            location: location.map_err(|error| error.under("location"))?,
            gnss_bias_sigma: self.gnss_bias_sigma_m.map(GnssBiasSigma::new).transpose()?,
            recipe: self.recipe.unwrap_or(blank.recipe),
            target_classes: classes(&self.target_classes)?,
            labels: self.labels,
            receivers: receivers(&self.receivers)?,
            retrain_when_moved: self.retrain_when_moved,
            learn_automatically: self.learn_automatically.unwrap_or(blank.learn_automatically),
            site: self.site.as_deref().map(SiteId::new).transpose().map_err(|error| error.at("site"))?,
            snapshot: self.snapshot.map(SnapshotSource::into_domain).transpose()?,
            history: self.history.map(HistorySettings::to_domain).transpose()?,
            known_points: known_points(&self.known_points)?,
            id: blank.id,
        })
    }
}

fn classes(names: &[String]) -> Result<Vec<TargetClass>> {
    let class = |(index, name): (usize, &String)| {
        TargetClass::new(name).map_err(|error| match error {
            Error::Refused(refusal) => Error::invalid(format!("target_classes[{index}]"), refusal.message),
            fault @ Error::Fault(_) => fault,
        })
    };
    names.iter().enumerate().map(class).collect()
}

/// Changes to a profile (a merge patch, RFC 7396): what is left out stays, null restores the default, and objects
/// such as labels are merged.
#[derive(ToSchema)]
#[expect(dead_code, reason = "the shape of a patch, for the description alone")]
struct CameraChange {
    /// New name; null is the id.
    #[schema(max_length = 200)]
    display_name: Option<String>,
    /// New size of the image; null forgets it.
    image_size: Option<ImageSize>,
    /// New error of the receiver; null is `"unknown"`.
    gnss_error: Option<GnssError>,
    /// New position of the camera itself; null forgets it.
    location: Option<Position>,
    /// New standard deviation per axis, m, of the bias that all fixes have in common; null is the model's own
    /// prior.
    #[schema(exclusive_minimum = 0.0, maximum = 100.0)]
    gnss_bias_sigma_m: Option<f64>,
    /// New recipe, for runs to come; null is the server's default.
    recipe: Option<Recipe>,
    /// New classes, all of them; null is none.
    target_classes: Option<Vec<String>>,
    /// Labels to be set; a label that is null is removed, null removes all.
    labels: Option<BTreeMap<String, Option<String>>>,
    /// New receivers, all of them; null is none.
    #[schema(max_items = 1_024)]
    receivers: Option<Vec<Receiver>>,
    /// True to start a training run once the camera is found to have moved; null for false.
    retrain_when_moved: Option<bool>,
    /// True to record and learn while there is no model; null for true.
    learn_automatically: Option<bool>,
    /// New site; null removes the camera from its site.
    site: Option<String>,
    /// New address of a still picture; null forgets it.
    snapshot: Option<SnapshotSource>,
    /// New settings of the history; null keeps no more tracks. What is kept already stays until it is deleted or too old.
    history: Option<HistorySettings>,
    /// New known points, all of them, for runs to come; null is none.
    #[schema(max_items = 100)]
    known_points: Option<Vec<KnownPoint>>,
}

/// The change that a merge patch makes of a stored camera.
fn patched(app: &App, camera: domain::Camera, patch: &JsonObject) -> Result<domain::CameraChange> {
    let document = merge_patch::merged(&Camera::of(app, camera), patch, &domain::CameraChange::FIELDS)?;
    let profile = parse_document::<CameraDraft>(&document)?.into_domain()?;
    Ok(domain::CameraChange::of_fields(profile, |field| patch.contains_key(field)))
}

/// A stored camera.
#[derive(Serialize, ToSchema)]
pub(super) struct Camera {
    /// The slug that the operator chose.
    #[schema(example = "north-gate")]
    id: String,
    /// The name for people.
    display_name: String,
    /// Size of the image, if it is known.
    #[serde(skip_serializing_if = "Option::is_none")]
    image_size: Option<ImageSize>,
    /// The receiver's error.
    gnss_error: GnssError,
    /// Rough position of the camera itself, if stated.
    #[serde(skip_serializing_if = "Option::is_none")]
    location: Option<Position>,
    /// Standard deviation per axis, m, of the bias that all fixes have in common, if stated.
    #[serde(skip_serializing_if = "Option::is_none")]
    gnss_bias_sigma_m: Option<f64>,
    /// How the camera is learnt.
    recipe: Recipe,
    /// Classes that the camera is used for; none means all.
    target_classes: Vec<String>,
    /// Free-form labels.
    labels: BTreeMap<String, String>,
    /// Whose the GNSS receivers are, and how far their clocks are off, by receiver id.
    receivers: Vec<Receiver>,
    /// True if a training run starts automatically once the camera is found to have moved.
    retrain_when_moved: bool,
    /// True if the camera, while it has no model, records boxes of trackers and fixes of receivers and is trained on
    /// them.
    learn_automatically: bool,
    /// The site whose world tracks the camera contributes to, if any.
    #[serde(skip_serializing_if = "Option::is_none")]
    site: Option<String>,
    /// Where a still picture is fetched, if stated; without the password.
    #[serde(skip_serializing_if = "Option::is_none")]
    snapshot: Option<SnapshotSource>,
    /// How finished tracks are kept; missing if none are.
    #[serde(skip_serializing_if = "Option::is_none")]
    history: Option<HistorySettings>,
    /// Points of the ground whose place is known.
    known_points: Vec<KnownPoint>,
    /// Counts the changes of the profile, from 1.
    revision: u64,
    /// When it was made.
    #[schema(value_type = String, format = DateTime)]
    created_at: Timestamp,
    /// When the profile was changed last.
    #[schema(value_type = String, format = DateTime)]
    updated_at: Timestamp,
    /// Number of the model version that answers, if any.
    #[serde(skip_serializing_if = "Option::is_none")]
    active_model: Option<u32>,
    /// Why the active model cannot be used, if so. Fixes then pass through without it.
    #[serde(skip_serializing_if = "Option::is_none")]
    model_fault: Option<String>,
    /// Set if the camera no longer looks where it looked when its active model was trained.
    #[serde(skip_serializing_if = "Option::is_none")]
    moved: Option<CameraMoved>,
    /// Number of stored samples.
    samples: u64,
    /// Number of these samples without a fix.
    samples_without_fix: u64,
    /// Consequences of fields that were left out.
    warnings: Vec<String>,
}

impl Camera {
    pub(super) fn of(app: &App, camera: domain::Camera) -> Self {
        let moved = app.cameras().moved(camera.id()).map(|moved| CameraMoved::from(&*moved));
        let model_fault = app.models().fault(camera.id()).map(|fault| fault.reason);
        let warnings = app.cameras().warnings(&camera);
        let domain::Camera { profile, revision, created_at, updated_at, active_model, samples, key: _ } =
            camera;
        Self {
            id: profile.id.as_str().to_owned(),
            display_name: profile.display_name,
            image_size: profile
                .image_size
                .map(|size| ImageSize { width_px: size.width_px(), height_px: size.height_px() }),
            gnss_error: profile.gnss_error.into(),
            location: profile.location.map(Into::into),
            gnss_bias_sigma_m: profile.gnss_bias_sigma.map(GnssBiasSigma::metres),
            recipe: profile.recipe,
            target_classes: profile.target_classes.iter().map(|class| class.as_str().to_owned()).collect(),
            labels: profile.labels,
            receivers: shown(&profile.receivers),
            retrain_when_moved: profile.retrain_when_moved,
            learn_automatically: profile.learn_automatically,
            site: profile.site.map(|site| site.as_str().to_owned()),
            snapshot: profile.snapshot.as_ref().map(SnapshotSource::shown),
            history: profile.history.map(Into::into),
            known_points: profile.known_points.into_iter().map(Into::into).collect(),
            revision: revision.0,
            created_at,
            updated_at,
            active_model,
            model_fault,
            moved,
            samples: samples.all,
            samples_without_fix: samples.without_fix,
            warnings,
        }
    }
}

/// The camera no longer looks where it looked when its model was trained: its positions have left the
/// receivers' fixes, or the positions by the other cameras of its site, beyond what the errors explain.
#[derive(Serialize, ToSchema)]
pub(super) struct CameraMoved {
    /// Number of the model version that no longer fits.
    model_version: u32,
    /// Estimated onset of the change.
    #[schema(value_type = String, format = DateTime)]
    onset_at: Timestamp,
    /// When the evidence was enough.
    #[schema(value_type = String, format = DateTime)]
    raised_at: Timestamp,
    /// Mean shift of the regressed positions since then, towards east in metres.
    shift_east_m: f64,
    /// The same towards north.
    shift_north_m: f64,
    /// The test's statistic: chi-square of 2 degrees at one known onset without a change.
    statistic: f64,
    /// Targets that bear witness.
    targets: u32,
}

impl From<&domain::CameraMoved> for CameraMoved {
    fn from(moved: &domain::CameraMoved) -> Self {
        let &domain::CameraMoved { model_version, onset_at, raised_at, .. } = moved;
        let &domain::CameraMoved { shift_east_m, shift_north_m, statistic, targets, .. } = moved;
        Self { model_version, onset_at, raised_at, shift_east_m, shift_north_m, statistic, targets }
    }
}

/// A page of cameras, by id.
#[derive(Serialize, ToSchema)]
struct CameraPage {
    /// A page of cameras.
    items: Vec<Camera>,
    /// Asks for the next page; missing on the last.
    #[serde(skip_serializing_if = "Option::is_none")]
    next_cursor: Option<String>,
}

/// Store a new camera
#[utoipa::path(
    post, path = "/v1/cameras", tag = "cameras", request_body = CameraDraft,
    responses(
        (status = 201, description = "The stored camera", body = Camera,
            headers(("location" = String, description = "Its path"), ("etag" = String, description = "Names this state of this camera"))),
        (status = 409, description = "A camera of that id exists", body = Problem, content_type = "application/problem+json"),
    )
)]
async fn create_camera(CallerApp(app): CallerApp, body: JsonBody) -> ApiResult {
    let camera = app.cameras().create(body.read::<CameraDraft>()?.into_domain()?).await?;
    let (location, version) = (format!("/v1/cameras/{}", camera.id()), camera.version());
    Ok(with_etag(created(StatusCode::CREATED, &location, &Camera::of(&app, camera))?, version).await?)
}

/// List cameras by id
#[utoipa::path(
    get, path = "/v1/cameras", tag = "cameras",
    params(
        ("limit" = Option<u32>, Query, description = "Items on a page, 100 if left out"),
        ("cursor" = Option<String>, Query, description = "`next_cursor` of the page before"),
        ("site" = Option<String>, Query, description = "Only the cameras of this site"),
    ),
    responses(
        (status = 200, description = "A page of cameras", body = CameraPage),
        (status = 404, description = "There is no such site", body = Problem, content_type = "application/problem+json"),
    )
)]
async fn list_cameras(CallerApp(app): CallerApp, uri: Uri) -> ApiResult {
    let mut params = Params::of(&uri)?;
    let limit = params.limit(app.limits.page_items)?;
    let after = params.cursor()?;
    let site = params.take("site", site_of)?;
    params.end()?;
    let page = app.cameras().list(site.as_ref(), after.as_ref(), limit).await?;
    Ok(json(&CameraPage {
        items: page.items.into_iter().map(|camera| Camera::of(&app, camera)).collect(),
        next_cursor: page.next.map(|id| write_cursor(&id)),
    })?)
}

/// Read a camera
#[utoipa::path(
    get, path = "/v1/cameras/{camera}", tag = "cameras",
    params(
        ("camera" = String, Path, description = "The camera's id"),
        ("if-none-match" = Option<String>, Header, description = "An `etag` that was read; the answer is 304 while it is current"),
    ),
    responses(
        (status = 200, description = "The camera", body = Camera, headers(("etag" = String, description = "Names this state of this camera"))),
        (status = 304, description = "As the client knows it"),
    )
)]
async fn get_camera(CallerApp(app): CallerApp, CameraPath(id): CameraPath, headers: HeaderMap) -> ApiResult {
    let camera = app.cameras().get(&id).await?;
    let version = camera.version();
    let response = with_etag(json(&Camera::of(&app, camera))?, version).await?;
    Ok(unless_known(&headers, response))
}

/// Change a camera's profile
///
/// A merge patch (RFC 7396): what is left out stays, null restores the default, objects such as labels are merged.
/// The change is based on a revision, named by the header `if-match` with the `etag` that was read;
/// `if-match: *` changes whatever is there.
#[utoipa::path(
    patch, path = "/v1/cameras/{camera}", tag = "cameras",
    params(
        ("camera" = String, Path, description = "The camera's id"),
        ("if-match" = String, Header, description = "The `etag` that was read, or `*`"),
    ),
    request_body(content((CameraChange = "application/merge-patch+json"), (CameraChange = "application/json"))),
    responses(
        (status = 200, description = "The changed camera", body = Camera, headers(("etag" = String, description = "Names its new state"))),
        (status = 412, description = "The camera has another revision", body = Problem, content_type = "application/problem+json"),
        (status = 428, description = "`if-match` is missing", body = Problem, content_type = "application/problem+json"),
    )
)]
async fn change_camera(
    CallerApp(app): CallerApp,
    CameraPath(id): CameraPath,
    headers: HeaderMap,
    body: JsonBody,
) -> ApiResult {
    let expected = etag::required(&headers)?;
    let patch = body.read::<JsonObject>()?;
    let change = || async {
        let camera = app.cameras().get(&id).await?;
        let version = expected.unwrap_or(camera.version());
        app.cameras().change(&id, patched(&app, camera, &patch)?, Some(version)).await
    };
    let changed = merge_patch::retried(expected.is_some(), change).await?;
    let version = changed.version();
    Ok(with_etag(json(&Camera::of(&app, changed))?, version).await?)
}

/// Delete a camera with its samples, runs and models
#[utoipa::path(
    delete, path = "/v1/cameras/{camera}", tag = "cameras",
    params(
        ("camera" = String, Path, description = "The camera's id"),
        ("if-match" = Option<String>, Header, description = "Delete only at this revision"),
    ),
    responses(
        (status = 204, description = "It is gone"),
        (status = 409, description = "A training run is live", body = Problem, content_type = "application/problem+json"),
        (status = 412, description = "The camera has another revision", body = Problem, content_type = "application/problem+json"),
    )
)]
async fn delete_camera(
    CallerApp(app): CallerApp,
    CameraPath(id): CameraPath,
    headers: HeaderMap,
) -> ApiResult {
    app.cameras().delete(&id, etag::optional(&headers)?).await?;
    Ok(empty())
}
