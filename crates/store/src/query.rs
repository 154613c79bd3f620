//! Statements that both backends execute, with parameters `$1`, `$2`, ….
//!
//! A [`Query`] collects its values and is executed on a [`Session`]; a database error becomes an error of the domain
//! there. The few words that differ between the dialects of SQL are in [`Dialect`].

use sqlx::{
    AssertSqlSafe, Database, Encode, IntoArguments, PgConnection, Postgres, SqlSafeStr, SqlStr, Sqlite,
    SqliteConnection, Type,
};

use crate::domain::Result;
use crate::postgres::connection::DATABASE_NOW_US;
use crate::postgres::errors::failed as postgres_failed;
use crate::row_decoder::{Columns, StoredRow};
use crate::sqlite::errors::failed as sqlite_failed;

/// A connection to either database.
pub enum AnyConnection<'c> {
    Sqlite(&'c mut SqliteConnection),
    Postgres(&'c mut PgConnection),
}

/// A transaction or a connection on which statements are executed.
pub trait Session: Send {
    fn connection(&mut self) -> AnyConnection<'_>;

    fn dialect(&mut self) -> Dialect {
        match self.connection() {
            AnyConnection::Sqlite(_) => Dialect::Sqlite,
            AnyConnection::Postgres(_) => Dialect::Postgres,
        }
    }
}

impl Session for SqliteConnection {
    fn connection(&mut self) -> AnyConnection<'_> {
        AnyConnection::Sqlite(self)
    }
}

impl Session for PgConnection {
    fn connection(&mut self) -> AnyConnection<'_> {
        AnyConnection::Postgres(self)
    }
}

/// Expressions that the two databases write differently.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Dialect {
    Sqlite,
    Postgres,
}

impl Dialect {
    /// The time now in microseconds: by the database's clock, or in a data folder the value of a parameter.
    pub(crate) const fn now_us(self, parameter: &'static str) -> &'static str {
        match self {
            Self::Sqlite => parameter,
            Self::Postgres => DATABASE_NOW_US,
        }
    }

    /// Ends a SELECT that locks its rows and passes over those that another transaction has locked. SQLite has one
    /// writer at a time.
    pub(crate) const fn skip_locked(self) -> &'static str {
        match self {
            Self::Sqlite => "",
            Self::Postgres => "FOR UPDATE SKIP LOCKED",
        }
    }

    /// The texts of the JSON array that is the first parameter, as rows.
    pub(crate) const fn listed_texts(self) -> &'static str {
        match self {
            Self::Sqlite => "SELECT value FROM json_each($1)",
            Self::Postgres => "SELECT jsonb_array_elements_text($1::JSONB)",
        }
    }

    /// The bytes of a model's metadata. In a damaged file they may be no text.
    pub(crate) const fn metadata_bytes(self) -> &'static str {
        match self {
            Self::Sqlite => "CAST(metadata AS BLOB)",
            Self::Postgres => "convert_to(metadata, 'UTF8')",
        }
    }

    /// The training report in a model's metadata; NULL where the document is damaged, which is reported where the
    /// model is read.
    pub(crate) const fn training_report(self) -> &'static str {
        match self {
            Self::Sqlite => {
                "CASE WHEN json_valid(models.metadata) THEN json_extract(models.metadata, '$.report') END"
            }
            Self::Postgres => "training_report(models.metadata)",
        }
    }
}

/// How a SELECT locks its rows until the end of the transaction. SQLite has one writer at a time and needs no such
/// locks.
#[derive(Debug, Clone, Copy)]
pub(crate) enum RowLock {
    /// Against every other change and lock.
    Update,
    /// As `Update`, but rows that refer to the locked ones may be added.
    NoKeyUpdate,
}

impl RowLock {
    const fn clause(self) -> &'static str {
        match self {
            Self::Update => " FOR UPDATE",
            Self::NoKeyUpdate => " FOR NO KEY UPDATE",
        }
    }
}

/// A value of a parameter. A missing one has a type too, which PostgreSQL asks for.
pub(crate) enum Value {
    Integer(Option<i64>),
    /// NaN is stored as NULL.
    Real(Option<f64>),
    Text(Option<String>),
    Bytes(Option<Vec<u8>>),
    Flag(Option<bool>),
}

macro_rules! values {
    ($($from:ty => $variant:ident($convert:expr);)*) => {
        $(
            impl From<$from> for Value {
                fn from(value: $from) -> Self {
                    Self::from(Some(value))
                }
            }

            impl From<Option<$from>> for Value {
                fn from(value: Option<$from>) -> Self {
                    Self::$variant(value.map($convert))
                }
            }
        )*
    };
}

values! {
    i64 => Integer(|number| number);
    i32 => Integer(i64::from);
    u32 => Integer(i64::from);
    f64 => Real(|number| number);
    &str => Text(str::to_owned);
    String => Text(|text| text);
    &String => Text(String::clone);
    &[u8] => Bytes(<[u8]>::to_vec);
    bool => Flag(|flag| flag);
}

/// A statement with its values; its rows are read as `T`.
#[must_use]
pub struct Query<T> {
    sql: SqlStr,
    lock: Option<RowLock>,
    values: Vec<Value>,
    read: fn(StoredRow) -> sqlx::Result<T>,
}

/// A statement whose rows are read by a [`crate::row_decoder::RowDecoder`], if it has any.
pub(crate) fn query(sql: impl SqlSafeStr) -> Query<StoredRow> {
    Query { sql: sql.into_sql_str(), lock: None, values: Vec::new(), read: Ok }
}

/// A statement whose rows are read as tuples.
pub(crate) fn query_as<T: Columns>(sql: impl SqlSafeStr) -> Query<T> {
    Query { sql: sql.into_sql_str(), lock: None, values: Vec::new(), read: |row| row.columns() }
}

/// A statement whose rows have one column.
pub(crate) fn query_scalar<T>(sql: impl SqlSafeStr) -> Query<T>
where
    (T,): Columns,
{
    let read = |row: StoredRow| row.columns().map(|(value,): (T,)| value);
    Query { sql: sql.into_sql_str(), lock: None, values: Vec::new(), read }
}

impl<T> Query<T> {
    /// Adds the value of the next parameter.
    pub(crate) fn bind(mut self, value: impl Into<Value>) -> Self {
        self.values.push(value.into());
        self
    }

    /// Locks the selected rows.
    pub(crate) fn locking(mut self, lock: RowLock) -> Self {
        self.lock = Some(lock);
        self
    }

    /// Returns how many rows were changed, or selected.
    pub(crate) async fn execute(self, session: &mut dyn Session) -> Result<u64> {
        match session.connection() {
            AnyConnection::Sqlite(connection) => {
                let done = self.for_sqlite().execute(connection).await.map_err(sqlite_failed)?;
                Ok(done.rows_affected())
            }
            AnyConnection::Postgres(connection) => {
                let done = self.for_postgres().execute(connection).await.map_err(postgres_failed)?;
                Ok(done.rows_affected())
            }
        }
    }

    pub(crate) async fn fetch_all(self, session: &mut dyn Session) -> Result<Vec<T>> {
        let read = self.read;
        match session.connection() {
            AnyConnection::Sqlite(connection) => {
                let rows = self.for_sqlite().fetch_all(connection).await.map_err(sqlite_failed)?;
                rows.into_iter().map(|row| read(StoredRow::Sqlite(row)).map_err(sqlite_failed)).collect()
            }
            AnyConnection::Postgres(connection) => {
                let rows = self.for_postgres().fetch_all(connection).await.map_err(postgres_failed)?;
                rows.into_iter().map(|row| read(StoredRow::Postgres(row)).map_err(postgres_failed)).collect()
            }
        }
    }

    pub(crate) async fn fetch_optional(self, session: &mut dyn Session) -> Result<Option<T>> {
        let read = self.read;
        match session.connection() {
            AnyConnection::Sqlite(connection) => {
                let row = self.for_sqlite().fetch_optional(connection).await.map_err(sqlite_failed)?;
                row.map(|row| read(StoredRow::Sqlite(row)).map_err(sqlite_failed)).transpose()
            }
            AnyConnection::Postgres(connection) => {
                let row = self.for_postgres().fetch_optional(connection).await.map_err(postgres_failed)?;
                row.map(|row| read(StoredRow::Postgres(row)).map_err(postgres_failed)).transpose()
            }
        }
    }

    /// As [`Query::fetch_optional`]; a missing row is a fault.
    pub(crate) async fn fetch_one(self, session: &mut dyn Session) -> Result<T> {
        let row = self.fetch_optional(session).await?;
        row.ok_or_else(|| crate::domain::Error::fault(sqlx::Error::RowNotFound))
    }

    fn for_sqlite(self) -> sqlx::query::Query<'static, Sqlite, <Sqlite as Database>::Arguments> {
        bound(self.sql, self.values)
    }

    fn for_postgres(self) -> sqlx::query::Query<'static, Postgres, <Postgres as Database>::Arguments> {
        let sql = match self.lock {
            Some(lock) => AssertSqlSafe(format!("{}{}", self.sql.as_str(), lock.clause())).into_sql_str(),
            None => self.sql,
        };
        bound(sql, self.values)
    }
}

fn bound<DB: Database>(
    sql: SqlStr,
    values: Vec<Value>,
) -> sqlx::query::Query<'static, DB, <DB as Database>::Arguments>
where
    <DB as Database>::Arguments: IntoArguments<DB>,
    Option<i64>: for<'q> Encode<'q, DB> + Type<DB>,
    Option<f64>: for<'q> Encode<'q, DB> + Type<DB>,
    Option<String>: for<'q> Encode<'q, DB> + Type<DB>,
    Option<Vec<u8>>: for<'q> Encode<'q, DB> + Type<DB>,
    Option<bool>: for<'q> Encode<'q, DB> + Type<DB>,
{
    values.into_iter().fold(sqlx::query(sql), |query, value| match value {
        Value::Integer(value) => query.bind(value),
        Value::Real(value) => query.bind(value.filter(|number| !number.is_nan())),
        Value::Text(value) => query.bind(value),
        Value::Bytes(value) => query.bind(value),
        Value::Flag(value) => query.bind(value),
    })
}
