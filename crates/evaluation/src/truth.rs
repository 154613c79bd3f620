//! The error of a position against the truth: a column of the test file, a fixed point, or lines.
//!
//! Distances between points are geodesic (Karney 2013). The distance to a line is taken in the local
//! plane whose origin is the position itself, where the projection error vanishes.

use geojson::{GeoJson, Geometry, GeometryValue};

use crate::domain::{Error, Result, Truth};
use crate::geo::{EastNorth, LocalPlane, Position, distance_m};

/// The lines of a GeoJSON document as the truth: every LineString in it, at any depth.
///
/// # Errors
/// Names `truth_line` for text that is not GeoJSON or contains no line of two positions.
pub fn truth_from_geojson(text: &str) -> Result<Truth> {
    let wrong = |message: String| Error::invalid("truth_line", message);
    let document: GeoJson = text.parse().map_err(|error| wrong(format!("is not GeoJSON: {error}")))?;
    let mut lines = Vec::new();
    match &document {
        GeoJson::Geometry(geometry) => collect_lines(geometry, &mut lines)?,
        GeoJson::Feature(feature) => {
            feature.geometry.iter().try_for_each(|one| collect_lines(one, &mut lines))?
        }
        GeoJson::FeatureCollection(all) => {
            let geometries = all.features.iter().filter_map(|feature| feature.geometry.as_ref());
            geometries.into_iter().try_for_each(|one| collect_lines(one, &mut lines))?;
        }
    }
    if lines.is_empty() {
        return Err(wrong("must hold a LineString of at least two positions".to_owned()));
    }
    Ok(Truth::Lines(lines))
}

/// Horizontal error of a position, m, if the truth is known; `row` is the truth that the row states.
pub(crate) fn error_m(truth: &Truth, row: Option<Position>, position: Position) -> Option<f64> {
    match truth {
        Truth::Columns => row.map(|truth| distance_m(truth, position)),
        Truth::Point(point) => Some(distance_m(*point, position)),
        Truth::Lines(lines) => Some(distance_to_lines_m(lines, position)),
    }
}

fn collect_lines(geometry: &Geometry, lines: &mut Vec<Vec<Position>>) -> Result<()> {
    let mut line = |coordinates: &[geojson::Position]| -> Result<()> {
        let position = |pair: &geojson::Position| match pair.as_slice() {
            [longitude_deg, latitude_deg, ..] => Position::new(*longitude_deg, *latitude_deg)
                .map_err(|error| Error::invalid("truth_line", error.to_string())),
            _ => Err(Error::invalid("truth_line", "has a position without two numbers")),
        };
        let positions: Vec<Position> = coordinates.iter().map(position).collect::<Result<_>>()?;
        if positions.len() >= 2 {
            lines.push(positions);
        }
        Ok(())
    };
    match &geometry.value {
        GeometryValue::LineString { coordinates } => line(coordinates),
        GeometryValue::MultiLineString { coordinates } => coordinates.iter().try_for_each(|one| line(one)),
        GeometryValue::GeometryCollection { geometries } => {
            geometries.iter().try_for_each(|one| collect_lines(one, lines))
        }
        _ => Ok(()),
    }
}

fn distance_to_lines_m(lines: &[Vec<Position>], position: Position) -> f64 {
    let plane = LocalPlane::new(position);
    let mut nearest_m = f64::INFINITY;
    for line in lines {
        let points: Vec<EastNorth> = line.iter().map(|&point| plane.to_plane(point)).collect();
        for pair in points.windows(2) {
            nearest_m = nearest_m.min(distance_of_origin_m(pair[0], pair[1]));
        }
    }
    nearest_m
}

/// Distance from the plane's origin to a line segment, m.
fn distance_of_origin_m(from: EastNorth, to: EastNorth) -> f64 {
    let (east_m, north_m) = (to.east_m - from.east_m, to.north_m - from.north_m);
    let length_m2 = east_m * east_m + north_m * north_m;
    let part = if length_m2 > 0.0 {
        (-(from.east_m * east_m + from.north_m * north_m) / length_m2).clamp(0.0, 1.0)
    } else {
        0.0
    };
    (from.east_m + part * east_m).hypot(from.north_m + part * north_m)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const LINE: &str = r#"{"type": "FeatureCollection", "features": [{"type": "Feature", "properties": {},
        "geometry": {"type": "LineString", "coordinates": [[8.0, 47.0], [8.001, 47.0], [8.001, 47.001]]}}]}"#;

    #[test]
    fn a_line_is_read_and_its_distance_is_geodesic() {
        let truth = truth_from_geojson(LINE).expect("a line");
        let at = |longitude, latitude| Position::new(longitude, latitude).expect("valid");
        let beside = at(8.0005, 47.0001);
        let expected_m = distance_m(beside, at(8.0005, 47.0));
        let stated_m = error_m(&truth, None, beside).expect("known");
        assert!((stated_m - expected_m).abs() < 1e-3, "{stated_m} {expected_m}");
        // Beyond the end it is the distance to the end.
        let beyond = at(7.999, 47.0);
        let stated_m = error_m(&truth, None, beyond).expect("known");
        assert!((stated_m - distance_m(beyond, at(8.0, 47.0))).abs() < 1e-3, "{stated_m}");
    }

    #[test]
    fn documents_without_a_line_are_refused() {
        for text in [
            "",
            "{}",
            r#"{"type": "Point", "coordinates": [8.0, 47.0]}"#,
            r#"{"type": "LineString", "coordinates": [[8.0, 47.0]]}"#,
            r#"{"type": "LineString", "coordinates": [[8.0, 97.0], [8.0, 47.0]]}"#,
        ] {
            assert!(truth_from_geojson(text).is_err(), "{text}");
        }
    }

    proptest! {
        #[test]
        fn the_line_is_never_farther_than_its_points(
            longitude in 7.99..8.01f64, latitude in 46.99..47.01f64,
        ) {
            let Truth::Lines(lines) = truth_from_geojson(LINE).expect("a line") else { unreachable!() };
            let position = Position::new(longitude, latitude).expect("valid");
            let to_points_m = lines[0].iter().map(|&point| distance_m(point, position))
                .fold(f64::INFINITY, f64::min);
            let to_lines_m = error_m(&Truth::Lines(lines), None, position).expect("known");
            prop_assert!(to_lines_m <= to_points_m + 1e-3, "{to_lines_m} {to_points_m}");
        }
    }
}
