//! Reading, counting and deleting samples; `group_commit` stores them.

use jiff::Timestamp;
use sqlx::sqlite::{SqliteArguments, SqliteRow};
use sqlx::{AssertSqlSafe, Sqlite};

use super::Store;
use super::audit::Change;
use super::cameras::camera_key;
use super::errors::failed;
use super::group_commit::Inserted;
use super::row_decoder::RowDecoder;
use crate::domain::{
    AuditAction, BoundingBox, CameraId, CameraKey, Durability, Fix, Result, Sample, Score, SigmaM,
    TargetClass, TargetId, TimeRange,
};
use crate::geo::Position;

/// Which samples of a camera.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct SampleFilter {
    /// From this instant on.
    pub from: Option<Timestamp>,
    /// Before this instant.
    pub until: Option<Timestamp>,
    /// Of this target alone.
    pub target_id: Option<TargetId>,
}

impl SampleFilter {
    /// All samples of a stretch of time.
    #[must_use]
    pub fn within(range: TimeRange) -> Self {
        Self { from: range.from(), until: range.until(), target_id: None }
    }
}

/// The place of a sample in its camera's order: by time, then by target (bytes of its UTF-8).
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub struct SampleKey {
    /// The sample's time.
    pub time: Timestamp,
    /// The sample's target.
    pub target_id: TargetId,
}

impl SampleKey {
    /// The key of a sample, to go on after it.
    #[must_use]
    pub fn of(sample: &Sample) -> Self {
        Self { time: sample.time, target_id: sample.target_id.clone() }
    }
}

impl Store {
    /// Stores samples of a camera and returns after their commit, and with [`Durability::Synced`] after
    /// they have been flushed to the disk; all of them are stored, or none. A
    /// sample whose camera, target and time are stored already is left as it is and counted as a
    /// duplicate. Many callers at once share a transaction; a caller who goes away does not stop it.
    ///
    /// # Errors
    /// [`crate::domain::ErrorKind::CameraNotFound`], [`crate::domain::ErrorKind::InsufficientStorage`].
    pub async fn insert_samples(
        &self,
        id: &CameraId,
        samples: Vec<Sample>,
        durability: Durability,
    ) -> Result<Inserted> {
        self.inner.samples.insert(id.clone(), None, samples, durability).await
    }

    /// As [`Store::insert_samples`], for the camera of that key alone: if it was deleted and created again
    /// under the same id, nothing is stored.
    ///
    /// # Errors
    /// [`crate::domain::ErrorKind::CameraNotFound`], [`crate::domain::ErrorKind::InsufficientStorage`].
    pub async fn insert_samples_of(
        &self,
        id: &CameraId,
        key: CameraKey,
        samples: Vec<Sample>,
        durability: Durability,
    ) -> Result<Inserted> {
        self.inner.samples.insert(id.clone(), Some(key), samples, durability).await
    }

    /// A page of samples ordered by time and target, after a key.
    ///
    /// # Errors
    /// [`crate::domain::ErrorKind::CameraNotFound`].
    pub async fn samples(
        &self,
        id: &CameraId,
        filter: &SampleFilter,
        after: Option<SampleKey>,
        limit: u32,
    ) -> Result<Vec<Sample>> {
        let range = Range::of(camera_key(self.readers(), id).await?, filter, after);
        let sql = range.sql(
            "SELECT camera_key, time_us, target_id, left_px, top_px, width_px, height_px, longitude_deg, \
             latitude_deg, sigma_m, class, score, truth_longitude_deg, truth_latitude_deg FROM samples",
            " ORDER BY time_us, target_id LIMIT ?",
        );
        let rows = range.bind(&sql).bind(limit).fetch_all(self.readers()).await.map_err(failed)?;
        rows.iter().map(read_sample).collect()
    }

    /// How many samples a filter selects.
    ///
    /// # Errors
    /// [`crate::domain::ErrorKind::CameraNotFound`].
    pub async fn count_samples(&self, id: &CameraId, filter: &SampleFilter) -> Result<u64> {
        self.count(id, filter, "SELECT count(*) FROM samples").await
    }

    /// How many of the samples that a filter selects state the truth.
    ///
    /// # Errors
    /// [`crate::domain::ErrorKind::CameraNotFound`].
    pub async fn count_truths(&self, id: &CameraId, filter: &SampleFilter) -> Result<u64> {
        self.count(id, filter, "SELECT count(truth_longitude_deg) FROM samples").await
    }

    async fn count(&self, id: &CameraId, filter: &SampleFilter, head: &'static str) -> Result<u64> {
        let range = Range::of(camera_key(self.readers(), id).await?, filter, None);
        let sql = range.sql(head, "");
        let row = range.bind(&sql).fetch_one(self.readers()).await.map_err(failed)?;
        RowDecoder::new("samples", &row).parse(|stored: i64| u64::try_from(stored))
    }

    /// Time of the sample that has so many before it, in order of time; `None` behind the last.
    ///
    /// # Errors
    /// [`crate::domain::ErrorKind::CameraNotFound`].
    pub async fn sample_time(&self, id: &CameraId, before: u64) -> Result<Option<Timestamp>> {
        let range = Range::of(camera_key(self.readers(), id).await?, &SampleFilter::default(), None);
        let sql = range.sql("SELECT time_us FROM samples", " ORDER BY time_us, target_id LIMIT 1 OFFSET ?");
        let offset = i64::try_from(before).unwrap_or(i64::MAX);
        let row = range.bind(&sql).bind(offset).fetch_optional(self.readers()).await.map_err(failed)?;
        row.map(|row| RowDecoder::new("samples", &row).timestamp()).transpose()
    }

    /// How many samples a filter selects, and the corners of the ground they cover (south-west,
    /// north-east in degrees; across the antimeridian, of the whole parallel).
    ///
    /// # Errors
    /// [`crate::domain::ErrorKind::CameraNotFound`].
    pub async fn sample_extent(
        &self,
        id: &CameraId,
        filter: &SampleFilter,
    ) -> Result<(u64, Option<[Position; 2]>)> {
        let range = Range::of(camera_key(self.readers(), id).await?, filter, None);
        let sql = range.sql(
            "SELECT count(*), min(longitude_deg), min(latitude_deg), max(longitude_deg), max(latitude_deg) \
             FROM samples",
            "",
        );
        let row = range.bind(&sql).fetch_one(self.readers()).await.map_err(failed)?;
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

    /// Deletes the samples that a filter selects; returns how many.
    ///
    /// # Errors
    /// [`crate::domain::ErrorKind::CameraNotFound`].
    pub async fn delete_samples(&self, id: &CameraId, filter: &SampleFilter, now: Timestamp) -> Result<u64> {
        let mut deletion = self.deletion().await?;
        let mut transaction = deletion.begin().await?;
        let key = camera_key(&mut *transaction, id).await?;
        let range = Range::of(key, filter, None);
        let sql = range.sql("DELETE FROM samples", "");
        let deleted = range.bind(&sql).execute(&mut *transaction).await.map_err(failed)?.rows_affected();
        sqlx::query("UPDATE sample_counts SET samples = max(samples - ?, 0) WHERE camera_key = ?")
            .bind(i64::try_from(deleted).unwrap_or(i64::MAX))
            .bind(key)
            .execute(&mut *transaction)
            .await
            .map_err(failed)?;
        let subject = Some(format!("{deleted} samples"));
        let change = Change::of_camera(AuditAction::SamplesDeleted, id, subject);
        self.record(&mut transaction, change, now).await?;
        transaction.commit().await.map_err(failed)?;
        deletion.reclaim().await;
        Ok(deleted)
    }
}

/// A stretch of one camera's samples in key order, in the form that the primary key can seek.
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

    /// Only fixed text goes in; values are bound.
    fn sql(&self, head: &str, tail: &str) -> String {
        let until = if self.until_us.is_some() { " AND time_us < ?" } else { "" };
        let target = if self.target_id.is_some() { " AND target_id = ?" } else { "" };
        format!("{head} WHERE camera_key = ? AND (time_us, target_id) > (?, ?){until}{target}{tail}")
    }

    fn bind(self, sql: &str) -> sqlx::query::Query<'static, Sqlite, SqliteArguments> {
        let (after_us, after_target) = self.after;
        let query = sqlx::query(AssertSqlSafe(sql.to_owned()))
            .bind(self.camera_key)
            .bind(after_us)
            .bind(after_target);
        let query = match self.until_us {
            Some(until_us) => query.bind(until_us),
            None => query,
        };
        match self.target_id {
            Some(target) => query.bind(target),
            None => query,
        }
    }
}

fn read_sample(row: &SqliteRow) -> Result<Sample> {
    let mut fields = RowDecoder::new("samples", row).skip(1);
    let time = fields.timestamp()?;
    let target_id = fields.parse(TargetId::new)?;
    let (left_px, top_px) = (fields.get()?, fields.get()?);
    let (width_px, height_px) = (fields.get()?, fields.get()?);
    let bounding_box = fields.checked(BoundingBox::new(left_px, top_px, width_px, height_px))?;
    let (longitude_deg, latitude_deg) = (fields.get()?, fields.get()?);
    let position = fields.checked(Position::new(longitude_deg, latitude_deg))?;
    let sigma_m = fields.parse_optional(SigmaM::new)?;
    let class = fields.parse_optional(TargetClass::new)?;
    let score = fields.parse_optional(Score::new)?;
    let truth: (Option<f64>, Option<f64>) = (fields.get()?, fields.get()?);
    let truth =
        truth.0.zip(truth.1).map(|(longitude, latitude)| Position::new(longitude, latitude)).transpose();
    let truth = fields.checked(truth)?;
    Ok(Sample { time, target_id, bounding_box, fix: Fix { position, sigma_m }, class, score, truth })
}
