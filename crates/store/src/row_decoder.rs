//! Decoding a row column by column, with faults that name table, column and row.

use std::fmt::Display;

use jiff::Timestamp;
use sqlx::postgres::PgRow;
use sqlx::sqlite::SqliteRow;
use sqlx::{Column, Decode, FromRow, Postgres, Row as _, Sqlite, Type, ValueRef};

use super::refusals::Corrupt;
use crate::domain::{Error, Result, Revision};

/// Columns that either database can decode.
pub(crate) trait Columns: for<'r> FromRow<'r, SqliteRow> + for<'r> FromRow<'r, PgRow> {}

impl<T> Columns for T where T: for<'r> FromRow<'r, SqliteRow> + for<'r> FromRow<'r, PgRow> {}

/// A row of either backend.
pub enum StoredRow {
    Sqlite(SqliteRow),
    Postgres(PgRow),
}

impl StoredRow {
    /// All columns, as a tuple.
    pub(super) fn columns<T: Columns>(&self) -> sqlx::Result<T> {
        match self {
            Self::Sqlite(row) => T::from_row(row),
            Self::Postgres(row) => T::from_row(row),
        }
    }

    fn get<'r, T: Stored<'r>>(&'r self, index: usize) -> sqlx::Result<T> {
        match self {
            Self::Sqlite(row) => row.try_get(index),
            Self::Postgres(row) => row.try_get(index),
        }
    }

    /// True if a column is NULL or does not exist.
    pub(super) fn is_null(&self, index: usize) -> bool {
        match self {
            Self::Sqlite(row) => row.try_get_raw(index).map_or(true, |value| value.is_null()),
            Self::Postgres(row) => row.try_get_raw(index).map_or(true, |value| value.is_null()),
        }
    }

    fn column_name(&self, index: usize) -> Option<String> {
        match self {
            Self::Sqlite(row) => row.columns().get(index).map(|column| column.name().to_owned()),
            Self::Postgres(row) => row.columns().get(index).map(|column| column.name().to_owned()),
        }
    }

    /// A column of the key as text.
    fn text(&self, index: usize) -> Option<String> {
        let number = || self.get::<i64>(index).map(|number| number.to_string());
        self.get::<String>(index).or_else(|_| number()).ok()
    }
}

/// A type that both backends can decode.
pub(super) trait Stored<'r>:
    Decode<'r, Sqlite> + Type<Sqlite> + Decode<'r, Postgres> + Type<Postgres>
{
}

impl<'r, T> Stored<'r> for T where T: Decode<'r, Sqlite> + Type<Sqlite> + Decode<'r, Postgres> + Type<Postgres>
{}

/// Decodes the columns of one row from left to right. Every SELECT names the key's columns first, so
/// that a fault can name the row.
pub struct RowDecoder<'r> {
    table: &'static str,
    row: &'r StoredRow,
    next: usize,
}

impl<'r> RowDecoder<'r> {
    pub(super) const fn new(table: &'static str, row: &'r StoredRow) -> Self {
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
        T: Stored<'r>,
    {
        let index = self.next;
        self.next += 1;
        self.row.get(index).map_err(|error| self.corrupt(index, &error))
    }

    /// The next column, converted by a constructor of the domain.
    pub(super) fn parse<T, V, E>(&mut self, parse: impl FnOnce(T) -> Result<V, E>) -> Result<V>
    where
        T: Stored<'r>,
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
        T: Stored<'r>,
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

    /// A number that may have been NaN, which is stored as NULL.
    pub(super) fn nullable_f64(&mut self) -> Result<f64> {
        Ok(self.get::<Option<f64>>()?.unwrap_or(f64::NAN))
    }

    fn corrupt(&self, index: usize, cause: &dyn Display) -> Error {
        let column = self.row.column_name(index).unwrap_or_else(|| index.to_string());
        Error::fault(Corrupt { table: self.table, column, row: self.row_name(), cause: cause.to_string() })
    }

    /// The first columns with their values: the key.
    fn row_name(&self) -> String {
        let columns = (0..3).filter_map(|index| {
            let name = self.row.column_name(index)?;
            let mut value = self.row.text(index).unwrap_or_else(|| "NULL".to_owned());
            value.truncate(value.floor_char_boundary(64));
            Some(format!("{name}={value}"))
        });
        columns.collect::<Vec<_>>().join(" ")
    }
}
