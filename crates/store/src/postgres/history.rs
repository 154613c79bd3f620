//! Test that the database still has everything that it has acknowledged.
//!
//! A standby that becomes the primary may not have received the latest transactions; a backup that is restored ends
//! before them. Numbers of transactions, revisions, versions and fences then go back and are given out again, so nothing
//! that was read before can be compared with what is stored now. Every renewal of a node's registration is flushed to
//! the disk before it is acknowledged, so the one after it has a higher number in the same history.

use sqlx::Row as _;
use sqlx::postgres::PgRow;

use super::errors::failed;
use crate::domain::{Error, Result};

/// Where in the history of a database a transaction was committed.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct HistoryMark {
    server: String,
    transaction: u64,
}

/// Columns of a mark, read by [`HistoryMark::read`].
pub(super) const COLUMNS: &str = "database_history(), pg_current_xact_id()::TEXT";

impl HistoryMark {
    pub(super) fn read(row: &PgRow) -> Result<Self> {
        let transaction: String = row.try_get(1).map_err(failed)?;
        Ok(Self {
            server: row.try_get(0).map_err(failed)?,
            transaction: transaction.parse().map_err(Error::fault)?,
        })
    }

    /// Why what was committed at an earlier mark may be lost; `None` if it is not.
    #[must_use]
    pub fn break_since(&self, before: &Self) -> Option<String> {
        if self.server != before.server {
            return Some(format!("server/timeline {} follows {}", self.server, before.server));
        }
        (self.transaction <= before.transaction)
            .then(|| format!("transaction {} follows {}", self.transaction, before.transaction))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_history_breaks_with_another_server_or_timeline_and_where_transactions_go_back() {
        let mark = |server: &str, transaction| HistoryMark { server: server.to_owned(), transaction };
        let before = mark("7/00000001", 40);
        assert_eq!(mark("7/00000001", 41).break_since(&before), None);
        for after in
            [mark("7/00000002", 41), mark("8/00000001", 41), mark("7/00000001", 40), mark("7/00000001", 3)]
        {
            assert!(after.break_since(&before).is_some(), "{after:?}");
        }
    }
}
