//! Plots of an evaluation: errors over time and their distribution, stated against found error, and the
//! positions in the plane.

use super::axis::{Axes, AxisSpec};
use super::chart::{Panel, Series, Shape, chart, panels};
use super::options::TestRow;
use super::traces::{Curve, Evaluation, Trace, TracePoint};
use crate::domain::Truth;
use crate::geo::{EastNorth, LocalPlane, Position};
use crate::statistics::R95_PER_SIGMA;

/// Vertices of a line that shows a distribution.
const DISTRIBUTION_POINTS: usize = 200;
/// Ellipses per panel of the plane.
const ELLIPSES: usize = 24;
/// Vertices of an ellipse.
const ELLIPSE_POINTS: usize = 28;
/// Gaps between test rows are shown as this, s, so that traverses are adjacent.
const SHOWN_GAP_S: f64 = 5.0;

/// The plots by file name. Those for which there is nothing to show are left out: Es per epoch without
/// a recipe that has epochs, the calibration without a method that states its error.
#[must_use]
pub fn plots(evaluation: &Evaluation, test: &[TestRow], truth: &Truth) -> Vec<(String, String)> {
    let traces: Vec<&Trace> = evaluation.traces.iter().collect();
    let documents = [
        ("error_over_time.svg", error_over_time(&traces, test)),
        ("cumulative_share.svg", cumulative_share("Share of errors below a bound", &traces)),
        ("calibration.svg", calibration("Share of true positions inside the stated radius", &traces)),
        ("plane.svg", plane("Positions", &traces, test, truth)),
        ("error_scale.svg", error_scale(&evaluation.curves)),
    ];
    documents.into_iter().filter_map(|(name, svg)| Some((name.to_owned(), svg?))).collect()
}

/// Errors over test time, a panel per method.
fn error_over_time(traces: &[&Trace], test: &[TestRow]) -> Option<String> {
    let mut times_s: Vec<f64> = test.iter().map(time_s).collect();
    times_s.sort_by(f64::total_cmp);
    times_s.dedup();
    let mut shown_s = vec![0.0];
    for pair in times_s.windows(2) {
        let last_s = shown_s[shown_s.len() - 1];
        shown_s.push(last_s + (pair[1] - pair[0]).min(SHOWN_GAP_S));
    }
    let elapsed_s = |row: usize| {
        let at = times_s.partition_point(|&other_s| other_s < time_s(&test[row]));
        shown_s[at.min(shown_s.len() - 1)]
    };
    let points = |point: &TracePoint| Some([elapsed_s(point.row), point.error_m?]);
    let series = dots(traces, &points);
    let axes = Axes {
        across: AxisSpec::linear("seconds of test rows, gaps shortened", 0.0, shown_s[shown_s.len() - 1]),
        upward: AxisSpec::logarithmic("error, m", errors_m(traces)),
        equal_scale: false,
    };
    let each =
        series.into_iter().map(|series| Panel { background: Vec::new(), foreground: Vec::new(), series });
    Some(panels("Error over time", &axes, (1, 92.0), &each.collect::<Vec<_>>()))
}

fn time_s(row: &TestRow) -> f64 {
    row.observation.time().as_microsecond() as f64 * 1e-6
}

fn errors_m<'a>(traces: &'a [&Trace]) -> impl Iterator<Item = f64> + 'a {
    traces.iter().flat_map(|trace| &trace.points).filter_map(|point| point.error_m)
}

/// The cumulative distribution of every method's errors; `None` without any error.
pub(crate) fn cumulative_share(title: &str, traces: &[&Trace]) -> Option<String> {
    errors_m(traces).next()?;
    let distribution = |(number, trace): (usize, &&Trace)| {
        let errors_m: Vec<f64> = trace.points.iter().filter_map(|point| point.error_m).collect();
        Series::new(&trace.method, number, cumulative(errors_m), Shape::Line)
    };
    let series: Vec<Series> = traces.iter().enumerate().map(distribution).collect();
    let axes = Axes {
        across: AxisSpec::logarithmic("error, m", errors_m(traces)),
        upward: AxisSpec::linear("share of errors at most as large", 0.0, 1.0),
        equal_scale: false,
    };
    Some(chart(title, &axes, &series))
}

/// Found against stated share of true positions inside the radius, for the methods that state one; on the
/// diagonal the stated error is right, below it too small. `None` if no method states a radius.
///
/// The radius of a share p of an isotropic normal distribution is `r95 sqrt(ln(1 - p) / ln 0.05)`, so a
/// point is inside from the share `1 - exp(ln 0.05 (error / r95)^2)` on.
pub(crate) fn calibration(title: &str, traces: &[&Trace]) -> Option<String> {
    let curve = |(number, trace): (usize, &&Trace)| {
        let share = |point: &TracePoint| {
            let ratio = point.error_m? / point.r95_m?;
            Some(1.0 - (0.05_f64.ln() * ratio * ratio).exp())
        };
        let shares: Vec<f64> = trace.points.iter().filter_map(share).collect();
        (!shares.is_empty()).then(|| Series::new(&trace.method, number, cumulative(shares), Shape::Line))
    };
    let mut series: Vec<Series> = traces.iter().enumerate().filter_map(curve).collect();
    if series.is_empty() {
        return None;
    }
    series.push(Series::truth("a radius that is right", vec![[0.0, 0.0], [1.0, 1.0]], Shape::Line));
    let axes = Axes {
        across: AxisSpec::linear("stated share", 0.0, 1.0),
        upward: AxisSpec::linear("found share", 0.0, 1.0),
        equal_scale: false,
    };
    Some(chart(title, &axes, &series))
}

/// Vertices of the cumulative distribution of some values, from (lowest, 0) on.
fn cumulative(mut values: Vec<f64>) -> Vec<[f64; 2]> {
    values.sort_by(f64::total_cmp);
    let count = values.len();
    let steps = count.clamp(1, DISTRIBUTION_POINTS);
    let vertex = |step: usize| {
        let rank = step * count / steps;
        Some([*values.get(rank.saturating_sub(1))?, rank as f64 / count as f64])
    };
    (0..=steps).filter_map(vertex).collect()
}

/// The positions of every method in a panel of their own, with some of their stated 95 % ellipses, under
/// the truth; `None` without any position.
pub(crate) fn plane(title: &str, traces: &[&Trace], test: &[TestRow], truth: &Truth) -> Option<String> {
    let plane = LocalPlane::new(traces.iter().find_map(|trace| trace.points.first())?.position);
    let in_plane = |position: Position| {
        let EastNorth { east_m, north_m } = plane.to_plane(position);
        [east_m, north_m]
    };
    let known = match truth {
        Truth::Columns => {
            let points: Vec<[f64; 2]> = test.iter().filter_map(|row| row.truth.map(in_plane)).collect();
            vec![Series::truth("truth", points, Shape::Dots)]
        }
        Truth::Point(point) => vec![Series::truth("truth", vec![in_plane(*point)], Shape::Dots)],
        Truth::Lines(lines) => lines
            .iter()
            .map(|line| line.iter().map(|&point| in_plane(point)).collect())
            .map(|line| Series::truth("truth", line, Shape::Outline))
            .collect(),
    };
    let series = dots(traces, &|point| Some(in_plane(point.position)));
    let truths = known.iter().flat_map(Series::points).copied();
    let range = |axis: usize| extent(truths.clone(), series.iter().flat_map(Series::points).copied(), axis);
    let ([west_m, east_m], [south_m, north_m]) = (range(0), range(1));
    let axes = Axes {
        across: AxisSpec::linear("east, m", west_m, east_m),
        upward: AxisSpec::linear("north, m", south_m, north_m),
        equal_scale: true,
    };
    let each = series.into_iter().zip(traces).enumerate().map(|(number, (series, trace))| {
        let background = vec![Series::new("", number, ellipses(trace, &in_plane), Shape::Outline)];
        Panel { background, foreground: known.clone(), series }
    });
    Some(panels(title, &axes, (4, 260.0), &each.collect::<Vec<_>>()))
}

/// The truth's range and the central 90 % of all positions along an axis, with a margin.
fn extent(
    truths: impl Iterator<Item = [f64; 2]>,
    positions: impl Iterator<Item = [f64; 2]>,
    axis: usize,
) -> [f64; 2] {
    let mut values: Vec<f64> = positions.map(|point| point[axis]).collect();
    values.sort_by(f64::total_cmp);
    let tail = values.len() / 20;
    let central = values.get(tail).into_iter().chain(values.iter().rev().nth(tail)).copied();
    let (low, high) = truths
        .map(|point| point[axis])
        .chain(central)
        .fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), value| (low.min(value), high.max(value)));
    let margin = 0.06 * (high - low).max(1.0);
    [low - margin, high + margin]
}

/// Evenly chosen 95 % ellipses of a trace's stated covariances, or circles of its radii.
fn ellipses(trace: &Trace, in_plane: &dyn Fn(Position) -> [f64; 2]) -> Vec<[f64; 2]> {
    let step = trace.points.len().div_ceil(ELLIPSES).max(1);
    let mut vertices = Vec::new();
    for point in trace.points.iter().step_by(step) {
        let root_m = match (point.covariance, point.r95_m) {
            (Some(covariance), _) => covariance.square_root_m(),
            (None, Some(r95_m)) => [r95_m / R95_PER_SIGMA, r95_m / R95_PER_SIGMA, 0.0],
            (None, None) => continue,
        };
        let [east_m, north_m] = in_plane(point.position);
        vertices.extend((0..=ELLIPSE_POINTS).map(|vertex| {
            let angle = std::f64::consts::TAU * vertex as f64 / ELLIPSE_POINTS as f64;
            let (sine, cosine) = (R95_PER_SIGMA * angle.sin(), R95_PER_SIGMA * angle.cos());
            [east_m + root_m[0] * cosine + root_m[2] * sine, north_m + root_m[2] * cosine + root_m[1] * sine]
        }));
        vertices.push([f64::NAN; 2]);
    }
    vertices
}

/// Es per epoch of the recipes that are fitted by epochs.
fn error_scale(curves: &[Curve]) -> Option<String> {
    let points = |curve: &Curve| -> Vec<[f64; 2]> {
        let positive = curve.epochs.iter().filter(|one| one.error_scale > 0.0);
        positive.map(|one| [f64::from(one.epoch), one.error_scale]).collect()
    };
    let series: Vec<Series> = curves
        .iter()
        .enumerate()
        .map(|(number, curve)| Series::new(curve.recipe.as_str(), number, points(curve), Shape::Line))
        .filter(|series| !series.points().is_empty())
        .collect();
    let vertices = || series.iter().flat_map(Series::points);
    let last_epoch = vertices().map(|point| point[0]).reduce(f64::max)?;
    let axes = Axes {
        across: AxisSpec::linear("epoch", 1.0, last_epoch),
        upward: AxisSpec::logarithmic("Es", vertices().map(|point| point[1])),
        equal_scale: false,
    };
    Some(chart("Es per epoch", &axes, &series))
}

fn dots(traces: &[&Trace], point: &dyn Fn(&TracePoint) -> Option<[f64; 2]>) -> Vec<Series> {
    let one = |(number, trace): (usize, &&Trace)| {
        let points = trace.points.iter().filter_map(point).collect();
        Series::new(&trace.method, number, points, Shape::Dots)
    };
    traces.iter().enumerate().map(one).collect()
}
