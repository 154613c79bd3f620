//! The statements that fill the two tables of samples: arrays of columns, so that a statement has the same text for any
//! number of rows.

use std::collections::HashMap;

use sqlx::{AssertSqlSafe, PgConnection};

use super::errors::failed;
use crate::domain::{Result, Score, SigmaM, StoredSample, TargetClass};
use crate::geo::Position;
use crate::rows::samples::{Row, SampleTable, key};
use crate::statements::sample_counts::subtract;

const INSERT_WITH_FIX: &str = "INSERT INTO samples (camera_key, time_us, target_id, left_px, top_px, width_px, height_px, class, score, \
     truth_longitude_deg, truth_latitude_deg, longitude_deg, latitude_deg, sigma_m) \
     SELECT * FROM UNNEST($1::BIGINT[], $2::BIGINT[], $3::TEXT[], $4::FLOAT8[], $5::FLOAT8[], $6::FLOAT8[], \
     $7::FLOAT8[], $8::TEXT[], $9::FLOAT8[], $10::FLOAT8[], $11::FLOAT8[], $12::FLOAT8[], $13::FLOAT8[], \
     $14::FLOAT8[]) ON CONFLICT DO NOTHING";

const INSERT_WITHOUT_FIX: &str = "INSERT INTO samples_without_fix (camera_key, time_us, target_id, left_px, top_px, width_px, height_px, class, \
     score, truth_longitude_deg, truth_latitude_deg) \
     SELECT * FROM UNNEST($1::BIGINT[], $2::BIGINT[], $3::TEXT[], $4::FLOAT8[], $5::FLOAT8[], $6::FLOAT8[], \
     $7::FLOAT8[], $8::TEXT[], $9::FLOAT8[], $10::FLOAT8[], $11::FLOAT8[]) AS new (camera_key, time_us, target_id) \
     WHERE NOT EXISTS (SELECT 1 FROM samples WHERE samples.camera_key = new.camera_key \
     AND samples.time_us = new.time_us AND samples.target_id = new.target_id) ON CONFLICT DO NOTHING";

/// Inserts rows of one table; returns how many were new.
pub(super) async fn insert(
    connection: &mut PgConnection,
    table: SampleTable,
    rows: &[Row<'_>],
) -> Result<u64> {
    if rows.is_empty() {
        return Ok(0);
    }
    let samples = || rows.iter().map(|row| row.sample);
    let sides =
        |side: usize| samples().map(|sample| sample.bounding_box.sides_px()[side]).collect::<Vec<f64>>();
    let truth =
        |part: fn(Position) -> f64| samples().map(|sample| sample.truth.map(part)).collect::<Vec<_>>();
    let query = sqlx::query(match table {
        SampleTable::WithFix => INSERT_WITH_FIX,
        SampleTable::WithoutFix => INSERT_WITHOUT_FIX,
    })
    .bind(rows.iter().map(|row| row.camera_key).collect::<Vec<_>>())
    .bind(samples().map(|sample| sample.time.as_microsecond()).collect::<Vec<_>>())
    .bind(samples().map(|sample| sample.target_id.as_str()).collect::<Vec<_>>())
    .bind(sides(0))
    .bind(sides(1))
    .bind(sides(2))
    .bind(sides(3))
    .bind(samples().map(|sample| sample.class.as_ref().map(TargetClass::as_str)).collect::<Vec<_>>())
    .bind(samples().map(|sample| sample.score.map(Score::value)).collect::<Vec<_>>())
    .bind(truth(Position::longitude_deg))
    .bind(truth(Position::latitude_deg));
    let query = match table {
        SampleTable::WithoutFix => query,
        SampleTable::WithFix => {
            let fixes = || samples().filter_map(|sample| sample.fix);
            query
                .bind(fixes().map(|fix| fix.position.longitude_deg()).collect::<Vec<_>>())
                .bind(fixes().map(|fix| fix.position.latitude_deg()).collect::<Vec<_>>())
                .bind(fixes().map(|fix| fix.sigma_m.map(SigmaM::metres)).collect::<Vec<_>>())
        }
    };
    Ok(query.execute(connection).await.map_err(failed)?.rows_affected())
}

/// Deletes the samples without a fix whose keys are those of stored samples with one; returns how many, by
/// camera. Only cameras that `has_boxes` names can have any.
pub(super) async fn delete_replaced(
    connection: &mut PgConnection,
    stored: &[Row<'_>],
    has_boxes: impl Fn(i64) -> bool,
) -> Result<HashMap<i64, u64>> {
    let mut keys: HashMap<i64, Vec<(i64, &str)>> = HashMap::new();
    for Row { camera_key, sample, .. } in stored.iter().filter(|row| has_boxes(row.camera_key)) {
        keys.entry(*camera_key).or_default().push(key(sample));
    }
    let mut deleted = HashMap::new();
    for (camera_key, keys) in keys {
        let rows = delete_keys(connection, SampleTable::WithoutFix, camera_key, &keys).await?;
        deleted.insert(camera_key, rows);
    }
    Ok(deleted)
}

/// Deletes the samples of a camera in a table that have the keys of these, and subtracts them from the counts; returns
/// how many.
pub(super) async fn delete_stored(
    connection: &mut PgConnection,
    table: SampleTable,
    camera_key: i64,
    samples: &[StoredSample],
) -> Result<u64> {
    let keys: Vec<_> = samples.iter().map(key).collect();
    let rows = delete_keys(connection, table, camera_key, &keys).await?;
    if rows > 0 {
        subtract(connection, table, camera_key, rows).await?;
    }
    Ok(rows)
}

async fn delete_keys(
    connection: &mut PgConnection,
    table: SampleTable,
    camera_key: i64,
    keys: &[(i64, &str)],
) -> Result<u64> {
    let (times_us, targets): (Vec<i64>, Vec<&str>) = keys.iter().copied().unzip();
    let query = sqlx::query(AssertSqlSafe(format!(
        "DELETE FROM {table} WHERE camera_key = $1 \
         AND (time_us, target_id) IN (SELECT * FROM UNNEST($2::BIGINT[], $3::TEXT[]))"
    )));
    let query = query.bind(camera_key).bind(times_us).bind(targets);
    Ok(query.execute(connection).await.map_err(failed)?.rows_affected())
}
