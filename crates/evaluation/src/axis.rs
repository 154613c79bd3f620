//! Axes of charts: ranges, linear and logarithmic scales, round ticks.

/// Length of a decade below which a logarithmic axis labels powers of ten only, px.
const LONG_DECADE_PX: f64 = 80.0;

/// The two axes of a frame.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Axes<'a> {
    pub(crate) across: AxisSpec<'a>,
    pub(crate) upward: AxisSpec<'a>,
    /// True if a unit has the same length on both axes, which must be linear.
    pub(crate) equal_scale: bool,
}

/// Range and scale of an axis.
#[derive(Debug, Clone, Copy)]
pub(crate) struct AxisSpec<'a> {
    /// Quantity and unit.
    pub(crate) label: &'a str,
    low: f64,
    high: f64,
    is_logarithmic: bool,
}

impl<'a> AxisSpec<'a> {
    /// A linear axis over a range, which is widened if it is empty.
    pub(crate) fn linear(label: &'a str, low: f64, high: f64) -> Self {
        let margin = if high > low { 0.0 } else { 0.5 };
        Self { label, low: low - margin, high: high.max(low) + margin, is_logarithmic: false }
    }

    /// A logarithmic axis that shows the positive values up to their quantile 0.999, and at most four
    /// decades down from there.
    pub(crate) fn logarithmic(label: &'a str, values: impl Iterator<Item = f64>) -> Self {
        let mut ascending: Vec<f64> = values.filter(|value| value.is_finite() && *value > 0.0).collect();
        ascending.sort_by(f64::total_cmp);
        let last = ascending.len().saturating_sub(1);
        let at = |index: usize| ascending.get(index).copied().unwrap_or(1.0);
        let high = 1.2 * at(last - last / 1_000);
        let low = (at(last / 200) / 1.2).clamp(1e-4 * high, 0.5 * high);
        Self { label, low, high, is_logarithmic: true }
    }

    /// The axis drawn between two px, `low` at the first.
    pub(super) fn between(&self, from_px: f64, to_px: f64) -> Axis {
        let Self { low, high, is_logarithmic, .. } = *self;
        Axis { low, high, is_logarithmic, from_px, to_px }
    }
}

/// Maps values to px.
#[derive(Debug, Clone, Copy)]
pub(super) struct Axis {
    low: f64,
    high: f64,
    is_logarithmic: bool,
    from_px: f64,
    to_px: f64,
}

impl Axis {
    /// Place of a value, px; not finite for a value that a logarithmic axis cannot have.
    pub(super) fn at(&self, value: f64) -> f64 {
        let part = if self.is_logarithmic {
            (value / self.low).ln() / (self.high / self.low).ln()
        } else {
            (value - self.low) / (self.high - self.low)
        };
        self.from_px + part * (self.to_px - self.from_px)
    }

    pub(super) fn contains(&self, value: f64) -> bool {
        (self.low..=self.high).contains(&value)
    }

    /// Px of the lowest and of the highest value.
    pub(super) const fn ends_px(&self) -> [f64; 2] {
        [self.from_px, self.to_px]
    }

    /// Round values within the range.
    pub(super) fn ticks(&self) -> Vec<f64> {
        if self.is_logarithmic {
            return self.decade_ticks(&[1.0, 2.0, 5.0]);
        }
        let most = ((self.to_px - self.from_px).abs() / 45.0).clamp(2.0, 8.0);
        let raw = (self.high - self.low) / most;
        let power = 10.0_f64.powf(raw.log10().floor());
        let step = [1.0, 2.0, 5.0, 10.0].into_iter().map(|one| one * power).find(|&one| one >= raw);
        let step = step.unwrap_or(raw);
        let first = (self.low / step - 1e-9).ceil() as i64;
        let last = self.high + 1e-9 * step;
        (first..first + 12).map(|index| index as f64 * step).take_while(|&tick| tick <= last).collect()
    }

    /// The ticks with labels: all but those between the powers of ten where decades are short.
    pub(super) fn labelled_ticks(&self) -> Vec<f64> {
        let decade_px = (self.to_px - self.from_px).abs() / (self.high / self.low).log10();
        let is_crowded = self.is_logarithmic && decade_px < LONG_DECADE_PX;
        if is_crowded { self.decade_ticks(&[1.0]) } else { self.ticks() }
    }

    fn decade_ticks(&self, multiples: &[f64]) -> Vec<f64> {
        let first = self.low.log10().floor() as i32;
        let last = self.high.log10().ceil() as i32;
        (first..=last)
            .flat_map(|power| multiples.iter().map(move |multiple| multiple * 10.0_f64.powi(power)))
            .filter(|&tick| self.contains(tick))
            .collect()
    }

    pub(super) fn per_px(&self) -> f64 {
        (self.high - self.low) / (self.to_px - self.from_px).abs()
    }

    /// Widens a linear axis about its centre to a given value per px.
    pub(super) fn widen(&mut self, per_px: f64) {
        let half = 0.5 * per_px * (self.to_px - self.from_px).abs();
        let centre = 0.5 * (self.low + self.high);
        (self.low, self.high) = (centre - half, centre + half);
    }
}

/// A tick's label, rounded to 6 decimals.
pub(super) fn tick_label(tick: f64) -> String {
    let rounded = (tick * 1e6).round() / 1e6;
    // No label says "-0".
    format!("{}", if rounded == 0.0 { 0.0 } else { rounded })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ticks_are_round_and_within() {
        let axis = AxisSpec::linear("x", 0.0, 7.3).between(0.0, 400.0);
        let ticks = axis.ticks();
        assert!(ticks.len() >= 3 && ticks.iter().all(|&tick| axis.contains(tick)), "{ticks:?}");
        assert!(ticks.iter().all(|tick| (tick - tick.round()).abs() < 1e-9), "{ticks:?}");
    }

    #[test]
    fn a_logarithmic_axis_gives_equal_room_to_equal_ratios() {
        let values = (1..=1_000).map(|index| 0.1 * f64::from(index));
        let axis = AxisSpec::logarithmic("error, m", values).between(0.0, 300.0);
        let ticks = axis.ticks();
        assert!([1.0, 2.0, 5.0, 10.0, 100.0].iter().all(|tick| ticks.contains(tick)), "{ticks:?}");
        let (one, ten, hundred) = (axis.at(1.0), axis.at(10.0), axis.at(100.0));
        assert!((ten - one - (hundred - ten)).abs() < 1e-9, "{one} {ten} {hundred}");
        assert!(!axis.at(-1.0).is_finite() && !axis.contains(0.0));
    }

    #[test]
    fn a_logarithmic_axis_over_nothing_or_one_value_has_a_range() {
        for values in [vec![], vec![3.0], vec![0.0, -2.0]] {
            let axis = AxisSpec::logarithmic("x", values.into_iter()).between(0.0, 100.0);
            assert!(axis.high > axis.low && axis.low > 0.0, "{axis:?}");
        }
    }
}
