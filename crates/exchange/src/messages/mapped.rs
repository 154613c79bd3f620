//! JSON of any program, by a mapping of its members.

use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use serde_json::Value;
use utoipa::ToSchema;

use super::{
    DetectedBox, MessageContext, MessageDecoder, MessageItem, NamedDetection, Reading, ReportedFix, class,
    parse, score,
};
use crate::csv_layout::{BoxForm, BoxUnit};
use crate::domain::{Error, Result, SigmaM, TargetId, check_text, parse_time};
use crate::fix_quality::{sigma_of_deviations, sigma_of_radius_68};
use crate::unix_time::unix_time;

/// Where the values of a JSON message are, as JSON pointers (RFC 6901) such as `/objects` or `/bbox/0`. Pointers other
/// than `items` are looked up in an item first, then in the whole message.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(default, deny_unknown_fields)]
pub struct JsonMapping {
    /// The array of items; the message itself is the only item if left out.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(example = "/frame/observations")]
    pub items: Option<String>,
    /// Time of the frame or fix, as RFC 3339 or Unix time; the time at which the message came if left out.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub time: Option<String>,
    /// The sender's name of the camera.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub camera: Option<String>,
    /// The id that the tracker gives the target of a box.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub target: Option<String>,
    /// The box; a source gives either boxes or fixes.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub bounding_box: Option<BoxMapping>,
    /// Class of the target.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub class: Option<String>,
    /// Confidence score of the detector.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub score: Option<String>,
    /// The receiver of a fix.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub receiver: Option<String>,
    /// Longitude of a fix, degrees.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub longitude_deg: Option<String>,
    /// Latitude of a fix, degrees.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub latitude_deg: Option<String>,
    /// Standard deviation of a fix per axis, m.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub sigma_m: Option<String>,
    /// Radius that contains a fix in 68 of 100 cases, m, where there is no standard deviation.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub radius_68_m: Option<String>,
}

/// Where the sides of a box are.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct BoxMapping {
    /// Pointers to the four numbers, in the order of the form.
    #[schema(example = json!(["/bbox/0", "/bbox/1", "/bbox/2", "/bbox/3"]))]
    pub sides: [String; 4],
    /// The meaning of the four numbers.
    pub form: BoxForm,
    /// Their unit; pixels if left out.
    #[serde(default)]
    pub unit: BoxUnit,
}

impl JsonMapping {
    /// True if it reads fixes instead of boxes.
    #[must_use]
    pub const fn brings_fixes(&self) -> bool {
        self.bounding_box.is_none()
    }

    /// Checks the pointers, and that there is either a box with a target or a position.
    ///
    /// # Errors
    /// `InvalidArgument` naming the field.
    pub(crate) fn check(&self) -> Result<()> {
        let sides = self.bounding_box.iter().flat_map(|it| &it.sides);
        let named = [
            ("items", &self.items),
            ("time", &self.time),
            ("camera", &self.camera),
            ("target", &self.target),
            ("class", &self.class),
            ("score", &self.score),
            ("receiver", &self.receiver),
            ("longitude_deg", &self.longitude_deg),
            ("latitude_deg", &self.latitude_deg),
            ("sigma_m", &self.sigma_m),
            ("radius_68_m", &self.radius_68_m),
        ];
        let named = named.into_iter().filter_map(|(field, pointer)| Some((field, pointer.as_ref()?)));
        for (field, pointer) in named.chain(sides.map(|side| ("bounding_box.sides", side))) {
            check_text(field, pointer, 256)?;
            if !pointer.starts_with('/') {
                return Err(Error::invalid(field, "must be a JSON pointer, which begins with /"));
            }
        }
        let has_position = self.longitude_deg.is_some() && self.latitude_deg.is_some();
        let has_any_degrees = self.longitude_deg.is_some() || self.latitude_deg.is_some();
        match &self.bounding_box {
            Some(_) if has_any_degrees => {
                Err(Error::invalid("bounding_box", "a source gives either boxes or fixes"))
            }
            Some(_) if self.target.is_none() => Err(Error::invalid("target", "is required for boxes")),
            None if !has_position => Err(Error::invalid(
                "bounding_box",
                "give bounding_box and target, or longitude_deg and latitude_deg",
            )),
            _ => Ok(()),
        }
    }
}

/// Reads messages by a mapping.
pub(super) struct Mapped(pub(super) JsonMapping);

impl MessageDecoder for Mapped {
    fn decode(&mut self, payload: &[u8], context: &MessageContext<'_>) -> Result<Reading, String> {
        let message: Value = parse(payload)?;
        let mut reading = Reading::default();
        let items = match &self.0.items {
            None => std::slice::from_ref(&message),
            Some(pointer) => match message.pointer(pointer) {
                Some(Value::Array(items)) => items,
                Some(_) => return Err(format!("has at {pointer} no array")),
                // Axis leaves the array out of a frame in which nothing is seen.
                None if message.is_object() => {
                    reading.skip(format!("has nothing at {pointer}"));
                    return Ok(reading);
                }
                None => return Err(format!("has nothing at {pointer}")),
            },
        };
        for item in items {
            let values = Values { item, message: &message };
            reading.take(match &self.0.bounding_box {
                Some(bounding_box) => self.detection(&values, bounding_box, context),
                None => self.fix(&values, context),
            });
        }
        Ok(reading)
    }
}

impl Mapped {
    fn detection(
        &self,
        values: &Values<'_>,
        bounding_box: &BoxMapping,
        context: &MessageContext<'_>,
    ) -> Result<MessageItem, String> {
        let target = values.required("target", self.0.target.as_ref(), Values::text)?;
        let time =
            context.time_bounds.check(self.time(values, context)?).map_err(|error| error.to_string())?;
        Ok(MessageItem::Detection(NamedDetection {
            camera: values.optional(self.0.camera.as_ref(), Values::text)?.unwrap_or_default(),
            time,
            target_id: TargetId::new(&target).map_err(|error| error.to_string())?,
            detected_box: detected_box(values, bounding_box)?,
            class: values.optional(self.0.class.as_ref(), Values::text)?.as_deref().and_then(class),
            score: score(values.optional(self.0.score.as_ref(), Values::number)?),
        }))
    }

    fn fix(&self, values: &Values<'_>, context: &MessageContext<'_>) -> Result<MessageItem, String> {
        let receiver = values.optional(self.0.receiver.as_ref(), Values::text)?;
        let sigma_m = values.optional(self.0.sigma_m.as_ref(), Values::number)?;
        let radius_m = values.optional(self.0.radius_68_m.as_ref(), Values::number)?;
        let stated: Option<SigmaM> = sigma_m.and_then(|sigma_m| sigma_of_deviations(sigma_m, sigma_m));
        let fix = ReportedFix {
            time: self.time(values, context)?,
            receiver: receiver.as_deref(),
            longitude_deg: values.required("longitude_deg", self.0.longitude_deg.as_ref(), Values::number)?,
            latitude_deg: values.required("latitude_deg", self.0.latitude_deg.as_ref(), Values::number)?,
            sigma: stated.or_else(|| radius_m.and_then(sigma_of_radius_68)),
        };
        fix.checked(context).map(MessageItem::Fix)
    }

    fn time(&self, values: &Values<'_>, context: &MessageContext<'_>) -> Result<Timestamp, String> {
        let Some(pointer) = &self.0.time else { return Ok(context.received_at) };
        let text = values.required("time", Some(pointer), Values::text)?;
        match text.parse() {
            Ok(number) => unix_time(number),
            Err(_) => parse_time(&text).map_err(|error| error.to_string()),
        }
    }
}

fn detected_box(values: &Values<'_>, mapping: &BoxMapping) -> Result<DetectedBox, String> {
    let mut sides = [0.0; 4];
    for (side, pointer) in sides.iter_mut().zip(&mapping.sides) {
        *side = values.required("bounding_box", Some(pointer), Values::number)?;
    }
    let [left, top, width, height] = mapping.form.left_top_width_height(sides, [1.0, 1.0]);
    let edges = [left, top, left + width, top + height];
    Ok(match mapping.unit {
        BoxUnit::Px => DetectedBox::Pixels(edges),
        BoxUnit::Share => DetectedBox::Fractions(edges),
    })
}

/// An item with the message around it.
struct Values<'a> {
    item: &'a Value,
    message: &'a Value,
}

impl Values<'_> {
    fn optional<T>(
        &self,
        pointer: Option<&String>,
        read: fn(&Value) -> Option<T>,
    ) -> Result<Option<T>, String> {
        let Some(pointer) = pointer else { return Ok(None) };
        let found = self.item.pointer(pointer).or_else(|| self.message.pointer(pointer));
        match found {
            None | Some(Value::Null) => Ok(None),
            Some(value) => read(value).map(Some).ok_or_else(|| {
                let shown: String = value.to_string().chars().take(40).collect();
                format!("has at {pointer} `{shown}`, which is not of that kind")
            }),
        }
    }

    fn required<T>(
        &self,
        field: &str,
        pointer: Option<&String>,
        read: fn(&Value) -> Option<T>,
    ) -> Result<T, String> {
        let found = self.optional(pointer, read)?;
        found.ok_or_else(|| format!("an item has no {field} at {}", pointer.map_or("", String::as_str)))
    }

    fn text(value: &Value) -> Option<String> {
        match value {
            Value::String(text) => Some(text.clone()),
            Value::Number(number) => Some(number.to_string()),
            _ => None,
        }
    }

    /// A number, which may be in quotes.
    fn number(value: &Value) -> Option<f64> {
        value.as_f64().or_else(|| value.as_str()?.trim().parse().ok())
    }
}
