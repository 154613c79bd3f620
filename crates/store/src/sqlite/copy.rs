//! Reading and writing whole tables, for a copy into or from another store.

use futures_util::future::BoxFuture;
use futures_util::{FutureExt as _, TryStreamExt as _};
use sqlx::sqlite::{SqlitePoolOptions, SqliteRow};
use sqlx::{AssertSqlSafe, Row as _, Sqlite, Transaction};
use tokio::sync::mpsc;

use super::Store;
use super::errors::failed;
use crate::copy::{Column, CopyTransaction, Kind, Rows, Table, Value, names_of};
use crate::domain::{Error, Result};

impl Store {
    /// A transaction that keeps everybody else from changing the file.
    pub(crate) async fn begin_copy(&self) -> Result<Box<dyn CopyTransaction>> {
        let options = self.inner.writer.options();
        let pool = SqlitePoolOptions::new().max_connections(1).connect_lazy_with(options);
        let mut transaction = pool.begin_with("BEGIN IMMEDIATE").await.map_err(failed)?;
        sqlx::query("PRAGMA defer_foreign_keys = ON").execute(&mut *transaction).await.map_err(failed)?;
        Ok(Box::new(Copying(transaction)))
    }
}

struct Copying(Transaction<'static, Sqlite>);

impl CopyTransaction for Copying {
    fn tables(&mut self) -> BoxFuture<'_, Result<Vec<String>>> {
        async move {
            sqlx::query_scalar(
                "SELECT name FROM sqlite_schema WHERE type = 'table' AND name NOT LIKE 'sqlite%' \
                 AND name NOT IN ('_sqlx_migrations', 'outbox_logs')",
            )
            .fetch_all(&mut *self.0)
            .await
            .map_err(failed)
        }
        .boxed()
    }

    fn columns<'a>(&'a mut self, table: &'a Table) -> BoxFuture<'a, Result<Vec<Column>>> {
        async move {
            let columns: Vec<(String, String)> =
                sqlx::query_as("SELECT name, type FROM pragma_table_info(?) ORDER BY name")
                    .bind(table.name)
                    .fetch_all(&mut *self.0)
                    .await
                    .map_err(failed)?;
            let column = |(name, declared): (String, String)| {
                let kind = match &*declared {
                    "INTEGER" => Kind::Integer,
                    "REAL" => Kind::Real,
                    "TEXT" => Kind::Text,
                    "BLOB" => Kind::Bytes,
                    _ => return Err(Error::fault(format!("the column {name} is a {declared}"))),
                };
                Ok(Column { name, kind, is_flag: false })
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
            let places = vec!["?"; columns.len()].join(", ");
            let sql = format!("INSERT INTO {} ({}) VALUES ({places})", table.name, names_of(columns));
            for row in rows {
                let query = sqlx::query(AssertSqlSafe(sql.clone()));
                let query = row.into_iter().fold(query, |query, value| match value {
                    Value::Null => query.bind(None::<i64>),
                    Value::Integer(number) => query.bind(number),
                    Value::Real(number) => query.bind(number),
                    Value::Text(text) => query.bind(text),
                    Value::Bytes(bytes) => query.bind(bytes),
                });
                query.execute(&mut *self.0).await.map_err(failed)?;
            }
            Ok(())
        }
        .boxed()
    }

    fn last_number<'a>(&'a mut self, table: &'a str, _column: &'a str) -> BoxFuture<'a, Result<i64>> {
        async move {
            let last: Option<i64> = sqlx::query_scalar("SELECT seq FROM sqlite_sequence WHERE name = ?")
                .bind(table)
                .fetch_optional(&mut *self.0)
                .await
                .map_err(failed)?;
            Ok(last.unwrap_or_default())
        }
        .boxed()
    }

    fn set_last_number<'a>(
        &'a mut self,
        table: &'a str,
        _column: &'a str,
        number: i64,
    ) -> BoxFuture<'a, Result<()>> {
        async move {
            sqlx::query("DELETE FROM sqlite_sequence WHERE name = ?")
                .bind(table)
                .execute(&mut *self.0)
                .await
                .map_err(failed)?;
            sqlx::query("INSERT INTO sqlite_sequence (name, seq) VALUES (?, ?)")
                .bind(table)
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

fn values(row: &SqliteRow, columns: &[Column]) -> Result<Vec<Value>> {
    let value = |(index, column): (usize, &Column)| {
        Ok(match column.kind {
            Kind::Integer => row.try_get::<Option<i64>, _>(index)?.map(Value::Integer),
            Kind::Real => row.try_get::<Option<f64>, _>(index)?.map(Value::Real),
            Kind::Text => row.try_get::<Option<String>, _>(index)?.map(Value::Text),
            Kind::Bytes => row.try_get::<Option<Vec<u8>>, _>(index)?.map(Value::Bytes),
        }
        .unwrap_or(Value::Null))
    };
    columns.iter().enumerate().map(value).collect::<sqlx::Result<_>>().map_err(failed)
}
