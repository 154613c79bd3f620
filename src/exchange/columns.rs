//! The columns that a CSV file may have.

use crate::domain::{Error, ErrorKind, Result};

/// A column: its two spellings and the path of the same value in a JSON row.
pub(super) struct Column {
    /// As in the files of the paper.
    pub plain: &'static str,
    /// With its unit.
    pub with_unit: &'static str,
    /// Where the value stands in a JSON row.
    pub path: &'static str,
}

const fn column(plain: &'static str, with_unit: &'static str, path: &'static str) -> Column {
    Column { plain, with_unit, path }
}

pub(super) const TIME: usize = 0;
pub(super) const TARGET_ID: usize = 1;
pub(super) const LEFT: usize = 2;
pub(super) const HEIGHT: usize = 5;
pub(super) const LONGITUDE: usize = 6;
pub(super) const LATITUDE: usize = 7;
pub(super) const SIGMA: usize = 8;
pub(super) const CLASS: usize = 9;
pub(super) const SCORE: usize = 10;
pub(super) const TRUTH_LONGITUDE: usize = 11;
pub(super) const TRUTH_LATITUDE: usize = 12;
pub(super) const RECEIVER_ID: usize = 13;
/// Columns that a file of fixes may have.
pub(super) const COUNT: usize = 14;
/// Columns that a file of samples, observations or detections may have, the first of all.
pub(super) const OF_SAMPLES: usize = 13;

/// All columns, in the order in which they are written.
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
    column("receiver_id", "receiver_id", "receiver_id"),
];

/// Columns that belong together: all of them or none.
const GROUPS: [&[usize]; 3] =
    [&[LEFT, LEFT + 1, LEFT + 2, HEIGHT], &[LONGITUDE, LATITUDE], &[TRUTH_LONGITUDE, TRUTH_LATITUDE]];

/// Where each column stands in a file, and how the file spells it.
pub(super) struct Header {
    place: [Option<usize>; COUNT],
    spelled: [&'static str; COUNT],
    width: usize,
}

impl Header {
    /// Reads the names of a header line, of which the first `known` columns are known.
    ///
    /// # Errors
    /// Names a column that is unknown, stands twice or is missing.
    pub(super) fn read<'a>(
        names: impl Iterator<Item = &'a str>,
        required: &[usize],
        known: usize,
    ) -> Result<Self> {
        let known = COLUMNS.get(..known).unwrap_or(&COLUMNS);
        let mut header =
            Self { place: [None; COUNT], spelled: COLUMNS.each_ref().map(|column| column.plain), width: 0 };
        for name in names {
            let name = name.trim();
            let index = known
                .iter()
                .position(|column| column.plain == name || column.with_unit == name)
                .ok_or_else(|| unknown(name, known))?;
            if header.place[index].is_some() {
                return Err(refused(COLUMNS[index].plain, "the column stands twice".to_owned()));
            }
            header.place[index] = Some(header.width);
            if COLUMNS[index].with_unit == name {
                header.spelled[index] = COLUMNS[index].with_unit;
            }
            header.width += 1;
        }
        header.check(required)?;
        Ok(header)
    }

    fn check(&self, required: &[usize]) -> Result<()> {
        if let Some(&index) = required.iter().find(|&&index| !self.has(index)) {
            let name = COLUMNS[index].plain;
            return Err(refused(name, format!("the file has no column `{name}`, which is required")));
        }
        for group in GROUPS {
            let missing = group.iter().find(|&&index| !self.has(index));
            if let (true, Some(&index)) = (group.iter().any(|&index| self.has(index)), missing) {
                let name = COLUMNS[index].plain;
                let reason = format!("the file has no column `{name}`, which belongs to the others it has");
                return Err(refused(name, reason));
            }
        }
        Ok(())
    }

    pub(super) const fn has(&self, index: usize) -> bool {
        self.place[index].is_some()
    }

    pub(super) const fn place(&self, index: usize) -> Option<usize> {
        self.place[index]
    }

    /// Number of columns.
    pub(super) const fn width(&self) -> usize {
        self.width
    }

    /// The file's own name of a column.
    pub(super) const fn name(&self, index: usize) -> &'static str {
        self.spelled[index]
    }

    /// The file's own name of the value at a path of a JSON row; of its first column if the path is
    /// that of a group.
    pub(super) fn name_of_path<'a>(&self, path: &'a str) -> &'a str {
        let at_path = |column: &Column| {
            let below = column.path.strip_prefix(path);
            !path.is_empty() && below.is_some_and(|rest| rest.is_empty() || rest.starts_with('.'))
        };
        COLUMNS.iter().position(at_path).map_or(path, |index| self.spelled[index])
    }
}

fn unknown(name: &str, known: &[Column]) -> Error {
    let known = known.iter().map(|column| column.plain).collect::<Vec<_>>().join(", ");
    let shown: String = name.chars().take(60).collect();
    refused(&shown, format!("unknown column `{shown}`; columns, parted by commas, may be {known}"))
}

fn refused(field: &str, message: String) -> Error {
    Error::field(ErrorKind::MalformedBody, field, message)
}
