//! Reading, counting and deleting samples; `group_commit` stores them.

use std::sync::Arc;

use jiff::Timestamp;
use sqlx::sqlite::{SqliteArguments, SqliteRow};
use sqlx::{AssertSqlSafe, Row as _, Sqlite};

use super::Store;
use super::audit::Change;
use super::cameras::camera_key;
use super::errors::failed;
use super::group_commit::{InsertOptions, Inserted};
use super::row_decoder::RowDecoder;
use super::sample_table::{SampleTable, subtract};
use crate::domain::{
    AuditAction, BoundingBox, CameraId, CameraKey, Detection, Durability, Fix, Result, Sample, Score, SigmaM,
    StoredSample, TargetClass, TargetId, TimeRange,
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
    /// Only samples that have a fix, or only those that have none.
    pub has_fix: Option<bool>,
}

impl SampleFilter {
    /// All samples of a stretch of time.
    #[must_use]
    pub fn within(range: TimeRange) -> Self {
        Self { from: range.from(), until: range.until(), ..Self::default() }
    }

    fn tables(&self) -> &'static [SampleTable] {
        match self.has_fix {
            None => &[SampleTable::WithFix, SampleTable::WithoutFix],
            Some(true) => &[SampleTable::WithFix],
            Some(false) => &[SampleTable::WithoutFix],
        }
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
    pub fn of<F>(sample: &Sample<F>) -> Self {
        Self { time: sample.time, target_id: sample.target_id.clone() }
    }
}

impl Store {
    /// Stores samples of a camera and returns after their commit, and with [`Durability::Synced`] after
    /// they have been flushed to the disk; all of them are stored, or none. A sample whose camera, target
    /// and time are stored already is left as it is and counted as a duplicate, but a sample with a fix
    /// takes the place of one without, and with [`OnConflict::Replace`](crate::domain::OnConflict) each takes
    /// the place of a stored one. Many callers at once share a transaction; a caller who goes away
    /// does not stop it.
    ///
    /// # Errors
    /// [`crate::domain::ErrorKind::CameraNotFound`], [`crate::domain::ErrorKind::InsufficientStorage`].
    pub async fn insert_samples(
        &self,
        id: &CameraId,
        samples: Vec<impl Into<StoredSample>>,
        options: impl Into<InsertOptions>,
    ) -> Result<Inserted> {
        let actor = Arc::clone(&self.actor);
        self.inner.samples.insert((id.clone(), None), stored(samples), options.into(), actor).await
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
        samples: Vec<impl Into<StoredSample>>,
        durability: Durability,
    ) -> Result<Inserted> {
        let actor = Arc::clone(&self.actor);
        self.inner.samples.insert((id.clone(), Some(key)), stored(samples), durability.into(), actor).await
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
    ) -> Result<Vec<StoredSample>> {
        let range = Range::of(camera_key(self.readers(), id).await?, filter, after);
        let select = |table: &SampleTable| range.sql(&format!("SELECT {} FROM {table}", table.columns()));
        let tables: Vec<String> = filter.tables().iter().map(select).collect();
        let sql = format!("{} ORDER BY time_us, target_id LIMIT ?", tables.join(" UNION ALL "));
        let query = filter.tables().iter().fold(query(&sql), |query, _| range.bind(query));
        let rows = query.bind(limit).fetch_all(self.readers()).await.map_err(failed)?;
        rows.iter().map(read_sample).collect()
    }

    /// At most so many of the boxes without a fix that a filter selects, in order of time and target. Of
    /// more, one of every few consecutive ones is taken, at a place that changes from few to few, so that
    /// none of several simultaneous targets is preferred.
    ///
    /// # Errors
    /// [`crate::domain::ErrorKind::CameraNotFound`].
    pub async fn thinned_detections(
        &self,
        id: &CameraId,
        filter: &SampleFilter,
        most: u32,
    ) -> Result<Vec<Detection>> {
        let filter = SampleFilter { has_fix: Some(false), ..filter.clone() };
        let count = self.count_samples(id, &filter).await?;
        let stride = i64::try_from(count.div_ceil(most.max(1).into()).max(1)).unwrap_or(i64::MAX);
        let (table, range) =
            (SampleTable::WithoutFix, Range::of(camera_key(self.readers(), id).await?, &filter, None));
        let numbered = range.sql(&format!(
            "SELECT {}, row_number() OVER (ORDER BY time_us, target_id) - 1 AS ordinal FROM {table}",
            table.columns()
        ));
        // The place within each stride is a multiplicative hash of the stride's number.
        let sql = format!(
            "SELECT * FROM ({numbered}) WHERE ordinal % {stride} = \
             (ordinal / {stride} * 2654435761 / 65536) % {stride} ORDER BY time_us, target_id"
        );
        let rows = range.bind(query(&sql)).fetch_all(self.readers()).await.map_err(failed)?;
        rows.iter().map(|row| read_sample(row).map(Detection::from)).collect()
    }

    /// How many samples a filter selects.
    ///
    /// # Errors
    /// [`crate::domain::ErrorKind::CameraNotFound`].
    pub async fn count_samples(&self, id: &CameraId, filter: &SampleFilter) -> Result<u64> {
        let mut count = 0;
        for table in filter.tables() {
            count += self.count(id, filter, &format!("SELECT count(*) FROM {table}")).await?;
        }
        Ok(count)
    }

    /// How many of the samples with a fix that a filter selects state the truth.
    ///
    /// # Errors
    /// [`crate::domain::ErrorKind::CameraNotFound`].
    pub async fn count_truths(&self, id: &CameraId, filter: &SampleFilter) -> Result<u64> {
        self.count(id, filter, "SELECT count(truth_longitude_deg) FROM samples").await
    }

    async fn count(&self, id: &CameraId, filter: &SampleFilter, select: &str) -> Result<u64> {
        let range = Range::of(camera_key(self.readers(), id).await?, filter, None);
        let sql = range.sql(select);
        let row = range.bind(query(&sql)).fetch_one(self.readers()).await.map_err(failed)?;
        RowDecoder::new("samples", &row).parse(|stored: i64| u64::try_from(stored))
    }

    /// Time of the sample with a fix that has so many before it, in order of time; `None` behind the last.
    ///
    /// # Errors
    /// [`crate::domain::ErrorKind::CameraNotFound`].
    pub async fn sample_time(&self, id: &CameraId, before: u64) -> Result<Option<Timestamp>> {
        let range = Range::of(camera_key(self.readers(), id).await?, &SampleFilter::default(), None);
        let sql = format!(
            "{} ORDER BY time_us, target_id LIMIT 1 OFFSET ?",
            range.sql("SELECT time_us FROM samples")
        );
        let offset = i64::try_from(before).unwrap_or(i64::MAX);
        let row =
            range.bind(query(&sql)).bind(offset).fetch_optional(self.readers()).await.map_err(failed)?;
        row.map(|row| RowDecoder::new("samples", &row).timestamp()).transpose()
    }

    /// How many samples with a fix a filter selects, and the corners of the ground they cover (south-west,
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
        );
        let row = range.bind(query(&sql)).fetch_one(self.readers()).await.map_err(failed)?;
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
        let mut deleted = 0;
        for table in filter.tables() {
            let sql = range.sql(&format!("DELETE FROM {table}"));
            let rows =
                range.bind(query(&sql)).execute(&mut *transaction).await.map_err(failed)?.rows_affected();
            subtract(&mut transaction, *table, key, rows).await?;
            deleted += rows;
        }
        let subject = Some(format!("{deleted} samples"));
        let change = Change::of_camera(AuditAction::SamplesDeleted, id, subject);
        self.record(&mut transaction, change, now).await?;
        transaction.commit().await.map_err(failed)?;
        deletion.reclaim().await;
        Ok(deleted)
    }
}

fn stored(samples: Vec<impl Into<StoredSample>>) -> Vec<StoredSample> {
    samples.into_iter().map(Into::into).collect()
}

type Query = sqlx::query::Query<'static, Sqlite, SqliteArguments>;

/// Only fixed text goes into statements; values are bound.
fn query(sql: &str) -> Query {
    sqlx::query(AssertSqlSafe(sql.to_owned()))
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

    /// The statement with its condition; only fixed text goes in, the values are for [`Range::bind`].
    fn sql(&self, statement: &str) -> String {
        let until = if self.until_us.is_some() { " AND time_us < ?" } else { "" };
        let target = if self.target_id.is_some() { " AND target_id = ?" } else { "" };
        format!("{statement} WHERE camera_key = ? AND (time_us, target_id) > (?, ?){until}{target}")
    }

    fn bind(&self, query: Query) -> Query {
        let (after_us, after_target) = self.after.clone();
        let query = query.bind(self.camera_key).bind(after_us).bind(after_target);
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

/// A row of [`SampleTable::columns`].
fn read_sample(row: &SqliteRow) -> Result<StoredSample> {
    let longitude_deg: Option<f64> = row.try_get(7).unwrap_or_default();
    let table = if longitude_deg.is_some() { "samples" } else { "samples_without_fix" };
    let mut fields = RowDecoder::new(table, row).skip(1);
    let time = fields.timestamp()?;
    let target_id = fields.parse(TargetId::new)?;
    let (left_px, top_px) = (fields.get()?, fields.get()?);
    let (width_px, height_px) = (fields.get()?, fields.get()?);
    let bounding_box = fields.checked(BoundingBox::new(left_px, top_px, width_px, height_px))?;
    let fix_position = position(&mut fields)?;
    let sigma_m = fields.parse_optional(SigmaM::new)?;
    let fix = fix_position.map(|position| Fix { position, sigma_m });
    let class = fields.parse_optional(TargetClass::new)?;
    let score = fields.parse_optional(Score::new)?;
    let truth = position(&mut fields)?;
    Ok(Sample { time, target_id, bounding_box, fix, class, score, truth })
}

/// The next two columns.
fn position(fields: &mut RowDecoder<'_>) -> Result<Option<Position>> {
    let (longitude_deg, latitude_deg): (Option<f64>, Option<f64>) = (fields.get()?, fields.get()?);
    let position = longitude_deg.zip(latitude_deg);
    fields.checked(position.map(|(longitude, latitude)| Position::new(longitude, latitude)).transpose())
}
