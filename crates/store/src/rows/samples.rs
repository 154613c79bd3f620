//! Rows of samples: the two tables, the order in them, and which of them a caller asks for.

use std::collections::HashSet;
use std::fmt;

use jiff::Timestamp;

use crate::domain::{
    AuditAction, BoundingBox, Fix, Result, Sample, SampleFilter, Score, SigmaM, StoredSample, TargetClass,
    TargetId,
};
use crate::geo::Position;
use crate::row_decoder::{RowDecoder, StoredRow};
use crate::rows::audit::Change;

/// A table of samples. A key is in one of them only.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum SampleTable {
    /// Samples with a fix.
    WithFix,
    /// Samples without one.
    WithoutFix,
}

impl fmt::Display for SampleTable {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        out.write_str(match self {
            Self::WithFix => "samples",
            Self::WithoutFix => "samples_without_fix",
        })
    }
}

/// A row with the batch it came from and the key of its camera.
pub(crate) struct Row<'a> {
    pub(crate) batch: usize,
    pub(crate) camera_key: i64,
    pub(crate) sample: &'a StoredSample,
}

/// Time and target of a sample, as they are stored.
pub(crate) fn key(sample: &StoredSample) -> (i64, &str) {
    (sample.time.as_microsecond(), sample.target_id.as_str())
}

/// Keeps the last of samples that have the same key; returns how many others there were.
pub(crate) fn keep_last(samples: &mut Vec<StoredSample>) -> u64 {
    let before = samples.len();
    let mut seen = HashSet::with_capacity(before);
    let mut is_last: Vec<bool> = samples
        .iter()
        .rev()
        .map(|sample| seen.insert((sample.time.as_microsecond(), sample.target_id.clone())))
        .collect();
    samples.retain(|_| is_last.pop().unwrap_or(true));
    (before - samples.len()) as u64
}

/// Time of the newest sample: a look at the end of each camera's primary keys.
pub(crate) const NEWEST_TIME: &str = "SELECT max(time_us) FROM (\
     SELECT (SELECT max(time_us) FROM samples WHERE camera_key = counts.camera_key) AS time_us \
     FROM sample_counts AS counts UNION ALL \
     SELECT (SELECT max(time_us) FROM samples_without_fix WHERE camera_key = counts.camera_key) \
     FROM sample_counts AS counts) AS newest";

/// The entry of the audit log for samples that are deleted for their age.
pub(crate) fn expired(before: Timestamp) -> Change<'static> {
    Change::of(AuditAction::SamplesDeleted, format!("samples from before {before}, by limits.sample_days"))
}

impl SampleTable {
    /// Both tables.
    pub(crate) const ALL: [Self; 2] = [Self::WithFix, Self::WithoutFix];

    /// The table of a sample.
    pub(crate) const fn of(sample: &StoredSample) -> Self {
        if sample.fix.is_some() { Self::WithFix } else { Self::WithoutFix }
    }

    /// The tables of the samples that are asked for.
    pub(crate) const fn asked_for(filter: &SampleFilter) -> &'static [Self] {
        match filter.has_fix {
            None => &Self::ALL,
            Some(true) => &[Self::WithFix],
            Some(false) => &[Self::WithoutFix],
        }
    }

    /// Columns to select, the same for both tables.
    pub(crate) const fn columns(self) -> &'static str {
        match self {
            Self::WithFix => {
                "camera_key, time_us, target_id, left_px, top_px, width_px, height_px, longitude_deg, \
                 latitude_deg, sigma_m, class, score, truth_longitude_deg, truth_latitude_deg"
            }
            Self::WithoutFix => {
                "camera_key, time_us, target_id, left_px, top_px, width_px, height_px, \
                 CAST(NULL AS DOUBLE PRECISION), CAST(NULL AS DOUBLE PRECISION), CAST(NULL AS DOUBLE PRECISION), \
                 class, score, truth_longitude_deg, truth_latitude_deg"
            }
        }
    }

    /// Column of `sample_counts` that counts the rows of the table.
    pub(crate) const fn counter(self) -> &'static str {
        match self {
            Self::WithFix => "samples",
            Self::WithoutFix => "without_fix",
        }
    }
}

/// The rows of several statements together, each of which is ordered and limited as all of them are.
pub(crate) fn ordered_union(statements: &[String], order: &str) -> String {
    if let [one] = statements {
        return one.clone();
    }
    let parts = statements.iter().map(|statement| format!("SELECT * FROM ({statement}) AS part"));
    format!("{} {order}", parts.collect::<Vec<_>>().join(" UNION ALL "))
}

/// A row of [`SampleTable::columns`].
pub(crate) fn read_sample(row: &StoredRow) -> Result<StoredSample> {
    let table = if row.is_null(7) { "samples_without_fix" } else { "samples" };
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
