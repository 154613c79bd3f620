//! Histories of tracks as OGC Moving Features JSON (OGC 19-045r3, MF-JSON Prism), which is also GeoJSON.

use std::sync::Arc;

use jiff::Timestamp;
use serde::Serialize;
use utoipa::ToSchema;

use crate::app::TrackPoint;

/// Moving features as one collection.
#[derive(Serialize, ToSchema)]
pub(super) struct MovingFeatures {
    /// `FeatureCollection`.
    #[schema(example = "FeatureCollection")]
    r#type: &'static str,
    /// One per target.
    features: Vec<MovingFeature>,
}

/// A target with the positions that it was at.
#[derive(Serialize, ToSchema)]
struct MovingFeature {
    /// `Feature`.
    #[schema(example = "Feature")]
    r#type: &'static str,
    /// The target's id.
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
    /// The target's id.
    properties: TargetProperties,
}

/// The geometry of a path.
#[derive(Serialize, ToSchema)]
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
#[derive(Serialize, ToSchema)]
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
#[derive(Serialize, ToSchema)]
struct TemporalProperties {
    /// The instants of the values.
    #[schema(value_type = Vec<String>)]
    datetimes: Vec<Timestamp>,
    /// Radius about the position that holds the true one with 95 % probability.
    r95_m: Measure,
}

/// A number that changes with time.
#[derive(Serialize, ToSchema)]
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

/// Properties that do not change.
#[derive(Serialize, ToSchema)]
struct TargetProperties {
    /// The target's id.
    target_id: String,
}

impl MovingFeatures {
    /// The features of histories, each oldest first and of one target.
    pub(super) fn of<'a>(histories: impl Iterator<Item = &'a [Arc<TrackPoint>]>) -> Self {
        Self { r#type: "FeatureCollection", features: histories.filter_map(MovingFeature::of).collect() }
    }
}

impl MovingFeature {
    fn of(history: &[Arc<TrackPoint>]) -> Option<Self> {
        let (first, last) = (history.first()?, history.last()?);
        let rounded = |degrees: f64| (degrees * 1e7).round() / 1e7;
        let coordinates: Vec<[f64; 2]> = history
            .iter()
            .map(|point| [rounded(point.position.longitude_deg()), rounded(point.position.latitude_deg())])
            .collect();
        let datetimes: Vec<Timestamp> = history.iter().map(|point| point.state.time).collect();
        let geometry = match coordinates[..] {
            [coordinates] => Path::Point { coordinates },
            _ => Path::LineString { coordinates: coordinates.clone() },
        };
        let r95_m = Measure {
            r#type: "Measure",
            form: "MTR",
            values: history.iter().map(|point| point.state.r95_m).collect(),
            interpolation: "Linear",
        };
        Some(Self {
            r#type: "Feature",
            id: last.target_id.to_string(),
            geometry,
            temporal_properties: [TemporalProperties { datetimes: datetimes.clone(), r95_m }],
            temporal_geometry: TemporalGeometry {
                r#type: "MovingPoint",
                datetimes,
                coordinates,
                interpolation: "Linear",
            },
            time: vec![first.state.time, last.state.time],
            properties: TargetProperties { target_id: last.target_id.to_string() },
        })
    }
}
