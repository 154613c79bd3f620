//! Counts of places by minutes and by hours.

use std::collections::BTreeMap;

use crate::database::Database;
use crate::domain::{PlaceCount, PlaceKey, Result};
use crate::limits::StoreLimits;
use crate::query::{Session, query, query_as};

/// The lengths of intervals, s.
const MINUTE_S: i64 = 60;
const HOUR_S: i64 = 3_600;
const DAY_S: i64 = 86_400;
/// Rows of one statement.
const ROWS: usize = 200;

impl Database {
    pub(crate) async fn place_counts(
        &self,
        place: PlaceKey,
        step_s: u32,
        (from_s, until_s): (i64, i64),
        class: Option<&str>,
    ) -> Result<Vec<PlaceCount>> {
        let mut reader = self.reader().await?;
        let rows: Vec<(i64, String, String, f64)> = query_as(
            "SELECT from_s, class, figure, value FROM place_counts WHERE place_key = $1 AND step_s = $2 \
             AND from_s >= $3 AND from_s < $4 AND (class = $5 OR $5 IS NULL) ORDER BY from_s, class, figure",
        )
        .bind(place.0)
        .bind(step_s)
        .bind(from_s)
        .bind(until_s)
        .bind(class.map(str::to_owned))
        .fetch_all(&mut reader)
        .await?;
        let count = |(from_s, class, figure, value)| PlaceCount { place, from_s, class, figure, value };
        Ok(rows.into_iter().map(count).collect())
    }
}

/// Adds counts of minutes to those of their minutes and hours. Those of a place that was deleted are passed over.
pub(super) async fn add_counts(session: &mut dyn Session, counts: &[PlaceCount]) -> Result<()> {
    let mut sums: BTreeMap<(i64, i64, i64, &str, &str), f64> = BTreeMap::new();
    for PlaceCount { place, from_s, class, figure, value } in counts {
        for step_s in [MINUTE_S, HOUR_S] {
            let from_s = from_s.div_euclid(step_s) * step_s;
            *sums.entry((place.0, step_s, from_s, class, figure)).or_default() += value;
        }
    }
    let sums: Vec<_> = sums.into_iter().collect();
    for rows in sums.chunks(ROWS) {
        let values: Vec<_> = (0..rows.len())
            .map(|row| {
                let at = |column: usize| row * 6 + column;
                format!(
                    "(CAST(${} AS BIGINT), CAST(${} AS BIGINT), CAST(${} AS BIGINT), ${}, ${}, CAST(${} AS DOUBLE PRECISION))",
                    at(1), at(2), at(3), at(4), at(5), at(6)
                )
            })
            .collect();
        let sql = format!(
            "WITH added (place_key, step_s, from_s, class, figure, value) AS (VALUES {}) \
             INSERT INTO place_counts (place_key, step_s, from_s, class, figure, value) \
             SELECT added.place_key, step_s, from_s, class, figure, value FROM added \
             JOIN places ON places.key = added.place_key WHERE true \
             ON CONFLICT (place_key, step_s, from_s, class, figure) \
             DO UPDATE SET value = place_counts.value + excluded.value",
            values.join(", ")
        );
        let insert = rows.iter().fold(
            query(sqlx::AssertSqlSafe(sql)),
            |insert, ((place, step_s, from_s, class, figure), value)| {
                insert.bind(*place).bind(*step_s).bind(*from_s).bind(*class).bind(*figure).bind(*value)
            },
        );
        insert.execute(session).await?;
    }
    Ok(())
}

/// Deletes the counts of places that are too old beside those that were added.
pub(super) async fn prune_counts(
    session: &mut dyn Session,
    counts: &[PlaceCount],
    limits: &StoreLimits,
) -> Result<()> {
    let mut newest: BTreeMap<i64, i64> = BTreeMap::new();
    for count in counts {
        let latest = newest.entry(count.place.0).or_insert(count.from_s);
        *latest = count.from_s.max(*latest);
    }
    for (place, newest_s) in newest {
        for (step_s, days) in [(MINUTE_S, limits.place_minute_days), (HOUR_S, limits.place_hour_days)] {
            query("DELETE FROM place_counts WHERE place_key = $1 AND step_s = $2 AND from_s < $3")
                .bind(place)
                .bind(step_s)
                .bind(newest_s - i64::from(days) * DAY_S)
                .execute(session)
                .await?;
        }
    }
    Ok(())
}
