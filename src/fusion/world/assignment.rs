//! Which detection belongs to which track: the assignment of least cost within the gates.
//!
//! The cost of a pair is its negative log-likelihood but for a constant, `(d^2 + ln |S|) / 2`, less a bonus for
//! the track's own tracker id; that of a detection without a track is `-ln` of the density of new targets and
//! false detections (Blackman and Popoli 1999, 6.4). Pairs beyond the gate do not exist, so the problem falls
//! apart into small components, each solved by the Kuhn-Munkres algorithm.

use pathfinding::kuhn_munkres::kuhn_munkres;
use pathfinding::matrix::Matrix;

/// Costs are integers of this unit: exact, and the same on every machine.
const UNITS_PER_NAT: f64 = 1e6;
/// Benefit of a pair that is not possible: less than any sum of possible ones.
const IMPOSSIBLE: i64 = -1_000_000_000_000;

/// A possible pair.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Candidate {
    pub(super) detection: usize,
    pub(super) track: usize,
    /// Negative log-likelihood but for a constant.
    pub(super) cost: f64,
}

/// The track of each of that many detections, by the assignment of least cost; `unassigned_cost` is that of a
/// detection without a track.
pub(super) fn assign(
    detections: usize,
    candidates: &[Candidate],
    unassigned_cost: f64,
) -> Vec<Option<usize>> {
    let mut assigned = vec![None; detections];
    for component in components(detections, candidates) {
        for (detection, track) in solve(&component, unassigned_cost) {
            assigned[detection] = Some(track);
        }
    }
    assigned
}

/// The candidates by connected components of detections that compete for tracks.
fn components(detections: usize, candidates: &[Candidate]) -> Vec<Vec<Candidate>> {
    let mut parent: Vec<usize> = (0..detections).collect();
    let mut by_track: Vec<&Candidate> = candidates.iter().collect();
    by_track.sort_by_key(|candidate| candidate.track);
    for pair in by_track.windows(2) {
        if pair[0].track == pair[1].track {
            let (one, other) = (root(&mut parent, pair[0].detection), root(&mut parent, pair[1].detection));
            parent[one.max(other)] = one.min(other);
        }
    }
    let mut by_root: Vec<(usize, Candidate)> =
        candidates.iter().map(|candidate| (root(&mut parent, candidate.detection), *candidate)).collect();
    by_root.sort_by_key(|(root, candidate)| (*root, candidate.detection, candidate.track));
    let same_root = |one: &(usize, Candidate), other: &(usize, Candidate)| one.0 == other.0;
    by_root.chunk_by(same_root).map(|chunk| chunk.iter().map(|(_, candidate)| *candidate).collect()).collect()
}

fn root(parent: &mut [usize], mut at: usize) -> usize {
    while parent[at] != at {
        parent[at] = parent[parent[at]];
        at = parent[at];
    }
    at
}

/// Pairs of detection and track of one component.
fn solve(component: &[Candidate], unassigned_cost: f64) -> Vec<(usize, usize)> {
    let benefit = |cost: f64| ((unassigned_cost - cost) * UNITS_PER_NAT).round() as i64;
    if let [only] = component {
        return if benefit(only.cost) > 0 { vec![(only.detection, only.track)] } else { Vec::new() };
    }
    let sorted = |key: &dyn Fn(&Candidate) -> usize| {
        let mut keys: Vec<usize> = component.iter().map(key).collect();
        keys.sort_unstable();
        keys.dedup();
        keys
    };
    let rows = sorted(&|candidate| candidate.detection);
    let tracks = sorted(&|candidate| candidate.track);
    // Behind the tracks, a column per detection for no track, of benefit 0.
    let mut benefits = Matrix::new(rows.len(), tracks.len() + rows.len(), IMPOSSIBLE);
    for row in 0..rows.len() {
        benefits[(row, tracks.len() + row)] = 0;
    }
    for candidate in component {
        let row = rows.partition_point(|&detection| detection < candidate.detection);
        let column = tracks.partition_point(|&track| track < candidate.track);
        benefits[(row, column)] = benefit(candidate.cost);
    }
    let (_, columns) = kuhn_munkres(&benefits);
    let pairs = rows.iter().zip(columns);
    pairs.filter_map(|(&detection, column)| Some((detection, *tracks.get(column)?))).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn candidate(detection: usize, track: usize, cost: f64) -> Candidate {
        Candidate { detection, track, cost }
    }

    #[test]
    fn the_sum_decides_not_the_nearest_pair() {
        // Detection 0 is nearest to track 0, but detection 1 has no other.
        let candidates = [candidate(0, 0, 0.0), candidate(0, 1, 1.0), candidate(1, 0, 1.0)];
        assert_eq!(assign(2, &candidates, 4.0), [Some(1), Some(0)]);
    }

    #[test]
    fn a_pair_that_costs_more_than_none_is_not_made() {
        assert_eq!(assign(2, &[candidate(0, 0, 5.0), candidate(1, 1, 3.9)], 4.0), [None, Some(1)]);
        let competing = [candidate(0, 0, 5.0), candidate(1, 0, 4.5), candidate(1, 1, 4.2)];
        assert_eq!(assign(2, &competing, 4.0), [None, None]);
    }

    #[test]
    fn independent_components_are_solved_apart_as_together() {
        let candidates = [
            candidate(3, 7, 0.5),
            candidate(0, 2, 0.1),
            candidate(0, 5, 0.3),
            candidate(2, 5, 0.2),
            candidate(2, 2, 0.9),
        ];
        assert_eq!(assign(4, &candidates, 4.0), [Some(2), None, Some(5), Some(7)]);
    }
}
