//! The settings of a place as JSON: the same text in the database and on the wire.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};
use strum::IntoStaticStr;
use utoipa::ToSchema;

use crate::domain::{Error, Result, TargetClass, check_labels, check_text};
use crate::geo::Outline;
use crate::region::Region;

pub use crate::geometry::Geometry;

/// Rules of a place.
pub const MAX_RULES: usize = 32;
/// Classes that a rule may name.
const MAX_CLASSES: usize = 64;
/// Limits of the time and the distance of a rule.
const MAX_AFTER_S: f64 = 86_400.0;
const MAX_DISTANCE_M: f64 = 1_000.0;
const MAX_SPEED_MPS: f64 = 200.0;

/// The settings of a place.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct PlaceSettings {
    /// The name for people.
    #[schema(max_length = 200, example = "Gate")]
    pub display_name: String,
    /// Free-form labels.
    #[serde(default)]
    pub labels: BTreeMap<String, String>,
    /// Where the place is.
    pub geometry: Geometry,
    /// Radius of a point's place, m.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schema(exclusive_minimum = 0.0, maximum = 10000.0)]
    pub radius_m: Option<f64>,
    /// The probability at which a target counts as inside, or on one side of a line; its complement is that at which it
    /// counts as outside.
    #[serde(default = "default_probability")]
    #[schema(minimum = 0.6, maximum = 0.999)]
    pub probability: f64,
    /// Which events are made of what happens there.
    #[serde(default)]
    #[schema(max_items = 32)]
    pub rules: Vec<Rule>,
}

const fn default_probability() -> f64 {
    PlaceSettings::DEFAULT_PROBABILITY
}

/// A kind of event.
#[derive(
    Debug,
    Clone,
    Copy,
    PartialEq,
    Eq,
    Hash,
    Serialize,
    Deserialize,
    ToSchema,
    IntoStaticStr,
    strum::EnumString,
)]
#[serde(rename_all = "snake_case")]
#[strum(serialize_all = "snake_case", parse_err_ty = Error, parse_err_fn = unknown_kind)]
pub enum EventKind {
    /// A target entered an area.
    Enter,
    /// A target left an area.
    Leave,
    /// A target stayed in an area for `after_s`.
    Dwell,
    /// A target crossed a line, in either direction.
    Cross,
    /// A target crossed a line from its right to its left: against the direction that is allowed.
    WrongWay,
    /// A target is faster than `speed_mps` in an area, or as it crosses a line.
    SpeedAbove,
    /// A target is slower than `speed_mps` in an area, or as it crosses a line.
    SpeedBelow,
    /// A track began in an area.
    Appeared,
    /// A track ended in an area.
    Lost,
    /// A target is nearer than `distance_m` to another one; the one that moved is in an area.
    Near,
    /// A receiver is in an area, and no camera has seen a box of its target for `after_s`.
    ReceiverWithoutBox,
    /// A target is in an area, and no receiver has stated a fix of it for `after_s`.
    BoxWithoutReceiver,
}

fn unknown_kind(_: &str) -> Error {
    Error::invalid("kind", "is not a kind of event")
}

impl EventKind {
    /// Name in wire formats.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        self.into()
    }

    const fn is_of_line(self) -> bool {
        matches!(self, Self::Cross | Self::WrongWay)
    }

    const fn is_of_speed(self) -> bool {
        matches!(self, Self::SpeedAbove | Self::SpeedBelow)
    }

    const fn needs_time(self) -> bool {
        matches!(self, Self::Dwell | Self::ReceiverWithoutBox | Self::BoxWithoutReceiver)
    }
}

/// A rule of a place: which events are made.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct Rule {
    /// A name that no other rule of the place has.
    #[schema(min_length = 1, max_length = 63, example = "speeding")]
    pub id: String,
    /// The kind of event.
    pub kind: EventKind,
    /// Classes of targets; all if empty.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    #[schema(max_items = 64, example = json!(["person"]))]
    pub classes: Vec<String>,
    /// How long the state has lasted, s; for `dwell`, `receiver_without_box` and `box_without_receiver`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub after_s: Option<f64>,
    /// The speed, m/s; for `speed_above` and `speed_below`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub speed_mps: Option<f64>,
    /// The distance, m; for `near`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub distance_m: Option<f64>,
    /// The least probability of an event; that of the place if left out.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schema(minimum = 0.5, maximum = 0.999)]
    pub probability: Option<f64>,
}

impl PlaceSettings {
    /// The confidence of a place that states none.
    pub const DEFAULT_PROBABILITY: f64 = 0.95;

    /// The area on the ground; `None` of a line.
    ///
    /// # Errors
    /// As of settings that are stored.
    pub fn outline(&self) -> Result<Option<Outline>> {
        Ok(Region::of(&self.geometry, self.radius_m)?.outline())
    }

    /// The geometry in metres.
    ///
    /// # Errors
    /// `InvalidArgument`, naming the field: a geometry with too few or too many corners, with a border that crosses itself,
    /// near a pole, across the antimeridian or larger than a plane holds; a rule that does not fit the geometry or lacks its
    /// threshold.
    pub(crate) fn check(&self) -> Result<Region> {
        check_text("display_name", &self.display_name, 200)?;
        check_labels(&self.labels)?;
        check_range("probability", Some(self.probability), 0.6..=0.999)?;
        if self.rules.len() > MAX_RULES {
            return Err(Error::invalid("rules", format!("may be {MAX_RULES} at most")));
        }
        let is_line = matches!(self.geometry, Geometry::LineString(_));
        for (number, rule) in self.rules.iter().enumerate() {
            rule.check(is_line).map_err(|error| error.under(&format!("rules[{number}]")))?;
            if self.rules[..number].iter().any(|other| other.id == rule.id) {
                return Err(Error::invalid(format!("rules[{number}].id"), "is that of another rule"));
            }
        }
        Region::of(&self.geometry, self.radius_m)
    }
}

impl Rule {
    /// The rule of a kind that needs nothing else, under the kind's name.
    #[must_use]
    pub fn of(kind: EventKind) -> Self {
        Self {
            id: kind.as_str().to_owned(),
            kind,
            classes: Vec::new(),
            after_s: None,
            speed_mps: None,
            distance_m: None,
            probability: None,
        }
    }

    fn check(&self, is_line: bool) -> Result<()> {
        check_text("id", &self.id, 63)?;
        if self.classes.len() > MAX_CLASSES {
            return Err(Error::invalid("classes", format!("may be {MAX_CLASSES} at most")));
        }
        for class in &self.classes {
            TargetClass::new(class).map_err(|error| error.at("classes"))?;
        }
        if is_line != self.kind.is_of_line() && !(is_line && self.kind.is_of_speed()) {
            let message = if is_line {
                "of a line must be cross, wrong_way, speed_above or speed_below"
            } else {
                "cross and wrong_way need a line"
            };
            return Err(Error::invalid("kind", message));
        }
        check_threshold("after_s", self.after_s, self.kind.needs_time(), MAX_AFTER_S)?;
        check_threshold("speed_mps", self.speed_mps, self.kind.is_of_speed(), MAX_SPEED_MPS)?;
        check_threshold("distance_m", self.distance_m, self.kind == EventKind::Near, MAX_DISTANCE_M)?;
        check_range("probability", self.probability, 0.5..=0.999)
    }

    /// True if the rule is for targets of a class.
    pub(crate) fn takes(&self, class: Option<&TargetClass>) -> bool {
        let is_of = |wanted: &String| class.is_some_and(|class| class.as_str().eq_ignore_ascii_case(wanted));
        self.classes.is_empty() || self.classes.iter().any(is_of)
    }
}

fn check_threshold(field: &str, value: Option<f64>, is_needed: bool, most: f64) -> Result<()> {
    match value {
        Some(_) if !is_needed => Err(Error::invalid(field, "does not belong to this kind of rule")),
        None if is_needed => Err(Error::invalid(field, "is needed for this kind of rule")),
        Some(value) if !(value > 0.0 && value <= most) => {
            Err(Error::invalid(field, format!("must be above 0, and {most} at most")))
        }
        _ => Ok(()),
    }
}

fn check_range(field: &str, value: Option<f64>, range: std::ops::RangeInclusive<f64>) -> Result<()> {
    match value {
        Some(value) if !range.contains(&value) => {
            Err(Error::invalid(field, format!("must be from {} to {}", range.start(), range.end())))
        }
        _ => Ok(()),
    }
}
