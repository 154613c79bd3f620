//! Plots of an evaluation as self-contained SVG documents, without scripts or embedded fonts.

use std::fmt::Write as _;

use super::options::TestRow;
use super::traces::{Curve, Evaluation, Trace, TracePoint};
use crate::domain::Truth;
use crate::geo::{EastNorth, LocalPlane, Position};

/// Size of a plot: width, height, px.
const SIZE_PX: [f64; 2] = [900.0, 520.0];
/// Frame of the axes within the plot: left, top, right, bottom, px.
const FRAME_PX: [f64; 4] = [70.0, 40.0, 690.0, 465.0];
/// Colours that are distinct under colour blindness (after Okabe and Ito), then darker ones.
const COLOURS: [&str; 10] = [
    "#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#7f7f7f", "#8c564b", "#4b0092",
    "#1a1a1a",
];
/// A series with more points than this is thinned.
const MOST_POINTS: usize = 3_000;

/// The plots by file name: error over time, cumulative share, the plane, and Es per epoch.
#[must_use]
pub fn plots(evaluation: &Evaluation, test: &[TestRow], truth: &Truth) -> Vec<(String, String)> {
    let mut documents = vec![
        ("error_over_time.svg".to_owned(), error_over_time(&evaluation.traces, test)),
        ("cumulative_share.svg".to_owned(), cumulative_share(&evaluation.traces)),
        ("plane.svg".to_owned(), plane(&evaluation.traces, test, truth)),
    ];
    if !evaluation.curves.is_empty() {
        let curve = |curve: &Curve| Series {
            name: curve.recipe.to_string(),
            points: curve
                .epochs
                .iter()
                .map(|one| [f64::from(one.epoch), one.error_scale.max(1e-12).log10()])
                .collect(),
            shape: Shape::Line,
        };
        let series: Vec<Series> = evaluation.curves.iter().map(curve).collect();
        documents
            .push(("error_scale.svg".to_owned(), chart("Es per epoch", "epoch", "log10 Es", &series, false)));
    }
    documents
}

#[derive(Clone, Copy, PartialEq)]
enum Shape {
    Line,
    Dots,
}

struct Series {
    name: String,
    points: Vec<[f64; 2]>,
    shape: Shape,
}

/// Errors over test time, with gaps shortened to 5 s so that passes are adjacent.
fn error_over_time(traces: &[Trace], test: &[TestRow]) -> String {
    let mut times_s: Vec<f64> =
        test.iter().map(|row| row.observation.time().as_microsecond() as f64 * 1e-6).collect();
    times_s.sort_by(f64::total_cmp);
    times_s.dedup();
    let mut shown_s = vec![0.0];
    for pair in times_s.windows(2) {
        let last_s = shown_s[shown_s.len() - 1];
        shown_s.push(last_s + (pair[1] - pair[0]).min(5.0));
    }
    let elapsed_s = |row: usize| {
        let time_s = test[row].observation.time().as_microsecond() as f64 * 1e-6;
        shown_s[times_s.partition_point(|&other_s| other_s < time_s).min(shown_s.len() - 1)]
    };
    let points = |point: &TracePoint| Some([elapsed_s(point.row), point.error_m?]);
    let series = of_traces(traces, Shape::Dots, &points);
    chart("Error over time", "seconds of test rows, gaps shortened", "error, m", &series, false)
}

fn cumulative_share(traces: &[Trace]) -> String {
    let share = |trace: &Trace| {
        let mut errors_m: Vec<f64> = trace.points.iter().filter_map(|point| point.error_m).collect();
        errors_m.sort_by(f64::total_cmp);
        let count = errors_m.len().max(1) as f64;
        let points =
            errors_m.iter().enumerate().map(|(index, &error_m)| [error_m, (index + 1) as f64 / count]);
        Series { name: trace.method.clone(), points: thin(points.collect()), shape: Shape::Line }
    };
    let series: Vec<Series> = traces.iter().map(share).collect();
    chart("Share of errors below a bound", "error, m", "share", &series, false)
}

fn plane(traces: &[Trace], test: &[TestRow], truth: &Truth) -> String {
    let first = traces.iter().find_map(|trace| trace.points.first());
    let Some(first) = first else { return chart("Positions", "east, m", "north, m", &[], true) };
    let plane = LocalPlane::new(first.position);
    let in_plane = |position: Position| {
        let EastNorth { east_m, north_m } = plane.to_plane(position);
        [east_m, north_m]
    };
    let mut series = of_traces(traces, Shape::Dots, &|point| Some(in_plane(point.position)));
    let mut known = |points: Vec<[f64; 2]>, shape| {
        series.push(Series { name: "truth".to_owned(), points, shape });
    };
    match truth {
        Truth::Columns => {
            known(thin(test.iter().filter_map(|row| row.truth.map(in_plane)).collect()), Shape::Dots);
        }
        Truth::Point(point) => known(vec![in_plane(*point)], Shape::Dots),
        Truth::Lines(lines) => {
            for line in lines {
                known(line.iter().map(|&point| in_plane(point)).collect(), Shape::Line);
            }
        }
    }
    chart("Positions", "east, m", "north, m", &series, true)
}

fn of_traces(traces: &[Trace], shape: Shape, point: &dyn Fn(&TracePoint) -> Option<[f64; 2]>) -> Vec<Series> {
    let one = |trace: &Trace| Series {
        name: trace.method.clone(),
        points: thin(trace.points.iter().filter_map(point).collect()),
        shape,
    };
    traces.iter().map(one).collect()
}

fn thin(points: Vec<[f64; 2]>) -> Vec<[f64; 2]> {
    let step = points.len().div_ceil(MOST_POINTS).max(1);
    points.into_iter().step_by(step).collect()
}

/// Maps values to px and places ticks at round values.
struct Axis {
    low: f64,
    high: f64,
    from_px: f64,
    to_px: f64,
}

impl Axis {
    /// Spans the values except for the uppermost 0.5 %, so that one outlier does not compress all
    /// others.
    fn over(mut values: Vec<f64>, from_px: f64, to_px: f64) -> Self {
        values.retain(|value| value.is_finite());
        values.sort_by(f64::total_cmp);
        let last = values.len().saturating_sub(1);
        let low = values.first().copied().unwrap_or(0.0);
        let high = values.get(last - last / 200).copied().unwrap_or(1.0);
        let margin = if high > low { 0.03 * (high - low) } else { 0.5 };
        Self { low: low - margin, high: high + margin, from_px, to_px }
    }

    fn at(&self, value: f64) -> f64 {
        let part = (value - self.low) / (self.high - self.low);
        self.from_px + part.clamp(-0.02, 1.02) * (self.to_px - self.from_px)
    }

    fn ticks(&self) -> Vec<f64> {
        let raw = (self.high - self.low) / 6.0;
        let power = 10.0_f64.powf(raw.log10().floor());
        let step = [1.0, 2.0, 5.0, 10.0].into_iter().map(|one| one * power).find(|&one| one >= raw);
        let step = step.unwrap_or(raw);
        let first = (self.low / step).ceil() as i64;
        (first..first + 12).map(|index| index as f64 * step).take_while(|&tick| tick <= self.high).collect()
    }

    fn per_px(&self) -> f64 {
        (self.high - self.low) / (self.to_px - self.from_px).abs()
    }

    /// Widens the axis about its centre to a given value per px.
    fn widen(&mut self, per_px: f64) {
        let half = 0.5 * per_px * (self.to_px - self.from_px).abs();
        let centre = 0.5 * (self.low + self.high);
        (self.low, self.high) = (centre - half, centre + half);
    }
}

/// A chart with its legend; `equal_scale` gives both axes the same scale.
fn chart(title: &str, across: &str, upward: &str, series: &[Series], equal_scale: bool) -> String {
    let [left, top, right, bottom] = FRAME_PX;
    let values = |axis: usize| series.iter().flat_map(|one| &one.points).map(|point| point[axis]).collect();
    let mut x = Axis::over(values(0), left, right);
    let mut y = Axis::over(values(1), bottom, top);
    if equal_scale {
        let per_px = x.per_px().max(y.per_px());
        x.widen(per_px);
        y.widen(per_px);
    }
    let mut svg = String::new();
    // Writing to a string cannot fail.
    let _ = write!(
        svg,
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {} {}\" font-family=\"sans-serif\" \
         font-size=\"12\">\n<rect width=\"100%\" height=\"100%\" fill=\"white\"/>\n\
         <text x=\"{left}\" y=\"24\" font-size=\"16\">{title}</text>\n",
        SIZE_PX[0], SIZE_PX[1]
    );
    axes(&mut svg, &x, &y, across, upward);
    for (index, one) in series.iter().enumerate() {
        let colour = if one.name == "truth" { "#000000" } else { COLOURS[index % COLOURS.len()] };
        draw(&mut svg, one, colour, &x, &y);
        let line_px = top + 8.0 + 18.0 * index as f64;
        let _ = writeln!(
            svg,
            "<rect x=\"{}\" y=\"{}\" width=\"12\" height=\"4\" fill=\"{colour}\"/>\
             <text x=\"{}\" y=\"{}\">{}</text>",
            right + 15.0,
            line_px,
            right + 33.0,
            line_px + 6.0,
            one.name
        );
    }
    svg.push_str("</svg>\n");
    svg
}

fn axes(svg: &mut String, x: &Axis, y: &Axis, across: &str, upward: &str) {
    let [left, top, right, bottom] = FRAME_PX;
    for tick in x.ticks() {
        let at = x.at(tick);
        let _ = writeln!(
            svg,
            "<path d=\"M{at:.1} {top}V{bottom}\" stroke=\"#dddddd\"/>\
             <text x=\"{at:.1}\" y=\"{}\" text-anchor=\"middle\">{}</text>",
            bottom + 17.0,
            number(tick)
        );
    }
    for tick in y.ticks() {
        let at = y.at(tick);
        let _ = writeln!(
            svg,
            "<path d=\"M{left} {at:.1}H{right}\" stroke=\"#dddddd\"/>\
             <text x=\"{}\" y=\"{:.1}\" text-anchor=\"end\">{}</text>",
            left - 6.0,
            at + 4.0,
            number(tick)
        );
    }
    let _ = writeln!(
        svg,
        "<path d=\"M{left} {top}V{bottom}H{right}\" stroke=\"black\" fill=\"none\"/>\
         <text x=\"{}\" y=\"{}\" text-anchor=\"middle\">{across}</text>\
         <text transform=\"translate(18 {}) rotate(-90)\" text-anchor=\"middle\">{upward}</text>",
        0.5 * (left + right),
        bottom + 38.0,
        0.5 * (top + bottom)
    );
}

fn draw(svg: &mut String, series: &Series, colour: &str, x: &Axis, y: &Axis) {
    let mut path = String::new();
    for (index, [across, upward]) in series.points.iter().enumerate() {
        let (at_x, at_y) = (x.at(*across), y.at(*upward));
        let _ = match (series.shape, index) {
            (Shape::Dots, _) => write!(path, "M{at_x:.1} {at_y:.1}h0"),
            (Shape::Line, 0) => write!(path, "M{at_x:.1} {at_y:.1}"),
            (Shape::Line, _) => write!(path, "L{at_x:.1} {at_y:.1}"),
        };
    }
    let style = match series.shape {
        Shape::Dots => "stroke-width=\"3\" stroke-linecap=\"round\" stroke-opacity=\"0.6\"",
        Shape::Line => "stroke-width=\"1.6\" fill=\"none\"",
    };
    let _ = writeln!(svg, "<path d=\"{path}\" stroke=\"{colour}\" {style}/>");
}

/// A tick's label, rounded to 6 decimals.
fn number(tick: f64) -> String {
    format!("{}", (tick * 1e6).round() / 1e6)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ticks_are_round_and_within() {
        let axis = Axis::over(vec![0.0, 7.3], 0.0, 100.0);
        let ticks = axis.ticks();
        assert!(
            ticks.len() >= 3 && ticks.iter().all(|tick| (axis.low..=axis.high).contains(tick)),
            "{ticks:?}"
        );
        assert!(ticks.iter().all(|tick| (tick - tick.round()).abs() < 1e-9), "{ticks:?}");
    }

    #[test]
    fn a_chart_of_nothing_and_of_one_point_is_whole() {
        for series in
            [vec![], vec![Series { name: "a".to_owned(), points: vec![[1.0, 1.0]], shape: Shape::Dots }]]
        {
            let svg = chart("t", "x", "y", &series, true);
            assert!(svg.starts_with("<svg") && svg.ends_with("</svg>\n"));
            assert!(!svg.contains("NaN") && !svg.contains("inf"), "{svg}");
        }
    }
}
