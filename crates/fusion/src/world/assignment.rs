//! The assignment of rows to columns of least cost, over the pairs that are possible: detections to tracks within
//! the gates, or true targets to tracks in an evaluation.
//!
//! Pairs that are not listed do not exist, so the problem falls apart into small connected components, each
//! solved by the Kuhn-Munkres algorithm.

use pathfinding::kuhn_munkres::kuhn_munkres;
use pathfinding::matrix::Matrix;

/// Costs are integers of this unit: exact, and the same on every machine.
const UNITS_PER_NAT: f64 = 1e6;
/// Benefit of a pair that is not possible: less than any sum of possible ones.
const IMPOSSIBLE: i64 = -1_000_000_000_000;

/// A possible pair.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Candidate {
    /// Index of the row.
    pub row: usize,
    /// Index of the column.
    pub column: usize,
    /// Cost of the pair, within 1e6.
    pub cost: f64,
}

/// The column of each of that many rows, by the assignment of least total cost; `unassigned_cost` is that of a row
/// without a column.
#[must_use]
pub fn assign(rows: usize, candidates: &[Candidate], unassigned_cost: f64) -> Vec<Option<usize>> {
    let mut assigned = vec![None; rows];
    for component in components(rows, candidates) {
        for (row, column) in solve(&component, unassigned_cost) {
            assigned[row] = Some(column);
        }
    }
    assigned
}

/// The candidates by connected components of rows that compete for columns.
fn components(rows: usize, candidates: &[Candidate]) -> Vec<Vec<Candidate>> {
    let mut parent: Vec<usize> = (0..rows).collect();
    let mut by_column: Vec<&Candidate> = candidates.iter().collect();
    by_column.sort_by_key(|candidate| candidate.column);
    for pair in by_column.windows(2) {
        if pair[0].column == pair[1].column {
            let (one, other) = (root(&mut parent, pair[0].row), root(&mut parent, pair[1].row));
            parent[one.max(other)] = one.min(other);
        }
    }
    let mut by_root: Vec<(usize, Candidate)> =
        candidates.iter().map(|candidate| (root(&mut parent, candidate.row), *candidate)).collect();
    by_root.sort_by_key(|(root, candidate)| (*root, candidate.row, candidate.column));
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

/// Pairs of row and column of one component.
fn solve(component: &[Candidate], unassigned_cost: f64) -> Vec<(usize, usize)> {
    let benefit = |cost: f64| ((unassigned_cost - cost) * UNITS_PER_NAT).round() as i64;
    if let [only] = component {
        return if benefit(only.cost) > 0 { vec![(only.row, only.column)] } else { Vec::new() };
    }
    let sorted = |key: &dyn Fn(&Candidate) -> usize| {
        let mut keys: Vec<usize> = component.iter().map(key).collect();
        keys.sort_unstable();
        keys.dedup();
        keys
    };
    let rows = sorted(&|candidate| candidate.row);
    let columns = sorted(&|candidate| candidate.column);
    // Behind the real columns, one per row for no column, of benefit 0.
    let mut benefits = Matrix::new(rows.len(), columns.len() + rows.len(), IMPOSSIBLE);
    for row in 0..rows.len() {
        benefits[(row, columns.len() + row)] = 0;
    }
    for candidate in component {
        let row = rows.partition_point(|&row| row < candidate.row);
        let column = columns.partition_point(|&column| column < candidate.column);
        benefits[(row, column)] = benefit(candidate.cost);
    }
    let (_, chosen) = kuhn_munkres(&benefits);
    rows.iter().zip(chosen).filter_map(|(&row, column)| Some((row, *columns.get(column)?))).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn candidate(row: usize, column: usize, cost: f64) -> Candidate {
        Candidate { row, column, cost }
    }

    #[test]
    fn the_sum_decides_not_the_nearest_pair() {
        // Row 0 is nearest to column 0, but row 1 has no other.
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
