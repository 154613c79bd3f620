//! Rows of sample and observation files.

use std::io::Read;

use super::columns::{HEIGHT, LATITUDE, LEFT, LONGITUDE, TARGET_ID, TIME};
use super::csv_rows::CsvRows;
use super::elements::Elements;
use super::file_row::{FileRow, RowError, shared};
use super::format::Format;
use super::lines::{Line, Lines};
use super::wire::{self, box_within};
use crate::domain::{
    Detection, Error, ErrorKind, ImageSize, Observation, Result, Sample, Score, TargetClass, TargetId,
    TimeBounds, parse_time,
};
use crate::geo::Position;

/// What a row is held against.
#[derive(Debug, Clone, Copy)]
pub struct RowRules {
    /// Believable instants.
    pub time_bounds: TimeBounds,
    /// The camera's image, if it is known: boxes outside of it are refused.
    pub image_size: Option<ImageSize>,
}

/// A row of a file to be fused or evaluated.
#[derive(Debug, Clone, PartialEq)]
pub struct ObservedRow {
    /// What was seen and received.
    pub observation: Observation,
    /// What the detector takes the target for.
    pub class: Option<TargetClass>,
    /// How sure the detector is.
    pub score: Option<Score>,
    /// Where the target truly was.
    pub truth: Option<Position>,
}

/// Rows of a sample file, one by one, in the file's order.
///
/// CSV has the columns `time`, `target_id`, `left`, `top`, `width`, `height`, `longitude`,
/// `latitude` in any order, also with their units (`left_px`, `longitude_deg`), and at will
/// `sigma_m`, `class`, `score`, `truth_longitude` and `truth_latitude`. NDJSON has a [`wire::Sample`]
/// a line; JSON is an array of them, or an object `{"samples": [...]}`.
///
/// # Errors
/// Outside: a file that cannot be read at all (no header, a column missing or unknown, not JSON, a
/// format that is only written). As an item: a file that breaks off, after which nothing follows.
/// Within an item: the fault of that row alone.
pub fn read_samples<R: Read>(
    reader: R,
    format: Format,
    rules: &RowRules,
) -> Result<impl Iterator<Item = Result<Result<Sample, RowError>>> + use<R>> {
    let required = [TIME, TARGET_ID, LEFT, LEFT + 1, LEFT + 2, HEIGHT, LONGITUDE, LATITUDE];
    let mut rows = Rows::new(reader, format, &required)?;
    let mut reading = Reading::new(*rules);
    Ok(std::iter::from_fn(move || rows.next_row(|row| reading.sample(&row))))
}

/// The same with target, box, fix and class all optional: what `sightfix fuse` and evaluation read.
/// A row may hold a box, a fix, or both.
///
/// # Errors
/// As [`read_samples`].
pub fn read_observations<R: Read>(
    reader: R,
    format: Format,
    rules: &RowRules,
) -> Result<impl Iterator<Item = Result<Result<ObservedRow, RowError>>> + use<R>> {
    let mut rows = Rows::new(reader, format, &[TIME])?;
    let mut reading = Reading::new(*rules);
    Ok(std::iter::from_fn(move || rows.next_row(|row| reading.observed(&row))))
}

/// Detections of a file, one by one: rows as those of [`read_samples`] without a fix. A `target_id`
/// that is left out is the given one. What else a row holds is passed over.
///
/// # Errors
/// As [`read_samples`].
pub fn read_detections<R: Read>(
    reader: R,
    format: Format,
    rules: &RowRules,
    target_id: Option<TargetId>,
) -> Result<impl Iterator<Item = Result<Result<Detection, RowError>>> + use<R>> {
    let required = [TIME, LEFT, LEFT + 1, LEFT + 2, HEIGHT];
    let mut rows = Rows::new(reader, format, &required)?;
    let mut reading = Reading::new(*rules);
    Ok(std::iter::from_fn(move || rows.next_row(|row| reading.detection(&row, target_id.as_ref()))))
}

/// Turns rows into values. Neighbouring rows mostly have the same target and class, so these are
/// shared and not made anew.
struct Reading {
    rules: RowRules,
    target_id: Option<TargetId>,
    class: Option<TargetClass>,
}

impl Reading {
    const fn new(rules: RowRules) -> Self {
        Self { rules, target_id: None, class: None }
    }

    fn sample(&mut self, row: &FileRow<'_>) -> Result<Sample> {
        let ObservedRow { observation, class, score, truth } = self.observed(row)?;
        let Observation { time, target_id, bounding_box, fix } = observation;
        Ok(Sample {
            time,
            target_id: target_id.ok_or_else(|| missing("target_id"))?,
            bounding_box: bounding_box.ok_or_else(|| missing("bounding_box"))?,
            fix: fix.ok_or_else(|| missing("fix"))?,
            class,
            score,
            truth,
        })
    }

    fn detection(&mut self, row: &FileRow<'_>, unnamed: Option<&TargetId>) -> Result<Detection> {
        let ObservedRow { observation, class, score, .. } = self.observed(row)?;
        let target_id = observation.target_id.or_else(|| unnamed.cloned());
        Ok(Detection {
            time: observation.time,
            target_id: target_id.ok_or_else(|| missing("target_id"))?,
            bounding_box: observation.bounding_box.ok_or_else(|| missing("bounding_box"))?,
            class,
            score,
        })
    }

    fn observed(&mut self, row: &FileRow<'_>) -> Result<ObservedRow> {
        let time = parse_time(row.time.as_ref().ok_or_else(|| missing("time"))?.as_str())?;
        let observation = Observation {
            time: self.rules.time_bounds.check(time)?,
            target_id: shared(row.target_id.as_ref(), &mut self.target_id, TargetId::as_str, TargetId::new)?,
            bounding_box: row
                .bounding_box
                .map(|sides| box_within(sides, self.rules.image_size))
                .transpose()?,
            fix: row.fix.map(|fix| fix.to_domain().map_err(|error| error.under("fix"))).transpose()?,
        };
        if observation.bounding_box.is_none() && observation.fix.is_none() {
            return Err(Error::invalid("", "has neither a box nor a fix"));
        }
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

/// The rows of any format.
enum Rows<R> {
    Csv(CsvRows<R>),
    Lines(Lines<R>),
    Elements(Elements<R>),
}

impl<R: Read> Rows<R> {
    fn new(reader: R, format: Format, required: &[usize]) -> Result<Self> {
        match format {
            Format::Csv => CsvRows::new(reader, required).map(Self::Csv),
            Format::Ndjson => Ok(Self::Lines(Lines::new(reader))),
            Format::Json => Elements::new(reader, "samples").map(Self::Elements),
            Format::GeoJson => Err(Error::refused(
                ErrorKind::UnsupportedMediaType,
                "GeoJSON is written, not read; send CSV, NDJSON or JSON",
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
                    Err(broken) => return Some(Err(Error::fault(broken))),
                    Ok(None) => return None,
                    Ok(Some((_, Line::Text(text)))) if text.trim().is_empty() => {}
                    Ok(Some((line, text))) => return Some(json_row(line, &text, convert)),
                }
            },
            Self::Elements(elements) => match elements.next_element()? {
                Err(broken) => Some(Err(broken)),
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
