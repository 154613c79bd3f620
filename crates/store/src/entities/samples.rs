//! Reading, counting and deleting samples; `group_commit` stores them.

use std::sync::Arc;

use jiff::Timestamp;
use sqlx::AssertSqlSafe;

use super::cameras::{camera_key, lock_camera};
use crate::database::Database;
use crate::domain::{
    AuditAction, CameraId, CameraKey, Detection, Result, SampleFilter, SampleKey, StoredSample,
};
use crate::geo::Position;
use crate::group_commit::{InsertOptions, Inserted};
use crate::query::{Query, query};
use crate::row_decoder::RowDecoder;
use crate::row_decoder::StoredRow;
use crate::rows::audit::Change;
use crate::rows::samples::{SampleTable, ordered_union, read_sample};
use crate::statements::sample_counts::subtract;

impl Database {
    pub(crate) async fn insert_samples(
        &self,
        id: &CameraId,
        key: Option<CameraKey>,
        samples: Vec<StoredSample>,
        options: InsertOptions,
    ) -> Result<Inserted> {
        let actor = Arc::clone(&self.actor);
        self.sample_queue().insert((id.clone(), key), samples, options, actor).await
    }

    pub(crate) async fn samples(
        &self,
        id: &CameraId,
        filter: &SampleFilter,
        after: Option<SampleKey>,
        limit: u32,
    ) -> Result<Vec<StoredSample>> {
        let mut reader = self.reader().await?;
        let range = Range::of(camera_key(&mut reader, id).await?, filter, after);
        let order = format!("ORDER BY time_us, target_id LIMIT ${}", range.next_parameter());
        // Each table is read in the order of its primary key, and no further than the page.
        let select = |table: &SampleTable| {
            format!("{} {order}", range.sql(&format!("SELECT {} FROM {table}", table.columns())))
        };
        let tables: Vec<String> = SampleTable::asked_for(filter).iter().map(select).collect();
        let sql = ordered_union(&tables, &order);
        let rows = range.bind(&sql).bind(limit).fetch_all(&mut reader).await?;
        rows.iter().map(read_sample).collect()
    }

    pub(crate) async fn thinned_detections(
        &self,
        id: &CameraId,
        filter: &SampleFilter,
        most: u32,
    ) -> Result<Vec<Detection>> {
        let filter = SampleFilter { has_fix: Some(false), ..filter.clone() };
        let count = self.count_samples(id, &filter).await?;
        let mut reader = self.reader().await?;
        let stride = i64::try_from(count.div_ceil(most.max(1).into()).max(1)).unwrap_or(i64::MAX);
        let (table, range) =
            (SampleTable::WithoutFix, Range::of(camera_key(&mut reader, id).await?, &filter, None));
        let numbered = range.sql(&format!(
            "SELECT {}, row_number() OVER (ORDER BY time_us, target_id) - 1 AS ordinal FROM {table}",
            table.columns()
        ));
        // The place within each stride is a multiplicative hash of the stride's number.
        let sql = format!(
            "SELECT * FROM ({numbered}) AS numbered WHERE ordinal % {stride} = \
             (ordinal / {stride} * 2654435761 / 65536) % {stride} ORDER BY time_us, target_id"
        );
        let rows = range.bind(&sql).fetch_all(&mut reader).await?;
        rows.iter().map(|row| read_sample(row).map(Detection::from)).collect()
    }

    pub(crate) async fn count_samples(&self, id: &CameraId, filter: &SampleFilter) -> Result<u64> {
        let mut count = 0;
        for table in SampleTable::asked_for(filter) {
            count += self.count(id, filter, &format!("SELECT count(*) FROM {table}")).await?;
        }
        Ok(count)
    }

    pub(crate) async fn count_truths(&self, id: &CameraId, filter: &SampleFilter) -> Result<u64> {
        self.count(id, filter, "SELECT count(truth_longitude_deg) FROM samples").await
    }

    async fn count(&self, id: &CameraId, filter: &SampleFilter, select: &str) -> Result<u64> {
        let mut reader = self.reader().await?;
        let range = Range::of(camera_key(&mut reader, id).await?, filter, None);
        let sql = range.sql(select);
        let row = range.bind(&sql).fetch_one(&mut reader).await?;
        RowDecoder::new("samples", &row).parse(|stored: i64| u64::try_from(stored))
    }

    pub(crate) async fn sample_time(&self, id: &CameraId, before: u64) -> Result<Option<Timestamp>> {
        let mut reader = self.reader().await?;
        let range = Range::of(camera_key(&mut reader, id).await?, &SampleFilter::default(), None);
        let sql = format!(
            "{} ORDER BY time_us, target_id LIMIT 1 OFFSET ${}",
            range.sql("SELECT time_us FROM samples"),
            range.next_parameter()
        );
        let offset = i64::try_from(before).unwrap_or(i64::MAX);
        let row = range.bind(&sql).bind(offset).fetch_optional(&mut reader).await?;
        row.map(|row| RowDecoder::new("samples", &row).timestamp()).transpose()
    }

    pub(crate) async fn sample_extent(
        &self,
        id: &CameraId,
        filter: &SampleFilter,
    ) -> Result<(u64, Option<[Position; 2]>)> {
        let mut reader = self.reader().await?;
        let range = Range::of(camera_key(&mut reader, id).await?, filter, None);
        let sql = range.sql(
            "SELECT count(*), min(longitude_deg), min(latitude_deg), max(longitude_deg), max(latitude_deg) \
             FROM samples",
        );
        let row = range.bind(&sql).fetch_one(&mut reader).await?;
        let mut fields = RowDecoder::new("samples", &row);
        let count = fields.parse(|stored: i64| u64::try_from(stored))?;
        if count == 0 {
            return Ok((0, None));
        }
        let (west, south) = (fields.get()?, fields.get()?);
        let (east, north) = (fields.get()?, fields.get()?);
        let corner = |longitude_deg, latitude_deg| fields.checked(Position::new(longitude_deg, latitude_deg));
        Ok((count, Some([corner(west, south)?, corner(east, north)?])))
    }

    pub(crate) async fn delete_samples(
        &self,
        id: &CameraId,
        filter: &SampleFilter,
        now: Timestamp,
    ) -> Result<u64> {
        let mut writer = self.deletion().await?;
        let mut transaction = writer.begin().await?;
        let key = lock_camera(&mut transaction, id).await?;
        let range = Range::of(key, filter, None);
        let mut deleted = 0;
        for table in SampleTable::asked_for(filter) {
            let sql = range.sql(&format!("DELETE FROM {table}"));
            let rows = range.bind(&sql).execute(&mut transaction).await?;
            subtract(&mut transaction, *table, key, rows).await?;
            deleted += rows;
        }
        let subject = Some(format!("{deleted} samples"));
        let change = Change::of_camera(AuditAction::SamplesDeleted, id, subject);
        self.record(&mut transaction, change, now).await?;
        transaction.commit().await?;
        writer.reclaim().await;
        Ok(deleted)
    }
}

/// A range of one camera's samples in key order, in the form that the primary key can seek.
struct Range {
    camera_key: i64,
    /// Exclusive. No target is empty text, so (from, "") lies before all samples at `from`.
    after: (i64, String),
    until_us: Option<i64>,
    target_id: Option<String>,
}

impl Range {
    fn of(camera_key: i64, filter: &SampleFilter, after: Option<SampleKey>) -> Self {
        let from = (filter.from.map_or(i64::MIN, Timestamp::as_microsecond), String::new());
        let after = after.map(|key| (key.time.as_microsecond(), key.target_id.as_str().to_owned()));
        Self {
            camera_key,
            after: after.map_or_else(|| from.clone(), |after| after.max(from.clone())),
            until_us: filter.until.map(Timestamp::as_microsecond),
            target_id: filter.target_id.as_ref().map(|target| target.as_str().to_owned()),
        }
    }

    /// The statement with its condition; only fixed text goes in, the values are for [`Range::bind`].
    fn sql(&self, statement: &str) -> String {
        let until = if self.until_us.is_some() { " AND time_us < $4" } else { "" };
        let target = if self.target_id.is_some() {
            format!(" AND target_id = ${}", self.next_parameter() - 1)
        } else {
            String::new()
        };
        format!("{statement} WHERE camera_key = $1 AND (time_us, target_id) > ($2, $3){until}{target}")
    }

    /// Number of the parameter after those of [`Range::bind`].
    fn next_parameter(&self) -> usize {
        4 + usize::from(self.until_us.is_some()) + usize::from(self.target_id.is_some())
    }

    /// A statement with the values of its condition.
    fn bind(&self, sql: &str) -> Query<StoredRow> {
        let (after_us, after_target) = self.after.clone();
        let query =
            query(AssertSqlSafe(sql.to_owned())).bind(self.camera_key).bind(after_us).bind(after_target);
        let query = match self.until_us {
            Some(until_us) => query.bind(until_us),
            None => query,
        };
        match self.target_id.clone() {
            Some(target) => query.bind(target),
            None => query,
        }
    }
}
