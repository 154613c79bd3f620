//! Numbers of samples of each camera.

use sqlx::AssertSqlSafe;

use crate::domain::Result;
use crate::query::{Session, query, query_scalar};
use crate::rows::samples::SampleTable;

/// The samples of all cameras.
pub(crate) async fn count_all_samples(session: &mut dyn Session) -> Result<i64> {
    query_scalar("SELECT CAST(coalesce(sum(samples + without_fix), 0) AS BIGINT) FROM sample_counts")
        .fetch_one(session)
        .await
}

/// Subtracts deleted rows of a table from its count.
pub(crate) async fn subtract(
    session: &mut dyn Session,
    table: SampleTable,
    camera_key: i64,
    rows: u64,
) -> Result<()> {
    let counter = table.counter();
    let sql = format!(
        "UPDATE sample_counts SET {counter} = CASE WHEN {counter} > $1 THEN {counter} - $1 ELSE 0 END \
         WHERE camera_key = $2"
    );
    let update = query(AssertSqlSafe(sql)).bind(i64::try_from(rows).unwrap_or(i64::MAX)).bind(camera_key);
    update.execute(session).await?;
    Ok(())
}
