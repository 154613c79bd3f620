//! Connecting: the pool, the transactions, the schema.
//!
//! Every statement runs in a transaction, which begins by giving up what was prepared on its connection before (the
//! library numbers its statements by client, and a pooler mixes clients), and settings are made for one transaction
//! each. So nothing is expected of a connection between two transactions, and a pooler that gives out connections by
//! transaction (PgBouncer and its like) may stand between.

use std::time::Duration;

use sqlx::migrate::MigrateError;
use sqlx::postgres::{PgConnectOptions, PgPoolOptions};
use sqlx::{ConnectOptions, PgPool, Postgres, Transaction};
use tokio::time::Instant;

use super::errors::{Meaning, failed, meaning};
use super::locks::{Limit, try_lock_limit};
use crate::domain::{Durability, Error, Result};
use crate::folder_fault::{FolderFault, FolderFaultKind};
use crate::location::DatabaseUrl;
use crate::schema;

/// Connections of one process.
const CONNECTIONS: u32 = 12;
const CONNECTION_WAIT: Duration = Duration::from_secs(10);

/// How long a start waits for another process that changes the schema.
const SCHEMA_WAIT: Duration = Duration::from_secs(120);
const SCHEMA_PAUSE: Duration = Duration::from_millis(100);

/// A reader sees one state of the database. A transaction that holds locks for longer than these times is interrupted.
const BEGIN_READ: &str = "BEGIN ISOLATION LEVEL REPEATABLE READ READ ONLY; DEALLOCATE ALL; SET LOCAL statement_timeout = '60s'; \
                          SET LOCAL idle_in_transaction_session_timeout = '60s'";
const BEGIN_SYNCED: &str = "BEGIN; DEALLOCATE ALL; SET LOCAL statement_timeout = '60s'; SET LOCAL lock_timeout = '5s'; \
                            SET LOCAL idle_in_transaction_session_timeout = '30s'; \
                            SET LOCAL synchronous_commit = on";
const BEGIN_RELAXED: &str = "BEGIN; DEALLOCATE ALL; SET LOCAL statement_timeout = '60s'; SET LOCAL lock_timeout = '5s'; \
                             SET LOCAL idle_in_transaction_session_timeout = '30s'; \
                             SET LOCAL synchronous_commit = off";
const BEGIN_SCHEMA: &str =
    "BEGIN; DEALLOCATE ALL; SET LOCAL lock_timeout = '30s'; SET LOCAL synchronous_commit = on";

/// The time of the database, in microseconds, as an expression.
pub(crate) const DATABASE_NOW_US: &str = "(extract(epoch FROM clock_timestamp()) * 1000000)::BIGINT";

/// Connects, and brings the schema up to date.
///
/// # Errors
/// A [`FolderFault`] that names the database without its secrets.
pub(super) async fn open(url: &DatabaseUrl) -> Result<PgPool> {
    let pool = PgPoolOptions::new()
        .max_connections(CONNECTIONS)
        .acquire_timeout(CONNECTION_WAIT)
        .connect_with(options(url)?)
        .await
        .map_err(|error| unreachable(url, &error))?;
    migrate(&pool).await.map_err(|error| unusable(url, &error))?;
    Ok(pool)
}

/// A connection of its own for the renewals of a node, made when it is first needed.
///
/// # Errors
/// The URL cannot be read.
pub(super) fn for_renewals(url: &DatabaseUrl) -> Result<PgPool> {
    let pool = PgPoolOptions::new().max_connections(1).acquire_timeout(CONNECTION_WAIT);
    Ok(pool.connect_lazy_with(options(url)?))
}

fn options(url: &DatabaseUrl) -> Result<PgConnectOptions> {
    let options = url.options()?.statement_cache_capacity(0).disable_statement_logging();
    // Floats come in binary form; some poolers refuse a connection that sets this.
    let options = options.extra_float_digits(None::<i8>);
    if options.get_application_name().is_some() {
        return Ok(options);
    }
    Ok(options.application_name("sightfix"))
}

pub(super) async fn begin_read(pool: &PgPool) -> Result<Transaction<'static, Postgres>> {
    begin(pool, BEGIN_READ).await.map_err(failed)
}

/// A transaction that is flushed to the disk when it is committed, or may be undone by a power cut.
pub(crate) async fn begin_write(
    pool: &PgPool,
    durability: Durability,
) -> Result<Transaction<'static, Postgres>> {
    begin(pool, begin_write_statement(durability)).await.map_err(failed)
}

/// Begins a transaction on a task of its own, which goes on when its caller is gone: the library would give the connection
/// back to the pool in the middle of the statement, and the next caller would go on in that transaction, with its snapshot.
async fn begin(pool: &PgPool, statement: &'static str) -> sqlx::Result<Transaction<'static, Postgres>> {
    let pool = pool.clone();
    let beginning = tokio::spawn(async move { pool.begin_with(statement).await });
    beginning.await.unwrap_or_else(|ended| Err(sqlx::Error::Io(ended.into())))
}

/// As [`begin_write`], for a connection that is at hand.
pub(super) const fn begin_write_statement(durability: Durability) -> &'static str {
    match durability {
        Durability::Synced => BEGIN_SYNCED,
        Durability::Relaxed => BEGIN_RELAXED,
    }
}

/// All missing steps in one transaction: of several processes that start at once, one changes the schema, and a step
/// that fails leaves it as it was.
async fn migrate(pool: &PgPool) -> Result<(), MigrateError> {
    let began = Instant::now();
    loop {
        let mut transaction = begin(pool, BEGIN_SCHEMA).await?;
        if try_lock_limit(&mut transaction, Limit::Schema).await? {
            schema::POSTGRES.run_direct(None, &mut *transaction, false).await?;
            return Ok(transaction.commit().await?);
        }
        transaction.rollback().await?;
        if began.elapsed() > SCHEMA_WAIT {
            return Err(MigrateError::Execute(sqlx::Error::PoolTimedOut));
        }
        tokio::time::sleep(SCHEMA_PAUSE).await;
    }
}

/// Why there is no connection, for the person who started the program.
fn unreachable(url: &DatabaseUrl, error: &sqlx::Error) -> Error {
    FolderFault::error(FolderFaultKind::Unreachable, format!("cannot use the database {url} now: {error}"))
}

fn unusable(url: &DatabaseUrl, cause: &MigrateError) -> Error {
    let (kind, message) = match cause {
        MigrateError::VersionMissing(step) => (
            FolderFaultKind::OtherSchema,
            format!(
                "the database {url} was written by a newer version of sightfix (its schema has step {step}); start \
                 that version, or use another database"
            ),
        ),
        MigrateError::VersionMismatch(step) => (
            FolderFaultKind::OtherSchema,
            format!(
                "the database {url} has another schema in step {step}; it was made by a build that was never \
                 released"
            ),
        ),
        MigrateError::Execute(sqlx::Error::PoolTimedOut) => (
            FolderFaultKind::InUse,
            format!("another process has been changing the schema of the database {url} for minutes"),
        ),
        // A standby that is not yet the primary, or a connection that was lost: another start may find it otherwise.
        MigrateError::Execute(error) | MigrateError::ExecuteMigration(error, _)
            if matches!(meaning(error), Meaning::TryAgain(_) | Meaning::Conflict) =>
        {
            return unreachable(url, error);
        }
        cause => (
            FolderFaultKind::Other,
            format!("the schema of the database {url} cannot be brought up to date: {cause}"),
        ),
    };
    FolderFault::error(kind, message)
}
