//! The statements that fill the two tables of samples.

use std::collections::HashMap;
use std::ops::Range;
use std::sync::{Arc, LazyLock};

use sqlx::sqlite::SqliteArguments;
use sqlx::{Arguments, AssertSqlSafe, SqliteConnection};

use super::errors::failed;
use crate::domain::{Error, Result, Score, SigmaM, StoredSample, TargetClass};
use crate::geo::Position;
use crate::rows::samples::{Row, SampleTable, key};
use crate::statements::sample_counts::subtract;

/// Columns bound per row.
const fn width(table: SampleTable) -> usize {
    match table {
        SampleTable::WithFix => 14,
        SampleTable::WithoutFix => 11,
    }
}

fn insert_sql(table: SampleTable, rows: usize) -> String {
    let row = format!("({})", vec!["?"; width(table)].join(","));
    let rows = vec![row; rows].join(",");
    match table {
        SampleTable::WithFix => format!(
            "INSERT INTO samples (camera_key, time_us, target_id, left_px, top_px, width_px, height_px, \
                 longitude_deg, latitude_deg, sigma_m, class, score, truth_longitude_deg, truth_latitude_deg) \
                 VALUES {rows} ON CONFLICT DO NOTHING"
        ),
        SampleTable::WithoutFix => format!(
            "WITH new (camera_key, time_us, target_id, left_px, top_px, width_px, height_px, class, score, \
                 truth_longitude_deg, truth_latitude_deg) AS (VALUES {rows}) \
                 INSERT INTO samples_without_fix SELECT * FROM new WHERE NOT EXISTS (SELECT 1 FROM samples \
                 WHERE samples.camera_key = new.camera_key AND samples.time_us = new.time_us \
                 AND samples.target_id = new.target_id) ON CONFLICT DO NOTHING"
        ),
    }
}

fn inserts(table: SampleTable) -> &'static [Arc<str>; SIZES.len()] {
    static WITH_FIX: LazyLock<[Arc<str>; SIZES.len()]> =
        LazyLock::new(|| SIZES.map(|rows| insert_sql(SampleTable::WithFix, rows).into()));
    static WITHOUT_FIX: LazyLock<[Arc<str>; SIZES.len()]> =
        LazyLock::new(|| SIZES.map(|rows| insert_sql(SampleTable::WithoutFix, rows).into()));
    match table {
        SampleTable::WithFix => &WITH_FIX,
        SampleTable::WithoutFix => &WITHOUT_FIX,
    }
}

/// Rows per statement, largest first. Few sizes, so that each stays prepared.
const SIZES: [usize; 6] = [1000, 250, 50, 10, 3, 1];

/// Splits the ranges between borders into statements of the available sizes.
pub(super) fn statements(borders: &[usize]) -> Vec<Range<usize>> {
    let mut ranges = Vec::new();
    let mut start = 0;
    for &border in borders {
        for size in SIZES {
            while border - start >= size {
                ranges.push(start..start + size);
                start += size;
            }
        }
    }
    ranges
}

/// One statement for as many rows as one of the sizes, with its values.
pub(super) struct Insert {
    sql: Arc<str>,
    arguments: SqliteArguments,
}

impl Insert {
    pub(super) fn of(table: SampleTable, rows: &[Row<'_>]) -> Result<Self> {
        let size = SIZES.iter().position(|&size| size == rows.len());
        let size = size.ok_or_else(|| Error::fault("a statement of an unknown size"))?;
        let mut arguments = SqliteArguments::default();
        arguments.reserve(rows.len() * width(table), 0);
        for row in rows {
            bind(&mut arguments, row).map_err(Error::fault)?;
        }
        Ok(Self { sql: Arc::clone(&inserts(table)[size]), arguments })
    }

    /// Returns how many rows were new.
    pub(super) async fn execute(self, connection: &mut SqliteConnection) -> Result<u64> {
        let query = sqlx::query_with(AssertSqlSafe(self.sql), self.arguments);
        Ok(query.execute(connection).await.map_err(failed)?.rows_affected())
    }
}

fn bind(arguments: &mut SqliteArguments, row: &Row<'_>) -> Result<(), sqlx::error::BoxDynError> {
    let sample = row.sample;
    arguments.add(row.camera_key)?;
    arguments.add(sample.time.as_microsecond())?;
    arguments.add(sample.target_id.as_str())?;
    for side_px in sample.bounding_box.sides_px() {
        arguments.add(side_px)?;
    }
    if let Some(fix) = sample.fix {
        arguments.add(fix.position.longitude_deg())?;
        arguments.add(fix.position.latitude_deg())?;
        arguments.add(fix.sigma_m.map(SigmaM::metres))?;
    }
    arguments.add(sample.class.as_ref().map(TargetClass::as_str))?;
    arguments.add(sample.score.map(Score::value))?;
    arguments.add(sample.truth.map(Position::longitude_deg))?;
    arguments.add(sample.truth.map(Position::latitude_deg))
}

/// Deletes the samples without a fix whose keys are those of stored samples with one; returns how many, by
/// camera. Only cameras that `has_boxes` names can have any.
pub(super) async fn delete_replaced(
    connection: &mut SqliteConnection,
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
    connection: &mut SqliteConnection,
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
    connection: &mut SqliteConnection,
    table: SampleTable,
    camera_key: i64,
    keys: &[(i64, &str)],
) -> Result<u64> {
    let query = sqlx::query(AssertSqlSafe(format!(
        "DELETE FROM {table} WHERE camera_key = ? AND (time_us, target_id) IN \
         (SELECT json_extract(value, '$[0]'), json_extract(value, '$[1]') FROM json_each(?))"
    )));
    let query = query.bind(camera_key).bind(serde_json::to_string(keys).map_err(Error::fault)?);
    Ok(query.execute(connection).await.map_err(failed)?.rows_affected())
}
