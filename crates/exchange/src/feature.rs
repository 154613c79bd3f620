//! Features of a GeoJSON collection (RFC 7946) as rows.

use serde::Deserialize;

use super::file_row::FileRow;
use super::wire::{self, Text};
use crate::domain::{Error, Result};

/// A collection; members that the format does not know are ignored, as it demands.
#[derive(Deserialize)]
pub(super) struct FeatureCollection<'a> {
    #[serde(borrow)]
    r#type: Text<'a>,
    #[serde(borrow)]
    features: Vec<Feature<'a>>,
}

impl<'a> FeatureCollection<'a> {
    /// # Errors
    /// `InvalidArgument` for another object of GeoJSON.
    pub(super) fn into_features(self) -> Result<Vec<Feature<'a>>> {
        match self.r#type.as_str() {
            "FeatureCollection" => Ok(self.features),
            _ => Err(Error::invalid("type", "must be FeatureCollection")),
        }
    }
}

/// A feature: its point is the fix of the row that its properties make up.
#[derive(Deserialize)]
pub(super) struct Feature<'a> {
    #[serde(borrow)]
    r#type: Text<'a>,
    #[serde(borrow, default)]
    geometry: Option<Point<'a>>,
    #[serde(borrow)]
    properties: Properties<'a>,
}

#[derive(Deserialize)]
struct Point<'a> {
    #[serde(borrow)]
    r#type: Text<'a>,
    /// Longitude and latitude in degrees; an altitude is ignored.
    coordinates: Vec<f64>,
}

/// The fields of a row; the fix may also be given by the geometry and this standard deviation.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Properties<'a> {
    #[serde(borrow)]
    time: Option<Text<'a>>,
    #[serde(borrow)]
    target_id: Option<Text<'a>>,
    bounding_box: Option<wire::BoundingBox>,
    fix: Option<wire::Fix>,
    sigma_m: Option<f64>,
    #[serde(borrow)]
    class: Option<Text<'a>>,
    score: Option<f64>,
    truth: Option<wire::Position>,
}

impl<'a> Feature<'a> {
    /// # Errors
    /// `InvalidArgument` for what is no feature, or a geometry that is no point.
    pub(super) fn into_row(self) -> Result<FileRow<'a>> {
        if self.r#type.as_str() != "Feature" {
            return Err(Error::invalid("type", "must be Feature"));
        }
        let Properties { time, target_id, bounding_box, fix, sigma_m, class, score, truth } = self.properties;
        let at_point = self.geometry.map(|point| point.to_fix(sigma_m)).transpose()?;
        let fix = fix.or(at_point);
        Ok(FileRow {
            time,
            target_id,
            bounding_box,
            fix,
            class,
            score,
            truth,
            tracker_id: None,
            _match_probability: None,
            receiver_id: None,
        })
    }
}

impl Point<'_> {
    fn to_fix(&self, sigma_m: Option<f64>) -> Result<wire::Fix> {
        match (self.r#type.as_str(), self.coordinates.as_slice()) {
            ("Point", &[longitude_deg, latitude_deg] | &[longitude_deg, latitude_deg, _]) => {
                Ok(wire::Fix { longitude_deg, latitude_deg, sigma_m })
            }
            _ => Err(Error::invalid("geometry", "must be null or a Point with [longitude, latitude]")),
        }
    }
}
