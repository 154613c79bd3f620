//! Reading and writing whole tables, for a copy into or from another store.

use futures_util::future::BoxFuture;
use futures_util::{FutureExt as _, TryStreamExt as _};
use sqlx::postgres::PgRow;
use sqlx::{AssertSqlSafe, Postgres, Row as _, Transaction};
use tokio::sync::mpsc;

use super::Store;
use super::connection::DATABASE_NOW_US;
use super::errors::failed;
use crate::copy::{Column, CopyTransaction, Kind, Rows, Table, Value, names_of};
use crate::domain::{Error, ErrorKind, Result};

/// A copy may take long, and there is nobody whom it could keep waiting.
const NO_TIMEOUTS: &str =
    "SET LOCAL statement_timeout = 0; SET LOCAL idle_in_transaction_session_timeout = 0";

impl Store {
    /// A transaction that keeps everybody else from changing the tables, and nodes from registering.
    ///
    /// # Errors
    /// `Overloaded` where a node has renewed its registration within its lease.
    pub(crate) async fn begin_copy(&self) -> Result<Box<dyn CopyTransaction>> {
        let mut transaction = self.writer().await?;
        sqlx::raw_sql(NO_TIMEOUTS).execute(&mut *transaction).await.map_err(failed)?;
        let mut copying = Copying(transaction);
        let tables = copying.tables().await?.join(", ");
        let lock = format!("LOCK TABLE {tables}, nodes IN EXCLUSIVE MODE");
        sqlx::raw_sql(AssertSqlSafe(lock)).execute(&mut *copying.0).await.map_err(failed)?;
        let running = format!(
            "SELECT coalesce(url, id) FROM nodes WHERE renewed_at_us + 1000 * lease_ms > {DATABASE_NOW_US}"
        );
        let running: Vec<String> =
            sqlx::query_scalar(AssertSqlSafe(running)).fetch_all(&mut *copying.0).await.map_err(failed)?;
        if !running.is_empty() {
            let nodes = running.join(", ");
            return Err(Error::refused(
                ErrorKind::Overloaded,
                format!(
                    "servers use the database: {nodes}; stop all of them, and wait until their leases are over"
                ),
            ));
        }
        Ok(Box::new(copying))
    }
}

struct Copying(Transaction<'static, Postgres>);

impl CopyTransaction for Copying {
    fn tables(&mut self) -> BoxFuture<'_, Result<Vec<String>>> {
        async move {
            sqlx::query_scalar(
                "SELECT relname::TEXT FROM pg_class WHERE relnamespace = current_schema()::REGNAMESPACE \
                 AND (relkind = 'p' OR relkind = 'r' AND NOT relispartition AND relname !~ '^samples_.*[0-9]{8}$') \
                 AND relname NOT IN ('_sqlx_migrations', 'nodes', 'camera_owners', 'connection_owners', \
                 'connection_statuses', 'camera_changes', 'outbox_logs') ORDER BY relname::TEXT COLLATE \"C\"",
            )
            .fetch_all(&mut *self.0)
            .await
            .map_err(failed)
        }
        .boxed()
    }

    fn columns<'a>(&'a mut self, table: &'a Table) -> BoxFuture<'a, Result<Vec<Column>>> {
        async move {
            let columns: Vec<(String, String)> = sqlx::query_as(
                "SELECT column_name::TEXT, data_type::TEXT FROM information_schema.columns \
                 WHERE table_schema = current_schema() AND table_name = $1 ORDER BY column_name::TEXT COLLATE \"C\"",
            )
            .bind(table.name)
            .fetch_all(&mut *self.0)
            .await
            .map_err(failed)?;
            let column = |(name, declared): (String, String)| {
                let kind = match &*declared {
                    "bigint" | "boolean" => Kind::Integer,
                    "double precision" => Kind::Real,
                    "text" => Kind::Text,
                    "bytea" => Kind::Bytes,
                    _ => return Err(Error::fault(format!("the column {name} is a {declared}"))),
                };
                Ok(Column { name, kind, is_flag: declared == "boolean" })
            };
            columns.into_iter().map(column).collect()
        }
        .boxed()
    }

    fn read<'a>(
        &'a mut self,
        table: &'a Table,
        columns: &'a [Column],
        batches: mpsc::Sender<Rows>,
    ) -> BoxFuture<'a, Result<()>> {
        async move {
            let Table { name, key } = table;
            let sql = format!("SELECT {} FROM {name} ORDER BY {key}", names_of(columns));
            let mut stored = sqlx::query(AssertSqlSafe(sql)).fetch(&mut *self.0);
            let mut rows = Rows::new();
            while let Some(row) = stored.try_next().await.map_err(failed)? {
                rows.push(values(&row, columns)?);
                if rows.len() == table.rows_at_a_time()
                    && batches.send(std::mem::take(&mut rows)).await.is_err()
                {
                    return Ok(());
                }
            }
            // This fails only if the comparison of the rows has ended with an error.
            let _ = batches.send(rows).await;
            Ok(())
        }
        .boxed()
    }

    fn write<'a>(
        &'a mut self,
        table: &'a Table,
        columns: &'a [Column],
        rows: Rows,
    ) -> BoxFuture<'a, Result<()>> {
        async move {
            let arrays = columns.iter().enumerate().map(|(index, column)| {
                let declared = match column.kind {
                    Kind::Integer if column.is_flag => "BOOLEAN",
                    Kind::Integer => "BIGINT",
                    Kind::Real => "FLOAT8",
                    Kind::Text => "TEXT",
                    Kind::Bytes => "BYTEA",
                };
                format!("${}::{declared}[]", index + 1)
            });
            let sql = format!(
                "INSERT INTO {} ({}) SELECT * FROM UNNEST({})",
                table.name,
                names_of(columns),
                arrays.collect::<Vec<_>>().join(", ")
            );
            let query = sqlx::query(AssertSqlSafe(sql));
            let query = columns.iter().enumerate().fold(query, |query, (index, column)| {
                let values = rows.iter().map(|row| &row[index]);
                match column.kind {
                    Kind::Integer if column.is_flag => {
                        query.bind(values.map(|it| integer(it).map(|it| it != 0)).collect::<Vec<_>>())
                    }
                    Kind::Integer => query.bind(values.map(integer).collect::<Vec<_>>()),
                    Kind::Real => query.bind(values.map(real).collect::<Vec<_>>()),
                    Kind::Text => query.bind(values.map(text).collect::<Vec<_>>()),
                    Kind::Bytes => query.bind(values.map(bytes).collect::<Vec<_>>()),
                }
            });
            query.execute(&mut *self.0).await.map_err(failed)?;
            Ok(())
        }
        .boxed()
    }

    fn last_number<'a>(&'a mut self, table: &'a str, column: &'a str) -> BoxFuture<'a, Result<i64>> {
        async move {
            let last: Option<i64> =
                sqlx::query_scalar("SELECT pg_sequence_last_value(pg_get_serial_sequence($1, $2)::REGCLASS)")
                    .bind(table)
                    .bind(column)
                    .fetch_one(&mut *self.0)
                    .await
                    .map_err(failed)?;
            Ok(last.unwrap_or_default())
        }
        .boxed()
    }

    fn set_last_number<'a>(
        &'a mut self,
        table: &'a str,
        column: &'a str,
        number: i64,
    ) -> BoxFuture<'a, Result<()>> {
        async move {
            // The third argument: whether the number itself has been used.
            sqlx::query("SELECT setval(pg_get_serial_sequence($1, $2)::REGCLASS, GREATEST($3, 1), $3 > 0)")
                .bind(table)
                .bind(column)
                .bind(number)
                .execute(&mut *self.0)
                .await
                .map_err(failed)?;
            Ok(())
        }
        .boxed()
    }

    fn commit(self: Box<Self>) -> BoxFuture<'static, Result<()>> {
        async move {
            let Self(transaction) = *self;
            transaction.commit().await.map_err(failed)
        }
        .boxed()
    }
}

fn values(row: &PgRow, columns: &[Column]) -> Result<Vec<Value>> {
    let value = |(index, column): (usize, &Column)| {
        Ok(match column.kind {
            Kind::Integer if column.is_flag => {
                row.try_get::<Option<bool>, _>(index)?.map(|flag| Value::Integer(flag.into()))
            }
            Kind::Integer => row.try_get::<Option<i64>, _>(index)?.map(Value::Integer),
            Kind::Real => row.try_get::<Option<f64>, _>(index)?.map(Value::Real),
            Kind::Text => row.try_get::<Option<String>, _>(index)?.map(Value::Text),
            Kind::Bytes => row.try_get::<Option<Vec<u8>>, _>(index)?.map(Value::Bytes),
        }
        .unwrap_or(Value::Null))
    };
    columns.iter().enumerate().map(value).collect::<sqlx::Result<_>>().map_err(failed)
}

fn integer(value: &Value) -> Option<i64> {
    if let Value::Integer(number) = value { Some(*number) } else { None }
}

fn real(value: &Value) -> Option<f64> {
    if let Value::Real(number) = value { Some(*number) } else { None }
}

fn text(value: &Value) -> Option<&str> {
    if let Value::Text(text) = value { Some(text) } else { None }
}

fn bytes(value: &Value) -> Option<&[u8]> {
    if let Value::Bytes(bytes) = value { Some(bytes) } else { None }
}
