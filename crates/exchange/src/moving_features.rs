//! Paths of targets as OGC Moving Features JSON (OGC 19-045r3, MF-JSON Prism), which is also GeoJSON.

use std::collections::BTreeMap;
use std::io::{self, Write};

use jiff::Timestamp;
use serde::Serialize;
use utoipa::ToSchema;

use super::format::Format;
use super::write::PositionDocument;
use crate::domain::{ArchivedPosition, TRACK_GAP, TargetClass};
use crate::geo::Position;

/// Positions that wait for the end of their tracks; beyond, paths are written in pieces.
const MOST_WAITING: usize = 100_000;

/// Moving features as one collection.
#[derive(Debug, Serialize, ToSchema)]
pub struct MovingFeatures {
    /// `FeatureCollection`.
    #[schema(example = "FeatureCollection")]
    r#type: &'static str,
    /// One per target.
    features: Vec<MovingFeature>,
}

/// A target with the positions that it was at.
#[derive(Debug, Serialize, ToSchema)]
pub struct MovingFeature {
    /// `Feature`.
    #[schema(example = "Feature")]
    r#type: &'static str,
    /// The target's id, or that of the track.
    id: String,
    /// The path, for readers that know GeoJSON alone.
    geometry: Path,
    /// Where it was when.
    #[serde(rename = "temporalGeometry")]
    temporal_geometry: TemporalGeometry,
    /// The error of the positions.
    #[serde(rename = "temporalProperties")]
    temporal_properties: [TemporalProperties; 1],
    /// First and last instant.
    #[schema(value_type = Vec<String>)]
    time: Vec<Timestamp>,
    /// The properties that do not change.
    properties: MovingTarget,
}

/// The geometry of a path.
#[derive(Debug, Serialize, ToSchema)]
#[serde(tag = "type")]
enum Path {
    /// One position.
    Point {
        /// Longitude and latitude in degrees, WGS 84.
        coordinates: [f64; 2],
    },
    /// Several.
    LineString {
        /// Longitudes and latitudes in degrees, WGS 84.
        coordinates: Vec<[f64; 2]>,
    },
}

/// Where a target was when; it moved straight in between.
#[derive(Debug, Serialize, ToSchema)]
struct TemporalGeometry {
    /// `MovingPoint`.
    #[schema(example = "MovingPoint")]
    r#type: &'static str,
    /// The instants of the positions.
    #[schema(value_type = Vec<String>)]
    datetimes: Vec<Timestamp>,
    /// Longitudes and latitudes in degrees, WGS 84.
    coordinates: Vec<[f64; 2]>,
    /// `Linear`.
    #[schema(example = "Linear")]
    interpolation: &'static str,
}

/// Properties that change with time.
#[derive(Debug, Serialize, ToSchema)]
struct TemporalProperties {
    /// The instants of the values.
    #[schema(value_type = Vec<String>)]
    datetimes: Vec<Timestamp>,
    /// Radius about the position that holds the true one with 95 % probability.
    r95_m: Measure,
}

/// A number that changes with time.
#[derive(Debug, Serialize, ToSchema)]
struct Measure {
    /// `Measure`.
    #[schema(example = "Measure")]
    r#type: &'static str,
    /// Its unit by UN/CEFACT recommendation 20.
    #[schema(value_type = String, example = "MTR")]
    form: &'static str,
    /// One per instant.
    values: Vec<f64>,
    /// `Linear`.
    #[schema(example = "Linear")]
    interpolation: &'static str,
}

/// Properties of a moving feature that do not change.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, ToSchema)]
pub struct MovingTarget {
    /// The target's id, if it is known.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub target_id: Option<String>,
    /// The track, for a finished one.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub track_id: Option<String>,
    /// Class reported by a detector, for a finished track.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub class: Option<String>,
}

/// Where a target was at an instant.
#[derive(Debug, Clone, Copy)]
pub struct PathPoint {
    /// The instant.
    pub time: Timestamp,
    /// The target's position.
    pub position: Position,
    /// Radius about the position that holds the true one with 95 % probability.
    pub r95_m: f64,
}

impl MovingFeatures {
    /// The collection of some features.
    #[must_use]
    pub fn of(features: impl Iterator<Item = MovingFeature>) -> Self {
        Self { r#type: "FeatureCollection", features: features.collect() }
    }
}

impl MovingFeature {
    /// The feature of a path, oldest point first; `None` without points.
    #[must_use]
    pub fn new(id: String, properties: MovingTarget, path: &[PathPoint]) -> Option<Self> {
        let (first, last) = (path.first()?, path.last()?);
        let rounded = |degrees: f64| (degrees * 1e7).round() / 1e7;
        let coordinates: Vec<[f64; 2]> = path
            .iter()
            .map(|point| [rounded(point.position.longitude_deg()), rounded(point.position.latitude_deg())])
            .collect();
        let datetimes: Vec<Timestamp> = path.iter().map(|point| point.time).collect();
        let geometry = match coordinates[..] {
            [coordinates] => Path::Point { coordinates },
            _ => Path::LineString { coordinates: coordinates.clone() },
        };
        let r95_m = Measure {
            r#type: "Measure",
            form: "MTR",
            values: path.iter().map(|point| point.r95_m).collect(),
            interpolation: "Linear",
        };
        Some(Self {
            r#type: "Feature",
            id,
            geometry,
            temporal_properties: [TemporalProperties { datetimes: datetimes.clone(), r95_m }],
            temporal_geometry: TemporalGeometry {
                r#type: "MovingPoint",
                datetimes,
                coordinates,
                interpolation: "Linear",
            },
            time: vec![first.time, last.time],
            properties,
        })
    }
}

/// Writes positions of finished tracks, which come in order of time, as one feature per track. A path that would take
/// too much memory until its track ends is written in several features, one after the other.
pub(super) struct MovingFeaturesWriter<W> {
    pub(super) document: PositionDocument<W>,
    paths: BTreeMap<String, WaitingPath>,
    waiting: usize,
}

#[derive(Default)]
struct WaitingPath {
    target: MovingTarget,
    points: Vec<PathPoint>,
}

impl<W: Write> MovingFeaturesWriter<W> {
    pub(super) const fn new(out: W) -> Self {
        let document = PositionDocument::new(out, Format::GeoJson, "features");
        Self { document, paths: BTreeMap::new(), waiting: 0 }
    }

    pub(super) fn write(&mut self, row: &ArchivedPosition) -> io::Result<()> {
        let path = self.paths.entry(row.track.clone()).or_default();
        path.target.target_id = row.target.as_ref().map(ToString::to_string).or(path.target.target_id.take());
        path.target.class =
            row.class.as_ref().map(TargetClass::to_string).or_else(|| path.target.class.take());
        let r95_m = row.covariance_m2.r95_m();
        path.points.push(PathPoint { time: row.time, position: row.position, r95_m });
        self.waiting += 1;
        if self.waiting < MOST_WAITING {
            return Ok(());
        }
        let has_ended = |path: &WaitingPath| {
            path.points.last().is_none_or(|last| row.time.duration_since(last.time) >= TRACK_GAP)
        };
        self.write_paths(has_ended)?;
        if self.waiting > MOST_WAITING / 2 { self.write_paths(|_| true) } else { Ok(()) }
    }

    pub(super) fn finish(mut self) -> io::Result<W> {
        self.write_paths(|_| true)?;
        self.document.finish(|_| Ok(()))
    }

    fn write_paths(&mut self, is_chosen: impl Fn(&WaitingPath) -> bool) -> io::Result<()> {
        let (chosen, waiting): (BTreeMap<_, _>, BTreeMap<_, _>) =
            std::mem::take(&mut self.paths).into_iter().partition(|(_, path)| is_chosen(path));
        self.paths = waiting;
        self.waiting = self.paths.values().map(|path| path.points.len()).sum();
        for (track, WaitingPath { target, points }) in chosen {
            let target = MovingTarget { track_id: Some(track.clone()), ..target };
            if let Some(feature) = MovingFeature::new(track, target, &points) {
                self.document.json_row(&feature)?;
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::domain::{Motion, Velocity};
    use crate::geo::PlaneCovariance;

    /// A position of a track at a second.
    fn row(track: &str, second: i64) -> ArchivedPosition {
        let covariance_m2 = PlaneCovariance::isotropic(1.0);
        ArchivedPosition {
            time: Timestamp::from_second(second).expect("in range"),
            track: track.to_owned(),
            target: None,
            class: None,
            position: Position::new(8.0, 47.0).expect("valid"),
            covariance_m2,
            motion: Motion::of(Velocity { east_m_s: 1.0, north_m_s: 0.0 }, covariance_m2, 0.0),
            acceleration: None,
        }
    }

    #[test]
    fn a_track_that_has_ended_is_one_feature_and_memory_is_bounded() {
        let mut writer = MovingFeaturesWriter::new(Vec::new());
        let seconds = 3 * MOST_WAITING as i64;
        for second in 0..seconds {
            if second < 10 {
                writer.write(&row("short", second)).expect("written");
            }
            writer.write(&row("long", second)).expect("written");
            assert!(writer.waiting < MOST_WAITING);
        }
        let document = writer.finish().expect("written");
        let document: serde_json::Value = serde_json::from_slice(&document).expect("JSON");
        let features = document["features"].as_array().expect("features");
        let points = |track: &str| -> Vec<usize> {
            let of_track = features.iter().filter(|it| it["id"] == track);
            of_track.filter_map(|it| it["temporalGeometry"]["datetimes"].as_array().map(Vec::len)).collect()
        };
        assert_eq!(points("short"), [10]);
        assert_eq!(points("long").iter().sum::<usize>(), 3 * MOST_WAITING);
        assert!(points("long").len() <= 4, "{:?}", points("long"));
    }
}
