//! Periodic work, every few seconds, that each backend does in its own way.

use jiff::Timestamp;
use sqlx::AssertSqlSafe;

use crate::database::{Backend, Database};
use crate::domain::{Error, Result};
use crate::limits::StorageStatus;
use crate::query::{Dialect, query_scalar};

impl Database {
    pub(crate) async fn maintain(&self) -> Result<StorageStatus> {
        match &self.backend {
            Backend::Sqlite(store) => store.maintain().await,
            Backend::Postgres(store) => store.maintain().await,
        }
    }

    /// The processes of a database agree on its server's clock, not on their own. A data folder has no clock but that of
    /// its process.
    pub(crate) async fn time(&self, now: Timestamp) -> Result<Timestamp> {
        if let Backend::Sqlite(_) = &self.backend {
            return Ok(now);
        }
        let sql = AssertSqlSafe(format!("SELECT {}", Dialect::Postgres.now_us("")));
        let now_us: i64 = query_scalar(sql).fetch_one(&mut self.reader().await?).await?;
        Timestamp::from_microsecond(now_us).map_err(Error::fault)
    }
}
