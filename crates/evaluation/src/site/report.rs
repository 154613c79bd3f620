//! The figures of a site as a table and as JSON.

use std::collections::BTreeMap;
use std::fmt::Write as _;

use serde::Serialize;

use super::clock_figures::ClockFigures;
use super::crossing_figures::{CrossingFigures, PlaceCounts};
use super::receiver_feed::NamedFigures;
use super::runner::{FoundCamera, SiteOutcome};

/// The figures of one way to track a site, or their means over draws.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct SiteCase {
    /// The name of the case.
    pub name: String,
    /// Identity F1 by boxes.
    pub identity_f1_by_boxes: f64,
    /// Association precision.
    pub association_precision: f64,
    /// Association recall.
    pub association_recall: f64,
    /// Hand-over rate.
    pub handover_rate: Option<f64>,
    /// IDF1 of positions within 1 m.
    pub idf1: f64,
    /// MOTA of positions within 1 m.
    pub mota: f64,
    /// GOSPA, m.
    pub gospa_m: f64,
    /// Mean error of the positions, m.
    pub mean_error_m: Option<f64>,
    /// For a single camera: mean error, over the targets in its view, of the tracks by all cameras trained together, m.
    pub mean_error_by_all_m: Option<f64>,
    /// Share of true positions inside the stated 95 % radius.
    pub coverage95: Option<f64>,
    /// Receivers of tracks, over all draws, where fixes came.
    pub named: Option<NamedFigures>,
    /// The clocks of receivers at the ends of all draws, likewise.
    pub receiver_clocks: Option<ClockFigures>,
    /// Crossings of lines over the area, over all draws.
    pub crossings: Option<CrossingFigures>,
    /// Counts of lines over the area and of its middle, in the first draw.
    pub counts: Vec<PlaceCounts>,
    /// The cameras whose clocks were found to be wrong, over all draws.
    pub wrong_clocks: Vec<FoundCameraFigures>,
    /// The cameras that were found to have been moved, over all draws.
    pub moved: Vec<FoundCameraFigures>,
    /// Number of draws.
    pub draws: usize,
}

/// How often and how soon something was found of a camera.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct FoundCameraFigures {
    /// The camera's id.
    pub camera: String,
    /// Draws in which it was found.
    pub draws: usize,
    /// Mean time to the finding in these, s.
    pub mean_after_s: f64,
    /// The latest, s.
    pub latest_after_s: f64,
}

impl FoundCameraFigures {
    fn over_draws(outcomes: &[SiteOutcome], found: fn(&SiteOutcome) -> &[FoundCamera]) -> Vec<Self> {
        let mut times_s: BTreeMap<&str, Vec<f64>> = BTreeMap::new();
        for found in outcomes.iter().flat_map(found) {
            times_s.entry(found.camera.as_str()).or_default().push(found.after_s);
        }
        let figures = |(camera, times_s): (&str, Vec<f64>)| Self {
            camera: camera.to_owned(),
            draws: times_s.len(),
            mean_after_s: times_s.iter().sum::<f64>() / times_s.len() as f64,
            latest_after_s: times_s.iter().copied().fold(0.0, f64::max),
        };
        times_s.into_iter().map(figures).collect()
    }
}

impl SiteCase {
    /// With the mean error, over the targets in a camera's view, of tracks by all cameras.
    #[must_use]
    pub fn compared_in_view(self, camera: usize, by_all: &[SiteOutcome]) -> Self {
        let errors =
            by_all.iter().map(|outcome| Some(outcome.positions_in_view.get(camera)?.as_ref()?.mean_error_m));
        let sum = errors.sum::<Option<f64>>();
        Self { mean_error_by_all_m: sum.map(|sum| sum / by_all.len().max(1) as f64), ..self }
    }

    /// The means over draws; `None` without any.
    #[must_use]
    pub fn over_draws(name: &str, outcomes: &[SiteOutcome]) -> Option<Self> {
        let count = outcomes.len();
        let mean = |figure: &dyn Fn(&SiteOutcome) -> f64| {
            outcomes.iter().map(figure).sum::<f64>() / count.max(1) as f64
        };
        let optional = |figure: &dyn Fn(&SiteOutcome) -> Option<f64>| {
            outcomes.iter().map(figure).sum::<Option<f64>>().map(|sum| sum / count.max(1) as f64)
        };
        (count > 0).then(|| Self {
            name: name.to_owned(),
            identity_f1_by_boxes: mean(&|it| it.boxes.identity_f1),
            association_precision: mean(&|it| it.boxes.association_precision),
            association_recall: mean(&|it| it.boxes.association_recall),
            handover_rate: optional(&|it| it.boxes.handover_rate),
            idf1: mean(&|it| it.world.idf1),
            mota: mean(&|it| it.world.mota),
            gospa_m: mean(&|it| it.world.gospa_m),
            mean_error_m: optional(&|it| it.positions.map(|positions| positions.mean_error_m)),
            mean_error_by_all_m: None,
            coverage95: optional(&|it| it.positions.map(|positions| positions.coverage95)),
            named: outcomes.iter().filter_map(|it| it.named).reduce(NamedFigures::plus),
            receiver_clocks: outcomes.iter().filter_map(|it| it.receiver_clocks).reduce(ClockFigures::plus),
            crossings: CrossingFigures::over_draws(outcomes.iter().filter_map(|it| it.crossings)),
            counts: outcomes.first().map(|it| it.counts.clone()).unwrap_or_default(),
            wrong_clocks: FoundCameraFigures::over_draws(outcomes, |it| &it.wrong_clocks),
            moved: FoundCameraFigures::over_draws(outcomes, |it| &it.moved),
            draws: count,
        })
    }
}

/// All cases of an evaluation.
#[derive(Debug, Clone, PartialEq, Default, Serialize)]
pub struct SiteReport {
    /// In the order in which they were run.
    pub cases: Vec<SiteCase>,
}

impl SiteReport {
    /// As a Markdown table.
    #[must_use]
    pub fn table(&self) -> String {
        let mut table = String::from(
            "| case | identity F1 by boxes | association precision | recall | hand-over | IDF1 1 m | MOTA 1 m | GOSPA \
             m | mean error m | same targets, all cameras m | coverage 95 % |\n|---|---|---|---|---|---|---|---|---|---|---|\n",
        );
        let or_dash = |value: Option<f64>| value.map_or("–".to_owned(), |value| format!("{value:.3}"));
        for case in &self.cases {
            // Writing to a string cannot fail.
            let _ = writeln!(
                table,
                "| {} | {:.3} | {:.3} | {:.3} | {} | {:.3} | {:.3} | {:.2} | {} | {} | {} |",
                case.name,
                case.identity_f1_by_boxes,
                case.association_precision,
                case.association_recall,
                or_dash(case.handover_rate),
                case.idf1,
                case.mota,
                case.gospa_m,
                or_dash(case.mean_error_m),
                or_dash(case.mean_error_by_all_m),
                or_dash(case.coverage95),
            );
        }
        table
    }

    /// The crossings of lines as a Markdown table.
    #[must_use]
    pub fn crossing_table(&self) -> String {
        let mut table = String::from(
            "| case | true crossings | reported | missed per 1,000 | false per 1,000 | mean error of the time s | true time \
             in the interval % |\n|---|---|---|---|---|---|---|\n",
        );
        for (name, crossings) in self.cases.iter().filter_map(|case| Some((&case.name, case.crossings?))) {
            let CrossingFigures { true_crossings, reported, missed_per_1000, false_per_1000, .. } = crossings;
            let (mean_error_s, coverage) = (crossings.mean_error_s, 100.0 * crossings.coverage95);
            // Writing to a string cannot fail.
            let _ = writeln!(
                table,
                "| {name} | {true_crossings} | {reported} | {missed_per_1000:.0} | {false_per_1000:.0} | \
                 {mean_error_s:.3} | {coverage:.1} |"
            );
        }
        table
    }

    /// What places count in the first case, in its first draw, as a Markdown table.
    #[must_use]
    pub fn count_table(&self) -> String {
        let mut table = String::from(
            "| place | counted | truth | tracks | expected | 95 % interval |\n|---|---|---|---|---|---|\n",
        );
        for PlaceCounts { place, counted, truth, tracked } in
            self.cases.first().iter().flat_map(|it| &it.counts)
        {
            let [low, high] = tracked.interval;
            // Writing to a string cannot fail.
            let _ = writeln!(
                table,
                "| {place} | {counted} | {truth} | {} | {:.1} | {low} to {high} |",
                tracked.count, tracked.expected
            );
        }
        table
    }

    /// The receivers of tracks as a Markdown table; empty where no fixes came.
    #[must_use]
    pub fn named_table(&self) -> String {
        let mut table = String::new();
        for (name, named) in self.cases.iter().filter_map(|case| Some((&case.name, case.named?))) {
            if table.is_empty() {
                table.push_str(
                    "| case | boxes on tracks with a receiver | right | share of the carriers' boxes | \
                     in hindsight: boxes | right | share |\n|---|---|---|---|---|---|---|\n",
                );
            }
            let (right, found) = (named.right_shares(), named.found_shares());
            // Writing to a string cannot fail.
            let _ = writeln!(
                table,
                "| {name} | {} | {:.3} | {:.3} | {} | {:.3} | {:.3} |",
                named.named, right[0], found[0], named.named_in_hindsight, right[1], found[1],
            );
        }
        table
    }

    /// The clocks that were found to be wrong, and the cameras that were found to have been moved, as a Markdown table; empty
    /// where there were none.
    #[must_use]
    pub fn found_table(&self) -> String {
        let mut table = String::new();
        for case in &self.cases {
            let clocks = case.wrong_clocks.iter().map(|own| ("clock wrong", own));
            let found = clocks.chain(case.moved.iter().map(|own| ("moved", own)));
            for (what, FoundCameraFigures { camera, draws, mean_after_s, latest_after_s }) in found {
                if table.is_empty() {
                    table.push_str(
                        "| case | camera | found | in draws | of | after s, mean | latest |\n|---|---|---|---|---|---|---|\n",
                    );
                }
                // Writing to a string cannot fail.
                let _ = writeln!(
                    table,
                    "| {} | {camera} | {what} | {draws} | {} | {mean_after_s:.0} | {latest_after_s:.0} |",
                    case.name, case.draws
                );
            }
        }
        table
    }

    /// The estimated clocks of receivers as a Markdown table; empty where no fixes came.
    #[must_use]
    pub fn clock_table(&self) -> String {
        let mut table = String::new();
        for (name, clocks) in self.cases.iter().filter_map(|case| Some((&case.name, case.receiver_clocks?))) {
            if table.is_empty() {
                table.push_str(
                    "| case | receivers with an estimate | error s | in standard deviations | called wrong | in common: draws | \
                     error s | in standard deviations | called wrong |\n|---|---|---|---|---|---|---|---|---|\n",
                );
            }
            let cells = [clocks.single, clocks.common].map(|own| {
                let [error_s, in_sigmas] = own.root_mean_squares();
                format!("{} | {error_s:.2} | {in_sigmas:.2} | {}", own.count, own.called_wrong)
            });
            // Writing to a string cannot fail.
            let _ = writeln!(table, "| {name} | {} |", cells.join(" | "));
        }
        table
    }

    /// As JSON.
    ///
    /// # Errors
    /// That of the serializer.
    pub fn to_json(&self) -> serde_json::Result<String> {
        serde_json::to_string_pretty(self)
    }
}
