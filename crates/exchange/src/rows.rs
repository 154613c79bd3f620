//! Rows of files of samples, observations and detections.

use std::io::Read;

use super::columns::{HEIGHT, LEFT, TARGET_ID, TIME, TOP, WIDTH};
use super::csv_layout::{CsvLayout, LaidOut};
use super::csv_rows::CsvRows;
use super::elements::Elements;
use super::feature::FeatureCollection;
use super::file_row::{FileRow, RowError, shared};
use super::format::Format;
use super::lines::{Line, Lines};
use super::wire::{self, box_within};
use crate::domain::{
    Detection, Error, ErrorKind, ImageSize, LiveItem, Observation, ReceiverId, Result, Sample, Score,
    StoredSample, TargetClass, TargetId, TimeBounds, TrackerId, convert_all, parse_time,
};
use crate::geo::Position;

/// The rules that rows are checked against.
#[derive(Debug, Clone, Copy)]
pub struct RowRules {
    /// Valid times.
    pub time_bounds: TimeBounds,
    /// Size of the camera's image, if known: boxes outside of it are refused.
    pub image_size: Option<ImageSize>,
}

/// A row of a file to fuse or evaluate.
#[derive(Debug, Clone, PartialEq)]
pub struct ObservedRow {
    /// The observation.
    pub observation: Observation,
    /// Class reported by the detector.
    pub class: Option<TargetClass>,
    /// Confidence score of the detector.
    pub score: Option<Score>,
    /// True position.
    pub truth: Option<Position>,
}

/// Samples of a file, in the order of the file.
///
/// CSV has the columns `time`, `target_id`, `left`, `top`, `width`, `height` in any order, also with their
/// units (`left_px`), and optionally `longitude` and `latitude` (`longitude_deg`), `sigma_m`, `class`,
/// `score`, `truth_longitude` and `truth_latitude`, or others by its [`CsvLayout`](super::CsvLayout). NDJSON has
/// a [`wire::Sample`] per line; JSON is an array of them, or an object `{"samples": [...]}`.
///
/// A row whose longitude and latitude are both empty (in JSON: without `fix`, or with null) is a sample
/// without a fix; its `sigma_m` is ignored. One of the two alone is invalid, as is a file with one of the two
/// columns alone.
///
/// # Errors
/// The outer error: the file cannot be read at all (no header, a column missing or unknown, not JSON, a
/// format that is only written). The error of an item: the file is truncated or cannot be read further;
/// nothing follows. The inner error of an item: that row is invalid.
pub fn read_samples<R: Read, F: Into<LaidOut<Format>>>(
    reader: R,
    format: F,
    rules: &RowRules,
) -> Result<impl Iterator<Item = Result<Result<StoredSample, RowError>>> + use<R, F>> {
    let laid_out = format.into();
    let target_id = laid_out.layout.target_id.clone();
    let mut rows = Rows::new(reader, &laid_out, &required(target_id.is_none()), rules)?;
    let mut converter = RowConverter::new(*rules);
    Ok(std::iter::from_fn(move || rows.next_row(|row| converter.sample(&row, target_id.as_ref()))))
}

/// Observations of a file: rows as those of [`read_samples`] with a box, a fix, or both; target and class
/// are optional.
///
/// # Errors
/// As [`read_samples`].
pub fn read_observations<R: Read>(
    reader: R,
    format: Format,
    rules: &RowRules,
) -> Result<impl Iterator<Item = Result<Result<ObservedRow, RowError>>> + use<R>> {
    let mut rows = Rows::new(reader, &format.into(), &[TIME], rules)?;
    let mut converter = RowConverter::new(*rules);
    Ok(std::iter::from_fn(move || rows.next_row(|row| converter.observed(&row))))
}

/// Live items of a file: rows as those of [`read_observations`] that may also have `tracker_id`, the number by the camera's
/// tracker of a box whose target is not known, and `receiver_id`, the receiver of a fix that names no target.
///
/// # Errors
/// As [`read_samples`].
pub fn read_live_items<R: Read>(
    reader: R,
    format: Format,
    rules: &RowRules,
) -> Result<impl Iterator<Item = Result<Result<LiveItem, RowError>>> + use<R>> {
    let mut rows = match format {
        Format::Csv => Rows::Csv(CsvRows::with_receivers(reader, &[TIME], &CsvLayout::default())?),
        format => Rows::new(reader, &format.into(), &[TIME], rules)?,
    };
    let mut converter = RowConverter::new(*rules);
    Ok(std::iter::from_fn(move || rows.next_row(|row| converter.live_item(&row))))
}

/// Observations of a GeoJSON feature collection (RFC 7946): the properties of a feature are those of a row,
/// and its point is the fix, with the property `sigma_m`. Any fault refuses them all.
///
/// # Errors
/// `MalformedBody` for what is no JSON, `InvalidArgument` naming the fields at fault.
pub fn read_observation_features(json: &[u8], rules: &RowRules) -> Result<Vec<Observation>> {
    let features = wire::parse_json::<FeatureCollection<'_>>(json)?.into_features()?;
    let mut converter = RowConverter::new(*rules);
    convert_all("features", features, |feature| Ok(converter.observed(&feature.into_row()?)?.observation))
}

/// Detections of a file: rows as those of [`read_samples`], whose fixes and true positions are ignored.
/// `target_id` is the target of rows that name none.
///
/// # Errors
/// As [`read_samples`].
pub fn read_detections<R: Read, F: Into<LaidOut<Format>>>(
    reader: R,
    format: F,
    rules: &RowRules,
    target_id: Option<TargetId>,
) -> Result<impl Iterator<Item = Result<Result<Detection, RowError>>> + use<R, F>> {
    let mut rows = Rows::new(reader, &format.into(), &required(false), rules)?;
    let mut converter = RowConverter::new(*rules);
    Ok(std::iter::from_fn(move || rows.next_row(|row| converter.detection(&row, target_id.as_ref()))))
}

/// Columns of a file with boxes.
fn required(with_target: bool) -> Vec<usize> {
    let columns = [TIME, LEFT, TOP, WIDTH, HEIGHT];
    columns.into_iter().chain(with_target.then_some(TARGET_ID)).collect()
}

/// Converts rows into domain values. Adjacent rows mostly have the same target and class, whose text is
/// then shared.
struct RowConverter {
    rules: RowRules,
    target_id: Option<TargetId>,
    tracker_id: Option<TrackerId>,
    receiver_id: Option<ReceiverId>,
    class: Option<TargetClass>,
}

impl RowConverter {
    const fn new(rules: RowRules) -> Self {
        Self { rules, target_id: None, tracker_id: None, receiver_id: None, class: None }
    }

    fn sample(&mut self, row: &FileRow<'_>, default_target: Option<&TargetId>) -> Result<StoredSample> {
        let ObservedRow { observation, class, score, truth } = self.observed(row)?;
        let (time, target_id, bounding_box, fix) = observation.into_parts();
        Ok(Sample {
            time,
            target_id: target_id.or_else(|| default_target.cloned()).ok_or_else(|| missing("target_id"))?,
            bounding_box: bounding_box.ok_or_else(|| missing("bounding_box"))?,
            fix,
            class,
            score,
            truth,
        })
    }

    fn detection(&mut self, row: &FileRow<'_>, default_target: Option<&TargetId>) -> Result<Detection> {
        let ObservedRow { observation, class, score, .. } = self.observed(row)?;
        let (time, target_id, bounding_box, _) = observation.into_parts();
        let target_id = target_id.or_else(|| default_target.cloned());
        Ok(Detection {
            time,
            target_id: target_id.ok_or_else(|| missing("target_id"))?,
            bounding_box: bounding_box.ok_or_else(|| missing("bounding_box"))?,
            class,
            score,
        })
    }

    /// The item of a row. The tracker's number of a sample whose target is known says nothing more.
    fn live_item(&mut self, row: &FileRow<'_>) -> Result<LiveItem> {
        let receiver_id =
            shared(row.receiver_id.as_ref(), &mut self.receiver_id, ReceiverId::as_str, ReceiverId::new)?;
        let tracker_id =
            shared(row.tracker_id.as_ref(), &mut self.tracker_id, TrackerId::as_str, TrackerId::new)?;
        let ObservedRow { observation, class, score, truth: _ } = self.row(row)?;
        let tracker_id = tracker_id.filter(|_| observation.target_id().is_none());
        let observation = observation.with_tracker_id(tracker_id.clone())?;
        let (time, target_id, bounding_box, fix) = observation.into_parts();
        Ok(LiveItem { time, target_id, tracker_id, receiver_id, bounding_box, fix, class, score })
    }

    fn observed(&mut self, row: &FileRow<'_>) -> Result<ObservedRow> {
        if row.receiver_id.is_some() {
            return Err(Error::invalid(
                "receiver_id",
                "belongs to files of fixes; name the target in target_id",
            ));
        }
        self.row(row)
    }

    fn row(&mut self, row: &FileRow<'_>) -> Result<ObservedRow> {
        let time = parse_time(row.time.as_ref().ok_or_else(|| missing("time"))?.as_str())?;
        let time = self.rules.time_bounds.check(time)?;
        let target_id = shared(row.target_id.as_ref(), &mut self.target_id, TargetId::as_str, TargetId::new)?;
        let bounding_box =
            row.bounding_box.map(|sides| box_within(sides, self.rules.image_size)).transpose()?;
        let fix = row.fix.map(|fix| fix.to_domain().map_err(|error| error.under("fix"))).transpose()?;
        let observation = Observation::new(time, target_id, bounding_box, fix)
            .map_err(|_| Error::invalid("", "has neither a box nor a fix"))?;
        let truth = row.truth.map(|truth| truth.to_domain().map_err(|error| error.under("truth")));
        Ok(ObservedRow {
            observation,
            class: shared(row.class.as_ref(), &mut self.class, TargetClass::as_str, TargetClass::new)?,
            score: row.score.map(Score::new).transpose()?,
            truth: truth.transpose()?,
        })
    }
}

fn missing(path: &str) -> Error {
    Error::invalid(path, "is required")
}

/// A reader for each format.
enum Rows<R> {
    Csv(CsvRows<R>),
    Lines(Lines<R>),
    Elements(Elements<R>),
}

impl<R: Read> Rows<R> {
    fn new(reader: R, laid_out: &LaidOut<Format>, required: &[usize], rules: &RowRules) -> Result<Self> {
        let LaidOut { format, layout } = laid_out;
        match format {
            Format::Csv => CsvRows::new(reader, required, layout, rules.image_size).map(Self::Csv),
            Format::Ndjson => Ok(Self::Lines(Lines::new(reader))),
            Format::Json => Elements::new(reader, "samples").map(Self::Elements),
            Format::GeoJson => Err(Error::refused(
                ErrorKind::UnsupportedMediaType,
                "GeoJSON is not read, only written; send CSV, NDJSON or JSON",
            )),
        }
    }

    fn next_row<T>(
        &mut self,
        convert: impl FnOnce(FileRow<'_>) -> Result<T>,
    ) -> Option<Result<Result<T, RowError>>> {
        match self {
            Self::Csv(rows) => rows.next_row(convert),
            Self::Lines(lines) => loop {
                match lines.next_line() {
                    Err(error) => return Some(Err(Error::fault(error))),
                    Ok(None) => return None,
                    Ok(Some((_, Line::Text(text)))) if text.trim().is_empty() => {}
                    Ok(Some((line, text))) => return Some(json_row(line, &text, convert)),
                }
            },
            Self::Elements(elements) => match elements.next_element()? {
                Err(error) => Some(Err(error)),
                Ok((line, text)) => Some(json_row(line, &text, convert)),
            },
        }
    }
}

fn json_row<T>(
    line: u64,
    text: &Line<'_>,
    convert: impl FnOnce(FileRow<'_>) -> Result<T>,
) -> Result<Result<T, RowError>> {
    let text = match text {
        Line::Text(text) => text,
        Line::NotUtf8 => return Ok(Err(RowError::whole(line, "is not UTF-8"))),
        Line::TooLong => return Ok(Err(RowError::whole(line, "is longer than 64 KiB"))),
    };
    match wire::parse_json(text.as_bytes()).and_then(convert) {
        Ok(value) => Ok(Ok(value)),
        Err(error) => RowError::of(line, error).map(Err),
    }
}
