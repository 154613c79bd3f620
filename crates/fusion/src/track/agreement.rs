//! The agreement of the boxes and the fixes of a target, over longer than one instant.
//!
//! Each fix is paired with the box of its instant. Of the pairs' differences (fix less box) running means are kept: in
//! metres, in standard deviations of the stated errors, and the share beyond the gate of a single pair. Errors that
//! last longer than the mean do not average out, so a mean of n pairs has the variance `c + (1 - c) / n`, with c the
//! share of such errors. Beside it each source is held against the motion of a target: it may not jump, nor stand
//! still to the last digit. Where no source moves like a target, the stated radius follows from how far their positions
//! miss the predicted ones. Does not contain estimates or
//! the filter's own state.

use jiff::Timestamp;

use super::measurement::{MeasuredPosition, Measurement, MeasurementSource, RejectionReason};
use super::settings::TrackSettings;
use crate::geo::{EastNorth, PlaneCovariance};
use crate::statistics::{CHI_SQUARE_95, CHI_SQUARE_99_9, ONE_SIDED_95};

/// Time constant of the running means, s.
const MEMORY_S: f64 = 8.0;
/// A pair's box and fix are at most this far apart in time, s.
const PAIR_S: f64 = 1.0;
/// Pairs, and the time that they cover, s, before anything is decided.
const LEAST_PAIRS: u32 = 3;
const LEAST_S: f64 = 2.0;
/// Without a pair for this long nothing is known any more, s.
const FORGET_S: f64 = 10.0;
/// Largest length that a difference counts with, in standard deviations per axis.
const LARGEST_SIGMAS: f64 = 6.0;
/// A position that is the same to the last digit for this long, s, may be that of a target that stands still, but not
/// of one that the other source sees moving.
const REPEATED_S: f64 = 3.0;
/// Share of time in which a source's positions are not those of a target, from which on the stated radius grows to that
/// of their misses, and where it has reached it.
const SCATTERS_FROM: f64 = 0.5;
const SCATTERS_AT: f64 = 0.75;

/// The agreement of boxes and fixes so far: a plain value, part of the filter.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Agreement {
    /// By `MeasurementSource as usize`.
    motions: [SourceMotion; 2],
    pairs: Option<Pairs>,
    is_frozen: bool,
    disagrees: bool,
}

/// How one source moves.
#[derive(Debug, Clone, Copy, Default)]
struct SourceMotion {
    latest: Option<(Timestamp, MeasuredPosition)>,
    /// Running share of time in which its positions are not those of a target.
    implausible: f64,
    /// The same of those whose stated error rests on nothing of training.
    doubtful: f64,
    /// The same of those that jump away from where they are expected, or say no more than that a target is in view.
    scattered: f64,
    /// Running mean of the stated covariances and of the squared distances from the predicted positions, m2 (covariance
    /// matching; Mehra 1970).
    missed: PlaneCovariance,
}

/// Where the filter expects a target at an instant.
#[derive(Debug, Clone, Copy)]
pub(super) struct Expected {
    pub(super) position: EastNorth,
    /// The largest speed that the target may have, m/s.
    pub(super) speed_m_s: f64,
}

/// Running means over pairs.
#[derive(Debug, Clone, Copy)]
struct Pairs {
    since: Timestamp,
    latest_at: Timestamp,
    count: u32,
    /// Sum of the squared weights: the variance of the mean of white errors of variance 1.
    white_factor: f64,
    /// Share of the errors' variance that lasts.
    lasting_share: f64,
    /// Variance per axis of a difference, m2.
    variance_m2: f64,
    /// Mean difference, in standard deviations and in m.
    mean: [f64; 2],
    mean_m: [f64; 2],
    /// Length of the latest difference, m.
    latest_m: f64,
    /// Share of the pairs beyond the gate.
    contradicting: f64,
}

/// The verdict on boxes and fixes together.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(super) struct Verdict {
    /// True if they differ by more than chance explains.
    pub(super) disagrees: bool,
    /// The source that is not to be used, and why: its positions are not those of a moving target where they differ from
    /// the other's, or its boxes are frozen.
    pub(super) refuted: Option<(MeasurementSource, RejectionReason)>,
}

impl Verdict {
    /// Why a source is not to be used, if it is not.
    pub(super) fn refutes(&self, source: MeasurementSource) -> Option<RejectionReason> {
        self.refuted.filter(|(refuted, _)| *refuted == source).map(|(_, reason)| reason)
    }
}

impl Agreement {
    /// Takes in what was measured at an instant.
    pub(super) fn observe(
        &mut self,
        settings: &TrackSettings,
        measurement: &Measurement,
        expected: Expected,
    ) {
        let Measurement { time, fix, regressed } = *measurement;
        if let Some(regressed) = regressed {
            self.is_frozen = regressed.repeated_s >= settings.frozen_after_s;
        }
        for (source, measured) in [(MeasurementSource::Regressed, regressed), (MeasurementSource::Fix, fix)] {
            if let Some(measured) = measured {
                let white_share = settings.white_share(source);
                self.motions[source as usize].observe(time, measured, white_share, expected);
            }
        }
        self.forget(time);
        let Some(fix) = fix else { return };
        let Some((box_at, regressed)) = self.motions[MeasurementSource::Regressed as usize].latest else {
            return;
        };
        let apart_s = time.duration_since(box_at).as_secs_f64();
        if (0.0..=PAIR_S).contains(&apart_s) {
            let pair = Pair::new(settings, regressed, fix, expected.speed_m_s * apart_s);
            match &mut self.pairs {
                Some(pairs) => pairs.add(time, &pair),
                none => *none = Some(Pairs::new(time, &pair)),
            }
            self.decide();
        }
    }

    /// Returns the verdict so far.
    #[inline]
    pub(super) fn verdict(&self) -> Verdict {
        let [by_box, by_fix] = self.motions.map(|motion| motion.implausible > 0.5);
        // Fixes that are beside such boxes tell more, even where a vague box does not contradict them.
        let scatters =
            self.pairs.is_some() && self.motions[MeasurementSource::Regressed as usize].scattered > 0.5;
        let refuted = match (self.disagrees || scatters, by_box, by_fix) {
            _ if self.is_frozen => Some((MeasurementSource::Regressed, RejectionReason::Frozen)),
            (true, true, false) => Some((MeasurementSource::Regressed, RejectionReason::Implausible)),
            (true, false, true) => Some((MeasurementSource::Fix, RejectionReason::Implausible)),
            // The target is in view, and the fixes are of no place there.
            (true, true, true) if self.motions[MeasurementSource::Fix as usize].doubtful > 0.5 => {
                Some((MeasurementSource::Fix, RejectionReason::Implausible))
            }
            _ => None,
        };
        Verdict { disagrees: self.disagrees, refuted }
    }

    /// The 95 % radius, m, at an instant, of an estimate that has `r95_m` if its sources are those of a target.
    pub(super) fn radius_m(&self, now: Timestamp, r95_m: f64) -> f64 {
        let either_m = self.radius_of_either_m(r95_m);
        let verdict = self.verdict();
        let in_use =
            [MeasurementSource::Regressed, MeasurementSource::Fix].into_iter().filter_map(|source| {
                let motion = &self.motions[source as usize];
                let (at, _) = motion.latest.filter(|_| verdict.refutes(source).is_none())?;
                (elapsed_s(at, now) <= FORGET_S).then_some(motion)
            });
        let (share, missed_m) = in_use.fold((1.0_f64, 0.0_f64), |(share, missed_m), motion| {
            let own = (motion.implausible - SCATTERS_FROM) / (SCATTERS_AT - SCATTERS_FROM);
            (share.min(own.clamp(0.0, 1.0)), missed_m.max(motion.missed.r95_m()))
        });
        either_m + share * (missed_m - either_m).max(0.0)
    }

    /// The least 95 % radius, m, about a position between box and fix that holds the truth whichever of them is right,
    /// `r95_m` being that of the position if they agree. It grows from there as they cease to.
    fn radius_of_either_m(&self, r95_m: f64) -> f64 {
        let Some(pairs) = self.pairs.filter(|_| self.verdict().refuted.is_none()) else { return r95_m };
        let [east_m, north_m] = pairs.mean_m;
        let apart_m =
            if self.disagrees { pairs.latest_m.max(east_m.hypot(north_m)) } else { east_m.hypot(north_m) };
        let either_m = apart_m + ONE_SIDED_95 * (pairs.variance_m2 * pairs.share_of_variance()).sqrt();
        let share = ((pairs.statistic() - CHI_SQUARE_95) / (CHI_SQUARE_99_9 - CHI_SQUARE_95)).clamp(0.0, 1.0);
        let share = if self.disagrees { 1.0 } else { share };
        r95_m + share * (either_m - r95_m).max(0.0)
    }

    fn forget(&mut self, now: Timestamp) {
        if self.pairs.is_some_and(|pairs| elapsed_s(pairs.latest_at, now) > FORGET_S) {
            self.pairs = None;
            self.disagrees = false;
        }
    }

    fn decide(&mut self) {
        let Some(pairs) = self.pairs else { return };
        let is_known = pairs.count >= LEAST_PAIRS && elapsed_s(pairs.since, pairs.latest_at) >= LEAST_S;
        let (statistic, contradicting) = (pairs.statistic(), pairs.contradicting);
        self.disagrees = if self.disagrees {
            statistic > CHI_SQUARE_95 || contradicting > 0.25
        } else {
            is_known && (statistic > CHI_SQUARE_99_9 || contradicting > 0.5)
        };
    }
}

impl SourceMotion {
    fn observe(
        &mut self,
        time: Timestamp,
        measured: MeasuredPosition,
        white_share: f64,
        Expected { position, speed_m_s }: Expected,
    ) {
        let miss = measured.position.minus(position);
        let miss = PlaneCovariance::outer(miss.east_m, miss.north_m);
        let missed = measured.covariance.scaled(measured.stated_scale).plus(miss);
        let as_share = |is_so: bool| f64::from(u8::from(is_so));
        let doubtful = as_share(measured.is_doubtful);
        let Some((before, latest)) = self.latest.replace((time, measured)) else {
            let scattered = as_share(measured.is_vague);
            *self = Self { implausible: doubtful, doubtful, scattered, missed, ..*self };
            return;
        };
        let step_s = elapsed_s(before, time);
        let white_m2 = |it: &MeasuredPosition| {
            it.white.unwrap_or_else(|| it.covariance.scaled(white_share)).per_axis_m2()
        };
        let noise_m = (CHI_SQUARE_99_9 * (white_m2(&measured) + white_m2(&latest))).sqrt();
        let jumps = measured.position.distance_m(latest.position) > noise_m + speed_m_s * step_s;
        let is_implausible = jumps || measured.is_doubtful || measured.repeated_s >= REPEATED_S;
        let weight = 1.0 - (-step_s.max(0.0) / MEMORY_S).exp();
        self.implausible += weight * (as_share(is_implausible) - self.implausible);
        // After a single false position the next one jumps back to where it is expected.
        let is_astray = jumps && measured.position.distance_m(position) > noise_m + speed_m_s * step_s;
        self.scattered += weight * (as_share(is_astray || measured.is_vague) - self.scattered);
        self.doubtful += weight * (doubtful - self.doubtful);
        self.missed = self.missed.scaled(1.0 - weight).plus(missed.scaled(weight));
    }
}

/// A fix beside the box of its instant.
struct Pair {
    difference: EastNorth,
    variance_m2: f64,
    lasting_share: f64,
}

impl Pair {
    /// `moved_m` is how far the target may have moved between the two.
    fn new(
        settings: &TrackSettings,
        regressed: MeasuredPosition,
        fix: MeasuredPosition,
        moved_m: f64,
    ) -> Self {
        let stated = |it: &MeasuredPosition| it.covariance.per_axis_m2() * it.stated_scale;
        let white_m2 = |it: &MeasuredPosition, source| {
            let share = settings.white_share(source);
            it.white.map_or_else(|| stated(it) * share, |white| white.per_axis_m2())
        };
        let moved_m2 = 0.5 * moved_m * moved_m;
        let white_m2 = white_m2(&regressed, MeasurementSource::Regressed)
            + white_m2(&fix, MeasurementSource::Fix)
            + moved_m2;
        let variance_m2 = stated(&regressed) + stated(&fix) + moved_m2;
        Self {
            difference: fix.position.minus(regressed.position),
            variance_m2,
            lasting_share: (1.0 - white_m2 / variance_m2).clamp(0.0, 1.0),
        }
    }

    /// In standard deviations per axis, of bounded length.
    fn normalized(&self) -> [f64; 2] {
        let EastNorth { east_m, north_m } = self.difference;
        let sigma_m = self.variance_m2.sqrt().max(east_m.hypot(north_m) / LARGEST_SIGMAS);
        [east_m / sigma_m, north_m / sigma_m]
    }

    fn contradicts(&self) -> bool {
        let EastNorth { east_m, north_m } = self.difference;
        east_m * east_m + north_m * north_m > CHI_SQUARE_99_9 * self.variance_m2
    }
}

impl Pairs {
    fn new(time: Timestamp, pair: &Pair) -> Self {
        let mut first = Self {
            since: time,
            latest_at: time,
            count: 0,
            white_factor: 1.0,
            lasting_share: 0.0,
            variance_m2: 0.0,
            mean: [0.0; 2],
            mean_m: [0.0; 2],
            latest_m: 0.0,
            contradicting: 0.0,
        };
        first.add(time, pair);
        first
    }

    fn add(&mut self, time: Timestamp, pair: &Pair) {
        self.count = self.count.saturating_add(1);
        let decay = (-elapsed_s(self.latest_at, time).max(0.0) / MEMORY_S).exp();
        let weight = (1.0 - decay).max(1.0 / f64::from(self.count));
        self.latest_at = time;
        self.white_factor = (1.0 - weight).powi(2) * self.white_factor + weight * weight;
        let EastNorth { east_m, north_m } = pair.difference;
        self.latest_m = east_m.hypot(north_m);
        let towards = |mean: &mut f64, value: f64| *mean += weight * (value - *mean);
        towards(&mut self.lasting_share, pair.lasting_share);
        towards(&mut self.variance_m2, pair.variance_m2);
        towards(&mut self.contradicting, f64::from(u8::from(pair.contradicts())));
        for (mean, value) in self.mean.iter_mut().zip(pair.normalized()) {
            towards(mean, value);
        }
        for (mean, value) in self.mean_m.iter_mut().zip([east_m, north_m]) {
            towards(mean, value);
        }
    }

    /// Variance of the mean per unit variance of a difference.
    fn share_of_variance(&self) -> f64 {
        self.lasting_share + (1.0 - self.lasting_share) * self.white_factor
    }

    /// Chi-square with 2 degrees of freedom for sources that agree.
    fn statistic(&self) -> f64 {
        self.mean.iter().map(|mean| mean * mean).sum::<f64>() / self.share_of_variance()
    }
}

fn elapsed_s(since: Timestamp, now: Timestamp) -> f64 {
    now.duration_since(since).as_secs_f64()
}
