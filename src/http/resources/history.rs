//! `/v1/history`: positions of finished tracks.

use axum::body::Body;
use axum::response::Response;
use bytes::Bytes;
use futures_util::stream;
use hyper::Uri;
use hyper::header::{CONTENT_DISPOSITION, CONTENT_TYPE};
use hyper::http::HeaderValue;
use serde::{Deserialize, Serialize};
use utoipa::{IntoParams, ToSchema};
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use crate::app::{App, HistoryRows, HistorySelection};
use crate::archive::{BoundingArea, FileWriter};
use crate::domain::{
    self, ArchivedPosition, Error, HistoryKey, PlaceId, ReceiverId, Result, TargetClass, TargetId, TrackScope,
};
use crate::exchange::{self, Format, HistoryWriter, MotFrames, wire, write_cursor};
use crate::geo::Position;
use crate::http::plumbing::access::CallerApp;
use crate::http::plumbing::extract::{Params, scope_of};
use crate::http::plumbing::problem::{ApiResult, Problem};
use crate::http::plumbing::state::Rest;
use crate::http::plumbing::wire::json;

pub(super) fn routes() -> OpenApiRouter<Rest> {
    OpenApiRouter::new().routes(routes!(list_history, delete_history))
}

/// How the finished tracks of a camera or a site are kept.
#[derive(Clone, Copy, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub(super) struct HistorySettings {
    /// Days that positions are kept.
    #[serde(default = "default_days")]
    #[schema(minimum = 1, maximum = 3_650, default = 30)]
    keep_days: u32,
    /// Size of the files; beyond, the oldest are deleted.
    #[serde(default = "default_bytes")]
    #[schema(minimum = 1_000_000, maximum = 1_000_000_000_000_000_i64, default = 1_073_741_824)]
    max_bytes: u64,
    /// Mesh of the grid that positions are moved to before they are written, m; 0 keeps them as they are.
    #[serde(default)]
    #[schema(minimum = 0.0, maximum = 10_000.0, default = 0.0)]
    coarsen_m: f64,
}

const fn default_days() -> u32 {
    domain::HistorySettings::KEEP_DAYS
}

const fn default_bytes() -> u64 {
    domain::HistorySettings::MAX_BYTES
}

impl HistorySettings {
    pub(super) fn to_domain(self) -> Result<domain::HistorySettings> {
        let settings = domain::HistorySettings::new(self.keep_days, self.max_bytes, self.coarsen_m);
        settings.map_err(|error| error.under("history"))
    }
}

impl From<domain::HistorySettings> for HistorySettings {
    fn from(settings: domain::HistorySettings) -> Self {
        Self {
            keep_days: settings.keep_days(),
            max_bytes: settings.max_bytes(),
            coarsen_m: settings.coarsen_m(),
        }
    }
}

/// Format of the positions.
#[derive(Clone, Copy, ToSchema)]
#[schema(rename_all = "lowercase")]
enum HistoryFormat {
    /// A page of JSON.
    Json,
    /// Lines of JSON.
    Ndjson,
    /// Comma-separated values.
    Csv,
    /// Features with a point each (RFC 7946).
    GeoJson,
    /// Columns for geopandas, DuckDB and GIS programs (GeoParquet 1.1).
    GeoParquet,
    /// A moving feature per track, as OGC Moving Features JSON (19-045r3).
    #[schema(rename = "moving_features")]
    MovingFeatures,
    /// Lines `frame,id,-1,-1,-1,-1,confidence,x,y,z`, as the MOTChallenge has them with world coordinates.
    Mot,
}

impl HistoryFormat {
    const ALL: [(&'static str, Self); 7] = [
        ("json", Self::Json),
        ("ndjson", Self::Ndjson),
        ("csv", Self::Csv),
        ("geojson", Self::GeoJson),
        ("geoparquet", Self::GeoParquet),
        ("moving_features", Self::MovingFeatures),
        ("mot", Self::Mot),
    ];

    fn parse(text: &str) -> Result<Self> {
        let named = Self::ALL.iter().find(|(name, _)| *name == text);
        let names = Self::ALL.map(|(name, _)| name).join(", ");
        named
            .map(|(_, format)| *format)
            .ok_or_else(|| Error::invalid("format", format!("must be one of {names}")))
    }
}

/// The description of the parameters that [`selection`] reads.
#[derive(IntoParams)]
#[into_params(parameter_in = Query)]
#[expect(dead_code, reason = "the description alone; `Params` reads and refuses as all requests do")]
pub(super) struct SelectionParams {
    /// The camera whose tracks are meant; either this or `site`
    #[param(required = false)]
    camera: String,
    /// The site whose world tracks are meant
    #[param(required = false)]
    site: String,
    /// From this instant on (RFC 3339)
    #[param(required = false, format = DateTime)]
    from: String,
    /// Before this instant (RFC 3339)
    #[param(required = false, format = DateTime)]
    until: String,
    /// Only within `west,south,east,north`, degrees; west is greater than east across the antimeridian
    #[param(required = false)]
    bbox: String,
    /// Only in this place, an area or a disc of that camera or site; not beside `bbox`
    #[param(required = false)]
    place: String,
    /// Only targets of this class
    #[param(required = false)]
    class: String,
    /// Only this target
    #[param(required = false)]
    target_id: String,
    /// Only the target that carries this receiver
    #[param(required = false)]
    receiver_id: String,
    /// Only this track
    #[param(required = false)]
    track_id: String,
}

/// The scope and the selection of a request.
pub(super) fn selection(params: &mut Params) -> Result<(TrackScope, HistorySelection)> {
    let scope = scope_of(params)?.ok_or_else(|| Error::invalid("site", "give either site or camera"))?;
    let selection = HistorySelection {
        from: params.time("from")?,
        until: params.time("until")?,
        area: params.take("bbox", area)?,
        place: params.take("place", |text| PlaceId::new(text).map_err(|error| error.at("place")))?,
        class: params.take("class", |text| TargetClass::new(text).map_err(|error| error.at("class")))?,
        target: params
            .take("target_id", |text| TargetId::new(text).map_err(|error| error.at("target_id")))?,
        receiver: params
            .take("receiver_id", |text| ReceiverId::new(text).map_err(|error| error.at("receiver_id")))?,
        track: params.take("track_id", |text| Ok(text.to_owned()))?,
    };
    Ok((scope, selection))
}

fn area(text: &str) -> Result<BoundingArea> {
    let numbers: Vec<f64> = text.split(',').filter_map(|number| number.trim().parse().ok()).collect();
    let corners = <[f64; 4]>::try_from(numbers);
    BoundingArea::new(
        corners.map_err(|_| Error::invalid("bbox", "must be west,south,east,north in degrees"))?,
    )
}

/// A page of positions of finished tracks, by time and track.
#[derive(Serialize, ToSchema)]
struct HistoryPage<'a> {
    /// A page of positions.
    items: Vec<wire::HistoryPosition<'a>>,
    /// Asks for the next page; missing on the last.
    #[serde(skip_serializing_if = "Option::is_none")]
    next_cursor: Option<String>,
}

/// List positions of finished tracks
///
/// Of a camera or a site whose profile has a `history`, by time and track. As `json`, page by page; in all other formats
/// (`format`) as a file, all at once.
#[utoipa::path(
    get, path = "/v1/history", tag = "history",
    params(
        SelectionParams,
        ("format" = inline(Option<HistoryFormat>), Query, description = "`json` if left out"),
        ("origin" = Option<String>, Query, description = "`longitude,latitude` in degrees, from which `mot` counts x to the east and y to the north, m"),
        ("frame_hz" = Option<f64>, Query, description = "Frames per second of `mot`, of which frame 1 is at `from`"),
        ("limit" = Option<u32>, Query, description = "Items on a page of JSON, 100 if left out"),
        ("cursor" = Option<String>, Query, description = "`next_cursor` of the page of JSON before"),
    ),
    responses(
        (status = 200, description = "A page of positions, or all of them", content(
            (HistoryPage<'static> = "application/json"), (String = "application/x-ndjson"), (String = "text/csv"),
            (Object = "application/geo+json"), (String = "text/plain"), (Vec<u8> = "application/vnd.apache.parquet"),
        )),
        (status = 404, description = "No such camera or site", body = Problem, content_type = "application/problem+json"),
    )
)]
async fn list_history(CallerApp(app): CallerApp, uri: Uri) -> ApiResult {
    use exchange::HistoryFormat::{Mot, MovingFeatures, Rows};
    let mut params = Params::of(&uri)?;
    let (scope, selection) = selection(&mut params)?;
    let format = params.take("format", HistoryFormat::parse)?.unwrap_or(HistoryFormat::Json);
    let file = match format {
        HistoryFormat::Json => {
            let limit = params.limit(app.limits.page_items)?;
            let after = params.cursor()?;
            params.end()?;
            return Ok(page(&app, scope, selection, after, limit).await?);
        }
        HistoryFormat::Ndjson => HistoryFile::text(&scope, Rows(Format::Ndjson)),
        HistoryFormat::Csv => HistoryFile::text(&scope, Rows(Format::Csv)),
        HistoryFormat::GeoJson => HistoryFile::text(&scope, Rows(Format::GeoJson)),
        HistoryFormat::MovingFeatures => HistoryFile::text(&scope, MovingFeatures),
        HistoryFormat::Mot => HistoryFile::text(&scope, Mot(mot_frames(&mut params, &selection)?)),
        HistoryFormat::GeoParquet => HistoryFile::Columns(Box::new(FileWriter::new(scope.clone())?)),
    };
    params.end()?;
    let rows = app.history().rows(scope, selection).await?;
    Ok(download(rows, file)?)
}

/// What the frames and coordinates of `mot` are counted from: all of it is stated, since its files cannot state it.
fn mot_frames(params: &mut Params, selection: &HistorySelection) -> Result<MotFrames> {
    let needed = |name: &str| Error::invalid(name, "is needed for mot");
    let origin = params.take("origin", origin)?.ok_or_else(|| needed("origin"))?;
    let frame_hz = params
        .take("frame_hz", |text| text.parse().map_err(|_| Error::invalid("frame_hz", "must be a number")))?;
    let start = selection.from.ok_or_else(|| needed("from"))?;
    MotFrames::new(origin, start, frame_hz.ok_or_else(|| needed("frame_hz"))?)
}

fn origin(text: &str) -> Result<Position> {
    let refused = || Error::invalid("origin", "must be longitude,latitude in degrees");
    let (longitude, latitude) = text.split_once(',').ok_or_else(refused)?;
    let degrees = |text: &str| text.trim().parse::<f64>().map_err(|_| refused());
    Position::new(degrees(longitude)?, degrees(latitude)?).map_err(|_| refused())
}

async fn page(
    app: &App,
    scope: TrackScope,
    selection: HistorySelection,
    after: Option<HistoryKey>,
    limit: u32,
) -> Result<Response> {
    let page = app.history().page(scope.clone(), selection, after, limit).await?;
    json(&HistoryPage {
        items: page.items.iter().map(|row| wire::HistoryPosition::of(&scope, row)).collect(),
        next_cursor: page.next.as_ref().map(write_cursor),
    })
}

/// A file that is sent while it is written.
enum HistoryFile {
    Text(Box<TextFile>),
    Columns(Box<FileWriter>),
}

struct TextFile {
    format: exchange::HistoryFormat,
    writer: HistoryWriter<Vec<u8>>,
}

impl HistoryFile {
    fn text(scope: &TrackScope, format: exchange::HistoryFormat) -> Self {
        let writer = HistoryWriter::new(Vec::new(), scope.clone(), format.clone());
        Self::Text(Box::new(TextFile { format, writer }))
    }

    fn media_type(&self) -> &'static str {
        match self {
            Self::Text(file) => file.format.media_type(),
            Self::Columns(_) => "application/vnd.apache.parquet",
        }
    }

    fn ending(&self) -> &'static str {
        match self {
            Self::Text(file) => file.format.ending(),
            Self::Columns(_) => "parquet",
        }
    }

    /// Writes rows, and returns the bytes that are complete.
    fn write(&mut self, rows: Vec<ArchivedPosition>) -> Result<Vec<u8>> {
        match self {
            Self::Text(file) => {
                rows.iter().try_for_each(|row| file.writer.write(row)).map_err(Error::fault)?;
                Ok(std::mem::take(file.writer.get_mut()))
            }
            Self::Columns(writer) => {
                let mut written = Vec::new();
                for row in rows {
                    written.extend(writer.push(row)?);
                }
                Ok(written)
            }
        }
    }

    fn finish(self) -> Result<Vec<u8>> {
        match self {
            Self::Text(file) => file.writer.finish().map_err(Error::fault),
            Self::Columns(writer) => writer.finish(),
        }
    }
}

fn download(rows: HistoryRows, file: HistoryFile) -> Result<Response> {
    let (media_type, name) =
        (file.media_type(), format!("attachment; filename=\"history.{}\"", file.ending()));
    let parts = stream::try_unfold(Some((rows, file)), |state| async {
        let Some((mut rows, mut file)) = state else { return Ok::<_, Error>(None) };
        let next = rows.next().await.inspect_err(|error| {
            tracing::error!(%error, "an export of the history was interrupted");
        })?;
        match next {
            Some(batch) => {
                let written = file.write(batch)?;
                Ok(Some((Bytes::from(written), Some((rows, file)))))
            }
            None => Ok(Some((file.finish()?.into(), None))),
        }
    });
    let mut response = Response::new(Body::from_stream(parts));
    let headers = response.headers_mut();
    headers.insert(CONTENT_TYPE, HeaderValue::from_static(media_type));
    headers.insert(CONTENT_DISPOSITION, HeaderValue::from_str(&name).map_err(Error::fault)?);
    Ok(response)
}

/// The outcome of a deletion.
#[derive(Serialize, ToSchema)]
struct DeletedHistory {
    /// Positions that were deleted.
    deleted: u64,
}

/// Delete positions of finished tracks
///
/// Those of the selection, or all of the camera or site; their files are written again without them. Tracks that have not
/// finished are kept when they do.
#[utoipa::path(
    delete, path = "/v1/history", tag = "history",
    params(SelectionParams),
    responses(
        (status = 200, description = "They are deleted", body = DeletedHistory),
        (status = 404, description = "No such camera or site", body = Problem, content_type = "application/problem+json"),
    )
)]
async fn delete_history(CallerApp(app): CallerApp, uri: Uri) -> ApiResult {
    let mut params = Params::of(&uri)?;
    let (scope, selection) = selection(&mut params)?;
    params.end()?;
    Ok(json(&DeletedHistory { deleted: app.history().delete(scope, selection).await? })?)
}
