//! Tracks against true positions, instant by instant.

use std::collections::BTreeMap;

use serde::Serialize;

use super::box_figures::best_common;
use crate::fusion::world::WorldTrackId;
use crate::fusion::world::assignment::{Candidate, assign};
use crate::geo::EastNorth;

/// Distance within which a track matches a target, m.
const MATCHED_WITHIN_M: f64 = 1.0;
/// Cut-off distance of GOSPA, m.
const GOSPA_CUTOFF_M: f64 = 2.0;
/// Benefit of a match above that of any distance: as many matches as possible.
const MATCH_BENEFIT: f64 = 1_000.0;

/// A track that is reported at an instant.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ReportedTrack {
    /// The number of the track.
    pub track: WorldTrackId,
    /// Its position, m.
    pub position: EastNorth,
    /// Its stated 95 % radius, m.
    pub r95_m: f64,
    /// The target of most of its boxes at this instant.
    pub target: Option<usize>,
}

/// One instant: the targets in any camera's view and the tracks that are reported.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct WorldInstant {
    /// Index and true position of each visible target, m.
    pub targets: Vec<(usize, EastNorth)>,
    /// The tracks.
    pub tracks: Vec<ReportedTrack>,
}

/// Figures of positions in the world at 1 m.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct WorldFigures {
    /// `2 IDTP / (2 IDTP + IDFP + IDFN)` over positions within 1 m (Ristani et al. 2016).
    pub idf1: f64,
    /// `1 - (misses + false tracks + identity switches) / targets` (Bernardin and Stiefelhagen 2008).
    pub mota: f64,
    /// Mean over instants of the generalised optimal sub-pattern assignment metric, p = 2, c = 2 m, alpha = 2
    /// (Rahmathullah, Garcia-Fernandez and Svensson 2017), m.
    pub gospa_m: f64,
}

/// Errors of the positions of reported tracks against the target of their boxes.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct PositionFigures {
    /// Mean distance, m.
    pub mean_error_m: f64,
    /// Share of true positions inside the stated 95 % radius.
    pub coverage95: f64,
    /// Number of positions.
    pub positions: usize,
}

impl WorldFigures {
    /// Figures of all instants in their order.
    #[must_use]
    pub fn of(instants: &[WorldInstant]) -> Self {
        let mut common: BTreeMap<(usize, WorldTrackId), usize> = BTreeMap::new();
        let mut matches: BTreeMap<usize, WorldTrackId> = BTreeMap::new();
        let (mut targets, mut tracks, mut wrong) = (0, 0, 0);
        let mut gospa_m = 0.0;
        for instant in instants {
            targets += instant.targets.len();
            tracks += instant.tracks.len();
            for (target, at) in &instant.targets {
                for track in
                    instant.tracks.iter().filter(|it| it.position.distance_m(*at) <= MATCHED_WITHIN_M)
                {
                    *common.entry((*target, track.track)).or_default() += 1;
                }
            }
            wrong += errors_at(instant, &mut matches);
            gospa_m += gospa_at_m(instant);
        }
        Self {
            idf1: 2.0 * best_common(&common) as f64 / (targets + tracks).max(1) as f64,
            mota: 1.0 - wrong as f64 / targets.max(1) as f64,
            gospa_m: gospa_m / instants.len().max(1) as f64,
        }
    }
}

impl PositionFigures {
    /// Figures of all tracks of a known target.
    #[must_use]
    pub fn of(instants: &[WorldInstant]) -> Option<Self> {
        let mut errors = Vec::new();
        for instant in instants {
            for track in &instant.tracks {
                let truth = instant.targets.iter().find(|(target, _)| Some(*target) == track.target);
                errors.extend(truth.map(|(_, at)| (track.position.distance_m(*at), track.r95_m)));
            }
        }
        let positions = errors.len();
        (positions > 0).then(|| Self {
            mean_error_m: errors.iter().map(|(error_m, _)| error_m).sum::<f64>() / positions as f64,
            coverage95: errors.iter().filter(|(error_m, r95_m)| error_m <= r95_m).count() as f64
                / positions as f64,
            positions,
        })
    }
}

/// Misses, false tracks and identity switches at one instant. A match of the instant before goes on while it is
/// within the distance; the rest is assigned.
fn errors_at(instant: &WorldInstant, matches: &mut BTreeMap<usize, WorldTrackId>) -> usize {
    let mut matched: Vec<Option<usize>> = vec![None; instant.targets.len()];
    let mut used = vec![false; instant.tracks.len()];
    for (row, (target, at)) in instant.targets.iter().enumerate() {
        let kept =
            matches.get(target).and_then(|track| instant.tracks.iter().position(|it| it.track == *track));
        if let Some(column) = kept
            && !used[column]
            && instant.tracks[column].position.distance_m(*at) <= MATCHED_WITHIN_M
        {
            matched[row] = Some(column);
            used[column] = true;
        }
    }
    let mut candidates = Vec::new();
    for (row, (_, at)) in instant.targets.iter().enumerate().filter(|(row, _)| matched[*row].is_none()) {
        for (column, track) in instant.tracks.iter().enumerate().filter(|(column, _)| !used[*column]) {
            let distance_m = track.position.distance_m(*at);
            if distance_m <= MATCHED_WITHIN_M {
                candidates.push(Candidate { row, column, cost: distance_m - MATCH_BENEFIT });
            }
        }
    }
    let assigned = assign(instant.targets.len(), &candidates, 0.0);
    let mut switches = 0;
    for (row, (target, _)) in instant.targets.iter().enumerate() {
        if let Some(column) = matched[row].or(assigned[row]) {
            matched[row] = Some(column);
            let track = instant.tracks[column].track;
            switches += usize::from(matches.insert(*target, track).is_some_and(|before| before != track));
        }
    }
    let hits = matched.iter().flatten().count();
    (instant.targets.len() - hits) + (instant.tracks.len() - hits) + switches
}

/// `(sum of d^2 over the matches + c^2 / 2 for each target and track without one)^(1/2)`, m.
fn gospa_at_m(instant: &WorldInstant) -> f64 {
    let cutoff_m2 = GOSPA_CUTOFF_M * GOSPA_CUTOFF_M;
    let mut candidates = Vec::new();
    for (row, (_, at)) in instant.targets.iter().enumerate() {
        for (column, track) in instant.tracks.iter().enumerate() {
            let cost = track.position.distance_m(*at).powi(2) - cutoff_m2;
            if cost < 0.0 {
                candidates.push(Candidate { row, column, cost });
            }
        }
    }
    let assigned = assign(instant.targets.len(), &candidates, 0.0);
    let gained: f64 = candidates
        .iter()
        .filter(|candidate| assigned[candidate.row] == Some(candidate.column))
        .map(|candidate| candidate.cost)
        .sum();
    let unmatched = 0.5 * cutoff_m2 * (instant.targets.len() + instant.tracks.len()) as f64;
    (unmatched + gained).max(0.0).sqrt()
}
