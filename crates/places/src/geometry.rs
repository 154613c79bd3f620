//! The geometry of a place as GeoJSON.

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

/// A geometry of GeoJSON (RFC 7946): coordinates are longitude and latitude in degrees.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(tag = "type", content = "coordinates")]
pub enum Geometry {
    /// An area: an outer ring and holes, each closed, with 3 to 512 corners in all.
    #[schema(example = json!([[[8.54, 47.37], [8.541, 47.37], [8.541, 47.371], [8.54, 47.37]]]))]
    Polygon(Vec<Vec<[f64; 2]>>),
    /// A line that targets cross, of 2 to 512 points. Its direction says which side is its left one.
    #[schema(example = json!([[8.54, 47.37], [8.541, 47.37]]))]
    LineString(Vec<[f64; 2]>),
    /// The centre of a disc with the radius `radius_m`.
    #[schema(example = json!([8.54, 47.37]))]
    Point([f64; 2]),
}
