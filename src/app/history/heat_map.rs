//! Where the targets of a selection spent their time.

use std::collections::{BTreeMap, HashMap};

use jiff::{SignedDuration, Timestamp};

use super::queries::{History, HistorySelection};
use crate::domain::{ArchivedPosition, Error, Result, TRACK_GAP, TrackScope};
use crate::geo::{METRES_PER_DEGREE, Position};

/// Most cells of one heat map.
const MOST_CELLS: usize = 100_000;
/// Tracks that are remembered before those that have ended are forgotten.
const TRACKS: usize = 10_000;

/// Cells of a grid of parallels and meridians, and what happened there.
pub struct HeatMap {
    /// North-south and, nearly, east-west extent of a cell, m.
    pub cell_m: f64,
    /// Cells where targets were, from south to north and from west to east.
    pub cells: Vec<HeatCell>,
}

/// One cell of a heat map.
pub struct HeatCell {
    /// The south-western corner.
    pub south_west: Position,
    /// The north-eastern corner.
    pub north_east: Position,
    /// Time that all targets together spent there, s.
    pub seconds: f64,
    /// How often a track came into it.
    pub visits: u64,
}

impl History<'_> {
    /// The heat map of a selection, read position by position.
    ///
    /// # Errors
    /// As [`History::page`]; `InvalidArgument` naming `cell_m` if it is outside 0.1 to 10,000 m, or there are more than
    /// 100,000 cells.
    pub async fn heat_map(
        &self,
        scope: TrackScope,
        selection: HistorySelection,
        cell_m: f64,
    ) -> Result<HeatMap> {
        if !(0.1..=10_000.0).contains(&cell_m) {
            return Err(Error::invalid("cell_m", "must be 0.1 to 10000"));
        }
        let mut heat = Heat { cell_deg: cell_m / METRES_PER_DEGREE, ..Heat::default() };
        let mut rows = self.rows(scope, selection).await?;
        while let Some(batch) = rows.next().await? {
            batch.iter().for_each(|row| heat.add(row));
            if heat.cells.len() > MOST_CELLS {
                let message = format!("makes more than {MOST_CELLS} cells; make it greater or select less");
                return Err(Error::invalid("cell_m", message));
            }
        }
        Ok(HeatMap { cell_m, cells: heat.cells()? })
    }
}

/// A cell by its row from the equator and its number in that row from Greenwich.
type Cell = (i64, i64);

/// What is counted while positions come in order of time.
#[derive(Default)]
struct Heat {
    cell_deg: f64,
    cells: BTreeMap<Cell, (SignedDuration, u64)>,
    /// Where each track was last.
    latest: HashMap<String, (Timestamp, Cell)>,
}

impl Heat {
    /// A position stands for the time until the next one of its track.
    fn add(&mut self, row: &ArchivedPosition) {
        let cell = self.cell_of(row.position);
        let before = self.latest.insert(row.track.clone(), (row.time, cell));
        let before = before.filter(|(time, _)| row.time.duration_since(*time) < TRACK_GAP);
        if let Some((time, cell)) = before {
            self.cells.entry(cell).or_default().0 += row.time.duration_since(time);
        }
        let is_entered = before.is_none_or(|(_, before)| before != cell);
        self.cells.entry(cell).or_default().1 += u64::from(is_entered);
        if self.latest.len() > TRACKS {
            self.latest.retain(|_, (time, _)| row.time.duration_since(*time) < TRACK_GAP);
        }
    }

    fn cell_of(&self, position: Position) -> Cell {
        let row = (position.latitude_deg() / self.cell_deg).floor() as i64;
        (row, (position.longitude_deg() / self.width_deg(row)).floor() as i64)
    }

    /// Width of the cells of a row in degrees of longitude.
    fn width_deg(&self, row: i64) -> f64 {
        let middle_deg = (row as f64 + 0.5) * self.cell_deg;
        self.cell_deg / middle_deg.to_radians().cos().max(1e-6)
    }

    fn cells(self) -> Result<Vec<HeatCell>> {
        let corner = |row: i64, column: i64, width_deg: f64| {
            let longitude_deg = (column as f64 * width_deg).clamp(-180.0, 180.0);
            Position::new(longitude_deg, (row as f64 * self.cell_deg).clamp(-90.0, 90.0))
                .map_err(Error::fault)
        };
        let cell = |((row, column), (time, visits)): (&Cell, &(SignedDuration, u64))| {
            let width_deg = self.width_deg(*row);
            Ok(HeatCell {
                south_west: corner(*row, *column, width_deg)?,
                north_east: corner(row + 1, column + 1, width_deg)?,
                seconds: time.as_secs_f64(),
                visits: *visits,
            })
        };
        self.cells.iter().map(cell).collect()
    }
}
