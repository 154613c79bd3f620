//! Fixes of a GPX file: its track, route and way points.
//!
//! Read as a stream of XML events in bounded memory: no tag or text is longer than 64 KiB and no
//! element lies deeper than 64. Entities are not expanded and nothing is fetched.

use std::io::{self, BufRead, BufReader, Read};

use quick_xml::Reader;
use quick_xml::events::{BytesStart, Event};

use super::LONGEST_ROW_BYTES;
use super::file_row::RowError;
use super::fix_row::FixRow;
use super::wire;
use crate::domain::{Error, ErrorKind, Fix, Result, TimeBounds, parse_time};

/// Elements within elements.
const DEEPEST: usize = 64;
/// Longest text of a time.
const LONGEST_TIME_BYTES: usize = 64;

/// Reads a GPX file's points.
pub(super) struct GpxFixes<R> {
    reader: Reader<Counted<R>>,
    buffer: Vec<u8>,
    time_bounds: TimeBounds,
    /// Elements that are open.
    depth: usize,
    /// The point that is open.
    point: Option<Point>,
    begun: bool,
    ended: bool,
}

struct Point {
    line: u64,
    /// Elements open around it.
    depth: usize,
    fix: std::result::Result<Fix, RowError>,
    /// Text of its `time`, if it has one.
    time: Option<String>,
    in_time: bool,
}

/// What an event means for the points.
enum Step {
    Open { point: Option<Point>, is_time: bool, is_gpx: bool, is_empty: bool },
    Close,
    Text(String),
    Other,
    End,
}

impl<R: Read> GpxFixes<R> {
    pub(super) fn new(reader: R, time_bounds: TimeBounds) -> Self {
        let source = Counted { reader: BufReader::new(reader), line: 1, since: 0 };
        Self {
            reader: Reader::from_reader(source),
            buffer: Vec::new(),
            time_bounds,
            depth: 0,
            point: None,
            begun: false,
            ended: false,
        }
    }

    pub(super) fn next_row(&mut self) -> Option<Result<Result<FixRow, RowError>>> {
        while !self.ended {
            match self.step().and_then(|step| self.take(step)) {
                Ok(None) => {}
                Ok(Some(row)) => return Some(Ok(row)),
                Err(broken) => {
                    self.ended = true;
                    return Some(Err(broken));
                }
            }
        }
        None
    }

    fn step(&mut self) -> Result<Step> {
        self.buffer.clear();
        self.reader.get_mut().since = 0;
        let in_time = self.point.as_ref().is_some_and(|point| point.in_time);
        let event = self.reader.read_event_into(&mut self.buffer);
        // Text and names borrow the buffer, so the line is taken where nothing else is borrowed.
        Ok(match event {
            Ok(Event::Start(tag)) => opened(&tag, self.reader.get_ref().line, self.depth, false),
            Ok(Event::Empty(tag)) => opened(&tag, self.reader.get_ref().line, self.depth, true),
            Ok(Event::End(_)) => Step::Close,
            Ok(Event::Text(text)) if in_time => Step::Text(text.to_string()),
            Ok(Event::Eof) => Step::End,
            Ok(_) => Step::Other,
            Err(quick_xml::Error::Io(error)) if error.kind() != io::ErrorKind::InvalidInput => {
                return Err(Error::fault(error));
            }
            Err(error) => return Err(self.malformed(&format!("not XML: {error}"))),
        })
    }

    fn take(&mut self, step: Step) -> Result<Option<std::result::Result<FixRow, RowError>>> {
        match step {
            Step::Open { point, is_time, is_gpx, is_empty } => {
                if !self.begun && !is_gpx {
                    return Err(self.malformed("not GPX: the first element must be `gpx`"));
                }
                self.begun = true;
                if let Some(open) = &mut self.point {
                    // A time that is the point's own, not one of its extensions'.
                    if is_time && self.depth == open.depth + 1 && !is_empty {
                        open.in_time = true;
                        open.time.get_or_insert_default();
                    }
                } else {
                    self.point = point;
                }
                self.depth += 1;
                if self.depth > DEEPEST {
                    return Err(self.malformed("elements lie more than 64 deep"));
                }
                if is_empty {
                    return Ok(self.close());
                }
            }
            Step::Close => return Ok(self.close()),
            Step::Text(text) => {
                if let Some(time) = self.point.as_mut().and_then(|point| point.time.as_mut())
                    && time.len() + text.len() <= LONGEST_TIME_BYTES
                {
                    time.push_str(&text);
                }
            }
            Step::Other => {}
            Step::End if self.depth == 0 && self.begun => self.ended = true,
            Step::End => return Err(self.malformed("the file ends before its elements do")),
        }
        Ok(None)
    }

    fn close(&mut self) -> Option<std::result::Result<FixRow, RowError>> {
        self.depth = self.depth.saturating_sub(1);
        let depth = self.depth;
        if let Some(open) = &mut self.point {
            open.in_time = false;
        }
        let point = self.point.take_if(|point| point.depth == depth)?;
        Some(point.row(&self.time_bounds))
    }

    fn malformed(&self, reason: &str) -> Error {
        let line = self.reader.get_ref().line;
        Error::refused(ErrorKind::MalformedBody, format!("line {line}: {reason}"))
    }
}

impl Point {
    fn row(self, time_bounds: &TimeBounds) -> std::result::Result<FixRow, RowError> {
        let fix = self.fix?;
        let time = self.time.as_deref().map(|text| parse_time(text.trim())).transpose();
        let at_fault = |_| RowError {
            line: self.line,
            field: "time".to_owned(),
            reason: "must be RFC 3339 with an offset, such as 2020-12-14T06:41:48Z".to_owned(),
        };
        FixRow::checked(self.line, time.map_err(at_fault)?, None, fix, time_bounds)
    }
}

fn opened(tag: &BytesStart<'_>, line: u64, depth: usize, is_empty: bool) -> Step {
    let name = tag.local_name().into_inner();
    let is_point = matches!(name, "trkpt" | "rtept" | "wpt");
    let point = is_point.then(|| Point { line, depth, fix: place(tag, line), time: None, in_time: false });
    Step::Open { point, is_time: name == "time", is_gpx: name == "gpx", is_empty }
}

fn place(tag: &BytesStart<'_>, line: u64) -> std::result::Result<Fix, RowError> {
    let fault =
        |field: &str, reason: &str| RowError { line, field: field.to_owned(), reason: reason.to_owned() };
    let degrees = |name: &str| {
        let attribute = tag.try_get_attribute(name).ok().flatten();
        let attribute = attribute.ok_or_else(|| fault(name, "is required"))?;
        attribute.value.trim().parse().map_err(|_| fault(name, "must be a number of degrees"))
    };
    let place = wire::Fix { longitude_deg: degrees("lon")?, latitude_deg: degrees("lat")?, sigma_m: None };
    place.to_domain().map_err(|error| {
        let is_latitude = error.to_string().starts_with("latitude");
        fault(if is_latitude { "lat" } else { "lon" }, &error.to_string())
    })
}

/// Counts lines, and refuses to go on within one event for longer than a row may be.
struct Counted<R> {
    reader: BufReader<R>,
    line: u64,
    /// Bytes taken since the last event.
    since: usize,
}

impl<R: Read> Read for Counted<R> {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let taken = self.fill_buf()?.read(buffer)?;
        self.consume(taken);
        Ok(taken)
    }
}

impl<R: Read> BufRead for Counted<R> {
    fn fill_buf(&mut self) -> io::Result<&[u8]> {
        if self.since > LONGEST_ROW_BYTES {
            let reason = "a tag or text is longer than 64 KiB";
            return Err(io::Error::new(io::ErrorKind::InvalidInput, reason));
        }
        self.reader.fill_buf()
    }

    fn consume(&mut self, taken: usize) {
        let lines = self.reader.buffer().iter().take(taken).filter(|&&byte| byte == b'\n').count();
        self.line += lines as u64;
        self.since += taken;
        self.reader.consume(taken);
    }
}
