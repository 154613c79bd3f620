//! Decoding a row column by column, with faults that name table, column and row.

use std::fmt::Display;

use jiff::Timestamp;
use sqlx::sqlite::SqliteRow;
use sqlx::{Column, Decode, Row, Sqlite, Type};

use super::errors::Corrupt;
use crate::domain::{Error, Result, Revision};

/// Decodes the columns of one row from left to right. Every SELECT names the key's columns first, so
/// that a fault can name the row.
pub(super) struct RowDecoder<'r> {
    table: &'static str,
    row: &'r SqliteRow,
    next: usize,
}

impl<'r> RowDecoder<'r> {
    pub(super) const fn new(table: &'static str, row: &'r SqliteRow) -> Self {
        Self { table, row, next: 0 }
    }

    /// Skips columns that are selected only to name the row.
    pub(super) const fn skip(mut self, columns: usize) -> Self {
        self.next += columns;
        self
    }

    /// The next column as it is stored.
    pub(super) fn get<T>(&mut self) -> Result<T>
    where
        T: Decode<'r, Sqlite> + Type<Sqlite>,
    {
        let index = self.next;
        self.next += 1;
        self.row.try_get(index).map_err(|error| self.corrupt(index, &error))
    }

    /// The next column, converted by a constructor of the domain.
    pub(super) fn parse<T, V, E>(&mut self, parse: impl FnOnce(T) -> Result<V, E>) -> Result<V>
    where
        T: Decode<'r, Sqlite> + Type<Sqlite>,
        E: Display,
    {
        let stored = self.get()?;
        self.checked(parse(stored))
    }

    /// The next column, converted by a constructor of the domain unless it is NULL.
    pub(super) fn parse_optional<T, V, E>(
        &mut self,
        parse: impl FnOnce(T) -> Result<V, E>,
    ) -> Result<Option<V>>
    where
        T: Decode<'r, Sqlite> + Type<Sqlite>,
        E: Display,
    {
        let stored: Option<T> = self.get()?;
        self.checked(stored.map(parse).transpose())
    }

    /// A value constructed from columns up to the latest; a refusal becomes a fault that names it.
    pub(super) fn checked<V, E: Display>(&self, value: Result<V, E>) -> Result<V> {
        value.map_err(|error| self.corrupt(self.next.saturating_sub(1), &error))
    }

    pub(super) fn timestamp(&mut self) -> Result<Timestamp> {
        self.parse(Timestamp::from_microsecond)
    }

    pub(super) fn optional_timestamp(&mut self) -> Result<Option<Timestamp>> {
        self.parse_optional(Timestamp::from_microsecond)
    }

    pub(super) fn count(&mut self) -> Result<u32> {
        self.parse(|stored: i64| u32::try_from(stored))
    }

    pub(super) fn optional_count(&mut self) -> Result<Option<u32>> {
        self.parse_optional(|stored: i64| u32::try_from(stored))
    }

    pub(super) fn revision(&mut self) -> Result<Revision> {
        self.parse(|stored: i64| u64::try_from(stored)).map(Revision)
    }

    /// A number that may have been NaN, which SQLite stores as NULL.
    pub(super) fn nullable_f64(&mut self) -> Result<f64> {
        Ok(self.get::<Option<f64>>()?.unwrap_or(f64::NAN))
    }

    fn corrupt(&self, index: usize, cause: &dyn Display) -> Error {
        let column =
            self.row.columns().get(index).map_or_else(|| index.to_string(), |it| it.name().to_owned());
        Error::fault(Corrupt { table: self.table, column, row: self.row_name(), cause: cause.to_string() })
    }

    /// The first columns with their values: the key.
    fn row_name(&self) -> String {
        let columns = self.row.columns().iter().take(3).map(|column| {
            let value: Option<String> = self.row.try_get_unchecked(column.ordinal()).unwrap_or_default();
            let mut value = value.unwrap_or_else(|| "NULL".to_owned());
            value.truncate(value.floor_char_boundary(64));
            format!("{}={value}", column.name())
        });
        columns.collect::<Vec<_>>().join(" ")
    }
}
