//! Columns of CSV files.

/// A column: its two names and the path of the same value in a JSON row.
pub(super) struct Column {
    /// Name without the unit, as in the files of the paper.
    pub plain: &'static str,
    /// Name with the unit.
    pub with_unit: &'static str,
    /// Path of the value in a JSON row.
    pub path: &'static str,
}

const fn column(plain: &'static str, with_unit: &'static str, path: &'static str) -> Column {
    Column { plain, with_unit, path }
}

pub(super) const TIME: usize = 0;
pub(super) const TARGET_ID: usize = 1;
pub(super) const LEFT: usize = 2;
pub(super) const TOP: usize = 3;
pub(super) const WIDTH: usize = 4;
pub(super) const HEIGHT: usize = 5;
pub(super) const LONGITUDE: usize = 6;
pub(super) const LATITUDE: usize = 7;
pub(super) const SIGMA: usize = 8;
pub(super) const CLASS: usize = 9;
pub(super) const SCORE: usize = 10;
pub(super) const TRUTH_LONGITUDE: usize = 11;
pub(super) const TRUTH_LATITUDE: usize = 12;
pub(super) const TRACKER_ID: usize = 13;
pub(super) const RECEIVER_ID: usize = 15;
/// Number of columns of a file of fixes, or of live items.
pub(super) const COUNT: usize = 16;
/// Number of columns of a file of samples, observations or detections: the first of all.
pub(super) const OF_SAMPLES: usize = 15;
/// Number of columns of samples that were not matched: the last two say how a sample was.
pub(super) const OF_UNMATCHED: usize = 13;

/// All columns, in the order of writing.
pub(super) const COLUMNS: [Column; COUNT] = [
    column("time", "time", "time"),
    column("target_id", "target_id", "target_id"),
    column("left", "left_px", "bounding_box.left_px"),
    column("top", "top_px", "bounding_box.top_px"),
    column("width", "width_px", "bounding_box.width_px"),
    column("height", "height_px", "bounding_box.height_px"),
    column("longitude", "longitude_deg", "fix.longitude_deg"),
    column("latitude", "latitude_deg", "fix.latitude_deg"),
    column("sigma_m", "sigma_m", "fix.sigma_m"),
    column("class", "class", "class"),
    column("score", "score", "score"),
    column("truth_longitude", "truth_longitude_deg", "truth.longitude_deg"),
    column("truth_latitude", "truth_latitude_deg", "truth.latitude_deg"),
    column("tracker_id", "tracker_id", "tracker_id"),
    column("match_probability", "match_probability", "match_probability"),
    column("receiver_id", "receiver_id", "receiver_id"),
];

/// The field of a documented name.
pub(super) fn index_of(name: &str) -> Option<usize> {
    COLUMNS.iter().position(|column| column.plain == name || column.with_unit == name)
}
