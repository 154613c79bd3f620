//! Flags for the layout of CSV files.

use clap::Args;
use jiff::tz::TimeZone;

use crate::domain::parse_time_zone;
use crate::exchange::{BoxForm, BoxUnit, ColumnNames, CsvLayout};

/// How CSV files name their columns and write their boxes.
#[derive(Args)]
pub(super) struct LayoutFlags {
    /// Columns of CSV files: `auto` finds them by usual names in either case, `FIELD:COLUMN,...` names them
    /// (such as time:Timestamp,left:x1); other columns are ignored, and any separator, decimal commas and Unix
    /// times are read [default: the documented columns, separated by commas]
    #[arg(long, value_name = "COLUMNS")]
    columns: Option<ColumnNames>,
    /// Meaning of the columns left, top, width and height: left_top, centre (of the box, and its size) or
    /// corners (the last two are right and bottom) [default: by the names of the columns]
    #[arg(long, value_name = "FORM")]
    box_form: Option<BoxForm>,
    /// Unit of the sides of boxes: px, or share (of the image's width and height) [default: px]
    #[arg(long, value_name = "UNIT")]
    box_unit: Option<BoxUnit>,
    /// IANA time zone (such as Europe/Berlin) whose local times are the times of CSV files without an offset
    /// [default: such rows are rejected]
    #[arg(long, value_name = "ZONE", value_parser = parse_time_zone)]
    timezone: Option<TimeZone>,
}

impl LayoutFlags {
    /// The layout that the flags say.
    pub(super) fn to_layout(&self) -> CsvLayout {
        let layout = CsvLayout::new(self.columns.clone(), self.box_form, self.box_unit);
        CsvLayout { timezone: self.timezone.clone(), ..layout }
    }
}
