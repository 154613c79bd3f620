//! How a CSV file names its columns and writes its boxes. The console maps files by the same rules, and reads
//! the same list of names (`column_names.json`).

use std::collections::HashMap;
use std::sync::LazyLock;

use jiff::tz::TimeZone;
use serde::{Deserialize, Serialize};
use strum::{EnumString, IntoStaticStr};
use utoipa::ToSchema;

use super::columns::{COLUMNS, LEFT, WIDTH, index_of};
use crate::domain::{Error, ImageSize, Result, TargetId};

/// The layout of a CSV file. The default is the documented one: the documented columns and no others,
/// separated by commas.
///
/// With other columns than the documented ones, the separator is that of `;`, tab, `,` and `|` that the header
/// has most of, numbers may have a decimal comma where it is not the separator, a time that is a bare number
/// is Unix time (in seconds, milliseconds, microseconds or nanoseconds, by its size), and columns that nothing asks for are ignored.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct CsvLayout {
    /// Which columns hold the values.
    pub columns: ColumnNames,
    /// The meaning of the sides of a box; derived from the names of the columns if `None`.
    pub box_form: Option<BoxForm>,
    /// The unit of the sides.
    pub box_unit: BoxUnit,
    /// The target of a file that names none.
    pub target_id: Option<TargetId>,
    /// The zone of times without an offset, which are refused if it is `None`.
    pub timezone: Option<TimeZone>,
}

/// Which columns hold the values.
#[derive(Debug, Clone, Default, PartialEq)]
pub enum ColumnNames {
    /// The documented ones.
    #[default]
    Documented,
    /// Those of names that the fields have in the wild, in either case.
    Guessed,
    /// Those given, by their field, and the documented ones for all other fields.
    Given(Vec<(usize, String)>),
}

/// The meaning of the four columns of a box.
#[derive(Debug, Clone, Copy, PartialEq, Eq, EnumString, IntoStaticStr, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
#[strum(serialize_all = "snake_case", parse_err_ty = Error, parse_err_fn = unknown_box_form)]
pub enum BoxForm {
    /// Left, top, width, height.
    LeftTop,
    /// Centre x, centre y, width, height.
    Centre,
    /// Left, top, right, bottom.
    Corners,
}

/// The unit of a box's sides.
#[derive(
    Debug, Clone, Copy, Default, PartialEq, Eq, EnumString, IntoStaticStr, Serialize, Deserialize, ToSchema,
)]
#[serde(rename_all = "snake_case")]
#[strum(serialize_all = "snake_case", parse_err_ty = Error, parse_err_fn = unknown_box_unit)]
pub enum BoxUnit {
    /// The sides are in pixels.
    #[default]
    Px,
    /// Shares of the image's width and height, 0 to 1.
    Share,
}

fn unknown_box_form(_: &str) -> Error {
    Error::invalid("box_form", "must be left_top, centre or corners")
}

fn unknown_box_unit(_: &str) -> Error {
    Error::invalid("box_unit", "must be px or share")
}

impl std::str::FromStr for ColumnNames {
    type Err = Error;

    /// `auto`, or `FIELD:COLUMN` separated by commas, such as `time:Timestamp,left:x1`.
    fn from_str(text: &str) -> Result<Self> {
        if text == "auto" {
            return Ok(Self::Guessed);
        }
        let given = text.split(',').map(|pair| {
            let refused = || {
                let shown: String = pair.chars().take(60).collect();
                let fields = COLUMNS.map(|column| column.plain).join(", ");
                Error::invalid(
                    "columns",
                    format!("`{shown}` must be `auto`, or FIELD:COLUMN, where the field is one of {fields}"),
                )
            };
            let (field, column) = pair.split_once(':').ok_or_else(refused)?;
            let index = index_of(field.trim()).ok_or_else(refused)?;
            Ok((index, column.trim().to_owned()))
        });
        Ok(Self::Given(given.collect::<Result<_>>()?))
    }
}

impl CsvLayout {
    /// The layout that a client gives. Names are guessed if form or unit are given but they are not.
    #[must_use]
    pub fn new(columns: Option<ColumnNames>, box_form: Option<BoxForm>, box_unit: Option<BoxUnit>) -> Self {
        let is_documented = box_form.is_none() && box_unit.is_none();
        let assumed = if is_documented { ColumnNames::Documented } else { ColumnNames::Guessed };
        let columns = columns.unwrap_or(assumed);
        Self { columns, box_form, box_unit: box_unit.unwrap_or_default(), ..Self::default() }
    }

    /// True if the file has the documented columns.
    #[must_use]
    pub fn is_documented(&self) -> bool {
        self.columns == ColumnNames::Documented
    }

    /// The separator of a file with this header.
    pub(super) fn separator(&self, header: &str) -> char {
        if self.is_documented() {
            return ',';
        }
        let count = |separator: &char| header.matches(*separator).count();
        // Among equals the last.
        ['|', ',', '\t', ';'].into_iter().max_by_key(count).unwrap_or(',')
    }

    /// The field of each of a file's columns; `None` for those that nothing asks for.
    pub(super) fn fields(&self, names: &[String]) -> Vec<Option<usize>> {
        let mut fields = vec![None; names.len()];
        for field in 0..COLUMNS.len() {
            if let Some(at) = self.position(field, names) {
                fields[at] = Some(field);
            }
        }
        fields
    }

    fn position(&self, field: usize, names: &[String]) -> Option<usize> {
        if let ColumnNames::Given(given) = &self.columns {
            if let Some((_, wanted)) = given.iter().find(|(index, _)| *index == field) {
                return names.iter().position(|name| name.eq_ignore_ascii_case(wanted));
            }
            return names.iter().position(|name| index_of(name) == Some(field));
        }
        let known = KNOWN_NAMES.get(COLUMNS[field].plain)?;
        let rank = |name: &String| known.iter().position(|known| *known == bare(name));
        let ranked = names.iter().enumerate().filter_map(|(at, name)| Some((rank(name)?, at)));
        ranked.min().map(|(_, at)| at)
    }

    /// Returns the meaning of the boxes' columns, by the names of the columns of `left` and `width`.
    pub(super) fn form(&self, name_of: impl Fn(usize) -> Option<String>) -> BoxForm {
        let name = |field| name_of(field).map(|name| bare(&name)).unwrap_or_default();
        match self.box_form {
            Some(form) => form,
            None if self.columns != ColumnNames::Guessed => BoxForm::LeftTop,
            None if matches!(name(WIDTH).as_str(), "x2" | "xmax" | "right") => BoxForm::Corners,
            None if name(LEFT) == "cx" || name(LEFT).contains("cent") => BoxForm::Centre,
            None => BoxForm::LeftTop,
        }
    }

    /// Width and height of what the sides are shares of.
    ///
    /// # Errors
    /// `InvalidArgument` naming `box_unit` if the size of the image is needed and not known.
    pub(super) fn scale_px(&self, image_size: Option<ImageSize>) -> Result<[f64; 2]> {
        match (self.box_unit, image_size) {
            (BoxUnit::Px, _) => Ok([1.0, 1.0]),
            (BoxUnit::Share, Some(size)) => Ok([f64::from(size.width_px()), f64::from(size.height_px())]),
            (BoxUnit::Share, None) => Err(Error::invalid(
                "box_unit",
                "needs the size of the camera's image: set image_size in its profile",
            )),
        }
    }
}

impl BoxForm {
    /// Left, top, width and height, of the four columns in the order of the fields, px.
    pub(super) fn left_top_width_height(self, columns: [f64; 4], scale_px: [f64; 2]) -> [f64; 4] {
        let [a, b, c, d] = columns;
        let [a, b, c, d] = [a * scale_px[0], b * scale_px[1], c * scale_px[0], d * scale_px[1]];
        match self {
            Self::LeftTop => [a, b, c, d],
            Self::Centre => [a - c / 2.0, b - d / 2.0, c, d],
            Self::Corners => [a, b, c - a, d - b],
        }
    }
}

/// A format, and the layout if it is CSV.
pub struct LaidOut<F> {
    pub(super) format: F,
    pub(super) layout: CsvLayout,
}

impl<F> From<F> for LaidOut<F> {
    fn from(format: F) -> Self {
        Self { format, layout: CsvLayout::default() }
    }
}

impl<F> From<(F, &CsvLayout)> for LaidOut<F> {
    fn from((format, layout): (F, &CsvLayout)) -> Self {
        Self { format, layout: layout.clone() }
    }
}

/// Names that columns of each field have in the wild, as [`bare`] gives them, the usual ones first.
static KNOWN_NAMES: LazyLock<HashMap<String, Vec<String>>> =
    LazyLock::new(|| serde_json::from_str(include_str!("column_names.json")).unwrap_or_default());

/// A name in lower case, without its unit and all that is no letter or digit.
fn bare(name: &str) -> String {
    let lower = name.to_lowercase();
    let without_unit = ["px", "deg", "m2"].iter().find_map(|unit| lower.strip_suffix(unit));
    without_unit.unwrap_or(&lower).chars().filter(|letter| letter.is_alphanumeric()).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_field_has_names_that_are_bare() {
        assert_eq!(KNOWN_NAMES.len(), COLUMNS.len());
        for column in COLUMNS {
            let names = &KNOWN_NAMES[column.plain];
            assert_eq!(bare(column.plain), names[0]);
            assert!(names.iter().all(|name| *name == bare(name)), "{names:?}");
        }
    }
}
