//! Reading a row column by column, with faults that name the place.

use std::fmt::Display;

use jiff::Timestamp;
use sqlx::sqlite::SqliteRow;
use sqlx::{Column, Decode, Row, Sqlite, Type};

use super::faults::Corrupt;
use crate::domain::{Error, Result};

/// The columns of one row from left to right. Every SELECT names the key's columns first, so that a
/// fault can tell which row it met.
pub(super) struct Fields<'r> {
    table: &'static str,
    row: &'r SqliteRow,
    next: usize,
}

impl<'r> Fields<'r> {
    pub(super) const fn of(table: &'static str, row: &'r SqliteRow) -> Self {
        Self { table, row, next: 0 }
    }

    /// Passes over a column that is only there to name the row.
    pub(super) const fn skip(mut self, columns: usize) -> Self {
        self.next += columns;
        self
    }

    /// The next column as it is stored.
    pub(super) fn take<T>(&mut self) -> Result<T>
    where
        T: Decode<'r, Sqlite> + Type<Sqlite>,
    {
        let index = self.next;
        self.next += 1;
        self.row.try_get(index).map_err(|error| self.corrupt(index, &error))
    }

    /// The next column, made into a value of the domain.
    pub(super) fn make<T, V, E>(&mut self, make: impl FnOnce(T) -> Result<V, E>) -> Result<V>
    where
        T: Decode<'r, Sqlite> + Type<Sqlite>,
        E: Display,
    {
        let stored = self.take()?;
        self.made(make(stored))
    }

    /// The next column, made into a value of the domain unless it is NULL.
    pub(super) fn make_some<T, V, E>(&mut self, make: impl FnOnce(T) -> Result<V, E>) -> Result<Option<V>>
    where
        T: Decode<'r, Sqlite> + Type<Sqlite>,
        E: Display,
    {
        let stored: Option<T> = self.take()?;
        self.made(stored.map(make).transpose())
    }

    /// A value made of the columns up to the one taken last.
    pub(super) fn made<V, E: Display>(&self, made: Result<V, E>) -> Result<V> {
        made.map_err(|error| self.corrupt(self.next.saturating_sub(1), &error))
    }

    pub(super) fn time(&mut self) -> Result<Timestamp> {
        self.make(Timestamp::from_microsecond)
    }

    pub(super) fn some_time(&mut self) -> Result<Option<Timestamp>> {
        self.make_some(Timestamp::from_microsecond)
    }

    pub(super) fn count(&mut self) -> Result<u32> {
        self.make(|stored: i64| u32::try_from(stored))
    }

    pub(super) fn some_count(&mut self) -> Result<Option<u32>> {
        self.make_some(|stored: i64| u32::try_from(stored))
    }

    /// A number that may have been NaN, which SQLite keeps as NULL.
    pub(super) fn number(&mut self) -> Result<f64> {
        Ok(self.take::<Option<f64>>()?.unwrap_or(f64::NAN))
    }

    fn corrupt(&self, index: usize, cause: &dyn Display) -> Error {
        let column =
            self.row.columns().get(index).map_or_else(|| index.to_string(), |it| it.name().to_owned());
        Error::fault(Corrupt { table: self.table, column, row: self.name(), cause: cause.to_string() })
    }

    /// The first columns with their values: the key.
    fn name(&self) -> String {
        let shown = self.row.columns().iter().take(3).map(|column| {
            let value: Option<String> = self.row.try_get_unchecked(column.ordinal()).unwrap_or_default();
            let mut value = value.unwrap_or_else(|| "NULL".to_owned());
            value.truncate(value.floor_char_boundary(64));
            format!("{}={value}", column.name())
        });
        shown.collect::<Vec<_>>().join(" ")
    }
}
