//! Statistics of a place.

use std::collections::BTreeMap;

use jiff::Timestamp;

use super::Places;
use crate::domain::{Error, PlaceId, Result, TrackScope};
use crate::places::statistics::{CountFigure, Counts, Figures};

/// Intervals of one answer.
const MAX_INTERVALS: i64 = 10_080;

/// The length of the intervals.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum StatisticsStep {
    #[default]
    Minute,
    Hour,
}

impl StatisticsStep {
    /// Length, s.
    #[must_use]
    pub const fn seconds(self) -> u32 {
        match self {
            Self::Minute => 60,
            Self::Hour => 3_600,
        }
    }
}

impl std::str::FromStr for StatisticsStep {
    type Err = Error;

    fn from_str(text: &str) -> Result<Self> {
        match text {
            "minute" => Ok(Self::Minute),
            "hour" => Ok(Self::Hour),
            _ => Err(Error::invalid("interval", "must be minute or hour")),
        }
    }
}

/// Which statistics are asked for.
#[derive(Debug, Clone, Default)]
pub struct StatisticsRequest {
    /// From the interval that holds this instant; the latest hour of minutes, or day of hours, if left out.
    pub from: Option<Timestamp>,
    /// Before this instant; until now if left out.
    pub until: Option<Timestamp>,
    pub step: StatisticsStep,
    /// Targets of this class alone; all if left out.
    pub class: Option<String>,
}

/// The statistics of a place.
#[derive(Debug, Clone)]
pub struct PlaceStatistics {
    /// The number of targets in it now.
    pub occupancy: CountFigure,
    /// Figures over all of the time that was asked for.
    pub total: Figures,
    /// The intervals in which something was counted, oldest first.
    pub intervals: Vec<StatisticsInterval>,
}

/// The statistics of an interval.
#[derive(Debug, Clone)]
pub struct StatisticsInterval {
    pub from: Timestamp,
    pub figures: Figures,
}

impl Places<'_> {
    /// Statistics of a place by intervals.
    ///
    /// # Errors
    /// `PlaceNotFound`; `InvalidArgument` naming `from` for a time that is empty or too long; `CameraOnOtherNode`,
    /// `CameraBetweenNodes`.
    pub async fn statistics(&self, id: &PlaceId, request: &StatisticsRequest) -> Result<PlaceStatistics> {
        let place = self.store.place(id).await?;
        self.check_scope_readable(&place.profile.scope).await?;
        let step_s = i64::from(request.step.seconds());
        let until_s = request.until.unwrap_or_else(|| self.clock.now()).as_second();
        let usual_s = if request.step == StatisticsStep::Minute { 3_600 } else { 86_400 };
        let from_s = request.from.map_or(until_s - usual_s, Timestamp::as_second).div_euclid(step_s) * step_s;
        let length_s = until_s - from_s;
        if !(1..=MAX_INTERVALS * step_s).contains(&length_s) {
            let message = format!("must be before until, by {MAX_INTERVALS} intervals at most");
            return Err(Error::invalid("from", message));
        }
        let class = request.class.as_deref();
        let counts =
            self.store.place_counts(place.key, request.step.seconds(), (from_s, until_s), class).await?;
        let mut total = Counts::default();
        let mut intervals: BTreeMap<i64, Counts> = BTreeMap::new();
        for count in counts {
            total.add_figure(&count.figure, count.value);
            intervals.entry(count.from_s).or_default().add_figure(&count.figure, count.value);
        }
        let interval = |(from_s, counts): (i64, Counts)| {
            let from = Timestamp::from_second(from_s).map_err(Error::fault)?;
            Ok(StatisticsInterval { from, figures: counts.figures(step_s as f64) })
        };
        Ok(PlaceStatistics {
            occupancy: self.monitor.occupancy(&place.profile.scope, place.key),
            total: total.figures(length_s as f64),
            intervals: intervals.into_iter().map(interval).collect::<Result<_>>()?,
        })
    }

    /// Checks that the tracks of a scope are evaluated here.
    async fn check_scope_readable(&self, scope: &TrackScope) -> Result<()> {
        match scope {
            TrackScope::Camera(id) => self.live.readable_camera(id).await.map(drop),
            TrackScope::Site(id) => self.world_tracks.readable_site(id).await.map(drop),
        }
    }
}
