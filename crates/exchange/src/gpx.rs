//! Fixes of a GPX file: track points, route points and waypoints.
//!
//! Read as a stream of XML events in bounded memory: a tag or text has at most 64 KiB, and elements are
//! nested at most 64 deep. Entities are not expanded and nothing is fetched.

use std::io::{self, Read};

use quick_xml::Reader;
use quick_xml::events::{BytesStart, Event};

use super::file_row::RowError;
use super::fix_quality::Solution;
use super::fix_row::FixRow;
use super::wire;
use super::xml::BoundedReader;
use crate::domain::{Error, ErrorKind, Fix, Result, SigmaM, TimeBounds, parse_time};

/// Largest nesting depth of elements.
const MAX_DEPTH: usize = 64;
/// Largest text of a child of a point, bytes.
const MAX_TEXT_BYTES: usize = 64;

/// Reads a GPX file's points.
pub(super) struct GpxFixes<R> {
    reader: Reader<BoundedReader<R>>,
    buffer: Vec<u8>,
    time_bounds: TimeBounds,
    /// Number of open elements.
    depth: usize,
    /// The open point.
    point: Option<OpenPoint>,
    has_root: bool,
    has_ended: bool,
}

struct OpenPoint {
    line: u64,
    /// Depth of its parent.
    depth: usize,
    fix: std::result::Result<Fix, RowError>,
    /// Texts of its children.
    texts: [Option<String>; Child::COUNT],
    /// The child that is open.
    child: Option<Child>,
}

/// A child of a point that is read.
#[derive(Clone, Copy)]
enum Child {
    Time,
    /// Kind of solution.
    Fix,
    Hdop,
}

impl Child {
    const COUNT: usize = 3;

    fn named(name: &str) -> Option<Self> {
        Some(match name {
            "time" => Self::Time,
            "fix" => Self::Fix,
            "hdop" => Self::Hdop,
            _ => return None,
        })
    }
}

/// An XML event as far as it concerns points.
enum PointEvent {
    Open { point: Option<OpenPoint>, child: Option<Child>, is_gpx: bool, is_empty: bool },
    Close,
    Text(String),
    Other,
    End,
}

impl<R: Read> GpxFixes<R> {
    pub(super) fn new(reader: R, time_bounds: TimeBounds) -> Self {
        Self {
            reader: Reader::from_reader(BoundedReader::new(reader)),
            buffer: Vec::new(),
            time_bounds,
            depth: 0,
            point: None,
            has_root: false,
            has_ended: false,
        }
    }

    pub(super) fn next_row(&mut self) -> Option<Result<Result<FixRow, RowError>>> {
        while !self.has_ended {
            match self.next_event().and_then(|event| self.handle(event)) {
                Ok(None) => {}
                Ok(Some(row)) => return Some(Ok(row)),
                Err(error) => {
                    self.has_ended = true;
                    return Some(Err(error));
                }
            }
        }
        None
    }

    fn next_event(&mut self) -> Result<PointEvent> {
        self.buffer.clear();
        self.reader.get_mut().begin_event();
        let in_child = self.point.as_ref().is_some_and(|point| point.child.is_some());
        let event = self.reader.read_event_into(&mut self.buffer);
        Ok(match event {
            Ok(Event::Start(tag)) => opened(&tag, self.reader.get_ref().line(), self.depth, false),
            Ok(Event::Empty(tag)) => opened(&tag, self.reader.get_ref().line(), self.depth, true),
            Ok(Event::End(_)) => PointEvent::Close,
            Ok(Event::Text(text)) if in_child => PointEvent::Text(text.to_string()),
            Ok(Event::Eof) => PointEvent::End,
            Ok(_) => PointEvent::Other,
            Err(quick_xml::Error::Io(error)) if error.kind() != io::ErrorKind::InvalidInput => {
                return Err(Error::fault(error));
            }
            Err(error) => return Err(self.malformed(&format!("not XML: {error}"))),
        })
    }

    fn handle(&mut self, event: PointEvent) -> Result<Option<std::result::Result<FixRow, RowError>>> {
        match event {
            PointEvent::Open { point, child, is_gpx, is_empty } => {
                if !self.has_root && !is_gpx {
                    return Err(self.malformed("not GPX: the first element must be `gpx`"));
                }
                self.has_root = true;
                if let Some(open) = &mut self.point {
                    // The child of the point itself, not of one of its extensions.
                    if self.depth == open.depth + 1 && !is_empty {
                        open.child = child;
                        if let Some(child) = child {
                            open.texts[child as usize].get_or_insert_default();
                        }
                    }
                } else {
                    self.point = point;
                }
                self.depth += 1;
                if self.depth > MAX_DEPTH {
                    return Err(self.malformed("elements are nested more than 64 deep"));
                }
                if is_empty {
                    return Ok(self.close());
                }
            }
            PointEvent::Close => return Ok(self.close()),
            PointEvent::Text(text) => {
                if let Some(known) = self.point.as_mut().and_then(OpenPoint::open_text)
                    && known.len() + text.len() <= MAX_TEXT_BYTES
                {
                    known.push_str(&text);
                }
            }
            PointEvent::Other => {}
            PointEvent::End if self.depth == 0 && self.has_root => self.has_ended = true,
            PointEvent::End => {
                return Err(self.malformed("the file ends before its root element is complete"));
            }
        }
        Ok(None)
    }

    fn close(&mut self) -> Option<std::result::Result<FixRow, RowError>> {
        self.depth = self.depth.saturating_sub(1);
        let depth = self.depth;
        if let Some(open) = &mut self.point {
            open.child = None;
        }
        let point = self.point.take_if(|point| point.depth == depth)?;
        Some(point.row(&self.time_bounds))
    }

    fn malformed(&self, reason: &str) -> Error {
        let line = self.reader.get_ref().line();
        Error::refused(ErrorKind::MalformedBody, format!("line {line}: {reason}"))
    }
}

impl OpenPoint {
    fn open_text(&mut self) -> Option<&mut String> {
        self.texts[self.child? as usize].as_mut()
    }

    fn text(&self, child: Child) -> Option<&str> {
        self.texts[child as usize].as_deref().map(str::trim)
    }

    /// By the kind of solution and the dilution of precision; `None` where the point has neither.
    fn sigma(&self) -> Option<SigmaM> {
        let hdop = self.text(Child::Hdop).and_then(|text| text.parse().ok());
        let solution = match self.text(Child::Fix) {
            Some("dgps") => Solution::Differential,
            Some("pps") => Solution::Precise,
            Some("2d" | "3d") => Solution::Autonomous,
            _ => hdop.map(|_| Solution::Autonomous)?,
        };
        solution.sigma(hdop)
    }

    fn row(self, time_bounds: &TimeBounds) -> std::result::Result<FixRow, RowError> {
        let time = self.text(Child::Time).map(parse_time).transpose();
        let sigma_m = self.sigma();
        let fix = Fix { sigma_m, ..self.fix? };
        let invalid = |_| RowError {
            line: self.line,
            field: "time".to_owned(),
            reason: "must be RFC 3339 with an offset, such as 2020-12-14T06:41:48Z".to_owned(),
        };
        FixRow::checked(self.line, time.map_err(invalid)?, None, fix, time_bounds)
    }
}

fn opened(tag: &BytesStart<'_>, line: u64, depth: usize, is_empty: bool) -> PointEvent {
    let name = tag.local_name().into_inner();
    let is_point = matches!(name, "trkpt" | "rtept" | "wpt");
    let point = is_point.then(|| OpenPoint {
        line,
        depth,
        fix: fix_of(tag, line),
        texts: [const { None }; 3],
        child: None,
    });
    PointEvent::Open { point, child: Child::named(name), is_gpx: name == "gpx", is_empty }
}

fn fix_of(tag: &BytesStart<'_>, line: u64) -> std::result::Result<Fix, RowError> {
    let error =
        |field: &str, reason: &str| RowError { line, field: field.to_owned(), reason: reason.to_owned() };
    let degrees = |name: &str| {
        let attribute = tag.try_get_attribute(name).ok().flatten();
        let attribute = attribute.ok_or_else(|| error(name, "is required"))?;
        attribute.value.trim().parse().map_err(|_| error(name, "must be a number of degrees"))
    };
    let fix = wire::Fix { longitude_deg: degrees("lon")?, latitude_deg: degrees("lat")?, sigma_m: None };
    fix.to_domain().map_err(|cause| {
        let is_latitude = cause.to_string().starts_with("latitude");
        error(if is_latitude { "lat" } else { "lon" }, &cause.to_string())
    })
}
