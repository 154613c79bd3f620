//! Rows of evaluations.

use uuid::Uuid;

use crate::domain::{
    CameraId, Error, ErrorKind, EvaluationId, EvaluationJob, EvaluationPlan, EvaluationProgress, Method,
    Result, SigmaM, TimeRange, Truth,
};
use crate::geo::Position;
use crate::jobs::read_state;
use crate::row_decoder::{RowDecoder, StoredRow};

macro_rules! select_evaluations {
    ($rest:literal) => {
        concat!(
            "SELECT jobs.id, cameras.id, jobs.train_from_us, jobs.train_until_us, jobs.test_from_us, \
             jobs.test_until_us, jobs.truth_longitude_deg, jobs.truth_latitude_deg, jobs.truth_lines, \
             jobs.methods, jobs.recipe, jobs.seeds, jobs.box_shift_px, jobs.gnss_sigma_m, ", $crate::jobs::job_state!("jobs"), ", \
             jobs.attempt, jobs.phase, jobs.steps_done, jobs.steps_planned, jobs.remaining_s, jobs.outcome, \
             jobs.created_at_us, jobs.started_at_us, jobs.ended_at_us \
             FROM evaluations AS jobs JOIN cameras ON cameras.key = jobs.camera_key ",
            $rest
        )
    };
}

pub(crate) fn read_evaluation(row: &StoredRow) -> Result<EvaluationJob> {
    let mut fields = RowDecoder::new("evaluations", row);
    Ok(EvaluationJob {
        id: EvaluationId(fields.parse(Uuid::parse_str)?),
        camera_id: fields.parse(CameraId::new)?,
        plan: EvaluationPlan {
            train: read_range(&mut fields)?,
            test: read_range(&mut fields)?,
            truth: read_truth(&mut fields)?,
            methods: fields.parse(read_methods)?,
            recipe: fields.parse(|name: &str| name.parse())?,
            seeds: fields.count()?,
            box_shift_px: fields.get()?,
            gnss_sigma: fields.parse_optional(SigmaM::new)?,
        },
        state: fields.parse(read_state)?,
        attempt: fields.count()?,
        progress: EvaluationProgress {
            phase: fields.get()?,
            steps_done: fields.count()?,
            steps: fields.count()?,
            remaining_s: fields.get()?,
        },
        outcome: fields.get()?,
        created_at: fields.timestamp()?,
        started_at: fields.optional_timestamp()?,
        ended_at: fields.optional_timestamp()?,
    })
}

fn read_range(fields: &mut RowDecoder<'_>) -> Result<TimeRange> {
    let (from, until) = (fields.optional_timestamp()?, fields.optional_timestamp()?);
    fields.checked(TimeRange::new(from, until))
}

fn read_methods(json: &str) -> Result<Vec<Method>> {
    let names: Vec<String> = serde_json::from_str(json).map_err(Error::fault)?;
    names.iter().map(|name| name.parse()).collect()
}

/// A truth as its columns: a point, or lines as JSON.
pub(crate) fn written_truth(truth: &Truth) -> Result<(Option<Position>, Option<String>)> {
    match truth {
        Truth::Columns => Ok((None, None)),
        Truth::Point(point) => Ok((Some(*point), None)),
        Truth::Lines(lines) => {
            let pair = |point: &Position| [point.longitude_deg(), point.latitude_deg()];
            let lines: Vec<Vec<[f64; 2]>> =
                lines.iter().map(|line| line.iter().map(pair).collect()).collect();
            Ok((None, Some(serde_json::to_string(&lines).map_err(Error::fault)?)))
        }
    }
}

fn read_truth(fields: &mut RowDecoder<'_>) -> Result<Truth> {
    let (longitude_deg, latitude_deg): (Option<f64>, Option<f64>) = (fields.get()?, fields.get()?);
    let point =
        longitude_deg.zip(latitude_deg).map(|(longitude, latitude)| Position::new(longitude, latitude));
    let point = fields.checked(point.transpose())?;
    let lines = fields.parse_optional(read_lines)?;
    Ok(match (point, lines) {
        (Some(point), _) => Truth::Point(point),
        (None, Some(lines)) => Truth::Lines(lines),
        (None, None) => Truth::Columns,
    })
}

fn read_lines(json: &str) -> Result<Vec<Vec<Position>>> {
    let lines: Vec<Vec<[f64; 2]>> = serde_json::from_str(json).map_err(Error::fault)?;
    let read = |line: Vec<[f64; 2]>| {
        line.into_iter()
            .map(|[longitude_deg, latitude_deg]| {
                Position::new(longitude_deg, latitude_deg).map_err(Error::fault)
            })
            .collect()
    };
    lines.into_iter().map(read).collect()
}

pub(crate) use select_evaluations;

/// Refuses to cancel an evaluation that has ended.
pub(crate) fn check_not_ended(job: &EvaluationJob) -> Result<()> {
    if !job.state.has_ended() {
        return Ok(());
    }
    let ended = format!("the evaluation has ended already: {}", job.state.as_str());
    Err(Error::refused(ErrorKind::EvaluationEnded, ended))
}
