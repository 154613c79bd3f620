//! Extractors of the handlers: path, parameters, JSON body, media types.

use axum::extract::{FromRequest, FromRequestParts, Path, Query, Request};
use bytes::Bytes;
use hyper::header::{ACCEPT, CONTENT_TYPE};
use hyper::http::request::Parts;
use hyper::{HeaderMap, Uri};
use jiff::Timestamp;
use serde::Deserialize;
use serde::de::DeserializeOwned;

use super::body;
use super::problem::{ApiError, ApiResult, no_route};
use crate::admission::ClientId;
use crate::domain::{
    CameraId, ConnectionId, Durability, Error, ErrorKind, EvaluationId, LiveId, OnConflict, PlaceId, Result,
    RunId, SiteId, TargetId, TrackScope, parse_time, parse_time_zone,
};
use crate::exchange::{CsvLayout, Cursor, Format, read_cursor, wire};
use crate::http::plumbing::state::Rest;
use crate::request::RequestContext;

/// Items on a page whose length the client leaves open.
const PAGE_ITEMS: u32 = 100;

/// Who sends the request.
pub(in crate::http) struct Client(pub(in crate::http) ClientId);

impl<S: Send + Sync> FromRequestParts<S> for Client {
    type Rejection = ApiError;

    async fn from_request_parts(parts: &mut Parts, _state: &S) -> ApiResult<Self> {
        Ok(Self(RequestContext::of(&parts.extensions)?.client()))
    }
}

/// The id of the last event that the client of an event stream has seen: of the header that browsers send by
/// themselves, or of the parameter `last_event_id`, for a page that opens the stream again.
pub(in crate::http) struct LastEventId(pub(in crate::http) Option<String>);

impl<S: Send + Sync> FromRequestParts<S> for LastEventId {
    type Rejection = ApiError;

    async fn from_request_parts(parts: &mut Parts, _state: &S) -> ApiResult<Self> {
        let mut params = Params::of(&parts.uri)?;
        let given = params.take("last_event_id", |text| Ok(text.to_owned()))?;
        params.end()?;
        let header = parts.headers.get("last-event-id").and_then(|value| value.to_str().ok());
        Ok(Self(header.map(str::to_owned).or(given)))
    }
}

/// A camera of the path. What is no slug names no camera.
pub(in crate::http) struct CameraPath(pub(in crate::http) CameraId);

impl<S: Send + Sync> FromRequestParts<S> for CameraPath {
    type Rejection = ApiError;

    async fn from_request_parts(parts: &mut Parts, state: &S) -> ApiResult<Self> {
        Ok(Self(camera_of(&path::<CameraSegment, S>(parts, state).await?.camera)?))
    }
}

/// A site of the path. What is no slug names no site.
pub(in crate::http) struct SitePath(pub(in crate::http) SiteId);

impl<S: Send + Sync> FromRequestParts<S> for SitePath {
    type Rejection = ApiError;

    async fn from_request_parts(parts: &mut Parts, state: &S) -> ApiResult<Self> {
        Ok(Self(site_of(&path::<SiteSegment, S>(parts, state).await?.site)?))
    }
}

/// A place of the path. What is no slug names none.
pub(in crate::http) struct PlacePath(pub(in crate::http) PlaceId);

impl<S: Send + Sync> FromRequestParts<S> for PlacePath {
    type Rejection = ApiError;

    async fn from_request_parts(parts: &mut Parts, state: &S) -> ApiResult<Self> {
        let id = PlaceId::new(&path::<PlaceSegment, S>(parts, state).await?.place);
        let none = || Error::refused(ErrorKind::PlaceNotFound, "that is not the id of a place");
        Ok(Self(id.map_err(|_| none())?))
    }
}

/// A connection of the path. What is no slug names none.
pub(in crate::http) struct ConnectionPath(pub(in crate::http) ConnectionId);

impl<S: Send + Sync> FromRequestParts<S> for ConnectionPath {
    type Rejection = ApiError;

    async fn from_request_parts(parts: &mut Parts, state: &S) -> ApiResult<Self> {
        let id = path::<ConnectionSegment, S>(parts, state).await?.connection;
        let id = ConnectionId::new(&id).map_err(|_| {
            let message = "that is not the id of a connection";
            Error::refused(ErrorKind::ConnectionNotFound, message)
        })?;
        Ok(Self(id))
    }
}

/// A world track of the path. What is no id of a track names none that there is.
pub(in crate::http) struct WorldTrackPath(pub(in crate::http) SiteId, pub(in crate::http) LiveId);

impl<S: Send + Sync> FromRequestParts<S> for WorldTrackPath {
    type Rejection = ApiError;

    async fn from_request_parts(parts: &mut Parts, state: &S) -> ApiResult<Self> {
        let WorldTrackSegments { site, track } = path(parts, state).await?;
        let track = track.parse().map_err(|_: Error| {
            Error::refused(ErrorKind::TrackNotFound, "that is not the id of a world track")
        })?;
        Ok(Self(site_of(&site)?, track))
    }
}

/// A training run of the path.
pub(in crate::http) struct RunPath(pub(in crate::http) CameraId, pub(in crate::http) RunId);

impl<S: Send + Sync> FromRequestParts<S> for RunPath {
    type Rejection = ApiError;

    async fn from_request_parts(parts: &mut Parts, state: &S) -> ApiResult<Self> {
        let RunSegments { camera, run } = path(parts, state).await?;
        Ok(Self(camera_of(&camera)?, run.parse()?))
    }
}

/// A training run of a site of the path.
pub(in crate::http) struct SiteRunPath(pub(in crate::http) SiteId, pub(in crate::http) RunId);

impl<S: Send + Sync> FromRequestParts<S> for SiteRunPath {
    type Rejection = ApiError;

    async fn from_request_parts(parts: &mut Parts, state: &S) -> ApiResult<Self> {
        let SiteRunSegments { site, run } = path(parts, state).await?;
        Ok(Self(site_of(&site)?, run.parse()?))
    }
}

/// A target of the path. What is no name of a target names none that is followed.
pub(in crate::http) struct TargetPath(pub(in crate::http) CameraId, pub(in crate::http) TargetId);

impl<S: Send + Sync> FromRequestParts<S> for TargetPath {
    type Rejection = ApiError;

    async fn from_request_parts(parts: &mut Parts, state: &S) -> ApiResult<Self> {
        let TargetSegments { camera, target } = path(parts, state).await?;
        let target = TargetId::new(&target)
            .map_err(|_| Error::refused(ErrorKind::TrackNotFound, "that is not the id of a target"))?;
        Ok(Self(camera_of(&camera)?, target))
    }
}

/// An evaluation of the path.
pub(in crate::http) struct EvaluationPath(pub(in crate::http) EvaluationId);

impl<S: Send + Sync> FromRequestParts<S> for EvaluationPath {
    type Rejection = ApiError;

    async fn from_request_parts(parts: &mut Parts, state: &S) -> ApiResult<Self> {
        Ok(Self(path::<EvaluationSegment, S>(parts, state).await?.evaluation.parse()?))
    }
}

/// A model version of the path.
pub(in crate::http) struct ModelPath(pub(in crate::http) CameraId, pub(in crate::http) u32);

impl<S: Send + Sync> FromRequestParts<S> for ModelPath {
    type Rejection = ApiError;

    async fn from_request_parts(parts: &mut Parts, state: &S) -> ApiResult<Self> {
        let ModelSegments { camera, model } = path(parts, state).await?;
        let number = model.parse();
        let number =
            number.map_err(|_| Error::refused(ErrorKind::ModelNotFound, "a model's number is 1, 2, ..."))?;
        Ok(Self(camera_of(&camera)?, number))
    }
}

#[derive(Deserialize)]
struct CameraSegment {
    camera: String,
}

#[derive(Deserialize)]
struct ConnectionSegment {
    connection: String,
}

#[derive(Deserialize)]
struct PlaceSegment {
    place: String,
}

#[derive(Deserialize)]
struct SiteSegment {
    site: String,
}

#[derive(Deserialize)]
struct WorldTrackSegments {
    site: String,
    track: String,
}

#[derive(Deserialize)]
struct SiteRunSegments {
    site: String,
    run: String,
}

#[derive(Deserialize)]
struct RunSegments {
    camera: String,
    run: String,
}

#[derive(Deserialize)]
struct TargetSegments {
    camera: String,
    target: String,
}

#[derive(Deserialize)]
struct EvaluationSegment {
    evaluation: String,
}

#[derive(Deserialize)]
struct ModelSegments {
    camera: String,
    model: String,
}

/// The segments of the path.
pub(in crate::http) async fn path<T: DeserializeOwned + Send, S: Send + Sync>(
    parts: &mut Parts,
    state: &S,
) -> Result<T> {
    match Path::<T>::from_request_parts(parts, state).await {
        Ok(Path(segments)) => Ok(segments),
        Err(_) => Err(no_route()), // not UTF-8
    }
}

/// A camera by its id in a path, parameter or body.
pub(in crate::http) fn camera_of(id: &str) -> Result<CameraId> {
    CameraId::new(id).map_err(|_| {
        let shown: String = id.chars().take(80).collect();
        Error::refused(ErrorKind::CameraNotFound, format!("`{shown}` is not the id of a camera"))
    })
}

/// A site by its id in a path, parameter or body.
pub(in crate::http) fn site_of(id: &str) -> Result<SiteId> {
    SiteId::new(id).map_err(|_| {
        let shown: String = id.chars().take(80).collect();
        Error::refused(ErrorKind::SiteNotFound, format!("`{shown}` is not the id of a site"))
    })
}

/// The scope that the parameters `site` and `camera` ask for, of which one is given at most.
pub(in crate::http) fn scope_of(params: &mut Params) -> Result<Option<TrackScope>> {
    let site = params.take("site", site_of)?.map(TrackScope::Site);
    let camera = params.take("camera", camera_of)?.map(TrackScope::Camera);
    match (site, camera) {
        (Some(_), Some(_)) => Err(Error::invalid("site", "give either site or camera")),
        (site, camera) => Ok(site.or(camera)),
    }
}

/// Query parameters, each taken at most once; what nobody takes is refused.
pub(in crate::http) struct Params(Vec<(String, String)>);

impl Params {
    pub(in crate::http) fn of(uri: &Uri) -> Result<Self> {
        match Query::try_from_uri(uri) {
            Ok(Query(pairs)) => Ok(Self(pairs)),
            Err(_) => Err(Error::invalid("query", "is not a query string")),
        }
    }

    pub(in crate::http) fn take<T>(
        &mut self,
        name: &str,
        parse: impl FnOnce(&str) -> Result<T>,
    ) -> Result<Option<T>> {
        let Some(at) = self.0.iter().position(|(given, _)| given == name) else { return Ok(None) };
        let (_, text) = self.0.swap_remove(at);
        if self.0.iter().any(|(given, _)| given == name) {
            return Err(Error::invalid(name, "appears twice"));
        }
        parse(&text).map(Some)
    }

    /// An instant; its refusal names the parameter.
    pub(in crate::http) fn time(&mut self, name: &str) -> Result<Option<Timestamp>> {
        self.take(name, |text| {
            // A plus sign that was not escaped arrives as a space.
            parse_time(&text.replace(' ', "+")).map_err(|error| error.at(name))
        })
    }

    /// `cursor`: where the page begins; from the start without one.
    pub(in crate::http) fn cursor<C: Cursor>(&mut self) -> Result<Option<C>> {
        self.take("cursor", |text| read_cursor("cursor", text))
    }

    /// `limit`: items on a page, from 1 to the server's own limit.
    pub(in crate::http) fn limit(&mut self, most: u32) -> Result<u32> {
        let limit = self.take("limit", |text| {
            let limit = text.parse().ok().filter(|limit| (1..=most).contains(limit));
            limit.ok_or_else(|| Error::invalid("limit", format!("must be from 1 to {most}")))
        })?;
        Ok(limit.unwrap_or(PAGE_ITEMS.min(most)))
    }

    /// `true` or `false`; its refusal names the parameter.
    pub(in crate::http) fn flag(&mut self, name: &str) -> Result<Option<bool>> {
        self.take(name, |text| text.parse().map_err(|_| Error::invalid(name, "must be true or false")))
    }

    /// `durability`: when stored samples are acknowledged.
    pub(in crate::http) fn durability(&mut self) -> Result<Durability> {
        Ok(self.take("durability", str::parse)?.unwrap_or_default())
    }

    /// `on_conflict`: what becomes of samples that are stored already.
    pub(in crate::http) fn on_conflict(&mut self) -> Result<OnConflict> {
        Ok(self.take("on_conflict", str::parse)?.unwrap_or_default())
    }

    /// `columns`, `box_form`, `box_unit` and `timezone`: the layout of a CSV file.
    pub(in crate::http) fn csv_layout(&mut self) -> Result<CsvLayout> {
        let columns = self.take("columns", str::parse)?;
        let box_form = self.take("box_form", str::parse)?;
        let box_unit = self.take("box_unit", str::parse)?;
        let timezone = self.take("timezone", parse_time_zone)?;
        Ok(CsvLayout { timezone, ..CsvLayout::new(columns, box_form, box_unit) })
    }

    /// # Errors
    /// `InvalidArgument` naming a parameter that is none.
    pub(in crate::http) fn check_names(&self, is_known: impl Fn(&str) -> bool) -> Result<()> {
        match self.0.iter().find(|(name, _)| !is_known(name)) {
            None => Ok(()),
            Some((name, _)) => Err(Error::invalid(name.clone(), "is not a parameter of this operation")),
        }
    }

    /// Nothing may be left.
    pub(in crate::http) fn end(self) -> Result<()> {
        self.check_names(|_| false)
    }
}

/// The layout of a body, which only CSV has.
///
/// # Errors
/// `InvalidArgument` if there is one for another format.
pub(in crate::http) fn layout_of(format: Format, layout: &CsvLayout) -> Result<()> {
    if format == Format::Csv || *layout == CsvLayout::default() {
        return Ok(());
    }
    Err(Error::invalid("columns", "columns, box_form, box_unit, timezone and target_id are for CSV alone"))
}

/// A body of JSON, not yet read.
pub(in crate::http) struct JsonBody(Bytes);

impl FromRequest<Rest> for JsonBody {
    type Rejection = ApiError;

    async fn from_request(request: Request, rest: &Rest) -> ApiResult<Self> {
        let (parts, content) = request.into_parts();
        let is_json = media_type(&parts.headers).is_some_and(|essence| {
            let essence = essence.to_ascii_lowercase();
            essence == "application/json" || essence.ends_with("+json")
        });
        let limit = rest.app.limits.body_bytes;
        let content = body::whole(&parts.headers, content, limit).await?;
        if !is_json && !content.is_empty() {
            return Err(not_read(&["application/json"]).into());
        }
        Ok(Self(content))
    }
}

impl JsonBody {
    /// # Errors
    /// `MalformedBody` for what is not JSON; `InvalidArgument` naming the paths of all fields of the
    /// wrong type, missing or unknown.
    pub(in crate::http) fn read<'a, T: Deserialize<'a>>(&'a self) -> Result<T> {
        if self.0.is_empty() {
            return Err(Error::refused(ErrorKind::MalformedBody, "the operation needs a body of JSON"));
        }
        wire::parse_document(&self.0)
    }

    /// Returns the bytes that were sent.
    pub(in crate::http) fn bytes(&self) -> &[u8] {
        &self.0
    }

    /// The same where all of the body may be left out.
    pub(in crate::http) fn read_or_default<'a, T: Deserialize<'a> + Default>(&'a self) -> Result<T> {
        if self.0.is_empty() { Ok(T::default()) } else { self.read() }
    }
}

/// A body of JSON, or of rows in another format, not yet read.
pub(in crate::http) enum FormattedBody {
    Json(JsonBody),
    Rows(Bytes, Format),
}

impl FromRequest<Rest> for FormattedBody {
    type Rejection = ApiError;

    async fn from_request(request: Request, rest: &Rest) -> ApiResult<Self> {
        let format = media_type(request.headers()).and_then(Format::from_media_type);
        match format {
            None | Some(Format::Json) => JsonBody::from_request(request, rest).await.map(Self::Json),
            Some(format) => {
                let (parts, content) = request.into_parts();
                let content = body::whole(&parts.headers, content, rest.app.limits.body_bytes).await?;
                Ok(Self::Rows(content, format))
            }
        }
    }
}

/// The announced type of a body, without its parameters.
pub(in crate::http) fn media_type(headers: &HeaderMap) -> Option<&str> {
    let text = headers.get(CONTENT_TYPE)?.to_str().ok()?;
    text.split(';').next().map(str::trim)
}

/// The refusal of a body of another type than these.
pub(in crate::http) fn not_read(readable: &[&str]) -> Error {
    let readable = readable.join(", ");
    Error::field(
        ErrorKind::UnsupportedMediaType,
        "content-type",
        format!("the header must be one of {readable}"),
    )
}

/// The one of the offers that the client likes best; of equals the first. No word means any.
pub(in crate::http) fn negotiate<T: Copy>(headers: &HeaderMap, offers: &[(&str, T)]) -> Result<T> {
    let accepted = headers.get_all(ACCEPT).iter().filter_map(|value| value.to_str().ok());
    let ranges: Vec<(&str, f32)> =
        accepted.flat_map(|value| value.split(',')).map(range).filter(|(name, _)| !name.is_empty()).collect();
    let mut best = None;
    for &(name, offer) in offers {
        let quality = if ranges.is_empty() { 1.0 } else { quality_of(name, &ranges) };
        if quality > best.map_or(0.0, |(quality, _)| quality) {
            best = Some((quality, offer));
        }
    }
    best.map(|(_, offer)| offer).ok_or_else(|| {
        let names: Vec<&str> = offers.iter().map(|&(name, _)| name).collect();
        let message = format!("the header must accept one of {}", names.join(", "));
        Error::field(ErrorKind::NotAcceptable, "accept", message)
    })
}

fn range(text: &str) -> (&str, f32) {
    let mut parts = text.split(';').map(str::trim);
    let name = parts.next().unwrap_or_default();
    let quality = parts.find_map(|part| part.strip_prefix("q=")?.parse().ok());
    (name, quality.unwrap_or(1.0))
}

/// The quality of the narrowest range that a type falls into.
fn quality_of(name: &str, ranges: &[(&str, f32)]) -> f32 {
    let kind = name.split('/').next().unwrap_or_default();
    let fits = |range: &str| match range.split_once('/') {
        _ if range.eq_ignore_ascii_case(name) => 3,
        Some((of, "*")) if of.eq_ignore_ascii_case(kind) => 2,
        Some(("*", "*")) => 1,
        _ => 0,
    };
    let narrowest = ranges.iter().map(|&(range, quality)| (fits(range), quality)).filter(|(fit, _)| *fit > 0);
    narrowest.max_by_key(|(fit, _)| *fit).map_or(0.0, |(_, quality)| quality)
}

#[cfg(test)]
mod tests {
    use hyper::http::HeaderValue;

    use super::*;

    fn chosen(accept: &str) -> Option<u8> {
        let mut headers = HeaderMap::new();
        headers.insert(ACCEPT, HeaderValue::from_str(accept).expect("a header"));
        negotiate(&headers, &[("application/json", 1), ("text/csv", 2)]).ok()
    }

    #[test]
    fn the_best_liked_offer_is_taken() {
        assert_eq!(chosen("*/*"), Some(1));
        assert_eq!(chosen("text/csv"), Some(2));
        assert_eq!(chosen("text/*;q=0.9, */*;q=0.1"), Some(2));
        assert_eq!(chosen("application/json;q=0.2, text/csv;q=0.3"), Some(2));
        assert_eq!(chosen("*/*, application/json;q=0"), Some(2));
        assert_eq!(chosen("image/png"), None);
        assert!(negotiate(&HeaderMap::new(), &[("application/json", 1)]).is_ok());
    }
}
