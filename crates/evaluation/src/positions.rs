//! The positions from which a report's figures are computed, for maps and charts.

use std::collections::BTreeMap;

use serde::Serialize;
use utoipa::ToSchema;

use super::options::TestRow;
use super::report::Report;
use super::traces::{Evaluation, TracePoint};

/// Test rows whose positions are shown, at most.
const SHOWN_ROWS: usize = 500;

/// A position that a method predicted with the first seed, and its error.
#[derive(Debug, Clone, PartialEq, Serialize, ToSchema)]
pub struct EvaluatedPosition {
    /// Longitude of the predicted position, degrees.
    pub longitude_deg: f64,
    /// Its latitude, degrees.
    pub latitude_deg: f64,
    /// Its horizontal error, m, where the truth is known.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub error_m: Option<f64>,
    /// The 95 % radius that the method states, m, if it states one.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub r95_m: Option<f64>,
    /// Longitude of the true position, degrees, where the sample states it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub truth_longitude_deg: Option<f64>,
    /// Its latitude, degrees.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub truth_latitude_deg: Option<f64>,
}

/// A report, and the positions that it is about.
#[derive(Debug, Clone, PartialEq, Serialize, ToSchema)]
#[schema(as = EvaluationOutcome)]
pub struct ReportWithPositions {
    /// Figures of all methods.
    #[serde(flatten)]
    pub report: Report,
    /// Positions by the method's name: those of at most 500 test samples, the same for every method, in order of
    /// target, then time.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub positions: BTreeMap<String, Vec<EvaluatedPosition>>,
}

impl Evaluation {
    /// The report with positions of some of the test rows.
    #[must_use]
    pub fn into_report_with_positions(self, test: &[TestRow]) -> ReportWithPositions {
        let step = test.len().div_ceil(SHOWN_ROWS).max(1);
        let shown = |points: Vec<TracePoint>| -> Vec<EvaluatedPosition> {
            let chosen = points.iter().filter(|point| point.row.is_multiple_of(step));
            chosen.map(|point| position(point, test)).collect()
        };
        let traces = self.traces.into_iter();
        let positions = traces.map(|trace| (trace.method, shown(trace.points))).collect();
        ReportWithPositions { report: self.report, positions }
    }
}

fn position(point: &TracePoint, test: &[TestRow]) -> EvaluatedPosition {
    let truth = test.get(point.row).and_then(|row| row.truth);
    EvaluatedPosition {
        longitude_deg: rounded(point.position.longitude_deg(), 1e8),
        latitude_deg: rounded(point.position.latitude_deg(), 1e8),
        error_m: point.error_m.map(|error_m| rounded(error_m, 1e4)),
        r95_m: point.r95_m.map(|r95_m| rounded(r95_m, 1e4)),
        truth_longitude_deg: truth.map(|truth| rounded(truth.longitude_deg(), 1e8)),
        truth_latitude_deg: truth.map(|truth| rounded(truth.latitude_deg(), 1e8)),
    }
}

/// A value in steps of `1 / steps`, which shortens the document.
fn rounded(value: f64, steps: f64) -> f64 {
    (value * steps).round() / steps
}

#[cfg(test)]
mod tests {
    use super::super::traces::Trace;
    use super::*;
    use crate::domain::{Fix, Observation};
    use crate::geo::Position;

    #[test]
    fn every_method_shows_the_same_rows_within_the_limit() {
        let at = Position::new(11.0, 48.0).expect("valid");
        let time = jiff::Timestamp::UNIX_EPOCH;
        let row = TestRow {
            observation: Observation::with_fix(time, None, None, Fix { position: at, sigma_m: None }),
            truth: Some(at),
        };
        let test = vec![row; 1_300];
        let point = |row| TracePoint {
            row,
            position: Position::new(11.0 + row as f64 * 1e-6, 48.0).expect("valid"),
            error_m: Some(row as f64 / 3.0),
            r95_m: None,
            covariance: None,
        };
        let every = Trace { method: "gnss".to_owned(), points: (0..1_300).map(point).collect() };
        // A method without an answer for some rows.
        let some = Trace {
            method: "track".to_owned(),
            points: (0..1_300).filter(|row| row % 2 == 0).map(point).collect(),
        };
        let evaluation = Evaluation { traces: vec![every, some], ..Evaluation::default() };
        let shown = evaluation.into_report_with_positions(&test).positions;
        assert_eq!((shown["gnss"].len(), shown["track"].len()), (434, 217));
        assert!(shown["track"].iter().all(|position| shown["gnss"].contains(position)));
        assert_eq!(shown["gnss"][1].error_m, Some(1.0), "the fourth row, in steps of 0.1 mm");
        assert_eq!(shown["gnss"][1].truth_longitude_deg, Some(11.0));
    }
}
