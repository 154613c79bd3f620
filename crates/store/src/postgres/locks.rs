//! Locks that last until the end of a transaction, for rules over more rows than one.

use sqlx::PgConnection;

use super::errors::failed;
use crate::domain::Result;

/// Advisory locks of this program; other programs may use the same database.
const NAMESPACE: i32 = 0x5366_7801;

/// A rule over all rows of a table, which changes must obey one after another.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Limit {
    /// The schema is brought up to date.
    Schema = 0,
    /// Number of cameras.
    Cameras = 1,
    /// Number of sites.
    Sites = 2,
    /// Number of jobs that have not ended.
    Jobs = 3,
    /// Number of keys.
    Keys = 4,
    /// Number of connections with other systems.
    Connections = 5,
    /// One owner of all connections that belong together.
    ConnectionOwners = 6,
    /// Which weeks of samples have a partition.
    SamplePartitions = 7,
    /// Number of places.
    Places = 8,
    /// The numbers of the events of places are in the order of their commits.
    PlaceEvents = 9,
}

/// Waits until no other transaction may change how far a limit is used.
pub(crate) async fn lock_limit(connection: &mut PgConnection, limit: Limit) -> Result<()> {
    sqlx::query("SELECT pg_advisory_xact_lock($1, $2)")
        .bind(NAMESPACE)
        .bind(limit as i32)
        .execute(connection)
        .await
        .map_err(failed)?;
    Ok(())
}

/// As [`lock_limit`] without waiting; false if another transaction has the lock. A transaction that waits would hold
/// its snapshot, and `CREATE INDEX CONCURRENTLY` waits for those.
pub(super) async fn try_lock_limit(connection: &mut PgConnection, limit: Limit) -> sqlx::Result<bool> {
    sqlx::query_scalar("SELECT pg_try_advisory_xact_lock($1, $2)")
        .bind(NAMESPACE)
        .bind(limit as i32)
        .fetch_one(connection)
        .await
}
