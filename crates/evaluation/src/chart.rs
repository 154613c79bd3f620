//! Charts as self-contained SVG documents: no scripts, no embedded fonts, an opaque background, so that they
//! are legible on light and dark pages.
//!
//! Points outside a frame are not drawn but counted, in the legend or in the title of its panel.

use std::fmt::Write as _;

use super::axis::{Axes, Axis, tick_label};

/// Colours that are distinct under colour blindness (Okabe and Ito 2008; yellow replaced by violet, which
/// is legible on white).
const COLOURS: [&str; 8] =
    ["#0072b2", "#d55e00", "#009e73", "#c2569b", "#b07c00", "#3aa5dd", "#6b6b6b", "#6a3d9a"];
/// Dashes of lines, so that no two series of a chart differ in colour alone.
const DASHES: [&str; 3] = ["none", "8 3", "2 3"];
/// Lines and dots of what is known.
const TRUTH_COLOUR: &str = "#1a1a1a";
/// Width of a chart, px.
const WIDTH_PX: f64 = 980.0;
/// Margins of a frame for its labels: left and bottom, px.
const LABELS_PX: [f64; 2] = [64.0, 42.0];
/// Room for the title above the frames, px.
const TITLE_PX: f64 = 40.0;
/// Room for the legend beside a frame, px.
const LEGEND_PX: f64 = 270.0;
/// Height of a chart with one frame, px.
const HEIGHT_PX: f64 = 540.0;

/// The largest number of dots drawn. Of more dots, evenly chosen ones are drawn; all are counted.
const MOST_DOTS: usize = 3_000;

/// How points are drawn.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Shape {
    /// A polyline; a point that is not finite interrupts it.
    Line,
    /// A thin polyline, for outlines beneath dots.
    Outline,
    /// A dot per point.
    Dots,
}

/// Points that belong together, in the axes' units.
#[derive(Debug, Clone)]
pub(crate) struct Series {
    name: String,
    /// `None` for the truth.
    number: Option<usize>,
    points: Vec<[f64; 2]>,
    shape: Shape,
}

impl Series {
    /// A series; those of the same number have the same colour in every chart.
    pub(crate) fn new(name: &str, number: usize, points: Vec<[f64; 2]>, shape: Shape) -> Self {
        Self { name: name.to_owned(), number: Some(number), points, shape }
    }

    /// A series of known values: positions, or the ideal.
    pub(crate) fn truth(name: &str, points: Vec<[f64; 2]>, shape: Shape) -> Self {
        Self { name: name.to_owned(), number: None, points, shape }
    }

    pub(crate) fn points(&self) -> &[[f64; 2]] {
        &self.points
    }

    fn colour(&self) -> &'static str {
        self.number.map_or(TRUTH_COLOUR, |number| COLOURS[number % COLOURS.len()])
    }

    fn dashes(&self) -> &'static str {
        self.number.map_or(DASHES[0], |number| {
            DASHES[(number % COLOURS.len() + number / COLOURS.len()) % DASHES.len()]
        })
    }

    /// Number of dots and vertices that a frame does not show; outlines do not count.
    fn outside(&self, frame: &Frame) -> usize {
        let is_outside = |point: &&[f64; 2]| {
            let is_finite = point.iter().all(|value| value.is_finite());
            is_finite && !(frame.x.contains(point[0]) && frame.y.contains(point[1]))
        };
        if self.shape == Shape::Outline { 0 } else { self.points.iter().filter(is_outside).count() }
    }

    fn label(&self, outside: usize) -> String {
        if outside == 0 { self.name.clone() } else { format!("{} ({outside} outside)", self.name) }
    }
}

/// A frame with its axes, in px of the document.
struct Frame {
    x: Axis,
    y: Axis,
}

/// One frame with its legend beside it.
pub(crate) fn chart(title: &str, axes: &Axes<'_>, series: &[Series]) -> String {
    let left = LABELS_PX[0] + 6.0;
    let sides = [left, TITLE_PX, WIDTH_PX - LEGEND_PX, HEIGHT_PX - LABELS_PX[1] - 6.0];
    let mut svg = document(title, HEIGHT_PX);
    let frame = frame_in(axes, sides);
    draw_frame(&mut svg, &frame, series, 0);
    tick_labels(&mut svg, &frame, [true, true]);
    axis_labels(&mut svg, axes, sides);
    for (index, one) in series.iter().enumerate() {
        legend_entry(&mut svg, one, &frame, [sides[2] + 16.0, TITLE_PX + 12.0 + 21.0 * index as f64]);
    }
    svg.push_str("</svg>\n");
    svg
}

/// A frame of a chart of several.
pub(crate) struct Panel {
    /// Beneath the series.
    pub(crate) background: Vec<Series>,
    /// Above the series.
    pub(crate) foreground: Vec<Series>,
    /// Its name is the title, with the number of points outside.
    pub(crate) series: Series,
}

/// A frame for each series, `columns` of them in a row, all with the same axes.
pub(crate) fn panels(
    title: &str,
    axes: &Axes<'_>,
    (columns, height_px): (usize, f64),
    panels: &[Panel],
) -> String {
    let rows = panels.len().div_ceil(columns).max(1);
    let total_px = TITLE_PX + rows as f64 * height_px + LABELS_PX[1];
    let mut svg = document(title, total_px);
    let width_px = (WIDTH_PX - LABELS_PX[0] - 10.0) / columns as f64;
    for (index, panel) in panels.iter().enumerate() {
        let (row, column) = (index / columns, index % columns);
        let left = LABELS_PX[0] + width_px * column as f64;
        let top = TITLE_PX + height_px * row as f64;
        let sides = [left, top + 20.0, left + width_px - 12.0, top + height_px - 4.0];
        let frame = frame_in(axes, sides);
        let mut series = panel.background.clone();
        series.push(panel.series.clone());
        series.extend(panel.foreground.iter().cloned());
        draw_frame(&mut svg, &frame, &series, index);
        tick_labels(&mut svg, &frame, [index + columns >= panels.len(), column == 0]);
        let _ = writeln!(
            svg,
            "<text x=\"{left:.0}\" y=\"{:.0}\" fill=\"{}\" font-weight=\"bold\">{}</text>",
            top + 14.0,
            panel.series.colour(),
            escaped(&panel.series.label(panel.series.outside(&frame)))
        );
    }
    axis_labels(&mut svg, axes, [LABELS_PX[0], TITLE_PX, WIDTH_PX - 10.0, total_px - LABELS_PX[1]]);
    svg.push_str("</svg>\n");
    svg
}

fn document(title: &str, height_px: f64) -> String {
    format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {WIDTH_PX} {height_px}\" \
         font-family=\"sans-serif\" font-size=\"12\" fill=\"{TRUTH_COLOUR}\">\n\
         <rect width=\"100%\" height=\"100%\" fill=\"white\"/>\n\
         <text x=\"16\" y=\"25\" font-size=\"16\">{}</text>\n",
        escaped(title)
    )
}

fn frame_in(axes: &Axes<'_>, [left, top, right, bottom]: [f64; 4]) -> Frame {
    let mut frame = Frame { x: axes.across.between(left, right), y: axes.upward.between(bottom, top) };
    if axes.equal_scale {
        let per_px = frame.x.per_px().max(frame.y.per_px());
        frame.x.widen(per_px);
        frame.y.widen(per_px);
    }
    frame
}

/// Grid, border and series, which a clip path keeps within the frame.
fn draw_frame(svg: &mut String, frame: &Frame, series: &[Series], number: usize) {
    let ([left, right], [bottom, top]) = (frame.x.ends_px(), frame.y.ends_px());
    let (width, height) = (right - left, bottom - top);
    let mut grid = String::new();
    // Writing to a string cannot fail.
    for tick in frame.x.ticks() {
        let _ = write!(grid, "M{:.1} {top:.1}V{bottom:.1}", frame.x.at(tick));
    }
    for tick in frame.y.ticks() {
        let _ = write!(grid, "M{left:.1} {:.1}H{right:.1}", frame.y.at(tick));
    }
    let _ = writeln!(
        svg,
        "<path d=\"{grid}\" stroke=\"#dddddd\"/>\n<clipPath id=\"frame{number}\"><rect x=\"{left:.1}\" \
         y=\"{top:.1}\" width=\"{width:.1}\" height=\"{height:.1}\"/></clipPath>\n\
         <g clip-path=\"url(#frame{number})\" fill=\"none\">"
    );
    for one in series {
        draw_series(svg, one, frame);
    }
    let _ = writeln!(
        svg,
        "</g>\n<rect x=\"{left:.1}\" y=\"{top:.1}\" width=\"{width:.1}\" height=\"{height:.1}\" \
         fill=\"none\" stroke=\"{TRUTH_COLOUR}\"/>"
    );
}

fn draw_series(svg: &mut String, series: &Series, frame: &Frame) {
    let mut path = String::new();
    let mut is_drawing = false;
    let step = if series.shape == Shape::Dots { series.points.len().div_ceil(MOST_DOTS).max(1) } else { 1 };
    for &[across, upward] in series.points.iter().step_by(step) {
        let (at_x, at_y) = (frame.x.at(across), frame.y.at(upward));
        let is_dot = series.shape == Shape::Dots;
        let is_drawn = at_x.is_finite()
            && at_y.is_finite()
            && (!is_dot || frame.x.contains(across) && frame.y.contains(upward));
        if is_drawn {
            let command = if is_drawing && !is_dot { 'L' } else { 'M' };
            let _ = write!(path, "{command}{at_x:.1} {at_y:.1}{}", if is_dot { "h0" } else { "" });
        }
        is_drawing = is_drawn;
    }
    let (colour, dashes) = (series.colour(), series.dashes());
    // Known values are thin, so that they hide nothing of what they are compared with.
    let is_truth = series.number.is_none();
    let style = match series.shape {
        Shape::Dots if is_truth => "stroke-width=\"1.2\" stroke-linecap=\"round\"".to_owned(),
        Shape::Dots => "stroke-width=\"3\" stroke-linecap=\"round\" stroke-opacity=\"0.6\"".to_owned(),
        Shape::Outline => "stroke-width=\"0.8\" stroke-opacity=\"0.7\"".to_owned(),
        Shape::Line if is_truth => "stroke-width=\"1\"".to_owned(),
        Shape::Line => format!("stroke-width=\"2\" stroke-dasharray=\"{dashes}\""),
    };
    let _ = writeln!(svg, "<path d=\"{path}\" stroke=\"{colour}\" {style}/>");
}

fn tick_labels(svg: &mut String, frame: &Frame, [across, upward]: [bool; 2]) {
    let ([left, _], [bottom, _]) = (frame.x.ends_px(), frame.y.ends_px());
    for tick in frame.x.labelled_ticks().into_iter().filter(|_| across) {
        let _ = writeln!(
            svg,
            "<text x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"middle\">{}</text>",
            frame.x.at(tick),
            bottom + 16.0,
            tick_label(tick)
        );
    }
    for tick in frame.y.labelled_ticks().into_iter().filter(|_| upward) {
        let _ = writeln!(
            svg,
            "<text x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"end\">{}</text>",
            left - 6.0,
            frame.y.at(tick) + 4.0,
            tick_label(tick)
        );
    }
}

fn axis_labels(svg: &mut String, axes: &Axes<'_>, [left, top, right, bottom]: [f64; 4]) {
    let _ = writeln!(
        svg,
        "<text x=\"{:.0}\" y=\"{:.0}\" text-anchor=\"middle\">{}</text>\
         <text transform=\"translate(16 {:.0}) rotate(-90)\" text-anchor=\"middle\">{}</text>",
        0.5 * (left + right),
        bottom + 34.0,
        escaped(axes.across.label),
        0.5 * (top + bottom),
        escaped(axes.upward.label)
    );
}

fn legend_entry(svg: &mut String, series: &Series, frame: &Frame, [left, middle]: [f64; 2]) {
    let colour = series.colour();
    let _ = match series.shape {
        Shape::Dots => {
            writeln!(svg, "<circle cx=\"{}\" cy=\"{middle}\" r=\"4\" fill=\"{colour}\"/>", left + 15.0)
        }
        Shape::Line | Shape::Outline => writeln!(
            svg,
            "<path d=\"M{left} {middle}h30\" stroke=\"{colour}\" stroke-width=\"2.5\" stroke-dasharray=\"{}\"/>",
            series.dashes()
        ),
    };
    let _ = writeln!(
        svg,
        "<text x=\"{}\" y=\"{}\">{}</text>",
        left + 38.0,
        middle + 4.0,
        escaped(&series.label(series.outside(frame)))
    );
}

fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;")
}

#[cfg(test)]
mod tests {
    use super::super::axis::AxisSpec;
    use super::*;

    fn axes(equal_scale: bool) -> Axes<'static> {
        Axes {
            across: AxisSpec::linear("x, m", 0.0, 10.0),
            upward: AxisSpec::linear("y, m", 0.0, 10.0),
            equal_scale,
        }
    }

    #[test]
    fn a_chart_of_nothing_and_of_one_point_is_whole() {
        for series in [vec![], vec![Series::new("a", 0, vec![[1.0, 1.0]], Shape::Dots)]] {
            let svg = chart("t", &axes(true), &series);
            assert!(svg.starts_with("<svg") && svg.ends_with("</svg>\n"));
            assert!(!svg.contains("NaN") && !svg.contains("inf"), "{svg}");
        }
    }

    #[test]
    fn points_outside_of_the_frame_are_counted_and_not_drawn() {
        let points = vec![[5.0, 5.0], [5.0, 50.0], [f64::NAN, 1.0], [-1.0, 2.0]];
        let svg = chart("t", &axes(false), &[Series::new("a", 0, points.clone(), Shape::Dots)]);
        assert!(svg.contains(">a (2 outside)<"), "{svg}");
        assert_eq!(svg.matches("h0").count(), 1, "{svg}");
        let series = Series::new("a", 0, points, Shape::Dots);
        let panel = Panel { background: Vec::new(), foreground: Vec::new(), series };
        let svg = panels("t", &axes(false), (2, 100.0), &[panel]);
        assert!(svg.contains(">a (2 outside)<") && svg.matches("h0").count() == 1, "{svg}");
    }

    #[test]
    fn twenty_four_lines_differ_in_colour_or_dashes() {
        let styles: std::collections::BTreeSet<_> = (0..24)
            .map(|number| Series::new("a", number, Vec::new(), Shape::Line))
            .map(|series| (series.colour(), series.dashes()))
            .collect();
        assert_eq!(styles.len(), 24);
    }
}
