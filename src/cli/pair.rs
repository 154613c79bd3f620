//! `sightfix pair`

use std::ffi::OsStr;
use std::fs::File;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::Context as _;
use clap::Args;
use jiff::Timestamp;

use super::files::{self, Output};
use super::import::image_size;
use super::layout::LayoutFlags;
use super::output::print_note;
use super::rejected_rows::print_reasons;
use super::summary::{Summary, SummaryFlags};
use super::{DataFolder, MissingData, camera_id, open_app, receiver_id, runtime, target_id};
use crate::app::{
    GroupMember, MatchReport, MatchRequest, MatchedPair, PairingCounts, Part, Recording, RecordingLimits,
    RejectedParts, SharedReceiver, of_part,
};
use crate::clock::Clock;
use crate::config::Limits;
use crate::domain::{
    CameraId, ClockOffset, Detection, Error, ImageSize, Receiver, ReceiverId, Receivers, TargetId,
    TimeBounds, parse_time,
};
use crate::exchange::{
    self, FixFormat, FrameClock, FrameFileFormat, LaidOut, MatchedSampleWriter, RowError, RowRules,
};
use crate::fusion::association::{Cancellation, MatchLimits, MatchSettings};
use crate::fusion::clock_offset::OffsetEstimate;
use crate::fusion::pairing::{PairingRule, PairingSettings};
use crate::model::{Artifact, Regressor};

/// A box of a file, or why its row is invalid.
type BoxRow = crate::domain::Result<Result<Detection, RowError>>;

/// Pair detections and fixes that were recorded separately into samples
#[derive(Args)]
pub(super) struct Pair {
    /// Boxes as CSV (time, target_id, left, top, width, height), NDJSON or JSON, by file extension, which may be followed by
    /// .gz or .zst; - is standard input
    #[arg(long, value_name = "FILE")]
    detections: PathBuf,
    /// Format of boxes by the number of their frame: mot (MOTChallenge), kitti (tracking labels), yolo (a folder of a tracker's
    /// labels per frame), coco (with tracks) or cvat (CVAT for video)
    #[arg(long, value_name = "FORMAT", requires_all = ["frame_rate", "start_time"])]
    detections_format: Option<FrameFileFormat>,
    /// Frames per second of such a file
    #[arg(long, value_name = "PER_S", requires = "detections_format")]
    frame_rate: Option<f64>,
    /// Time of the first frame of such a file, such as 2026-06-01T12:00:00Z
    #[arg(long, value_name = "TIME", value_parser = parse_time, requires = "detections_format")]
    start_time: Option<Timestamp>,
    /// Fixes as CSV, NMEA, GPX, gpsd reports (.json), solutions of RTKLIB (.pos), FIT or a log of GnssLogger, by file
    /// extension, which may be followed by .gz or .zst; - is standard input
    #[arg(long, value_name = "FILE")]
    fixes: PathBuf,
    /// Format of the fixes if the extension does not determine it: csv, nmea, gpx, gpsd, rtklib, fit or gnss_logger
    #[arg(long, value_name = "FORMAT")]
    fixes_format: Option<FixFormat>,
    /// Output file for `sightfix import`: CSV, NDJSON or JSON, by file extension, which may be followed by .gz or
    /// .zst; - is standard output
    #[arg(long, value_name = "FILE", required_unless_present = "estimate_offset")]
    out: Option<PathBuf>,
    /// Replace the output file if it exists
    #[arg(long, requires = "out")]
    overwrite: bool,
    /// Pairing method: nearest (each is the other's nearest within the window) or interpolate (between
    /// the fixes before and after the box)
    #[arg(long, value_name = "METHOD", default_value = "nearest")]
    method: PairingRule,
    /// Largest time between box and fix, s (nearest) [default: 0.5]
    #[arg(long, value_name = "S")]
    window_s: Option<f64>,
    /// Largest gap between fixes to interpolate over, s (interpolate) [default: 2.5]
    #[arg(long, value_name = "S")]
    longest_gap_s: Option<f64>,
    /// The target that carries a receiver; an unlisted receiver has its own id as target id
    #[arg(long = "receiver", value_name = "RECEIVER=TARGET", value_parser = binding)]
    receivers: Vec<Receiver>,
    /// Offset added to a receiver's time to get the camera's time, s
    #[arg(long = "clock-offset", value_name = "RECEIVER=S", value_parser = offset)]
    offsets: Vec<(ReceiverId, ClockOffset)>,
    /// Receiver of fixes that name none [default: the only --receiver, else that of the only target]
    #[arg(long, value_name = "RECEIVER", value_parser = receiver_id)]
    receiver_id: Option<ReceiverId>,
    /// Target of boxes that name none
    #[arg(long, value_name = "TARGET", value_parser = target_id)]
    target_id: Option<TargetId>,
    /// Print the estimated clock offset of each receiver
    #[arg(long)]
    estimate_offset: bool,
    /// Pair with the estimated offsets instead of the given ones
    #[arg(long, requires = "estimate_offset")]
    apply_offset: bool,
    /// Write the boxes that find no fix, too, with empty longitude and latitude
    #[arg(long)]
    keep_unpaired: bool,
    #[command(flatten)]
    summary: SummaryFlags,
    #[command(flatten)]
    layout: LayoutFlags,
    #[command(flatten)]
    matching: MatchFlags,
}

/// Matching of boxes that have only a tracker's ids with fixes that have only receivers'
#[derive(Args)]
struct MatchFlags {
    /// Match boxes with receivers: boxes need only a tracker's ids. Sure samples get the
    /// receiver's id as target_id, and the columns tracker_id and match_probability
    #[arg(long = "match", conflicts_with_all = ["receivers", "estimate_offset"])]
    matches: bool,
    /// A downloaded model file to match with [default: no model: camera and matches are found together]
    #[arg(long, value_name = "FILE", requires = "matches", conflicts_with = "camera")]
    model: Option<PathBuf>,
    /// The camera whose active model is used to match
    #[arg(long, value_name = "ID", value_parser = camera_id, requires = "matches")]
    camera: Option<CameraId>,
    /// Size of the image, to match without a model, for --box-unit share, and for boxes of yolo
    #[arg(long, value_name = "WIDTHxHEIGHT", value_parser = image_size)]
    image_size: Option<ImageSize>,
    /// Leave out samples whose match is less probable than this [default: 0.9 by a model, 0.8 without one]
    #[arg(long, value_name = "P", requires = "matches")]
    min_probability: Option<f64>,
    /// The receivers' clocks are off by at most this, s
    #[arg(long, value_name = "S", requires = "matches", default_value_t = 0.0)]
    clock_window_s: f64,
    /// Seed of the sampling of assignments
    #[arg(long, value_name = "N", requires = "matches", default_value_t = 1)]
    match_seed: u64,
    #[command(flatten)]
    folder: DataFolder,
}

impl MatchFlags {
    fn settings(&self) -> crate::domain::Result<MatchSettings> {
        MatchSettings::new(self.min_probability, self.clock_window_s, MatchLimits::default())
    }

    fn regressor(&self, file: Option<&Path>) -> anyhow::Result<Option<Arc<Regressor>>> {
        if let Some(path) = &self.model {
            let bytes = std::fs::read(path).with_context(|| format!("cannot read {}", path.display()))?;
            return Ok(Some(Arc::new(Artifact::from_file(&bytes)?.load()?)));
        }
        let Some(id) = &self.camera else { return Ok(None) };
        let settings = self.folder.settings(file)?;
        runtime()?.block_on(async {
            let app = open_app(&settings, "sightfix pair", MissingData::Refuse).await?;
            let serving = app.active_camera(id).await?;
            app.store.close().await;
            let (regressor, _) = serving.model.clone().with_context(|| {
                format!("camera {id} has no active model: train it first, or match without")
            })?;
            Ok(Some(regressor))
        })
    }
}

impl Pair {
    pub(super) fn run(self, config: Option<&Path>) -> anyhow::Result<()> {
        let settings = PairingSettings::new(self.method, self.window_s, self.longest_gap_s)?;
        let summary = self.summary.summary(self.out.as_deref());
        let (mut recording, format) = self.read()?;
        print_rejected(&summary, &recording.rejected)?;
        let mut receivers = self.receivers()?;
        if let Some(receiver) = recording.name_fixes(format, &receivers, self.receiver_id.clone())? {
            summary.line(&format_args!("fixes that name no receiver are those of {}", carried(&receiver)))?;
        }
        if self.estimate_offset {
            let estimates = recording.clock_offsets(&receivers);
            for (receiver, estimate) in &estimates {
                print_offset(&summary, receiver, estimate.as_ref())?;
            }
            if self.apply_offset {
                receivers = applied(&receivers, &estimates)?;
            }
        }
        let Some(out) = &self.out else {
            return summary.document(&serde_json::json!({ "rejected": recording.rejected.count }));
        };
        if self.matching.matches {
            return self.write_matched(recording, &receivers, &settings, out, config, &summary);
        }
        let (paired, counts, rejected) = recording.paired(&receivers, &settings);
        print_counts(&summary, &counts, &rejected, None)?;
        anyhow::ensure!(counts.paired > 0, "nothing could be paired; {} is not written", out.display());
        let mut file = Output::create(out)?;
        if self.keep_unpaired {
            summary.line(&format_args!("boxes kept without a fix {}", paired.unpaired_detections.len()))?;
        }
        let samples = paired.into_samples(self.keep_unpaired);
        exchange::write_samples(&mut file, files::format_of(out, None)?, &samples)?;
        file.finish().with_context(|| format!("cannot write {}", out.display()))
    }

    /// Matches, pairs and writes the samples of sure matches.
    fn write_matched(
        &self,
        recording: Recording,
        receivers: &Receivers,
        settings: &PairingSettings,
        out: &Path,
        config: Option<&Path>,
        summary: &Summary,
    ) -> anyhow::Result<()> {
        let regressor = self.matching.regressor(config)?;
        let request = MatchRequest {
            regressor: regressor.as_deref(),
            image_size: self.matching.image_size,
            settings: self.matching.settings()?,
            seed: self.matching.match_seed,
            cancellation: Cancellation::NEVER,
        };
        let matched = recording.matched(receivers, &request)?;
        print_match(summary, &matched.report)?;
        let (paired, counts, rejected) = matched.recording.paired(&matched.receivers, settings);
        print_counts(summary, &counts, &rejected, Some(&matched.report))?;
        anyhow::ensure!(counts.paired > 0, "nothing could be paired; {} is not written", out.display());
        let mut file = Output::create(out)?;
        let mut writer = MatchedSampleWriter::new(&mut file, files::format_of(out, None)?);
        for sample in paired.into_samples(self.keep_unpaired) {
            let key = (sample.time, sample.target_id.clone());
            writer.write(&sample, matched.associations.get(&key))?;
        }
        writer.finish()?;
        file.finish().with_context(|| format!("cannot write {}", out.display()))
    }

    fn read(&self) -> anyhow::Result<(Recording, FixFormat)> {
        let both = files::is_standard(&self.detections) && files::is_standard(&self.fixes);
        anyhow::ensure!(!both, "only one of --detections and --fixes can be standard input");
        let format = files::fix_format_of(&self.fixes, self.fixes_format).with_context(|| {
            let name = self.fixes.display();
            format!("{name}: the extension does not determine the format; give --fixes-format csv, nmea, gpx, gpsd, rtklib, fit or gnss_logger")
        })?;
        if let Some(out) = &self.out {
            files::format_of(out, None)?; // fail early
            let exists = !files::is_standard(out) && out.exists();
            anyhow::ensure!(
                self.overwrite || !exists,
                "{} exists; name another file or give --overwrite",
                out.display()
            );
        }
        let rules = RowRules {
            time_bounds: TimeBounds::at(Clock::system().now()),
            image_size: self.matching.image_size,
        };
        let layout = self.layout.to_layout();
        let boxes = self.boxes(rules)?;
        let fixes = files::open_input(&self.fixes)?;
        let fixes = exchange::read_received_fixes(fixes, (format, &layout), rules.time_bounds)
            .map_err(|error| of_part(Part::Fixes, error))?;
        let limits = RecordingLimits { rows: usize::MAX, rejected_rows: Limits::default().rejected_rows };
        Ok((Recording::read(boxes, fixes, limits)?, format))
    }

    fn boxes(&self, rules: RowRules) -> anyhow::Result<Box<dyn Iterator<Item = BoxRow>>> {
        if let (Some(format), Some(start), Some(rate)) =
            (self.detections_format, self.start_time, self.frame_rate)
        {
            let clock = FrameClock::new(start, rate).context("--frame-rate")?;
            if format == FrameFileFormat::Yolo && self.detections.is_dir() {
                return Ok(Box::new(yolo_boxes(&self.detections, clock, rules)?));
            }
            let input = files::open_input(&self.detections)?;
            return Ok(exchange::read_frame_file(input, format, clock, rules));
        }
        let input = files::open_input(&self.detections)?;
        let format = files::format_of(&self.detections, None)?;
        let laid_out = LaidOut::from((format, &self.layout.to_layout()));
        let boxes = exchange::read_detections(input, laid_out, &rules, self.target_id.clone());
        Ok(Box::new(boxes.map_err(|error| of_part(Part::Detections, error))?))
    }

    /// The receivers of both flags.
    fn receivers(&self) -> anyhow::Result<Receivers> {
        let mut receivers = self.receivers.clone();
        for (index, (receiver_id, clock_offset)) in self.offsets.iter().enumerate() {
            let is_duplicate = self.offsets[..index].iter().any(|(other, _)| other == receiver_id);
            anyhow::ensure!(!is_duplicate, "--clock-offset {receiver_id} is a duplicate");
            match receivers.iter_mut().find(|receiver| &receiver.receiver_id == receiver_id) {
                Some(receiver) => receiver.clock_offset = *clock_offset,
                None => receivers
                    .push(Receiver { clock_offset: *clock_offset, ..Receiver::named(receiver_id.clone()) }),
            }
        }
        Receivers::new(receivers).context("--receiver")
    }
}

/// The boxes of a folder with a file of labels per frame, whose names end with its number. The first frame is 1, or 0 if there is
/// one; a frame without boxes has no file.
fn yolo_boxes(
    folder: &Path,
    clock: FrameClock,
    rules: RowRules,
) -> anyhow::Result<impl Iterator<Item = BoxRow> + use<>> {
    let mut files = Vec::new();
    for entry in folder.read_dir().with_context(|| format!("cannot read {}", folder.display()))? {
        let path = entry?.path();
        let stem =
            path.file_stem().and_then(OsStr::to_str).filter(|_| path.extension() == Some("txt".as_ref()));
        if let Some(number) = stem.and_then(exchange::frame_number) {
            files.push((number, path));
        }
    }
    files.sort();
    let lowest = files.first().map(|(number, _)| *number);
    let lowest = lowest.with_context(|| format!("{} has no file such as gate_12.txt", folder.display()))?;
    let boxes = files.into_iter().map(move |(number, path)| {
        let file = File::open(&path).map_err(|error| Error::fault(format!("{}: {error}", path.display())))?;
        let clock = clock.after(number - lowest.min(1))?;
        let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let rows = exchange::read_frame_file(file, FrameFileFormat::Yolo, clock, rules);
        Ok(rows.map(move |row| {
            row.map(|row| row.map_err(|row| RowError { reason: format!("{} ({name})", row.reason), ..row }))
        }))
    });
    Ok(boxes.flat_map(|file: crate::domain::Result<_>| match file {
        Ok(rows) => Box::new(rows) as Box<dyn Iterator<Item = BoxRow>>,
        Err(error) => Box::new(std::iter::once(Err(error))),
    }))
}

/// The receivers with their estimated offsets, where there is an estimate.
fn applied(
    receivers: &Receivers,
    estimates: &[(Receiver, Option<OffsetEstimate>)],
) -> anyhow::Result<Receivers> {
    let mut changed: Vec<Receiver> = receivers.iter().cloned().collect();
    for (receiver, estimate) in estimates {
        let Some(estimate) = estimate else { continue };
        let clock_offset = ClockOffset::from_seconds(estimate.clock_offset.as_secs_f64())?;
        changed.retain(|other| other.receiver_id != receiver.receiver_id);
        changed.push(Receiver { clock_offset, ..receiver.clone() });
    }
    Ok(Receivers::new(changed)?)
}

fn carried(receiver: &Receiver) -> String {
    format!("{}, carried by {}", receiver.receiver_id, receiver.target_id)
}

fn print_rejected(summary: &Summary, rejected: &RejectedParts) -> anyhow::Result<()> {
    for part in [Part::Detections, Part::Fixes] {
        let rows: Vec<_> = rejected.rows.iter().filter(|(of, _)| *of == part).map(|(_, row)| row).collect();
        let count = rows.len() as u64;
        print_reasons(&format!("{} ", part.as_str()), rows, count);
    }
    let printed = rejected.rows.len() as u64;
    if rejected.count > printed {
        print_note(format_args!("... and {} more", rejected.count - printed));
    }
    if rejected.count > 0 {
        summary.line(&format_args!("rejected rows {}", rejected.count))?;
    }
    Ok(())
}

fn print_offset(
    summary: &Summary,
    receiver: &Receiver,
    estimate: Option<&OffsetEstimate>,
) -> anyhow::Result<()> {
    let receiver_and_target = carried(receiver);
    let given_s = receiver.clock_offset.seconds();
    match estimate {
        None => summary.line(&format_args!(
            "clock offset of {receiver_and_target}: cannot be estimated (too little movement, too little overlap, or \
             more than 10 s); {given_s:+.3} s is given"
        )),
        Some(found) => summary.line(&format_args!(
            "clock offset of {receiver_and_target}: {:+.3} s, standard deviation {:.3} s, explains {:.1} % of the movement \
             ({:.1} % without an offset); {given_s:+.3} s is given",
            found.clock_offset.as_secs_f64(),
            found.sigma_s,
            100.0 * found.explained,
            100.0 * found.explained_at_zero,
        )),
    }
}

fn print_match(summary: &Summary, report: &MatchReport) -> anyhow::Result<()> {
    if let Some(world) = &report.world {
        summary.line(&format_args!(
            "found the camera with score {:.1}; with shifted clocks at most {:.1}, another place at most {:.1}",
            world.best, world.best_shifted, world.second
        ))?;
    }
    summary.line(&format_args!(
        "matched {} tracklets (cut {} times) with {} receivers: {} boxes of probability {} or more, {} of less left out",
        report.tracklets,
        report.cuts,
        report.receivers,
        report.matched_detections,
        report.min_probability,
        report.unsure_detections,
    ))?;
    for (receiver_id, offset) in &report.clock_offsets {
        summary.line(&format_args!("clock offset of {receiver_id}: {:+.1} s found", offset.seconds()))?;
    }
    for pair in &report.pairs {
        summary.line(&format_args!(
            "{} is {} from {} to {}, {} boxes, probability {:.3}",
            pair.tracker_id, pair.receiver_id, pair.from, pair.to, pair.detections, pair.probability
        ))?;
    }
    for group in &report.groups {
        let members: Vec<&str> = group.members.iter().map(|own| own.tracker_id.as_str()).collect();
        summary.line(&format_args!(
            "one of {} is {} from {} to {}, {} mean boxes, probability {:.3}",
            members.join(", "),
            group.receiver_id,
            group.from,
            group.to,
            group.detections,
            group.probability
        ))?;
    }
    Ok(())
}

/// The matched rows, in the names of the answer over REST, the groups, and the scores of the search without a model.
fn match_document(report: &MatchReport) -> serde_json::Value {
    let pair = |pair: &MatchedPair| {
        serde_json::json!({
            "receiver_id": pair.receiver_id.as_str(),
            "tracker_id": pair.tracker_id.as_str(),
            "from": pair.from,
            "to": pair.to,
            "detections": pair.detections,
            "probability": pair.probability,
        })
    };
    let group = |group: &SharedReceiver| {
        let member = |own: &GroupMember| serde_json::json!({ "tracker_id": own.tracker_id.as_str(), "probability": own.probability });
        serde_json::json!({
            "receiver_id": group.receiver_id.as_str(),
            "from": group.from,
            "to": group.to,
            "detections": group.detections,
            "probability": group.probability,
            "members": group.members.iter().map(member).collect::<Vec<_>>(),
        })
    };
    let offset = |(id, offset): &(ReceiverId, ClockOffset)| serde_json::json!({ "receiver_id": id.as_str(), "offset_s": offset.seconds() });
    let score = |score: f64| score.is_finite().then_some(score);
    serde_json::json!({
        "tracklets": report.tracklets,
        "receivers": report.receivers,
        "cuts": report.cuts,
        "min_probability": report.min_probability,
        "matched_detections": report.matched_detections,
        "unsure_detections": report.unsure_detections,
        "pairs": report.pairs.iter().map(pair).collect::<Vec<_>>(),
        "groups": report.groups.iter().map(group).collect::<Vec<_>>(),
        "clock_offsets": report.clock_offsets.iter().map(offset).collect::<Vec<_>>(),
        "scores": report.world.map(|world| serde_json::json!({
            "best": world.best,
            "shifted_clocks": score(world.best_shifted),
            "another_place": score(world.second),
        })),
    })
}

fn print_counts(
    summary: &Summary,
    counts: &PairingCounts,
    rejected: &RejectedParts,
    matched: Option<&MatchReport>,
) -> anyhow::Result<()> {
    let PairingCounts { detections, fixes, paired, .. } = counts;
    summary.document(&serde_json::json!({
        "matching": matched.map(match_document),
        "detections": detections,
        "fixes": fixes,
        "paired": paired,
        "rejected": rejected.count,
        "unpaired_detections": {
            "no_fix_of_target": counts.detections_without_fixes,
            "no_fix_near": counts.detections_far_from_fixes,
            "fix_nearer_to_another": counts.detections_with_fix_claimed,
            "duplicate": counts.detections_duplicate,
        },
        "unused_fixes": {
            "no_receiver": counts.fixes_without_receiver,
            "no_box_of_target": counts.fixes_without_detections,
            "no_box_near": counts.fixes_unused,
            "duplicate": counts.fixes_duplicate,
        },
    }))?;
    summary.line(&format_args!("paired {paired} of {detections} detections and {fixes} fixes"))?;
    summary.line(&format_args!(
        "unpaired detections: no fix of the target {}, no fix near in time {}, nearest fix is nearer to \
         another box {}, duplicate {}",
        counts.detections_without_fixes,
        counts.detections_far_from_fixes,
        counts.detections_with_fix_claimed,
        counts.detections_duplicate,
    ))?;
    summary.line(&format_args!(
        "unused fixes: no receiver named {}, no box of the target {}, no box to take it {}, duplicate {}",
        counts.fixes_without_receiver,
        counts.fixes_without_detections,
        counts.fixes_unused,
        counts.fixes_duplicate,
    ))
}

/// A receiver as `phone-7=person-1`.
fn binding(text: &str) -> Result<Receiver, String> {
    let (receiver, target) = text.split_once('=').ok_or("must be RECEIVER=TARGET")?;
    Ok(Receiver { target_id: target_id(target)?, ..Receiver::named(receiver_id(receiver)?) })
}

/// An offset as `phone-7=-0.35`.
fn offset(text: &str) -> Result<(ReceiverId, ClockOffset), String> {
    let (receiver, seconds) = text.rsplit_once('=').ok_or("must be RECEIVER=SECONDS")?;
    let seconds: f64 = seconds.parse().map_err(|_| "must be RECEIVER=SECONDS")?;
    let offset = ClockOffset::from_seconds(seconds).map_err(|error| error.to_string())?;
    Ok((receiver_id(receiver)?, offset))
}
