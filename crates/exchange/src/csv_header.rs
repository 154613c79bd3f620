//! The header line of a CSV file: which field each of its columns holds.

use super::columns::{
    COLUMNS, COUNT, Column, HEIGHT, LATITUDE, LEFT, LONGITUDE, TRUTH_LATITUDE, TRUTH_LONGITUDE, index_of,
};
use super::csv_layout::CsvLayout;
use crate::domain::{Error, ErrorKind, Result};

/// Groups of columns that must occur together.
const GROUPS: [&[usize]; 3] =
    [&[LEFT, LEFT + 1, LEFT + 2, HEIGHT], &[LONGITUDE, LATITUDE], &[TRUTH_LONGITUDE, TRUTH_LATITUDE]];

/// Advice for a file of other columns than the documented ones.
const AUTO_HINT: &str =
    "; with `columns` as `auto` the usual names of columns are found, and other columns are ignored";

/// The fields of a file's columns, and the names that the file uses.
pub(super) struct Header {
    /// The field of each column of the file.
    fields: Vec<Option<usize>>,
    names: [String; COUNT],
}

impl Header {
    /// Reads the names of a header line; the first `known` of all columns are accepted.
    ///
    /// # Errors
    /// Names a column that is unknown, duplicated or missing.
    pub(super) fn read<'a>(
        names: impl Iterator<Item = &'a str>,
        required: &[usize],
        known: usize,
        layout: &CsvLayout,
    ) -> Result<Self> {
        let names: Vec<String> = names.map(|name| name.trim().to_owned()).collect();
        let fields = match layout.is_documented() {
            true => names.iter().map(|name| documented(name, known).map(Some)).collect::<Result<_>>()?,
            false => layout.fields(&names),
        };
        let mut header = Self {
            fields: vec![None; names.len()],
            names: COLUMNS.each_ref().map(|column| column.plain.to_owned()),
        };
        for (position, (name, field)) in names.into_iter().zip(fields).enumerate() {
            let Some(index) = field.filter(|index| *index < known) else { continue };
            if header.has(index) {
                return Err(refused(COLUMNS[index].plain, "the column is a duplicate".to_owned()));
            }
            header.fields[position] = Some(index);
            header.names[index] = name;
        }
        header.check(required, layout)?;
        Ok(header)
    }

    fn check(&self, required: &[usize], layout: &CsvLayout) -> Result<()> {
        let hint = if layout.is_documented() { AUTO_HINT } else { "" };
        if let Some(&index) = required.iter().find(|&&index| !self.has(index)) {
            let name = COLUMNS[index].plain;
            return Err(refused(name, format!("the file has no column `{name}`, which is required{hint}")));
        }
        for group in GROUPS {
            let missing = group.iter().find(|&&index| !self.has(index));
            if let (true, Some(&index)) = (group.iter().any(|&index| self.has(index)), missing) {
                let name = COLUMNS[index].plain;
                let reason = format!(
                    "the file has no column `{name}`, which must accompany the columns of its group{hint}"
                );
                return Err(refused(name, reason));
            }
        }
        Ok(())
    }

    pub(super) fn has(&self, index: usize) -> bool {
        self.fields.contains(&Some(index))
    }

    /// The field of a column of the file.
    pub(super) fn field_at(&self, position: usize) -> Option<usize> {
        self.fields.get(position).copied().flatten()
    }

    /// Number of columns.
    pub(super) fn width(&self) -> usize {
        self.fields.len()
    }

    /// The name that the file uses for a column.
    pub(super) fn name(&self, index: usize) -> &str {
        &self.names[index]
    }

    /// The name that the file uses for the value at a path of a JSON row; that of its first column for
    /// the path of a group.
    pub(super) fn name_of_path<'a>(&'a self, path: &'a str) -> &'a str {
        let at_path = |column: &Column| {
            let below = column.path.strip_prefix(path);
            !path.is_empty() && below.is_some_and(|rest| rest.is_empty() || rest.starts_with('.'))
        };
        COLUMNS.iter().position(at_path).map_or(path, |index| self.names[index].as_str())
    }
}

/// The field of a documented column.
fn documented(name: &str, known: usize) -> Result<usize> {
    let known = COLUMNS.get(..known).unwrap_or(&COLUMNS);
    let index = index_of(name).filter(|index| *index < known.len());
    index.ok_or_else(|| unknown(name, known))
}

fn unknown(name: &str, known: &[Column]) -> Error {
    let known = known.iter().map(|column| column.plain).collect::<Vec<_>>().join(", ");
    let shown: String = name.chars().take(60).collect();
    refused(
        &shown,
        format!("unknown column `{shown}`; columns, separated by commas, may be {known}{AUTO_HINT}"),
    )
}

fn refused(field: &str, message: String) -> Error {
    Error::field(ErrorKind::MalformedBody, field, message)
}
