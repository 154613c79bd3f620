//! Files of tracks: GPX 1.1 and KML 2.2 with the track extension of Google's, which GDAL and Google Earth read.
//!
//! A file is held in memory and written whole, so that it is complete whenever it is read.

use std::collections::BTreeMap;
use std::fmt::Write as _;

use jiff::Timestamp;
use serde::Deserialize;

use super::outgoing::escaped;

/// Format of a file of tracks.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TrackFileFormat {
    /// One `trk` per target.
    Gpx,
    /// One `Placemark` with a `gx:Track` per target.
    Kml,
}

impl TrackFileFormat {
    /// The ending of its files.
    #[must_use]
    pub const fn ending(self) -> &'static str {
        match self {
            Self::Gpx => "gpx",
            Self::Kml => "kml",
        }
    }
}

/// A position as [`super::position_json`] writes it, as far as it goes into a file.
#[derive(Debug, Deserialize)]
struct RecordedPosition {
    camera_id: String,
    target_id: String,
    time: Timestamp,
    position: RecordedPlace,
}

#[derive(Debug, Clone, Copy, Deserialize)]
struct RecordedPlace {
    longitude_deg: f64,
    latitude_deg: f64,
}

/// The tracks of one file.
#[derive(Debug)]
pub struct TrackFile {
    format: TrackFileFormat,
    /// By camera and target; in the order in which they came.
    tracks: BTreeMap<(String, String), Vec<(Timestamp, RecordedPlace)>>,
    points: usize,
}

impl TrackFile {
    /// A file without points.
    #[must_use]
    pub const fn new(format: TrackFileFormat) -> Self {
        Self { format, tracks: BTreeMap::new(), points: 0 }
    }

    /// Points of all tracks.
    #[must_use]
    pub const fn points(&self) -> usize {
        self.points
    }

    /// Adds a position, given as the JSON of [`super::position_json`].
    ///
    /// # Errors
    /// Why it cannot be read.
    pub fn push(&mut self, position: &[u8]) -> Result<(), String> {
        let recorded: RecordedPosition =
            serde_json::from_slice(position).map_err(|error| format!("is no position: {error}"))?;
        let RecordedPosition { camera_id, target_id, time, position } = recorded;
        self.tracks.entry((camera_id, target_id)).or_default().push((time, position));
        self.points += 1;
        Ok(())
    }

    /// The content of the file.
    #[must_use]
    pub fn to_text(&self) -> String {
        let mut text = "<?xml version=\"1.0\" encoding=\"UTF-8\"?>\n".to_owned();
        // Writing to a text cannot fail.
        let _ = match self.format {
            TrackFileFormat::Gpx => self.write_gpx(&mut text),
            TrackFileFormat::Kml => self.write_kml(&mut text),
        };
        text
    }

    fn write_gpx(&self, text: &mut String) -> std::fmt::Result {
        text.push_str(
            "<gpx version=\"1.1\" creator=\"sightfix\" xmlns=\"http://www.topografix.com/GPX/1/1\">\n",
        );
        for ((camera, target), points) in &self.tracks {
            let (camera, target) = (escaped(camera), escaped(target));
            writeln!(text, "<trk><name>{target}</name><src>{camera}</src><trkseg>")?;
            for (time, RecordedPlace { longitude_deg, latitude_deg }) in points {
                writeln!(
                    text,
                    "<trkpt lat=\"{latitude_deg:.7}\" lon=\"{longitude_deg:.7}\"><time>{time:.3}</time></trkpt>"
                )?;
            }
            text.push_str("</trkseg></trk>\n");
        }
        text.push_str("</gpx>\n");
        Ok(())
    }

    fn write_kml(&self, text: &mut String) -> std::fmt::Result {
        text.push_str(
            "<kml xmlns=\"http://www.opengis.net/kml/2.2\" xmlns:gx=\"http://www.google.com/kml/ext/2.2\"><Document>\n",
        );
        for ((camera, target), points) in &self.tracks {
            let (camera, target) = (escaped(camera), escaped(target));
            writeln!(text, "<Placemark><name>{target}</name><description>{camera}</description><gx:Track>")?;
            for (time, _) in points {
                writeln!(text, "<when>{time:.3}</when>")?;
            }
            for (_, RecordedPlace { longitude_deg, latitude_deg }) in points {
                writeln!(text, "<gx:coord>{longitude_deg:.7} {latitude_deg:.7} 0</gx:coord>")?;
            }
            text.push_str("</gx:Track></Placemark>\n");
        }
        text.push_str("</Document></kml>\n");
        Ok(())
    }
}
