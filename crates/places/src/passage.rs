//! One track at one place: on which side of the border it is, and when it crossed.

use jiff::Timestamp;

use crate::region::BorderView;

/// Standard deviation of a time that is anywhere in an interval, over the interval's length.
const UNIFORM_SIGMA: f64 = 0.288_675_134_594_812_9;

/// An instant with its standard deviation.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Instant {
    pub(crate) time: Timestamp,
    pub(crate) sigma_s: f64,
}

/// A change of side.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Change {
    pub(crate) at: Instant,
    pub(crate) probability: f64,
    /// True if the target is inside now, or on the left.
    pub(crate) is_inside: bool,
    /// How long it was inside, s, if it left an area.
    pub(crate) dwell_s: Option<f64>,
}

/// The estimates of a border crossing between two certain sides.
#[derive(Debug, Clone, Copy)]
struct Crossing {
    first: Timestamp,
    latest: Timestamp,
    sigma_s: f64,
    extent_probability: f64,
}

/// The state of one track at one place.
#[derive(Debug, Clone)]
pub(crate) struct Passage {
    /// The side where the target is for certain: inside, or on the left.
    side: Option<bool>,
    /// Latest time at which the side was certain, and with which probability.
    certain: (Timestamp, f64),
    previous: Option<(Timestamp, BorderView)>,
    crossing: Option<Crossing>,
    /// Since when the target is inside.
    pub(crate) inside_since: Option<Instant>,
    /// The rules, as bits, whose condition holds already.
    pub(crate) reported: u32,
}

impl Passage {
    pub(crate) const fn new(time: Timestamp) -> Self {
        Self {
            side: None,
            certain: (time, 0.0),
            previous: None,
            crossing: None,
            inside_since: None,
            reported: 0,
        }
    }

    pub(crate) fn is_inside(&self) -> bool {
        self.side == Some(true)
    }

    pub(crate) const fn is_unknown(&self) -> bool {
        self.side.is_none()
    }

    /// Probability that the target is inside, or on the left, at the latest instant.
    pub(crate) fn probability(&self) -> f64 {
        self.previous.map_or(0.0, |(_, view)| view.probability)
    }

    pub(crate) fn observed_at(&self) -> Option<Timestamp> {
        self.previous.map(|(time, _)| time)
    }

    /// Takes the view of an instant; returns the change of side that is certain with it. `certainty` is the probability
    /// from which a side is certain. The error of a target that stands goes from one side to the other by itself in time, so
    /// the complement of the probability for a change is cubed then.
    pub(crate) fn observe(
        &mut self,
        time: Timestamp,
        view: BorderView,
        (certainty, is_standing): (f64, bool),
    ) -> Option<Change> {
        if let Some((before, earlier)) = self.previous.replace((time, view))
            && (earlier.distance_m > 0.0) != (view.distance_m > 0.0)
        {
            self.note_crossing((before, earlier), (time, view));
        }
        let least_doubt = |side: bool| {
            let doubt = 1.0 - certainty;
            if is_standing && self.side == Some(!side) { doubt.powi(3) } else { doubt }
        };
        let side = if 1.0 - view.probability <= least_doubt(true) {
            true
        } else if view.probability <= least_doubt(false) {
            false
        } else {
            return None;
        };
        let of_side = if side { view.probability } else { 1.0 - view.probability };
        let (certain_at, certain_before) = std::mem::replace(&mut self.certain, (time, of_side));
        let was = self.side.replace(side);
        let crossing = self.crossing.take();
        if was == Some(side) {
            return None;
        }
        let interval_s = time.duration_since(certain_at).as_secs_f64();
        let at = crossing.map_or(Instant { time, sigma_s: 0.0 }, |it| it.instant(interval_s));
        let entered = std::mem::replace(&mut self.inside_since, side.then_some(at));
        self.reported = 0;
        // A track that begins inside, or beside a line, has crossed nothing.
        was?;
        let dwell_s = entered.map(|entered| at.time.duration_since(entered.time).as_secs_f64().max(0.0));
        let extent_probability = crossing.map_or(0.0, |it| it.extent_probability);
        let probability = certain_before * of_side * extent_probability;
        Some(Change { at, probability, is_inside: side, dwell_s })
    }

    /// The border lies between two views: its time is where the distance is 0.
    fn note_crossing(&mut self, earlier: (Timestamp, BorderView), later: (Timestamp, BorderView)) {
        let step_s = later.0.duration_since(earlier.0).as_secs_f64();
        let way_m = (later.1.distance_m - earlier.1.distance_m).abs();
        let share = if way_m > 0.0 { earlier.1.distance_m.abs() / way_m } else { 0.5 };
        let mean = |of: fn(&BorderView) -> f64| of(&earlier.1) * (1.0 - share) + of(&later.1) * share;
        let Ok(offset) = jiff::SignedDuration::try_from_secs_f64(share * step_s) else { return };
        let Ok(time) = earlier.0.checked_add(offset) else { return };
        self.crossing = Some(Crossing {
            first: self.crossing.map_or(time, |it| it.first),
            latest: time,
            // Of a target that hardly moves it is infinite; the interval in which the side is not certain bounds it.
            sigma_s: mean(|view| view.sigma_m) / mean(|view| view.rate_mps.abs()),
            extent_probability: mean(|view| view.extent_probability),
        });
    }
}

impl Crossing {
    /// The time is in the middle of all estimates, and its error less than the interval in which the side was not certain.
    fn instant(&self, interval_s: f64) -> Instant {
        let span = self.latest.duration_since(self.first);
        let spread_s = UNIFORM_SIGMA * span.as_secs_f64();
        let sigma_s = self.sigma_s.hypot(spread_s).min(interval_s);
        Instant { time: self.first.checked_add(span / 2).unwrap_or(self.latest), sigma_s }
    }
}
