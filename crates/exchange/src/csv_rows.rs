//! Rows of a CSV file.
//!
//! Read line by line, unlike the csv crate: no column contains line breaks, so an unclosed quote
//! invalidates its own row and not the rest of the file, and memory is bounded.

use std::io::Read;

use jiff::tz::TimeZone;

use super::columns::{
    CLASS, COUNT, HEIGHT, LATITUDE, LEFT, LONGITUDE, OF_SAMPLES, RECEIVER_ID, SCORE, SIGMA, TARGET_ID, TIME,
    TOP, TRACKER_ID, TRUTH_LATITUDE, TRUTH_LONGITUDE, WIDTH,
};
use super::csv_header::Header;
use super::csv_layout::{BoxForm, CsvLayout};
use super::file_row::{FileRow, RowError};
use super::formula_guard::unguarded;
use super::lines::{Line, Lines};
use super::unix_time::unix_time;
use super::wire::{self, Text};
use crate::domain::{Error, ErrorKind, ImageSize, Result, parse_time_in};

/// Reads a CSV file's rows.
pub(super) struct CsvRows<R> {
    lines: Lines<R>,
    header: Box<Header>,
    fields: FieldSplitter,
    values: ValueRules,
}

/// How the cells of a file are read.
struct ValueRules {
    is_documented: bool,
    has_decimal_comma: bool,
    box_form: BoxForm,
    /// The factors of the sides of boxes, in x and y.
    scale_px: [f64; 2],
    timezone: Option<TimeZone>,
}

impl<R: Read> CsvRows<R> {
    /// # Errors
    /// Refuses a file without a header, or with missing, duplicated or unknown columns.
    pub(super) fn new(
        reader: R,
        required: &[usize],
        layout: &CsvLayout,
        image_size: Option<ImageSize>,
    ) -> Result<Self> {
        let scale_px = layout.scale_px(image_size)?;
        Self::with_columns(reader, required, OF_SAMPLES, layout, scale_px)
    }

    /// Rows of a file of fixes or live items, which may have a receiver column.
    ///
    /// # Errors
    /// As [`CsvRows::new`].
    pub(super) fn with_receivers(reader: R, required: &[usize], layout: &CsvLayout) -> Result<Self> {
        Self::with_columns(reader, required, COUNT, layout, [1.0, 1.0])
    }

    fn with_columns(
        reader: R,
        required: &[usize],
        known: usize,
        layout: &CsvLayout,
        scale_px: [f64; 2],
    ) -> Result<Self> {
        let mut lines = Lines::new(reader);
        let mut fields = FieldSplitter::default();
        let header = loop {
            match lines.next_line().map_err(Error::fault)? {
                Some((_, Line::Text(text))) if text.trim().is_empty() => {}
                Some((_, Line::Text(text))) => {
                    fields.separator = layout.separator(text);
                    let split = fields.split(text).map_err(|reason| malformed(&reason))?;
                    break Box::new(Header::read(split, required, known, layout)?);
                }
                Some((_, Line::NotUtf8)) => return Err(malformed("the header is not UTF-8")),
                Some((_, Line::TooLong)) => return Err(malformed("the header is longer than 64 KiB")),
                None => return Err(malformed("the file is empty; the first line must name the columns")),
            }
        };
        let name = |index| header.has(index).then(|| header.name(index).to_owned());
        let values = ValueRules {
            is_documented: layout.is_documented(),
            has_decimal_comma: fields.separator != ',',
            box_form: layout.form(name),
            scale_px,
            timezone: layout.timezone.clone(),
        };
        Ok(Self { lines, header, fields, values })
    }

    /// Number of the latest line, from 1.
    pub(super) const fn line(&self) -> u64 {
        self.lines.number()
    }

    /// Converts the next row that is not blank.
    pub(super) fn next_row<T>(
        &mut self,
        convert: impl FnOnce(FileRow<'_>) -> Result<T>,
    ) -> Option<Result<Result<T, RowError>>> {
        loop {
            let (line, text) = match self.lines.next_line() {
                Err(error) => return Some(Err(Error::fault(error))),
                Ok(None) => return None,
                Ok(Some((_, Line::Text(text)))) if text.trim().is_empty() => continue,
                Ok(Some((line, Line::Text(text)))) => (line, text),
                Ok(Some((line, Line::NotUtf8))) => {
                    return Some(Ok(Err(RowError::whole(line, "is not UTF-8"))));
                }
                Ok(Some((line, Line::TooLong))) => {
                    return Some(Ok(Err(RowError::whole(line, "is longer than 64 KiB"))));
                }
            };
            let (header, values) = (&self.header, &self.values);
            let row = self.fields.split(text).map_err(CsvRowError::Row).and_then(|fields| {
                let cells = CsvCells::of(header, values, fields)?;
                let row = cells.row().map_err(|(index, reason)| CsvRowError::Column(index, reason))?;
                convert(row).map_err(CsvRowError::Value)
            });
            return Some(match row {
                Ok(value) => Ok(Ok(value)),
                Err(CsvRowError::Row(reason)) => Ok(Err(RowError::whole(line, &reason))),
                Err(CsvRowError::Column(index, reason)) => {
                    Ok(Err(RowError { line, field: header.name(index).to_owned(), reason }))
                }
                Err(CsvRowError::Value(error)) => RowError::of(line, error).map(|mut row_error| {
                    row_error.field = header.name_of_path(&row_error.field).to_owned();
                    Err(row_error)
                }),
            });
        }
    }
}

/// Why a row is invalid.
enum CsvRowError {
    /// The row as a whole.
    Row(String),
    /// One column, by its index in [`super::columns::COLUMNS`].
    Column(usize, String),
    /// A value that a domain constructor refuses.
    Value(Error),
}

fn malformed(reason: &str) -> Error {
    Error::refused(ErrorKind::MalformedBody, reason)
}

/// The cells of one line in the order of the known columns.
struct CsvCells<'a> {
    cells: [&'a str; COUNT],
    values: &'a ValueRules,
}

type CellResult<T> = std::result::Result<T, (usize, String)>;

impl<'a> CsvCells<'a> {
    fn of(
        header: &Header,
        values: &'a ValueRules,
        fields: impl Iterator<Item = &'a str>,
    ) -> Result<Self, CsvRowError> {
        let mut cells = [""; COUNT];
        let mut count = 0;
        for field in fields {
            if let Some(index) = header.field_at(count) {
                cells[index] = field.trim();
            }
            count += 1;
        }
        if count != header.width() {
            let width = header.width();
            return Err(CsvRowError::Row(format!("has {count} fields where the header names {width}")));
        }
        Ok(Self { cells, values })
    }

    fn row(&self) -> CellResult<FileRow<'a>> {
        Ok(FileRow {
            time: self.time()?,
            target_id: self.name(TARGET_ID),
            bounding_box: self.numbers([LEFT, TOP, WIDTH, HEIGHT])?.map(|columns| {
                let ValueRules { box_form, scale_px, .. } = self.values;
                let [left_px, top_px, width_px, height_px] =
                    box_form.left_top_width_height(columns, *scale_px);
                wire::BoundingBox { left_px, top_px, width_px, height_px }
            }),
            fix: self.fix()?,
            class: self.name(CLASS),
            score: self.number(SCORE)?,
            truth: self
                .numbers([TRUTH_LONGITUDE, TRUTH_LATITUDE])?
                .map(|[longitude_deg, latitude_deg]| wire::Position { longitude_deg, latitude_deg }),
            tracker_id: self.name(TRACKER_ID),
            _match_probability: None,
            receiver_id: self.name(RECEIVER_ID),
        })
    }

    fn fix(&self) -> CellResult<Option<wire::Fix>> {
        let sigma_m = self.number(SIGMA)?;
        let degrees = self.numbers([LONGITUDE, LATITUDE])?;
        Ok(degrees.map(|[longitude_deg, latitude_deg]| wire::Fix { longitude_deg, latitude_deg, sigma_m }))
    }

    fn time(&self) -> CellResult<Option<Text<'a>>> {
        let cell = self.cells[TIME];
        let is_unix = !self.values.is_documented
            && cell.starts_with(|first: char| first.is_ascii_digit())
            && cell.bytes().all(|byte| byte.is_ascii_digit() || b".,".contains(&byte));
        if is_unix {
            let value = self.number(TIME)?.unwrap_or_default();
            let time = unix_time(value).map_err(|reason| (TIME, reason))?;
            return Ok(Some(Text::from(time.to_string())));
        }
        match &self.values.timezone {
            Some(zone) if !cell.is_empty() => {
                let time = parse_time_in(cell, zone).map_err(|error| {
                    (TIME, RowError::of(0, error).map_or_else(|fault| fault.to_string(), |row| row.reason))
                })?;
                Ok(Some(Text::from(time.to_string())))
            }
            _ => Ok((!cell.is_empty()).then(|| Text::from(cell))),
        }
    }

    /// A name, without the guard that keeps spreadsheets from running it as a formula.
    fn name(&self, index: usize) -> Option<Text<'a>> {
        let cell = unguarded(self.cells[index]);
        (!cell.is_empty()).then(|| Text::from(cell))
    }

    fn number(&self, index: usize) -> CellResult<Option<f64>> {
        let cell = self.cells[index];
        if cell.is_empty() {
            return Ok(None);
        }
        let parsed = match cell.split_once(',') {
            Some((whole, part)) if self.values.has_decimal_comma => format!("{whole}.{part}").parse(),
            _ => cell.parse(),
        };
        parsed.map(Some).map_err(|_| {
            let shown: String = cell.chars().take(40).collect();
            (index, format!("must be a number, not `{shown}`"))
        })
    }

    /// The numbers of a group: `None` if all cells are empty, an error if some are.
    fn numbers<const N: usize>(&self, indexes: [usize; N]) -> CellResult<Option<[f64; N]>> {
        let mut numbers = [0.0; N];
        let mut missing = None;
        let mut given = 0;
        for (number, index) in numbers.iter_mut().zip(indexes) {
            match self.number(index)? {
                Some(value) => {
                    *number = value;
                    given += 1;
                }
                None => missing = Some(index),
            }
        }
        match missing {
            None => Ok(Some(numbers)),
            Some(_) if given == 0 => Ok(None),
            Some(index) => Err((index, "is empty, but other values of its group are given".to_owned())),
        }
    }
}

/// The fields of one line, as in RFC 4180 but without line breaks within quotes.
struct FieldSplitter {
    separator: char,
    /// Text of the fields without quotes.
    unquoted: String,
    /// Range of every field in `unquoted`.
    spans: Vec<(usize, usize)>,
}

impl Default for FieldSplitter {
    fn default() -> Self {
        Self { separator: ',', unquoted: String::new(), spans: Vec::new() }
    }
}

/// Fields borrowed from the line, or from the unquoted text.
enum SplitFields<'a> {
    Plain(std::str::Split<'a, char>),
    Quoted(&'a str, std::slice::Iter<'a, (usize, usize)>),
}

impl<'a> Iterator for SplitFields<'a> {
    type Item = &'a str;

    fn next(&mut self) -> Option<&'a str> {
        match self {
            Self::Plain(fields) => fields.next(),
            Self::Quoted(text, spans) => spans.next().map(|&(begin, end)| &text[begin..end]),
        }
    }
}

impl FieldSplitter {
    fn split<'a>(&'a mut self, line: &'a str) -> Result<SplitFields<'a>, String> {
        if !line.contains('"') {
            return Ok(SplitFields::Plain(line.split(self.separator)));
        }
        self.unquoted.clear();
        self.spans.clear();
        let mut rest = Some(line);
        while let Some(text) = rest {
            let begin = self.unquoted.len();
            rest = self.take_field(text)?;
            self.spans.push((begin, self.unquoted.len()));
        }
        Ok(SplitFields::Quoted(&self.unquoted, self.spans.iter()))
    }

    /// Appends the first field of the text; returns the rest after the separator.
    fn take_field<'a>(&mut self, text: &'a str) -> Result<Option<&'a str>, String> {
        let Some(mut quoted) = text.strip_prefix('"') else {
            let (field, rest) =
                text.split_once(self.separator).map_or((text, None), |(field, rest)| (field, Some(rest)));
            self.unquoted.push_str(field);
            return Ok(rest);
        };
        loop {
            let (part, after) = quoted
                .split_once('"')
                .ok_or("has an unclosed quote; a field cannot continue on the next line")?;
            self.unquoted.push_str(part);
            if let Some(after) = after.strip_prefix('"') {
                self.unquoted.push('"');
                quoted = after;
            } else if after.is_empty() {
                return Ok(None);
            } else {
                let rest = after.strip_prefix(self.separator).ok_or("has text after a closing quote")?;
                return Ok(Some(rest));
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn fields_written_by_the_csv_crate_are_read(
            fields in prop::collection::vec("[a-z0-9 \",;'é]{0,8}", 2..8)
        ) {
            let mut writer = csv::Writer::from_writer(Vec::new());
            writer.write_record(&fields).expect("memory");
            let line = String::from_utf8(writer.into_inner().expect("memory")).expect("UTF-8");
            let mut splitter = FieldSplitter::default();
            let split: Vec<&str> = splitter.split(line.trim_end_matches('\n')).expect("well formed").collect();
            prop_assert_eq!(split, fields);
        }
    }
}
