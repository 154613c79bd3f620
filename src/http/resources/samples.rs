//! `/v1/cameras/{camera}/samples`: import, list, export, count, delete.

use axum::body::Body;
use axum::extract::Request;
use axum::response::Response;
use bytes::Bytes;
use futures_util::stream;
use hyper::header::{CONTENT_DISPOSITION, CONTENT_TYPE, VARY};
use hyper::http::HeaderValue;
use hyper::{HeaderMap, Uri};
use serde::Serialize;
use utoipa::ToSchema;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use crate::app::{App, ImportOptions, ImportReport};
use crate::domain::{self, CameraId, Error, Result, StoredSample, TargetId, TimeRange};
use crate::exchange::wire;
use crate::exchange::{BoxForm, BoxUnit, CsvLayout, Format, SampleWriter, write_cursor};
use crate::http::plumbing::access::CallerApp;
use crate::http::plumbing::body;
use crate::http::plumbing::extract::{CameraPath, Params, layout_of, media_type, negotiate, not_read};
use crate::http::plumbing::idempotency::idempotent;
use crate::http::plumbing::problem::{ApiResult, Problem};
use crate::http::plumbing::state::Rest;
use crate::http::plumbing::wire::{Durability, OnConflict, json};
use crate::store::{SampleFilter, SampleKey};

/// Samples read from the store at once for an export.
const EXPORT_PAGE: u32 = 1_000;

pub(super) fn routes() -> OpenApiRouter<Rest> {
    OpenApiRouter::new()
        .routes(routes!(import_samples, list_samples, delete_samples))
        .routes(routes!(count_samples))
}

/// The counts of an import's rows.
#[derive(Serialize, ToSchema)]
pub(super) struct Imported {
    /// Number of samples stored now.
    accepted: u64,
    /// Number of accepted samples without a fix.
    accepted_without_fix: u64,
    /// The same camera, target and time were stored before, or appear twice in the import.
    duplicate: u64,
    /// Number of accepted samples that replaced a stored sample (`on_conflict=replace`).
    replaced: u64,
    /// Not stored for a fault of their own.
    rejected: u64,
    /// The first 100 of these.
    rejected_rows: Vec<RejectedRow>,
    /// The guarantee for the accepted rows.
    durability: Durability,
    /// Probable faults of the rows as a whole, each with its remedy, such as latitude and longitude swapped. The rows
    /// are stored all the same.
    warnings: Vec<String>,
}

/// A row that was not taken, and why.
#[derive(Serialize, ToSchema)]
pub(super) struct RejectedRow {
    /// Line of the file from 1 (a CSV file's header is line 1), or element of the JSON array from 1.
    line: u64,
    /// Column, or path of the field; empty if the row as a whole is at fault.
    #[schema(example = "latitude")]
    field: String,
    /// States the fault and the valid values.
    reason: String,
}

impl From<crate::app::RejectedRow> for RejectedRow {
    fn from(row: crate::app::RejectedRow) -> Self {
        Self { line: row.line, field: row.field, reason: row.reason }
    }
}

impl Imported {
    fn new(report: ImportReport, durability: domain::Durability) -> Self {
        let ImportReport { accepted, without_fix, duplicate, replaced, rejected, rejected_rows, warnings } =
            report;
        let rejected_rows = rejected_rows.into_iter().map(RejectedRow::from).collect();
        let durability = durability.into();
        Self {
            accepted,
            accepted_without_fix: without_fix,
            duplicate,
            replaced,
            rejected,
            rejected_rows,
            durability,
            warnings,
        }
    }
}

/// A page of samples, by time and target.
#[derive(Serialize, ToSchema)]
struct SamplePage<'a> {
    /// A page of samples.
    items: Vec<wire::Sample<'a>>,
    /// Asks for the next page; missing on the last.
    #[serde(skip_serializing_if = "Option::is_none")]
    next_cursor: Option<String>,
}

/// The count of samples.
#[derive(Serialize, ToSchema)]
struct SampleCount {
    /// Number of samples.
    count: u64,
    /// Number of these samples without a fix.
    without_fix: u64,
}

/// The count of deleted samples.
#[derive(Serialize, ToSchema)]
struct DeletedSamples {
    /// Number of samples deleted.
    deleted: u64,
}

/// Import samples
///
/// CSV has a header naming the columns `time`, `target_id`, `left`, `top`, `width`, `height` in any order
/// (also with their units: `left_px`), and optional `longitude` and `latitude` (`longitude_deg`), `sigma_m`,
/// `class`, `score`, `truth_longitude`, `truth_latitude`. NDJSON has one sample a line. JSON is an array of
/// samples, or an object with the array `samples`.
///
/// A row whose longitude and latitude are both empty, or in JSON one without `fix`, is a sample without a
/// fix. Training uses its box for the geometry of the camera. One of the two alone is rejected.
///
/// One bad row never loses the others. Samples that are stored already are counted, not stored again, so an
/// interrupted import can be sent again as it is; but a sample with a fix replaces one without.
/// With `on_conflict=replace`, which is for operators, each sample replaces the stored one.
///
/// With `columns`, `box_form` or `box_unit` a CSV file may have any separator, decimal commas, Unix times and
/// columns that nothing asks for.
#[utoipa::path(
    post, path = "/v1/cameras/{camera}/samples", tag = "samples",
    params(
        ("camera" = String, Path, description = "The camera's id"),
        ("durability" = inline(Option<Durability>), Query, description = "When the rows are acknowledged: `synced` (if left out), after they have been flushed to the disk; `relaxed`, after their commit, which a power cut may undo"),
        ("on_conflict" = inline(Option<OnConflict>), Query, description = "The rule for a sample that is stored already: `keep` (if left out) counts the new one as a duplicate, `replace` stores the new one instead"),
        ("columns" = Option<String>, Query, description = "The columns of a CSV file: `auto` finds them by usual names in either case, `FIELD:COLUMN,...` (such as `time:Timestamp,left:x1`) names them; other columns are ignored"),
        ("box_form" = inline(Option<BoxForm>), Query, description = "The meaning of the columns `left`, `top`, `width`, `height` of a CSV file: `left_top`, `centre` (of the box, and its size) or `corners` (the last two are right and bottom); by the columns' names if left out"),
        ("box_unit" = inline(Option<BoxUnit>), Query, description = "`px` (if left out), or `share` for sides that are shares of the image's width and height"),
        ("timezone" = Option<String>, Query, description = "The IANA time zone (such as `Europe/Berlin`) whose local times are the times of a CSV file without an offset; such times are refused if left out"),
        ("target_id" = Option<String>, Query, description = "The target of rows of a CSV file that name none"),
        ("idempotency-key" = Option<String>, Header, description = "1 to 255 visible ASCII characters: an import that is sent again under the same key gets the answer of the first; for a day"),
    ),
    request_body(content(
        (String = "text/csv", example = "time,target_id,left,top,width,height,longitude,latitude\n2020-12-14T14:41:48+08:00,person-1,475,11,28,77,103.98678,30.6280135\n"),
        (String = "application/x-ndjson", example = "{\"time\":\"2020-12-14T14:41:48+08:00\",\"target_id\":\"person-1\",\"bounding_box\":{\"left_px\":475,\"top_px\":11,\"width_px\":28,\"height_px\":77},\"fix\":{\"longitude_deg\":103.98678,\"latitude_deg\":30.628}}\n"),
        (Vec<wire::Sample<'static>> = "application/json"),
    )),
    responses(
        (status = 200, description = "The counts of the rows", body = Imported),
        (status = 507, description = "There is no space for them", body = Problem, content_type = "application/problem+json"),
    )
)]
async fn import_samples(
    CallerApp(app): CallerApp,
    CameraPath(id): CameraPath,
    request: Request,
) -> ApiResult {
    let (parts, content) = request.into_parts();
    let mut params = Params::of(&parts.uri)?;
    let durability = params.durability()?;
    let on_conflict = params.on_conflict()?;
    let layout = CsvLayout { target_id: params.take("target_id", TargetId::new)?, ..params.csv_layout()? };
    params.end()?;
    let format = import_format(&parts.headers)?;
    layout_of(format, &layout)?;
    let idempotent = idempotent(&parts)?;
    app.samples().row_rules(&id).await?; // refuses an unknown camera before its samples are sent
    let mut spooled = body::spooled(&app, &parts, content).await?;
    if let Some(request) = &idempotent {
        spooled = spooled.hash_into(request).await?;
    }
    let options = ImportOptions { durability, on_conflict, idempotent };
    let report = app.samples().import_file(&id, spooled, (format, layout), options).await?;
    Ok(json(&Imported::new(report, durability))?)
}

fn import_format(headers: &HeaderMap) -> Result<Format> {
    let format = media_type(headers).and_then(Format::from_media_type);
    format
        .filter(|format| *format != Format::GeoJson)
        .ok_or_else(|| not_read(&["text/csv", "application/x-ndjson", "application/json"]))
}

/// List or export samples by time and target
///
/// As JSON, page by page. As CSV, NDJSON or GeoJSON (by the header `accept`), all at once.
#[utoipa::path(
    get, path = "/v1/cameras/{camera}/samples", tag = "samples",
    params(
        ("camera" = String, Path, description = "The camera's id"),
        ("from" = Option<String>, Query, format = DateTime, description = "From this instant on (RFC 3339)"),
        ("until" = Option<String>, Query, format = DateTime, description = "Before this instant (RFC 3339)"),
        ("target_id" = Option<String>, Query, description = "Only samples of this target"),
        ("has_fix" = Option<bool>, Query, description = "`true`: only samples with a fix; `false`: only those without"),
        ("limit" = Option<u32>, Query, description = "Items on a page of JSON, 100 if left out"),
        ("cursor" = Option<String>, Query, description = "`next_cursor` of the page of JSON before"),
    ),
    responses(
        (status = 200, description = "A page of samples, or all of them", content(
            (SamplePage<'static> = "application/json"),
            (String = "text/csv"), (String = "application/x-ndjson"), (Object = "application/geo+json"),
        )),
        (status = 406, description = "None of the accepted types can be written", body = Problem, content_type = "application/problem+json"),
    )
)]
async fn list_samples(
    CallerApp(app): CallerApp,
    CameraPath(id): CameraPath,
    uri: Uri,
    headers: HeaderMap,
) -> ApiResult {
    let mut params = Params::of(&uri)?;
    let filter = filter(&mut params)?;
    let formats = [Format::Json, Format::Csv, Format::Ndjson, Format::GeoJson];
    let mut response = match negotiate(&headers, &formats.map(|format| (format.media_type(), format)))? {
        Format::Json => {
            let limit = params.limit(app.limits.page_items)?;
            let after = params.cursor()?;
            params.end()?;
            page(&app, &id, &filter, after, limit).await?
        }
        format @ (Format::Csv | Format::Ndjson | Format::GeoJson) => {
            params.end()?;
            export(app, id, filter, format).await?
        }
    };
    response.headers_mut().insert(VARY, HeaderValue::from_static("accept"));
    Ok(response)
}

async fn page(
    app: &App,
    id: &CameraId,
    filter: &SampleFilter,
    after: Option<SampleKey>,
    limit: u32,
) -> Result<Response> {
    let page = app.samples().list(id, filter, after, limit).await?;
    let next_cursor = page.next.as_ref().map(write_cursor);
    json(&SamplePage { items: page.items.iter().map(wire::Sample::from).collect(), next_cursor })
}

/// How far an export has come; each step writes one page.
struct Export {
    app: App,
    id: CameraId,
    filter: SampleFilter,
    writer: SampleWriter<Vec<u8>>,
    page: Vec<StoredSample>,
    next: Option<SampleKey>,
}

impl Export {
    /// Writes the page at hand and reads the next; gives back the export unless it is done.
    async fn step(mut self) -> Result<(Bytes, Option<Self>)> {
        for sample in &self.page {
            self.writer.write(sample).map_err(Error::fault)?;
        }
        let Some(next) = self.next.take() else {
            let last = self.writer.finish().map_err(Error::fault)?;
            return Ok((last.into(), None));
        };
        let page = self.app.samples().list(&self.id, &self.filter, Some(next), EXPORT_PAGE).await?;
        (self.page, self.next) = (page.items, page.next);
        let written = std::mem::take(self.writer.get_mut());
        Ok((written.into(), Some(self)))
    }
}

/// All samples, page by page as the client reads them.
async fn export(app: App, id: CameraId, filter: SampleFilter, format: Format) -> Result<Response> {
    // The first page is read before the answer begins, so that an unknown camera is still refused.
    let first = app.samples().list(&id, &filter, None, EXPORT_PAGE).await?;
    let ending = match format {
        Format::Csv => "csv",
        Format::Ndjson => "ndjson",
        Format::Json => "json",
        Format::GeoJson => "geojson",
    };
    let name = format!("attachment; filename=\"{id}.{ending}\"");
    let writer = SampleWriter::new(Vec::new(), format);
    let export = Export { app, id, filter, writer, page: first.items, next: first.next };
    let parts = stream::try_unfold(Some(export), |export| async {
        match export {
            None => Ok::<_, Error>(None),
            Some(export) => export.step().await.map(Some).inspect_err(|error| {
                tracing::error!(%error, "an export was interrupted");
            }),
        }
    });
    let mut response = Response::new(Body::from_stream(parts));
    let headers = response.headers_mut();
    headers.insert(CONTENT_TYPE, HeaderValue::from_static(format.media_type()));
    headers.insert(CONTENT_DISPOSITION, HeaderValue::from_str(&name).map_err(Error::fault)?);
    Ok(response)
}

/// Count samples
#[utoipa::path(
    get, path = "/v1/cameras/{camera}/samples/count", tag = "samples",
    params(
        ("camera" = String, Path, description = "The camera's id"),
        ("from" = Option<String>, Query, format = DateTime, description = "From this instant on (RFC 3339)"),
        ("until" = Option<String>, Query, format = DateTime, description = "Before this instant (RFC 3339)"),
        ("target_id" = Option<String>, Query, description = "Only samples of this target"),
        ("has_fix" = Option<bool>, Query, description = "`true`: only samples with a fix; `false`: only those without"),
    ),
    responses((status = 200, description = "Their number", body = SampleCount))
)]
async fn count_samples(CallerApp(app): CallerApp, CameraPath(id): CameraPath, uri: Uri) -> ApiResult {
    let filter = only_filter(&uri)?;
    let domain::SampleCount { all, without_fix } = app.samples().count(&id, &filter).await?;
    Ok(json(&SampleCount { count: all, without_fix })?)
}

/// Delete samples
///
/// At least one of the parameters must be given, so that not all are deleted by an oversight.
#[utoipa::path(
    delete, path = "/v1/cameras/{camera}/samples", tag = "samples",
    params(
        ("camera" = String, Path, description = "The camera's id"),
        ("from" = Option<String>, Query, format = DateTime, description = "From this instant on (RFC 3339)"),
        ("until" = Option<String>, Query, format = DateTime, description = "Before this instant (RFC 3339)"),
        ("target_id" = Option<String>, Query, description = "Only samples of this target"),
        ("has_fix" = Option<bool>, Query, description = "`true`: only samples with a fix; `false`: only those without"),
    ),
    responses((status = 200, description = "How many were deleted", body = DeletedSamples))
)]
async fn delete_samples(CallerApp(app): CallerApp, CameraPath(id): CameraPath, uri: Uri) -> ApiResult {
    let filter = only_filter(&uri)?;
    if filter == SampleFilter::default() {
        return Err(Error::invalid(
            "from",
            "give from, until, target_id or has_fix: which samples to delete",
        )
        .into());
    }
    Ok(json(&DeletedSamples { deleted: app.samples().delete(&id, &filter).await? })?)
}

/// The filter of a query that has no other parameters.
fn only_filter(uri: &Uri) -> Result<SampleFilter> {
    let mut params = Params::of(uri)?;
    let filter = filter(&mut params)?;
    params.end()?;
    Ok(filter)
}

fn filter(params: &mut Params) -> Result<SampleFilter> {
    let range = TimeRange::new(params.time("from")?, params.time("until")?)?;
    let target_id = params.take("target_id", TargetId::new)?;
    let has_fix = params.flag("has_fix")?;
    Ok(SampleFilter { target_id, has_fix, ..SampleFilter::within(range) })
}
