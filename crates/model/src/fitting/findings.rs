//! The findings of a run, in words: each candidate's held-out error, why it was kept or not, and what would
//! make the model surer.

use super::walked_line::is_one_line;
use crate::artifact::ModelParts;
use crate::domain::{CandidateFinding, CandidateReport, HeldOutError, ImageSize, TrainingReport};
use crate::geo::Position;
use crate::recipes::Candidate;
use crate::recipes::gaussian_process::KNOWN_POINTS;
use crate::regressor::Regressor;
use crate::samples::mirroring::{FootPosition, is_mirrored};
use crate::samples::rows::{TrainingRow, TrainingRows};
use crate::statistics::{R95_PER_SIGMA, median};

/// Below this share of held-out fixes inside the stated radius the report says so.
const LEAST_COVERAGE: f64 = 0.9;
/// Below this number of traverses more of them help.
const FEW_TRAVERSES: u32 = 8;
/// Sessions disagree if their bias per axis exceeds this share of the receiver's standard deviation.
const DISAGREEMENT: f64 = 0.5;

/// Below this share of a fix's 95 % radius the map's own error at the median of the scene needs no more walks.
const SMALL_MAP_ERROR: f64 = 0.5;

/// Rows at which the map's own error is looked at.
const MAP_ERROR_ROWS: usize = 512;

/// Rows that are compared with a mirror image.
const MIRROR_ROWS: usize = 512;

/// The outcome of a selection.
pub(super) struct Selection<'a> {
    /// The candidates that could be fitted, with their held-out errors.
    pub(super) candidates: &'a [&'a Candidate],
    pub(super) reports: &'a [CandidateReport],
    /// Mean squared held-out residual per axis of each, with outliers bounded, m2.
    pub(super) scores: &'a [f64],
    pub(super) chosen: usize,
}

/// The error that a model states of itself over the training positions: 95 % radii of one box alone, m.
struct MapError {
    median_m: f64,
    worst_m: f64,
    worst_at: Position,
}

impl MapError {
    /// `None` for a model that cannot be loaded, or without rows.
    fn of(rows: &TrainingRows, parts: &ModelParts) -> Option<Self> {
        let regressor = Regressor::build(parts.clone()).ok()?;
        let step = rows.rows.len().div_ceil(MAP_ERROR_ROWS).max(1);
        let radius_m = |row: &TrainingRow| regressor.regress(&row.bounding_box, None).r95_m();
        let radii: Vec<(f64, Position)> =
            rows.rows.iter().step_by(step).map(|row| (radius_m(row), row.position)).collect();
        let (worst_m, worst_at) = *radii.iter().max_by(|one, other| one.0.total_cmp(&other.0))?;
        Some(Self {
            median_m: median(radii.iter().map(|(radius_m, _)| *radius_m).collect()),
            worst_m,
            worst_at,
        })
    }

    fn text(&self) -> String {
        let Self { median_m, worst_m, worst_at } = self;
        format!(
            "; a box alone tells the position to {median_m:.1} m (95 %) at the median of the scene, and to {worst_m:.1} m \
             where it is worst, at longitude {:.6}, latitude {:.6}",
            worst_at.longitude_deg(),
            worst_at.latitude_deg()
        )
    }
}

/// The report of a run. `held_out` is the chosen candidate's error after its calibration.
pub(super) fn training_report(
    selection: &Selection<'_>,
    held_out: &HeldOutError,
    rows: &TrainingRows,
    parts: &ModelParts,
    image_size: Option<ImageSize>,
) -> TrainingReport {
    let Selection { candidates, reports, chosen, .. } = *selection;
    let map_error = MapError::of(rows, parts);
    let reason_to_keep = || {
        let of_map = map_error.as_ref().map(MapError::text).unwrap_or_default();
        format!("{}{of_map}", reason_to_keep(selection, parts))
    };
    let finding = |at: usize| {
        let is_chosen = at == chosen;
        let HeldOutError { mean_to_fix_m, coverage95_of_fixes, .. } =
            if is_chosen { held_out } else { &reports[at].held_out };
        CandidateFinding {
            candidate: candidates[at].name.to_owned(),
            weight: if is_chosen { 1.0 } else { 0.0 },
            held_out_miss_m: *mean_to_fix_m,
            coverage95_of_fixes: *coverage95_of_fixes,
            summary: if is_chosen { reason_to_keep() } else { reason_to_drop(selection, at) },
        }
    };
    TrainingReport {
        candidates: (0..candidates.len()).map(finding).collect(),
        advice: advice(held_out, rows, parts, image_size, map_error.as_ref()),
    }
}

fn reason_to_keep(selection: &Selection<'_>, parts: &ModelParts) -> String {
    let maps: Vec<String> = parts
        .parameters
        .iter()
        .filter_map(|(name, weight)| Some((name.strip_prefix("weight.")?, *weight)))
        .filter(|(_, weight)| *weight >= 0.01)
        .map(|(map, weight)| format!("{map} {weight:.2}"))
        .collect();
    let mixture = if maps.is_empty() { String::new() } else { format!("; mixture of {}", maps.join(", ")) };
    match selection.chosen {
        _ if selection.candidates.len() == 1 => format!("kept, the only candidate{mixture}"),
        0 => format!("kept, no other candidate is better by more than two standard errors{mixture}"),
        chosen => format!(
            "kept, its squared misses are {:.1} % smaller than those of {}, by more than two standard errors{mixture}",
            100.0 * (1.0 - selection.scores[chosen] / selection.scores[0]),
            selection.candidates[0].name
        ),
    }
}

fn reason_to_drop(selection: &Selection<'_>, at: usize) -> String {
    let Selection { candidates, scores, chosen, .. } = *selection;
    let larger = 100.0 * (scores[at] / scores[chosen] - 1.0);
    let kept = candidates[chosen].name;
    if larger > 0.0 {
        format!("not kept, its squared misses are {larger:.1} % larger than those of {kept}")
    } else {
        format!(
            "not kept, its squared misses are {:.1} % smaller than those of {kept}, within two standard errors",
            -larger
        )
    }
}

/// Advice for rows whose latitude and longitude seem to be swapped.
fn swapped_columns(rows: &TrainingRows) -> Option<String> {
    const REMEDY: &str = "swap the two columns, import these samples again with on_conflict=replace (--replace), and train again";
    let centre = rows.plane.origin();
    let swapped = rows.rows.iter().filter(|row| row.position.is_swapped_at(centre)).count();
    if swapped > 0 {
        return Some(format!(
            "latitude and longitude are swapped in {swapped} of {} samples, which lie near the others only with both \
             swapped: {REMEDY}",
            rows.rows.len()
        ));
    }
    let stride = rows.rows.len().div_ceil(MIRROR_ROWS);
    let points: Vec<FootPosition> = rows
        .rows
        .iter()
        .step_by(stride)
        .filter(|row| row.position.swapped().is_some())
        .map(|row| (row.bounding_box.foot_px(), row.position))
        .collect();
    is_mirrored(&points).then(|| {
        format!(
            "latitude and longitude seem to be swapped: the boxes show the positions as a mirror would, and no camera \
             does unless its picture is mirrored: {REMEDY}"
        )
    })
}

/// Advice to record more walks while the map is still the larger part of the answers' error.
fn more_walks(map_error: &MapError, parts: &ModelParts) -> Option<String> {
    let fix_m = R95_PER_SIGMA * parts.e_gnss_m2.sqrt();
    (map_error.median_m > SMALL_MAP_ERROR * fix_m).then(|| {
        format!(
            "walk on: a box alone tells the position to {:.1} m, a fix to {fix_m:.1} m; more walks help until the former is \
             below half of the latter",
            map_error.median_m
        )
    })
}

fn advice(
    held_out: &HeldOutError,
    rows: &TrainingRows,
    parts: &ModelParts,
    image_size: Option<ImageSize>,
    map_error: Option<&MapError>,
) -> Vec<String> {
    let mut advice: Vec<String> = swapped_columns(rows).into_iter().collect();
    advice.extend(map_error.and_then(|own| more_walks(own, parts)));
    // Known points show the bias.
    let is_bias_seen = parts.parameters.contains_key(KNOWN_POINTS);
    if rows.targets == 1 && !is_bias_seen {
        advice.push(
            "let a second receiver walk, or state known_points of the ground in the camera's profile: all fixes are of one \
             receiver, and its lasting bias cannot be seen; or state gnss_bias_sigma_m"
                .to_owned(),
        );
    }
    let sigma_m = |name: &str| parts.parameters.get(name).map_or(0.0, |variance_m2| variance_m2.sqrt());
    let between_m = sigma_m("between_sessions_m2").max(sigma_m("error_session_m2"));
    let sessions = rows.sessions();
    if sessions == 1 && !is_bias_seen {
        advice.push(
            "walk once more on another day: all samples are of one session, and a bias of that day cannot be seen"
                .to_owned(),
        );
    } else if between_m > DISAGREEMENT * parts.e_gnss_m2.sqrt() {
        // Per axis; the distance of two sessions has two axes of twice the variance.
        advice.push(format!(
            "walk once more on another day: the {sessions} sessions disagree by {:.1} m",
            2.0 * between_m
        ));
    }
    if is_one_line(rows) {
        advice.push(
            "cross the line on which all walks were: positions beside it rest on the heights of boxes alone"
                .to_owned(),
        );
    }
    if rows.traverses < FEW_TRAVERSES {
        advice.push(format!(
            "let targets cross the view on more lines: there are only {} passes",
            rows.traverses
        ));
    }
    if image_size.is_none() {
        advice.push(
            "state image_size in the camera's profile: the heights of boxes then tell the camera's geometry"
                .to_owned(),
        );
    }
    if held_out.coverage95_of_fixes < LEAST_COVERAGE {
        advice.push(format!(
            "check the pairing of boxes and fixes: only {:.0} % of the held-out fixes are inside the stated radius",
            100.0 * held_out.coverage95_of_fixes
        ));
    }
    if advice.is_empty() {
        advice.push("nothing in particular: receivers, sessions and passes are sufficient".to_owned());
    }
    advice
}
