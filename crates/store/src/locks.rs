//! Locks for rules over more rows than one, until the end of a transaction. SQLite has one writer at a time, so a data
//! folder needs none.

use sqlx::AssertSqlSafe;

use crate::domain::Result;
use crate::postgres::locks as postgres;
use crate::query::{AnyConnection, Session, query};

pub(crate) use crate::postgres::locks::Limit;

/// Waits until no other transaction may change how far a limit is used.
pub(crate) async fn lock_limit(session: &mut dyn Session, limit: Limit) -> Result<()> {
    match session.connection() {
        AnyConnection::Sqlite(_) => Ok(()),
        AnyConnection::Postgres(connection) => postgres::lock_limit(connection, limit).await,
    }
}

/// Deletes the rows of a numbered table that have at most `upto` in a column. Those that another transaction is deleting
/// are left to it.
pub(crate) async fn delete_upto(
    session: &mut dyn Session,
    table: &'static str,
    column: &'static str,
    upto: i64,
) -> Result<()> {
    let skip_locked = session.dialect().skip_locked();
    let sql = format!(
        "DELETE FROM {table} WHERE number IN (SELECT number FROM {table} WHERE {column} <= $1 {skip_locked})"
    );
    query(AssertSqlSafe(sql)).bind(upto).execute(session).await?;
    Ok(())
}
