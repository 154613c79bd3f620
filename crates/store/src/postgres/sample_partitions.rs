//! The partitions of samples: one table per week of their time, added before the week begins and dropped as a whole.
//!
//! The schema has one partition of everything before a week, and a default one. Weeks are those of the Unix epoch.

use jiff::Timestamp;
use jiff::tz::TimeZone;
use sqlx::{AssertSqlSafe, PgConnection};

use super::Store;
use super::errors::failed;
use super::locks::{Limit, try_lock_limit};
use crate::domain::{Actor, AuditAction, Error, Result};
use crate::rows::audit::Change;
use crate::rows::samples::SampleTable;
use crate::statements::audit::record;

const WEEK_US: i64 = 7 * 86_400 * 1_000_000;
/// Weeks after the present one that have a partition already.
const WEEKS_AHEAD: i64 = 2;
/// Length of a day in the name of a partition: year, month, day.
const DAY_LENGTH: usize = 8;
/// Counting the rows of a week may take long; nobody waits for them.
const NO_TIMEOUT: &str = "SET LOCAL statement_timeout = 0";

impl Store {
    /// Adds the partitions of the weeks to come, and drops those of weeks that are over at an instant, the start of a
    /// week; returns how many samples were in them.
    pub(crate) async fn retain_weeks(
        &self,
        actor: &Actor,
        since: Option<Timestamp>,
        now: Timestamp,
    ) -> Result<u64> {
        let mut deleted = 0;
        for table in SampleTable::ALL {
            self.add_partitions(table, now).await?;
            if let Some(since) = since {
                self.detach_before(table, since).await?;
            }
            for partition in self.detached(table).await? {
                deleted += self.drop_detached(actor, table, &partition, now).await?;
            }
        }
        Ok(deleted)
    }

    async fn add_partitions(&self, table: SampleTable, now: Timestamp) -> Result<()> {
        let mut transaction = self.writer().await?;
        if !try_lock_limit(&mut transaction, Limit::SamplePartitions).await.map_err(failed)? {
            return Ok(());
        }
        let stored = partitions(&mut transaction, table).await?;
        // The first of them says where weeks begin to have partitions of their own.
        let first = stored.iter().map(|name| day_of(name)).min();
        let weeks = (0..=WEEKS_AHEAD).map(|ahead| week_of(now) + ahead * WEEK_US);
        for week_us in weeks {
            let day = day(week_us)?;
            let name = format!("{table}_{day}");
            let is_wanted = first.is_some_and(|first| &*day >= first) && !stored.contains(&name);
            if !is_wanted || has_default_rows(&mut transaction, table, week_us).await? {
                continue;
            }
            let sql = format!(
                "CREATE TABLE {name} PARTITION OF {table} FOR VALUES FROM ({week_us}) TO ({})",
                week_us + WEEK_US
            );
            sqlx::raw_sql(AssertSqlSafe(sql)).execute(&mut *transaction).await.map_err(failed)?;
        }
        transaction.commit().await.map_err(failed)
    }

    /// Takes the weeks that are over before an instant out of the table. No row can come to them any more.
    async fn detach_before(&self, table: SampleTable, since: Timestamp) -> Result<()> {
        let mut transaction = self.writer().await?;
        if !try_lock_limit(&mut transaction, Limit::SamplePartitions).await.map_err(failed)? {
            return Ok(());
        }
        let first_kept = day(week_of(since))?;
        for name in partitions(&mut transaction, table).await? {
            if is_week(table, &name) && day_of(&name) < &*first_kept {
                let sql = format!("ALTER TABLE {table} DETACH PARTITION {name}");
                sqlx::raw_sql(AssertSqlSafe(sql)).execute(&mut *transaction).await.map_err(failed)?;
            }
        }
        transaction.commit().await.map_err(failed)
    }

    /// Weeks that were taken out and are not dropped yet, by this process or by one that ended in between.
    async fn detached(&self, table: SampleTable) -> Result<Vec<String>> {
        let mut reader = self.reader().await?;
        let names: Vec<String> = sqlx::query_scalar(
            "SELECT relname::TEXT FROM pg_class WHERE relnamespace = current_schema()::REGNAMESPACE \
             AND relkind = 'r' AND NOT relispartition ORDER BY 1",
        )
        .fetch_all(&mut *reader)
        .await
        .map_err(failed)?;
        Ok(names.into_iter().filter(|name| is_week(table, name)).collect())
    }

    /// Subtracts the samples of a detached week from the counts, and drops it; returns how many there were.
    async fn drop_detached(
        &self,
        actor: &Actor,
        table: SampleTable,
        name: &str,
        now: Timestamp,
    ) -> Result<u64> {
        let mut transaction = self.writer().await?;
        if !try_lock_limit(&mut transaction, Limit::SamplePartitions).await.map_err(failed)? {
            return Ok(0);
        }
        sqlx::raw_sql(NO_TIMEOUT).execute(&mut *transaction).await.map_err(failed)?;
        let counter = table.counter();
        let sql = format!(
            "WITH gone AS (SELECT camera_key, count(*) AS rows FROM {name} GROUP BY camera_key), \
             changed AS (UPDATE sample_counts SET {counter} = GREATEST({counter} - gone.rows, 0) FROM gone \
             WHERE sample_counts.camera_key = gone.camera_key) \
             SELECT coalesce(sum(rows), 0)::BIGINT FROM gone"
        );
        let rows: i64 =
            sqlx::query_scalar(AssertSqlSafe(sql)).fetch_one(&mut *transaction).await.map_err(failed)?;
        let sql = format!("DROP TABLE {name}");
        sqlx::raw_sql(AssertSqlSafe(sql)).execute(&mut *transaction).await.map_err(failed)?;
        let subject = format!("{rows} samples of the week of {}, by limits.sample_days", day_of(name));
        let change = Change::of(AuditAction::SamplesDeleted, subject);
        record(&mut *transaction, (actor, self.limits()), change, now).await?;
        transaction.commit().await.map_err(failed)?;
        Ok(rows.unsigned_abs())
    }
}

/// Partitions with a day in their name: those of weeks, and that of everything before.
async fn partitions(connection: &mut PgConnection, table: SampleTable) -> Result<Vec<String>> {
    let names: Vec<String> = sqlx::query_scalar(
        "SELECT inhrelid::REGCLASS::TEXT FROM pg_inherits WHERE inhparent = $1::REGCLASS ORDER BY 1",
    )
    .bind(table.to_string())
    .fetch_all(connection)
    .await
    .map_err(failed)?;
    let has_day = |name: &String| day_of(name).bytes().all(|byte| byte.is_ascii_digit());
    Ok(names.into_iter().filter(has_day).collect())
}

/// True if samples of a week came before anything had added its partition. PostgreSQL refuses a partition of rows that
/// the default one holds; they stay there, and are deleted in batches.
async fn has_default_rows(connection: &mut PgConnection, table: SampleTable, week_us: i64) -> Result<bool> {
    let sql = format!("SELECT EXISTS (SELECT 1 FROM {table}_other WHERE time_us >= $1 AND time_us < $2)");
    sqlx::query_scalar(AssertSqlSafe(sql))
        .bind(week_us)
        .bind(week_us + WEEK_US)
        .fetch_one(connection)
        .await
        .map_err(failed)
}

/// The last characters of a name: the first day of a week, or of the first week after them.
fn day_of(name: &str) -> &str {
    name.len().checked_sub(DAY_LENGTH).and_then(|start| name.get(start..)).unwrap_or(name)
}

/// True if a name is that of a week of this table.
fn is_week(table: SampleTable, name: &str) -> bool {
    let day = name.strip_prefix(&*table.to_string()).and_then(|rest| rest.strip_prefix('_'));
    day.is_some_and(|day| day.len() == DAY_LENGTH && day.bytes().all(|byte| byte.is_ascii_digit()))
}

/// Start of the week of an instant.
pub(crate) fn start_of_week(time: Timestamp) -> Result<Timestamp> {
    Timestamp::from_microsecond(week_of(time)).map_err(Error::fault)
}

/// Start of the week of an instant, microseconds.
fn week_of(time: Timestamp) -> i64 {
    time.as_microsecond().div_euclid(WEEK_US) * WEEK_US
}

/// A day in the name of a partition; days are in the order of time.
fn day(time_us: i64) -> Result<String> {
    let time = Timestamp::from_microsecond(time_us).map_err(Error::fault)?;
    Ok(time.to_zoned(TimeZone::UTC).strftime("%Y%m%d").to_string())
}
