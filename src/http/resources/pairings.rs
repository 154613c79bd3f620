//! `/v1/cameras/{camera}/samples/pairings`: an import of detections and fixes that come apart.

use axum::extract::Request;
use serde::Serialize;
use utoipa::ToSchema;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use super::receivers::Receiver;
use crate::app::{self, App, ImportOptions, MatchReport, PairedImport, PairedReport, PairingCounts, Part};
use crate::domain::{self, Error, ReceiverId, Result, TargetId};
use crate::exchange::{BoxForm, BoxUnit, FixFormat, Format, RowError};
use crate::fusion::association::MatchSettings;
use crate::fusion::clock_offset::OffsetEstimate;
use crate::fusion::pairing::{PairingRule, PairingSettings};
use crate::http::plumbing::access::CallerApp;
use crate::http::plumbing::extract::{CameraPath, Params};
use crate::http::plumbing::idempotency::idempotent;
use crate::http::plumbing::parts::parts;
use crate::http::plumbing::problem::{ApiResult, Problem};
use crate::http::plumbing::state::Rest;
use crate::http::plumbing::wire::{Durability, OnConflict, json};

pub(super) fn routes() -> OpenApiRouter<Rest> {
    OpenApiRouter::new().routes(routes!(pair_samples))
}

/// How a box finds its fix.
#[derive(ToSchema)]
#[schema(rename_all = "snake_case")]
#[expect(dead_code, reason = "the values of a parameter, for the description alone")]
enum PairingMethod {
    /// Box and fix that are each other's nearest within the window.
    Nearest,
    /// Every box between two fixes gets a fix of its own time.
    Interpolate,
}

/// Two files to be paired by time.
#[derive(ToSchema)]
#[expect(dead_code, reason = "describes the body, which is read part by part")]
struct PairingParts {
    /// CSV with the columns `time`, `target_id`, `left`, `top`, `width`, `height`, or NDJSON or JSON
    /// of the same; recognised by the part's content type or its file's name.
    #[schema(value_type = String, format = Binary)]
    detections: Vec<u8>,
    /// CSV (`time`, `longitude`, `latitude`, optional `receiver_id` and `sigma_m`), NMEA 0183, GPX, FIT, a solution of
    /// RTKLIB, a log of GnssLogger or gpsd's reports, one a line; recognised by the part's content type or its file's name.
    #[schema(value_type = String, format = Binary)]
    fixes: Vec<u8>,
}

/// The result of an import in two parts.
#[derive(Serialize, ToSchema)]
struct PairedSamples {
    /// Samples stored now.
    accepted: u64,
    /// Number of accepted samples without a fix.
    accepted_without_fix: u64,
    /// Samples of which the same camera, target and time were stored before.
    duplicate: u64,
    /// Number of accepted samples that replaced a stored sample (`on_conflict=replace`).
    replaced: u64,
    /// Rows of both parts that are none.
    rejected: u64,
    /// The first 100 of these in each part.
    rejected_rows: Vec<RejectedPartRow>,
    /// The guarantee for the accepted samples.
    durability: Durability,
    /// Probable faults of the samples as a whole, each with its remedy; they are stored all the same.
    warnings: Vec<String>,
    /// The counts of the other rows.
    pairing: Pairing,
    /// Whose the fixes are that name no receiver, if there are any and somebody claims them.
    #[serde(skip_serializing_if = "Option::is_none")]
    unnamed_fixes_of: Option<Receiver>,
    /// The report of the match, if one was requested.
    #[serde(skip_serializing_if = "Option::is_none")]
    matching: Option<Matching>,
    /// Clock offsets of the receivers as the files show them, if that was asked for.
    #[serde(skip_serializing_if = "Option::is_none")]
    clock_offsets: Option<Vec<ClockOffsetEstimate>>,
}

/// Boxes matched with receivers. The samples of a match have the receiver's id as target id.
#[derive(Serialize, ToSchema)]
struct Matching {
    /// Tracklets: segments of boxes of one tracker's id.
    tracklets: usize,
    /// Receivers with fixes.
    receivers: usize,
    /// Tracklets cut where their id seems to have moved to another target.
    cuts: usize,
    /// Bound on the posterior probability.
    min_probability: f64,
    /// Boxes matched with at least that probability.
    matched_detections: u64,
    /// Boxes whose most probable receiver is less probable, but at least 0.5: left out.
    unsure_detections: u64,
    /// Pairs of tracklet and receiver with at least that probability.
    pairs: Vec<MatchedPair>,
    /// Groups of tracklets: one of them shows the carrier with at least that probability, none of them alone does. Samples are made
    /// of the means of their boxes, weighed by their probabilities.
    groups: Vec<MatchedGroup>,
}

/// A tracklet, or a part of it, and the receiver that its target carries.
#[derive(Serialize, ToSchema)]
struct MatchedPair {
    /// The receiver; the target id of the samples.
    receiver_id: String,
    /// Id that the tracker gave the boxes.
    tracker_id: String,
    /// Time of the first box.
    #[schema(value_type = String, format = DateTime)]
    from: jiff::Timestamp,
    /// Time of the last box.
    #[schema(value_type = String, format = DateTime)]
    to: jiff::Timestamp,
    /// Number of boxes.
    detections: u64,
    /// Posterior probability of the match, 0 to 1.
    probability: f64,
}

/// Targets that walk together while all are seen: one of them carries the receiver.
#[derive(Serialize, ToSchema)]
struct MatchedGroup {
    /// The receiver.
    receiver_id: String,
    /// First instant at which all members are seen.
    #[schema(value_type = String, format = DateTime)]
    from: jiff::Timestamp,
    /// Last instant at which all members are seen.
    #[schema(value_type = String, format = DateTime)]
    to: jiff::Timestamp,
    /// Number of mean boxes.
    detections: u64,
    /// Posterior probability that one of the members carries it, 0 to 1.
    probability: f64,
    /// The members, the most probable first.
    members: Vec<GroupMember>,
}

/// A tracklet of a group.
#[derive(Serialize, ToSchema)]
struct GroupMember {
    /// Id that the tracker gave the boxes.
    tracker_id: String,
    /// Posterior probability that this one carries the receiver, 0 to 1.
    probability: f64,
}

/// A row that was not taken, and why.
#[derive(Serialize, ToSchema)]
struct RejectedPartRow {
    /// `detections` or `fixes`.
    #[schema(value_type = String, example = "fixes")]
    part: &'static str,
    /// Line of the part from 1 (a CSV file's header is line 1), or element of the JSON array from 1.
    line: u64,
    /// Column, or path of the field; empty if the row as a whole is at fault.
    field: String,
    /// States the fault and the valid values.
    reason: String,
}

/// Counts of the rows that could be read.
#[derive(Serialize, ToSchema)]
struct Pairing {
    /// Number of boxes read.
    detections: u64,
    /// Number of fixes read.
    fixes: u64,
    /// Number of samples made.
    paired: u64,
    /// Boxes that became no sample.
    unpaired_detections: UnpairedDetections,
    /// Fixes that no sample holds.
    unused_fixes: UnusedFixes,
}

/// Boxes that became no sample, by reason.
#[derive(Serialize, ToSchema)]
struct UnpairedDetections {
    /// No fix belongs to the target.
    no_fix_of_target: u64,
    /// The target has fixes, but none near in time.
    no_fix_near: u64,
    /// The nearest fix is nearer to another box.
    fix_nearer_to_another: u64,
    /// A box of that target and instant was there already.
    duplicate: u64,
}

/// Fixes that no sample holds, by reason.
#[derive(Serialize, ToSchema)]
struct UnusedFixes {
    /// They name no receiver, and nobody claims them.
    no_receiver: u64,
    /// No box shows the target.
    no_box_of_target: u64,
    /// No box was there to take them.
    no_box_near: u64,
    /// A fix of that target and instant was there already.
    duplicate: u64,
}

/// The clock offset of one receiver, estimated from the files.
#[derive(Serialize, ToSchema)]
struct ClockOffsetEstimate {
    /// The receiver's id.
    receiver_id: String,
    /// The target that carries it.
    target_id: String,
    /// Seconds to be added to the receiver's time to get the camera's; missing, as all below, where
    /// the files do not determine it.
    #[serde(skip_serializing_if = "Option::is_none")]
    clock_offset_s: Option<f64>,
    /// Standard deviation of the estimate.
    #[serde(skip_serializing_if = "Option::is_none")]
    sigma_s: Option<f64>,
    /// Share of the movement that the boxes explain at that offset.
    #[serde(skip_serializing_if = "Option::is_none")]
    explained: Option<f64>,
    /// The same without an offset.
    #[serde(skip_serializing_if = "Option::is_none")]
    explained_at_zero: Option<f64>,
}

/// Import detections and fixes that come apart
///
/// Both parts are paired by time: with the method `nearest` box and fix make a sample when each is
/// the other's nearest within the window; with `interpolate` every box between two fixes gets a fix
/// of its own time. Whose a receiver is and how far its clock is off is set in the camera's
/// `receivers`. Fixes that name no receiver are those of `receiver_id`; else of the camera's only
/// receiver; else of the only target among the detections. The device that a report of gpsd names is
/// a receiver if it is among the camera's, and no name else.
///
/// With `keep_unpaired` the boxes that find no fix, other than duplicates, are stored as samples without a
/// fix, whose boxes training uses for the geometry of the camera.
///
/// With `match` the boxes need only a tracker's ids: whose boxes show whose receivers is found out by the
/// camera's active model, without one together with the camera, whose profile then needs the image size.
/// Samples of sure matches have the receiver's id as target id; others are left out and counted. If nobody
/// can tell, the answer is a problem of type `not-identifiable` with what to record, and nothing is stored.
///
/// One bad row never loses the others. Sending the same again does no harm.
#[utoipa::path(
    post, path = "/v1/cameras/{camera}/samples/pairings", tag = "samples",
    params(
        ("camera" = String, Path, description = "The camera's id"),
        ("method" = inline(Option<PairingMethod>), Query, description = "`nearest` (if left out) or `interpolate`"),
        ("window_s" = Option<f64>, Query, description = "Box and fix are at most this far apart (nearest), 0.5 if left out"),
        ("longest_gap_s" = Option<f64>, Query, description = "Fixes are joined over at most this long a gap (interpolate), 2.5 if left out"),
        ("target_id" = Option<String>, Query, description = "The target of boxes that name none"),
        ("receiver_id" = Option<String>, Query, description = "The receiver of fixes that name none"),
        ("keep_unpaired" = Option<bool>, Query, description = "Store the boxes that find no fix as samples without one"),
        ("match" = Option<bool>, Query, description = "Find out whose boxes show whose receivers"),
        ("min_probability" = Option<f64>, Query, description = "With `match`, leave out samples whose match is less probable, 0.5 to 1; if left out 0.9, for a camera without a model 0.8"),
        ("clock_window_s" = Option<f64>, Query, description = "With `match`, the receivers' clocks are off by at most this, 0 if left out; 0 to 30"),
        ("durability" = inline(Option<Durability>), Query, description = "When the samples are acknowledged: `synced` (if left out), after they have been flushed to the disk; `relaxed`, after their commit, which a power cut may undo"),
        ("on_conflict" = inline(Option<OnConflict>), Query, description = "The rule for a sample that is stored already: `keep` (if left out) counts the new one as a duplicate, `replace` stores the new one instead"),
        ("columns" = Option<String>, Query, description = "The columns of CSV parts: `auto` finds them by usual names in either case, `FIELD:COLUMN,...` (such as `time:Timestamp,left:x1`) names them; other columns are ignored"),
        ("box_form" = inline(Option<BoxForm>), Query, description = "The meaning of the columns `left`, `top`, `width`, `height` of a CSV part: `left_top`, `centre` (of the box, and its size) or `corners` (the last two are right and bottom); by the columns' names if left out"),
        ("box_unit" = inline(Option<BoxUnit>), Query, description = "`px` (if left out), or `share` for sides that are shares of the image's width and height"),
        ("timezone" = Option<String>, Query, description = "The IANA time zone (such as `Europe/Berlin`) whose local times are the times of a CSV file without an offset; such times are refused if left out"),
        ("idempotency-key" = Option<String>, Header, description = "1 to 255 visible ASCII characters: an import that is sent again under the same key gets the answer of the first; for a day"),
        ("estimate_offset" = Option<bool>, Query, description = "Tell the receivers' clock offsets as the files show them; they are not applied"),
    ),
    request_body(content = PairingParts, content_type = "multipart/form-data"),
    responses(
        (status = 200, description = "The counts of the rows", body = PairedSamples),
        (status = 422, description = "A parameter cannot be used, or, with `match`, nobody can tell whose fixes belong to whose boxes", body = Problem, content_type = "application/problem+json"),
        (status = 507, description = "There is no space for them", body = Problem, content_type = "application/problem+json"),
    )
)]
async fn pair_samples(CallerApp(app): CallerApp, CameraPath(id): CameraPath, request: Request) -> ApiResult {
    let (head, content) = request.into_parts();
    let mut params = Params::of(&head.uri)?;
    let settings = settings(&mut params)?;
    let target_id = params.take("target_id", TargetId::new)?;
    let receiver_id = params.take("receiver_id", ReceiverId::new)?;
    let estimates_offsets = params.flag("estimate_offset")?.unwrap_or(false);
    let keeps_unpaired = params.flag("keep_unpaired")?.unwrap_or(false);
    let durability = params.durability()?;
    let on_conflict = params.on_conflict()?;
    let layout = params.csv_layout()?;
    let matching = matching(&mut params, &app)?;
    params.end()?;
    let idempotent = idempotent(&head)?;
    app.samples().row_rules(&id).await?; // refuses an unknown camera before its samples are sent
    let names = [Part::Detections, Part::Fixes].map(Part::as_str);
    let [mut detections, mut fixes] = parts(&app, &head, content, names).await?;
    if let Some(request) = &idempotent {
        detections.content = detections.content.hash_into(request).await?;
        fixes.content = fixes.content.hash_into(request).await?;
    }
    let readable = |format: &Format| *format != Format::GeoJson;
    let detections_format = detections.format(
        names[0],
        |essence| Format::from_media_type(essence).filter(readable),
        |path| Format::from_path(path).filter(readable),
        "CSV, NDJSON or JSON",
    )?;
    let fixes_format = fixes.format(
        names[1],
        FixFormat::from_media_type,
        FixFormat::from_path,
        "CSV, NMEA, GPX, FIT, gpsd's reports, solutions of RTKLIB or a log of GnssLogger",
    )?;
    let import = PairedImport {
        detections: detections.content,
        detections_format,
        fixes: fixes.content,
        fixes_format,
        settings,
        target_id,
        receiver_id,
        keeps_unpaired,
        options: ImportOptions { durability, on_conflict, idempotent },
        layout,
        estimates_offsets,
        matching,
    };
    let report = app.samples().import_paired(&id, import).await?;
    Ok(json(&paired_samples(report, durability, estimates_offsets))?)
}

/// How boxes are matched with receivers, if that is asked for.
fn matching(params: &mut Params, app: &App) -> Result<Option<MatchSettings>> {
    let mut number = |name: &str| {
        params.take(name, |text| text.parse::<f64>().map_err(|_| Error::invalid(name, "must be a number")))
    };
    let (min_probability, clock_window_s) = (number("min_probability")?, number("clock_window_s")?);
    if !params.flag("match")?.unwrap_or(false) {
        return match (min_probability, clock_window_s) {
            (None, None) => Ok(None),
            (Some(_), _) => Err(Error::invalid("min_probability", "needs match=true")),
            (None, Some(_)) => Err(Error::invalid("clock_window_s", "needs match=true")),
        };
    }
    let default = MatchSettings::default();
    let settings = MatchSettings::new(
        min_probability,
        clock_window_s.unwrap_or(default.clock_window_s),
        (&app.limits).into(),
    )?;
    Ok(Some(settings))
}

fn settings(params: &mut Params) -> Result<PairingSettings> {
    let method = params.take("method", str::parse::<PairingRule>)?.unwrap_or_default();
    let mut seconds = |name: &str| {
        params
            .take(name, |text| text.parse().map_err(|_| Error::invalid(name, "must be a number of seconds")))
    };
    let (window_s, longest_gap_s) = (seconds("window_s")?, seconds("longest_gap_s")?);
    PairingSettings::new(method, window_s, longest_gap_s)
}

fn paired_samples(report: PairedReport, durability: domain::Durability, with_offsets: bool) -> PairedSamples {
    let PairedReport { samples, counts, rejected, unnamed_fixes_of, clock_offsets, matching } = report;
    let estimates = clock_offsets.iter().map(|(receiver, found)| offset(receiver, found.as_ref()));
    PairedSamples {
        accepted: samples.accepted,
        accepted_without_fix: samples.without_fix,
        duplicate: samples.duplicate,
        replaced: samples.replaced,
        rejected: rejected.count,
        rejected_rows: rejected.rows.into_iter().map(|(part, row)| rejected_row(part, row)).collect(),
        durability: durability.into(),
        warnings: samples.warnings,
        pairing: counts.into(),
        unnamed_fixes_of: unnamed_fixes_of.as_ref().map(Receiver::from),
        matching: matching.map(Matching::from),
        clock_offsets: with_offsets.then(|| estimates.collect()),
    }
}

fn rejected_row(part: Part, row: RowError) -> RejectedPartRow {
    RejectedPartRow { part: part.as_str(), line: row.line, field: row.field, reason: row.reason }
}

fn offset(receiver: &domain::Receiver, found: Option<&OffsetEstimate>) -> ClockOffsetEstimate {
    ClockOffsetEstimate {
        receiver_id: receiver.receiver_id.as_str().to_owned(),
        target_id: receiver.target_id.as_str().to_owned(),
        clock_offset_s: found.map(|found| found.clock_offset.as_secs_f64()),
        sigma_s: found.map(|found| found.sigma_s),
        explained: found.map(|found| found.explained),
        explained_at_zero: found.map(|found| found.explained_at_zero),
    }
}

impl From<MatchReport> for Matching {
    fn from(report: MatchReport) -> Self {
        let pair = |own: app::MatchedPair| MatchedPair {
            receiver_id: own.receiver_id.as_str().to_owned(),
            tracker_id: own.tracker_id.as_str().to_owned(),
            from: own.from,
            to: own.to,
            detections: own.detections,
            probability: own.probability,
        };
        let member = |own: app::GroupMember| GroupMember {
            tracker_id: own.tracker_id.as_str().to_owned(),
            probability: own.probability,
        };
        let group = |own: app::SharedReceiver| MatchedGroup {
            receiver_id: own.receiver_id.as_str().to_owned(),
            from: own.from,
            to: own.to,
            detections: own.detections,
            probability: own.probability,
            members: own.members.into_iter().map(member).collect(),
        };
        Self {
            tracklets: report.tracklets,
            receivers: report.receivers,
            cuts: report.cuts,
            min_probability: report.min_probability,
            matched_detections: report.matched_detections,
            unsure_detections: report.unsure_detections,
            pairs: report.pairs.into_iter().map(pair).collect(),
            groups: report.groups.into_iter().map(group).collect(),
        }
    }
}

impl From<PairingCounts> for Pairing {
    fn from(counts: PairingCounts) -> Self {
        Self {
            detections: counts.detections,
            fixes: counts.fixes,
            paired: counts.paired,
            unpaired_detections: UnpairedDetections {
                no_fix_of_target: counts.detections_without_fixes,
                no_fix_near: counts.detections_far_from_fixes,
                fix_nearer_to_another: counts.detections_with_fix_claimed,
                duplicate: counts.detections_duplicate,
            },
            unused_fixes: UnusedFixes {
                no_receiver: counts.fixes_without_receiver,
                no_box_of_target: counts.fixes_without_detections,
                no_box_near: counts.fixes_unused,
                duplicate: counts.fixes_duplicate,
            },
        }
    }
}
