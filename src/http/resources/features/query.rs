//! The query of a collection: a box, a time, a number.

use std::fmt::Write as _;

use jiff::{SignedDuration, Timestamp};

use super::links::segment;
use crate::domain::{Error, Result, parse_time};
use crate::geo::Position;
use crate::http::plumbing::extract::Params;

/// Features on a page whose length the client leaves open.
const PAGE_ITEMS: u32 = 100;
/// Largest `limit` that is taken, that of the int32 which the description names.
const MOST_ASKED: u32 = i32::MAX.unsigned_abs();
/// Samples are stored to the microsecond, so the instant after one is this much later.
const RESOLUTION: SignedDuration = SignedDuration::from_micros(1);

/// Which features are asked for.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Selection {
    pub(super) area: Option<Area>,
    pub(super) interval: Interval,
    pub(super) limit: u32,
    /// The parameters as they came, for the link to the next page.
    given: Vec<(&'static str, String)>,
}

impl Selection {
    /// # Errors
    /// `InvalidArgument` naming the parameter.
    pub(super) fn take(params: &mut Params, most: u32) -> Result<Self> {
        let mut given = Vec::new();
        let mut text = |params: &mut Params, name: &'static str| {
            let text = params.take(name, |text| Ok(text.to_owned()))?;
            given.extend(text.clone().map(|text| (name, text)));
            Ok::<_, Error>(text)
        };
        let area = text(params, "bbox")?.map(|text| Area::parse(&text)).transpose()?;
        let interval = text(params, "datetime")?.map(|text| Interval::parse(&text)).transpose()?;
        let limit = text(params, "limit")?.map(|text| {
            let limit = text.parse::<u32>().ok().filter(|limit| (1..=MOST_ASKED).contains(limit));
            limit.ok_or_else(|| {
                Error::invalid("limit", format!("must be a whole number from 1 to {MOST_ASKED}"))
            })
        });
        let limit = limit.transpose()?.unwrap_or(PAGE_ITEMS);
        Ok(Self { area, interval: interval.unwrap_or_default(), limit: limit.min(most), given })
    }

    /// The query of the next page.
    pub(super) fn to_query(&self, cursor: &str) -> String {
        let mut query = String::new();
        for (name, text) in &self.given {
            let _ = write!(query, "{name}={}&", segment(text));
        }
        query + "cursor=" + &segment(cursor)
    }
}

/// An area between two meridians and two parallels.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Area {
    west_deg: f64,
    south_deg: f64,
    east_deg: f64,
    north_deg: f64,
}

impl Area {
    fn parse(text: &str) -> Result<Self> {
        let invalid = || {
            let message = "must be west,south,east,north in degrees, south not above north (or six numbers, with heights)";
            Error::invalid("bbox", message)
        };
        let numbers =
            text.split(',').map(|number| number.trim().parse().ok().filter(|it: &f64| it.is_finite()));
        let numbers: Vec<f64> = numbers.collect::<Option<_>>().ok_or_else(invalid)?;
        let [west_deg, south_deg, east_deg, north_deg] = match numbers[..] {
            [west, south, east, north] | [west, south, _, east, north, _] => [west, south, east, north],
            _ => return Err(invalid()),
        };
        let is_valid = [west_deg, east_deg].iter().all(|it| (-180.0..=180.0).contains(it))
            && -90.0 <= south_deg
            && south_deg <= north_deg
            && north_deg <= 90.0;
        if is_valid { Ok(Self { west_deg, south_deg, east_deg, north_deg }) } else { Err(invalid()) }
    }

    /// True if a point is in the area, borders included.
    pub(super) fn contains(&self, point: Position) -> bool {
        let longitude_deg = point.longitude_deg();
        let is_between = if self.west_deg <= self.east_deg {
            (self.west_deg..=self.east_deg).contains(&longitude_deg)
        } else {
            longitude_deg >= self.west_deg || longitude_deg <= self.east_deg
        };
        is_between && (self.south_deg..=self.north_deg).contains(&point.latitude_deg())
    }

    /// True if a convex polygon shares a point with the area (separating axes: the sides of both).
    pub(super) fn intersects(&self, corners: &[Position]) -> bool {
        self.rectangles().iter().any(|rectangle| {
            let polygon: Vec<[f64; 2]> =
                corners.iter().map(|corner| [corner.longitude_deg(), corner.latitude_deg()]).collect();
            !is_separated(&polygon, rectangle) && !is_separated(rectangle, &polygon)
        })
    }

    /// One rectangle, or the two on either side of the antimeridian, counterclockwise.
    fn rectangles(&self) -> Vec<[[f64; 2]; 4]> {
        let Self { west_deg, south_deg, east_deg, north_deg } = *self;
        let rectangle =
            |west, east| [[west, south_deg], [east, south_deg], [east, north_deg], [west, north_deg]];
        if west_deg <= east_deg {
            vec![rectangle(west_deg, east_deg)]
        } else {
            vec![rectangle(west_deg, 180.0), rectangle(-180.0, east_deg)]
        }
    }
}

/// True if a side of `one`, counterclockwise, has all of `other` beyond it.
fn is_separated(one: &[[f64; 2]], other: &[[f64; 2]]) -> bool {
    let next = one.iter().cycle().skip(1);
    one.iter().zip(next).any(|(from, to)| {
        let normal = [to[1] - from[1], from[0] - to[0]];
        normal != [0.0; 2]
            && other
                .iter()
                .all(|point| (point[0] - from[0]) * normal[0] + (point[1] - from[1]) * normal[1] > 0.0)
    })
}

/// A closed interval of time; an end that is `None` is open.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(super) struct Interval {
    from: Option<Timestamp>,
    to: Option<Timestamp>,
}

impl Interval {
    fn parse(text: &str) -> Result<Self> {
        // A plus sign that was not escaped arrives as a space.
        let instant = |text: &str| match text {
            "" | ".." => Ok(None),
            text => parse_time(&text.replace(' ', "+")).map(Some).map_err(|error| error.at("datetime")),
        };
        let interval = match text.split_once('/') {
            Some((from, to)) => Self { from: instant(from)?, to: instant(to)? },
            None => Self { from: instant(text)?, to: instant(text)? },
        };
        let is_empty = text.is_empty() || text == "..";
        let is_backward = matches!((interval.from, interval.to), (Some(from), Some(to)) if from > to);
        if is_empty || is_backward {
            return Err(Error::invalid(
                "datetime",
                "must be an instant, or begin/end with begin not after end",
            ));
        }
        Ok(interval)
    }

    /// True if an instant is in the interval, ends included.
    pub(super) fn contains(self, time: Timestamp) -> bool {
        self.from.is_none_or(|from| from <= time) && self.to.is_none_or(|to| time <= to)
    }

    /// First instant within.
    pub(super) const fn from(self) -> Option<Timestamp> {
        self.from
    }

    /// First instant after it.
    pub(super) fn until(self) -> Option<Timestamp> {
        self.to.map(|to| to.saturating_add(RESOLUTION).unwrap_or(Timestamp::MAX))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(longitude_deg: f64, latitude_deg: f64) -> Position {
        Position::new(longitude_deg, latitude_deg).expect("a position")
    }

    #[test]
    fn an_area_may_cross_the_antimeridian() {
        let pacific = Area::parse("170,-10,-170,10").expect("an area");
        assert!(pacific.contains(at(175.0, 0.0)) && pacific.contains(at(-175.0, 0.0)));
        assert!(!pacific.contains(at(0.0, 0.0)) && !pacific.contains(at(175.0, 11.0)));
        assert_eq!(Area::parse("170,-10,0,-170,10,99").expect("with heights"), pacific);
    }

    #[test]
    fn a_polygon_that_only_comes_near_does_not_intersect() {
        let area = Area::parse("0,0,1,1").expect("an area");
        let triangle = [at(1.5, 0.9), at(1.5, 1.5), at(0.9, 1.5)];
        assert!(!area.intersects(&triangle), "their bounding rectangles do");
        assert!(area.intersects(&[at(1.5, 0.2), at(1.5, 1.5), at(0.2, 1.5)]));
        assert!(area.intersects(&[at(-9.0, -9.0), at(9.0, -9.0), at(0.0, 9.0)]), "one around the area");
        assert!(area.intersects(&[at(0.5, 0.5)]), "a point within");
    }

    #[test]
    fn what_is_no_area_and_no_interval_is_refused() {
        for text in ["", "1,2,3", "a,b,c,d", "0,10,1,5", "0,0,200,1", "0,0,1,91", "nan,0,1,1", "1,2,3,4,5"] {
            assert!(Area::parse(text).is_err(), "{text}");
        }
        for text in
            ["", "..", "yesterday", "2026-01-02T00:00:00Z/2026-01-01T00:00:00Z", "2026-01-01T00:00:00Z/x"]
        {
            assert!(Interval::parse(text).is_err(), "{text}");
        }
    }

    #[test]
    fn intervals_are_closed_and_may_be_open_ended() {
        let time = |text: &str| text.parse::<Timestamp>().expect("a time");
        let instant = time("2026-01-01T00:00:00Z");
        for text in [
            "2026-01-01T00:00:00Z",
            "2026-01-01T00:00:00Z/2026-01-01T00:00:00Z",
            "../2026-01-01T00:00:00Z",
            "2026-01-01T00:00:00Z/..",
            "/2026-01-01T01:00:00 01:00",
        ] {
            assert!(Interval::parse(text).expect("an interval").contains(instant), "{text}");
        }
        let interval = Interval::parse("2026-01-01T00:00:00Z").expect("an instant");
        assert_eq!(interval.until(), Some(time("2026-01-01T00:00:00.000001Z")));
    }
}
