//! Counts of places, and the figures that are computed from them.

use std::collections::BTreeMap;

use serde::Serialize;
use utoipa::ToSchema;

use crate::domain::PlaceKey;
use crate::event::Direction;
use sightfix_domain::statistics::NORMAL_95;

/// Lower end of the first bin, and the ratio of the ends of a bin.
const FIRST_BIN: f64 = 0.01;
const BIN_RATIO: f64 = 1.02;
/// Lines of which the origins are counted; others count as none.
const MAX_ORIGINS: usize = 256;
/// Classes that are counted by themselves in a place and interval.
pub const MAX_CLASSES: usize = 64;

/// The place, the beginning of the minute (s since 1970) and the class (empty if unknown) of some counts.
pub type CountsKey = (PlaceKey, i64, String);

/// Counts of one place, interval and class. They can be added.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Counts {
    pub(crate) enters: Tally,
    pub(crate) leaves: Tally,
    pub(crate) left_to_right: Tally,
    pub(crate) right_to_left: Tally,
    /// Time that targets spent inside, s.
    pub(crate) occupied_s: f64,
    pub(crate) dwell_s: Histogram,
    pub(crate) speed_mps: Histogram,
    /// Crossings by the line that the target crossed before.
    pub(crate) origins: BTreeMap<String, u32>,
}

/// A number of things that happened with a probability each.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(crate) struct Tally {
    count: u32,
    expected: f64,
    variance: f64,
}

/// Numbers by bins of 2 % width.
#[derive(Debug, Clone, PartialEq, Default)]
pub(crate) struct Histogram(BTreeMap<u16, u32>);

impl Tally {
    pub(crate) fn add(&mut self, probability: f64, is_counted: bool) {
        self.count += u32::from(is_counted);
        self.expected += probability;
        self.variance += probability * (1.0 - probability);
    }

    fn to_figures(self, name: &str) -> [(String, f64); 3] {
        let figures =
            [("count", f64::from(self.count)), ("expected", self.expected), ("variance", self.variance)];
        figures.map(|(figure, value)| (format!("{name}.{figure}"), value))
    }

    fn add_figure(&mut self, figure: &str, value: f64) {
        match figure {
            "count" => self.count += value as u32,
            "expected" => self.expected += value,
            "variance" => self.variance += value,
            _ => {}
        }
    }
}

impl Histogram {
    pub(crate) fn add(&mut self, value: f64) {
        let bin = ((value.max(FIRST_BIN) / FIRST_BIN).ln() / BIN_RATIO.ln()).floor();
        *self.0.entry(bin.clamp(0.0, 1_000.0) as u16).or_default() += 1;
    }

    fn add_bin(&mut self, bin: &str, count: f64) {
        if let Ok(bin) = bin.parse() {
            *self.0.entry(bin).or_default() += count as u32;
        }
    }

    /// The value of a rank, from 0: the geometric middle of its bin.
    fn at(&self, rank: f64) -> Option<f64> {
        let mut before = 0.0;
        for (bin, count) in &self.0 {
            before += f64::from(*count);
            if rank < before {
                return Some(FIRST_BIN * BIN_RATIO.powf(f64::from(*bin) + 0.5));
            }
        }
        None
    }

    /// A quantile with the interval of its order statistics, which makes no assumption on the distribution.
    fn quantile(&self, share: f64) -> Option<Quantile> {
        let count = self.0.values().map(|count| f64::from(*count)).sum::<f64>();
        if count == 0.0 {
            return None;
        }
        let half = NORMAL_95 * (count * share * (1.0 - share)).sqrt();
        let at = |rank: f64| self.at(rank.floor().clamp(0.0, count - 1.0));
        let value = at(count * share)?;
        Some(Quantile {
            percent: (share * 100.0).round() as u32,
            value,
            interval: [at(count * share - half)?, at(count * share + half)?],
        })
    }
}

impl Counts {
    /// The counts as figures that add up, each with its name.
    #[must_use]
    pub fn to_figures(&self) -> Vec<(String, f64)> {
        let tallies = [
            ("enters", self.enters),
            ("leaves", self.leaves),
            ("left_to_right", self.left_to_right),
            ("right_to_left", self.right_to_left),
        ];
        let mut figures: Vec<_> = tallies.iter().flat_map(|(name, tally)| tally.to_figures(name)).collect();
        figures.push(("occupied_s".to_owned(), self.occupied_s));
        for (name, histogram) in [("dwell_s", &self.dwell_s), ("speed_mps", &self.speed_mps)] {
            let bins = histogram.0.iter().map(|(bin, count)| (format!("{name}.{bin}"), f64::from(*count)));
            figures.extend(bins);
        }
        let origins = self.origins.iter().map(|(line, count)| (format!("origins.{line}"), f64::from(*count)));
        figures.extend(origins);
        figures.retain(|(_, value)| *value != 0.0);
        figures
    }

    /// Adds the value of a figure; one of an unknown name is passed over.
    pub fn add_figure(&mut self, name: &str, value: f64) {
        let (head, tail) = name.split_once('.').unwrap_or((name, ""));
        match head {
            "enters" => self.enters.add_figure(tail, value),
            "leaves" => self.leaves.add_figure(tail, value),
            "left_to_right" => self.left_to_right.add_figure(tail, value),
            "right_to_left" => self.right_to_left.add_figure(tail, value),
            "occupied_s" => self.occupied_s += value,
            "dwell_s" => self.dwell_s.add_bin(tail, value),
            "speed_mps" => self.speed_mps.add_bin(tail, value),
            "origins" => self.add_origin(tail.to_owned(), value as u32),
            _ => {}
        }
    }

    pub(crate) const fn crossings(&mut self, direction: Direction) -> &mut Tally {
        match direction {
            Direction::LeftToRight => &mut self.left_to_right,
            Direction::RightToLeft => &mut self.right_to_left,
        }
    }

    pub(crate) fn add_origin(&mut self, line: String, count: u32) {
        if self.origins.len() < MAX_ORIGINS || self.origins.contains_key(&line) {
            *self.origins.entry(line).or_default() += count;
        }
    }

    /// The figures of an interval of that length, s.
    #[must_use]
    pub fn figures(&self, length_s: f64) -> Figures {
        let quantiles = |histogram: &Histogram| {
            [0.15, 0.5, 0.85].into_iter().filter_map(|share| histogram.quantile(share)).collect()
        };
        Figures {
            enters: self.enters.into(),
            leaves: self.leaves.into(),
            left_to_right: self.left_to_right.into(),
            right_to_left: self.right_to_left.into(),
            mean_occupancy: self.occupied_s / length_s,
            dwell_s: quantiles(&self.dwell_s),
            speed_mps: quantiles(&self.speed_mps),
            origins: self.origins.clone(),
        }
    }
}

/// A number of things with its uncertainty.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, ToSchema)]
pub struct CountFigure {
    /// How many were certain enough to count.
    pub count: u32,
    /// The expected number: the sum of the probabilities, also of those that were not certain enough.
    pub expected: f64,
    /// Interval that holds the true number with 95 % probability.
    pub interval: [f64; 2],
}

impl CountFigure {
    /// The figure of things that are there with a probability each, of which some are certain enough to count.
    #[must_use]
    pub fn of(things: impl Iterator<Item = (f64, bool)>) -> Self {
        let mut tally = Tally::default();
        things.for_each(|(probability, is_counted)| tally.add(probability, is_counted));
        tally.into()
    }
}

impl From<Tally> for CountFigure {
    fn from(tally: Tally) -> Self {
        let half = NORMAL_95 * tally.variance.sqrt();
        // Numbers are whole, so the interval is widened to the next ones; a sum of parts may miss one by its rounding.
        let low = (tally.expected - half + 1e-9).floor().max(0.0);
        // Zero is added so that no interval ends at -0.
        let high = (tally.expected + half - 1e-9).ceil().max(low) + 0.0;
        Self { count: tally.count, expected: tally.expected, interval: [low, high] }
    }
}

/// A quantile of observed values.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, ToSchema)]
pub struct Quantile {
    /// The share of values that are lower, percent.
    pub percent: u32,
    /// The value, to 1 %.
    pub value: f64,
    /// Interval that holds the quantile with 95 % probability.
    pub interval: [f64; 2],
}

/// The figures of a place in an interval.
#[derive(Debug, Clone, PartialEq, Serialize, ToSchema)]
pub struct Figures {
    /// Targets that entered the area.
    pub enters: CountFigure,
    /// Targets that left the area.
    pub leaves: CountFigure,
    /// Targets that crossed the line from its left to its right.
    pub left_to_right: CountFigure,
    /// Targets that crossed the line from its right to its left.
    pub right_to_left: CountFigure,
    /// Mean number of targets in the area.
    pub mean_occupancy: f64,
    /// Quantiles of 15, 50 and 85 % of how long targets that left were in the area, s.
    pub dwell_s: Vec<Quantile>,
    /// Quantiles of 15, 50 and 85 % of the speed of targets that entered or crossed, m/s.
    pub speed_mps: Vec<Quantile>,
    /// Crossings of the line by the line that the target had crossed before.
    pub origins: BTreeMap<String, u32>,
}
