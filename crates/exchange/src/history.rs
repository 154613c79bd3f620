//! Files of positions of finished tracks: CSV, NDJSON, GeoJSON, Moving Features JSON and lines of the MOTChallenge.

use std::io::{self, Write};

use super::format::Format;
use super::mot::{MotFrames, MotWriter};
use super::moving_features::MovingFeaturesWriter;
use super::wire::{HistoryPosition, Position};
use super::write::{Feature, PositionDocument, cell, degrees, text_cell};
use crate::domain::{ArchivedPosition, TrackScope};

const COLUMNS: &str = "time,camera_id,site_id,track_id,target_id,class,longitude,latitude,covariance_east_m2,\
                       covariance_north_m2,covariance_east_north_m2,speed_mps,speed_low_mps,speed_high_mps,\
                       course_deg,course_low_deg,course_high_deg,stationary_probability,acceleration_east_mps2,\
                       acceleration_north_mps2,acceleration_covariance_east_m2_s4,\
                       acceleration_covariance_north_m2_s4,acceleration_covariance_east_north_m2_s4";

/// The format of a file of positions of finished tracks.
#[derive(Debug, Clone, PartialEq)]
pub enum HistoryFormat {
    /// A row per position.
    Rows(Format),
    /// A feature per track, as OGC Moving Features JSON.
    MovingFeatures,
    /// A line per frame and track, as the MOTChallenge has them.
    Mot(MotFrames),
}

impl HistoryFormat {
    /// The media type in responses.
    #[must_use]
    pub const fn media_type(&self) -> &'static str {
        match self {
            Self::Rows(format) => format.media_type(),
            Self::MovingFeatures => Format::GeoJson.media_type(),
            Self::Mot(_) => "text/plain",
        }
    }

    /// The ending of its files.
    #[must_use]
    pub const fn ending(&self) -> &'static str {
        match self {
            Self::Rows(Format::Csv) => "csv",
            Self::Rows(Format::Ndjson) => "ndjson",
            Self::Rows(Format::Json) => "json",
            Self::Rows(Format::GeoJson) => "geojson",
            Self::MovingFeatures => "mfjson",
            Self::Mot(_) => "txt",
        }
    }
}

/// Writes positions of finished tracks one by one, in order of time. Between two of them the output can be drained
/// (`get_mut`), so a file of any length needs bounded memory.
pub struct HistoryWriter<W: Write> {
    scope: TrackScope,
    content: Content<W>,
}

enum Content<W> {
    Rows(PositionDocument<W>),
    MovingFeatures(MovingFeaturesWriter<W>),
    Mot(MotWriter<W>),
}

impl<W: Write> HistoryWriter<W> {
    /// A writer of the tracks of a camera or site. Nothing is written yet.
    pub fn new(out: W, scope: TrackScope, format: HistoryFormat) -> Self {
        let content = match format {
            HistoryFormat::Rows(format) => Content::Rows(PositionDocument::new(out, format, "items")),
            HistoryFormat::MovingFeatures => Content::MovingFeatures(MovingFeaturesWriter::new(out)),
            HistoryFormat::Mot(frames) => Content::Mot(MotWriter::new(out, frames)),
        };
        Self { scope, content }
    }

    /// Writes one position.
    ///
    /// # Errors
    /// An I/O error of the output.
    pub fn write(&mut self, row: &ArchivedPosition) -> io::Result<()> {
        match &mut self.content {
            Content::Rows(document) => write_row(document, &HistoryPosition::of(&self.scope, row)),
            Content::MovingFeatures(writer) => writer.write(row),
            Content::Mot(writer) => writer.write(row),
        }
    }

    /// The output, to drain it.
    pub const fn get_mut(&mut self) -> &mut W {
        match &mut self.content {
            Content::Rows(document) => &mut document.out,
            Content::MovingFeatures(writer) => &mut writer.document.out,
            Content::Mot(writer) => &mut writer.out,
        }
    }

    /// Completes the document and returns the output.
    ///
    /// # Errors
    /// An I/O error of the output.
    pub fn finish(self) -> io::Result<W> {
        match self.content {
            Content::Rows(document) => document.finish(header),
            Content::MovingFeatures(writer) => writer.finish(),
            Content::Mot(writer) => Ok(writer.out),
        }
    }
}

fn write_row<W: Write>(document: &mut PositionDocument<W>, row: &HistoryPosition<'_>) -> io::Result<()> {
    match document.format {
        Format::Csv => document.csv_row(header, |out| cells(out, row)),
        Format::Ndjson | Format::Json => document.json_row(row),
        Format::GeoJson => document.json_row(&Feature::new(Some(row.position), row)),
    }
}

fn header<W: Write>(out: &mut W) -> io::Result<()> {
    writeln!(out, "{COLUMNS}")
}

fn cells<W: Write>(out: &mut W, row: &HistoryPosition<'_>) -> io::Result<()> {
    write!(out, "{},", row.time)?;
    for text in [row.camera_id, row.site_id, Some(row.track_id), row.target_id, row.class] {
        cell(out, text.map(text_cell))?;
    }
    let Position { longitude_deg, latitude_deg } = row.position;
    degrees(out, Some(Position { longitude_deg, latitude_deg }))?;
    let covariance = row.covariance;
    for number in [covariance.east_m2, covariance.north_m2, covariance.east_north_m2] {
        cell(out, Some(number))?;
    }
    let motion = row.motion;
    let [low_mps, high_mps] = motion.speed_interval_mps;
    for number in [motion.speed_mps, low_mps, high_mps] {
        cell(out, Some(number))?;
    }
    let [low_deg, high_deg] = motion.course_interval_deg.map_or([None; 2], |ends| ends.map(Some));
    for number in [motion.course_deg, low_deg, high_deg] {
        cell(out, number)?;
    }
    write!(out, "{}", motion.stationary_probability)?;
    let acceleration = row.acceleration.map_or([None; 5], |it| it.numbers().map(Some));
    for number in acceleration {
        write!(out, ",")?;
        number.map_or(Ok(()), |number| write!(out, "{number}"))?;
    }
    writeln!(out)
}
