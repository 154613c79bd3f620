//! `SampleService.PairSamples`: an import of detections and fixes that come apart.

use tonic::Streaming;

use super::convert::{camera_id, durability, on_conflict, timestamp};
use super::proto;
use super::proto::pair_samples_request::Kind;
use super::statuses::broken;
use crate::app::{
    App, GroupMember, ImportOptions, MatchReport, PairedImport, PairedReport, PairingCounts, Part, Spool,
    Spooled,
};
use crate::config::Limits;
use crate::domain::{
    self, Durability, Error, ErrorKind, IdempotentRequest, ReceiverId, Result, TargetId, parse_time_zone,
};
use crate::exchange::{BoxForm, BoxUnit, CsvLayout, FixFormat, Format, RowError};
use crate::fusion::association::MatchSettings;
use crate::fusion::clock_offset::OffsetEstimate;
use crate::fusion::pairing::{PairingRule, PairingSettings};
use crate::request::RequestContext;
use crate::shutdown::Shutdown;

/// The messages of an import of two files.
pub(super) struct Pieces {
    pub(super) messages: Streaming<proto::PairSamplesRequest>,
    pub(super) context: RequestContext,
    pub(super) shutdown: Shutdown,
}

impl Pieces {
    async fn next(&mut self) -> Result<Option<Kind>> {
        let message = tokio::select! {
            // First, so that a client whose backlog never ends cannot hold the server up.
            biased;
            () = self.shutdown.draining() => Err(Error::refused(
                ErrorKind::ShuttingDown,
                "the server is ending; send the files again, nothing of them was stored",
            )),
            message = self.messages.message() => {
                message.map_err(|status| self.context.body_refusal().unwrap_or_else(|| broken(&status)))
            }
        };
        let missing = || Error::invalid("kind", "must be the opening or a piece of a file");
        message?.map(|message| message.kind.ok_or_else(missing)).transpose()
    }

    /// Both files whole, of at most as many bytes together as the body of a REST import.
    async fn spool(&mut self, app: &App) -> Result<[Spooled; 2]> {
        let limit = app.limits.import_bytes;
        let client = self.context.client();
        let mut detections = Spool::new(app, client)?;
        let mut fixes = Spool::new(app, client)?;
        while let Some(kind) = self.next().await? {
            let (spool, piece) = match kind {
                Kind::Opening(_) => return Err(Error::invalid("opening", "must be the first message alone")),
                Kind::Detections(piece) => (&mut detections, piece),
                Kind::Fixes(piece) => (&mut fixes, piece),
            };
            spool.push(piece).await?;
            if detections.length() + fixes.length() > limit {
                let message = format!("both files together may have at most {limit} bytes");
                return Err(Error::refused(ErrorKind::TooLarge, message));
            }
        }
        Ok([detections.finish().await?, fixes.finish().await?])
    }
}

/// Spools, pairs and stores.
pub(super) async fn pair(
    app: &App,
    mut pieces: Pieces,
    idempotent: Option<IdempotentRequest>,
) -> Result<proto::PairSamplesResponse> {
    let Some(Kind::Opening(opening)) = pieces.next().await? else {
        return Err(Error::invalid("opening", "is required in the first message"));
    };
    let camera = camera_id(&opening.camera_id)?;
    let settings = PairingSettings::new(method(opening.method)?, opening.window_s, opening.longest_gap_s)?;
    let estimates_offsets = opening.estimate_offset;
    let durability = durability(opening.durability)?;
    let on_conflict = on_conflict(opening.on_conflict)?;
    let layout = layout(opening.layout.clone().unwrap_or_default())?;
    let matching = opening.r#match.map(|options| matching(options, &app.limits)).transpose()?;
    let target_id = opening.target_id.as_deref().map(TargetId::new).transpose()?;
    let receiver_id = opening.receiver_id.as_deref().map(ReceiverId::new).transpose()?;
    let (detections_format, fixes_format) =
        (detection_format(opening.detections_format)?, fix_format(opening.fixes_format)?);
    app.samples().row_rules(&camera).await?; // refuses an unknown camera before its samples are sent
    let [mut detections, mut fixes] = pieces.spool(app).await?;
    if let Some(request) = &idempotent {
        request.hasher.update(&prost::Message::encode_to_vec(&opening));
        detections = detections.hash_into(request).await?;
        fixes = fixes.hash_into(request).await?;
    }
    let import = PairedImport {
        detections,
        detections_format,
        fixes,
        fixes_format,
        settings,
        target_id,
        receiver_id,
        keeps_unpaired: opening.keep_unpaired,
        options: ImportOptions { durability, on_conflict, idempotent },
        layout,
        estimates_offsets,
        matching,
    };
    Ok(response(app.samples().import_paired(&camera, import).await?, durability))
}

fn detection_format(format: i32) -> Result<Format> {
    match proto::DetectionFormat::try_from(format) {
        Ok(proto::DetectionFormat::Unspecified | proto::DetectionFormat::Csv) => Ok(Format::Csv),
        Ok(proto::DetectionFormat::Ndjson) => Ok(Format::Ndjson),
        Ok(proto::DetectionFormat::Json) => Ok(Format::Json),
        Err(_) => Err(unknown("detections_format", format)),
    }
}

fn fix_format(format: i32) -> Result<FixFormat> {
    match proto::FixFormat::try_from(format) {
        Ok(proto::FixFormat::Unspecified | proto::FixFormat::Csv) => Ok(FixFormat::Csv),
        Ok(proto::FixFormat::Nmea) => Ok(FixFormat::Nmea),
        Ok(proto::FixFormat::Gpx) => Ok(FixFormat::Gpx),
        Ok(proto::FixFormat::Gpsd) => Ok(FixFormat::Gpsd),
        Ok(proto::FixFormat::Rtklib) => Ok(FixFormat::Rtklib),
        Ok(proto::FixFormat::Fit) => Ok(FixFormat::Fit),
        Ok(proto::FixFormat::GnssLogger) => Ok(FixFormat::GnssLogger),
        Err(_) => Err(unknown("fixes_format", format)),
    }
}

fn method(method: i32) -> Result<PairingRule> {
    match proto::PairingMethod::try_from(method) {
        Ok(proto::PairingMethod::Unspecified | proto::PairingMethod::Nearest) => Ok(PairingRule::Nearest),
        Ok(proto::PairingMethod::Interpolate) => Ok(PairingRule::Interpolated),
        Err(_) => Err(unknown("method", method)),
    }
}

fn layout(layout: proto::CsvLayout) -> Result<CsvLayout> {
    let columns = Some(layout.columns).filter(|columns| !columns.is_empty());
    let columns = columns.map(|columns| columns.parse()).transpose();
    let box_form = match proto::BoxForm::try_from(layout.box_form) {
        Ok(proto::BoxForm::Unspecified) => None,
        Ok(proto::BoxForm::LeftTop) => Some(BoxForm::LeftTop),
        Ok(proto::BoxForm::Centre) => Some(BoxForm::Centre),
        Ok(proto::BoxForm::Corners) => Some(BoxForm::Corners),
        Err(_) => return Err(unknown("layout.box_form", layout.box_form)),
    };
    let box_unit = match proto::BoxUnit::try_from(layout.box_unit) {
        Ok(proto::BoxUnit::Unspecified) => None,
        Ok(proto::BoxUnit::Px) => Some(BoxUnit::Px),
        Ok(proto::BoxUnit::Share) => Some(BoxUnit::Share),
        Err(_) => return Err(unknown("layout.box_unit", layout.box_unit)),
    };
    let timezone = Some(layout.timezone).filter(|name| !name.is_empty());
    let timezone = timezone.map(|name| parse_time_zone(&name)).transpose();
    let under = |error: Error| error.under("layout");
    let layout = CsvLayout::new(columns.map_err(under)?, box_form, box_unit);
    Ok(CsvLayout { timezone: timezone.map_err(under)?, ..layout })
}

fn matching(options: proto::MatchOptions, limits: &Limits) -> Result<MatchSettings> {
    let default = MatchSettings::default();
    let settings = MatchSettings::new(
        options.min_probability,
        options.clock_window_s.unwrap_or(default.clock_window_s),
        limits.into(),
    );
    settings.map_err(|error| error.under("match"))
}

fn unknown(field: &str, value: i32) -> Error {
    Error::invalid(field, format!("has no value {value}"))
}

fn response(report: PairedReport, durability: Durability) -> proto::PairSamplesResponse {
    let PairedReport { samples, counts, rejected, unnamed_fixes_of, clock_offsets, matching } = report;
    let samples = proto::ImportSamplesResponse {
        accepted: samples.accepted,
        duplicate: samples.duplicate,
        rejected: rejected.count,
        rejected_rows: Vec::new(),
        durability: proto::Durability::from(durability).into(),
        accepted_without_fix: samples.without_fix,
        replaced: samples.replaced,
        warnings: samples.warnings,
    };
    let (of_detections, of_fixes): (Vec<_>, Vec<_>) =
        rejected.rows.into_iter().partition(|(part, _)| *part == Part::Detections);
    let rows = |rows: Vec<(Part, RowError)>| rows.into_iter().map(|(_, row)| row.into()).collect();
    proto::PairSamplesResponse {
        samples: Some(samples),
        rejected_detections: rows(of_detections),
        rejected_fixes: rows(of_fixes),
        pairing: Some(counts.into()),
        unnamed_fixes_of: unnamed_fixes_of.as_ref().map(Into::into),
        matching: matching.map(Into::into),
        clock_offsets: clock_offsets
            .iter()
            .map(|(receiver, found)| offset(receiver, found.as_ref()))
            .collect(),
    }
}

fn offset(receiver: &domain::Receiver, found: Option<&OffsetEstimate>) -> proto::ClockOffsetEstimate {
    proto::ClockOffsetEstimate {
        receiver_id: receiver.receiver_id.to_string(),
        target_id: receiver.target_id.to_string(),
        clock_offset_s: found.map(|found| found.clock_offset.as_secs_f64()),
        sigma_s: found.map(|found| found.sigma_s),
        explained: found.map(|found| found.explained),
        explained_at_zero: found.map(|found| found.explained_at_zero),
    }
}

impl From<PairingCounts> for proto::PairingCounts {
    fn from(counts: PairingCounts) -> Self {
        Self {
            detections: counts.detections,
            fixes: counts.fixes,
            paired: counts.paired,
            detections_no_fix_of_target: counts.detections_without_fixes,
            detections_no_fix_near: counts.detections_far_from_fixes,
            detections_fix_nearer_to_another: counts.detections_with_fix_claimed,
            detections_duplicate: counts.detections_duplicate,
            fixes_no_receiver: counts.fixes_without_receiver,
            fixes_no_box_of_target: counts.fixes_without_detections,
            fixes_no_box_near: counts.fixes_unused,
            fixes_duplicate: counts.fixes_duplicate,
        }
    }
}

impl From<MatchReport> for proto::MatchReport {
    fn from(report: MatchReport) -> Self {
        let pairs = report.pairs.into_iter().map(|pair| proto::MatchedPair {
            receiver_id: pair.receiver_id.to_string(),
            tracker_id: pair.tracker_id.to_string(),
            from: Some(timestamp(pair.from)),
            to: Some(timestamp(pair.to)),
            detections: pair.detections,
            probability: pair.probability,
        });
        let member = |member: GroupMember| proto::GroupMember {
            tracker_id: member.tracker_id.to_string(),
            probability: member.probability,
        };
        let groups = report.groups.into_iter().map(|group| proto::MatchedGroup {
            receiver_id: group.receiver_id.to_string(),
            from: Some(timestamp(group.from)),
            to: Some(timestamp(group.to)),
            probability: group.probability,
            members: group.members.into_iter().map(member).collect(),
            detections: group.detections,
        });
        Self {
            tracklets: report.tracklets as u64,
            receivers: report.receivers as u64,
            cuts: report.cuts as u64,
            min_probability: report.min_probability,
            matched_detections: report.matched_detections,
            unsure_detections: report.unsure_detections,
            pairs: pairs.collect(),
            groups: groups.collect(),
        }
    }
}
