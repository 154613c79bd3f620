//! Which rows are left out together: whole targets; where one target has nearly all rows whole sessions,
//! else spells.

use super::noise::Epoch;
use crate::samples::rows::SESSION_GAP_S;
use crate::samples::target_groups::groups_of_targets;

/// Groups at most.
pub(crate) const GROUPS: usize = 8;
/// Share of the rows that a session of its own has at least.
const MIN_SESSION_SHARE: f64 = 0.1;

/// Group of each row, and their number.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Grouping {
    of_row: Vec<usize>,
    count: usize,
}

impl Grouping {
    /// Rows of each group in their order.
    pub(crate) fn members(&self) -> Vec<Vec<usize>> {
        let mut members = vec![Vec::new(); self.count];
        for (row, group) in self.of_row.iter().enumerate() {
            members[*group].push(row);
        }
        members.retain(|rows| !rows.is_empty());
        members
    }
}

/// Groups of rows that stand in the order of target and time.
pub(crate) fn groups(epochs: &[Epoch]) -> Grouping {
    let targets: Vec<usize> =
        epochs.chunk_by(|one, next| one.sequence == next.sequence).map(<[Epoch]>::len).collect();
    whole_targets(&targets).or_else(|| sessions(epochs)).unwrap_or_else(|| spells(epochs, &targets))
}

/// Whole sessions, where there are at least two: what they contradict each other by is in no spell's
/// difference from its neighbours.
fn sessions(epochs: &[Epoch]) -> Option<Grouping> {
    let mut order: Vec<usize> = (0..epochs.len()).collect();
    order.sort_by(|one, other| epochs[*one].time_s.total_cmp(&epochs[*other].time_s));
    let least = (epochs.len() as f64 * MIN_SESSION_SHARE) as usize;
    let mut of_row = vec![0; epochs.len()];
    let (mut count, mut in_last) = (0, 0_usize);
    for session in order.chunk_by(|one, next| epochs[*next].time_s - epochs[*one].time_s <= SESSION_GAP_S) {
        // A short session joins its neighbour in time.
        if count == 0 || (in_last >= least && session.len() >= least) {
            count += 1;
            in_last = 0;
        }
        in_last += session.len();
        session.iter().for_each(|row| of_row[*row] = count - 1);
    }
    (count > 1).then_some(Grouping { of_row, count })
}

fn whole_targets(targets: &[usize]) -> Option<Grouping> {
    let (group_of, count) = groups_of_targets(targets, GROUPS)?;
    let of_row = targets.iter().zip(&group_of).flat_map(|(rows, group)| vec![*group; *rows]).collect();
    Some(Grouping { of_row, count })
}

/// Spells of each target, cut at the largest gaps near equal shares.
fn spells(epochs: &[Epoch], targets: &[usize]) -> Grouping {
    let pieces = GROUPS.div_ceil(targets.len().max(1));
    let mut of_row = Vec::with_capacity(epochs.len());
    let (mut from, mut group) = (0, 0);
    for rows in targets {
        let own = &epochs[from..from + rows];
        let share = rows / pieces;
        let cuts: Vec<usize> = (1..pieces)
            .map(|cut| {
                let (low, high) = (cut * share - share / 3, cut * share + share / 3);
                let gap_s = |at: usize| own[at].time_s - own[at - 1].time_s;
                (low.max(1)..=high.min(rows.saturating_sub(1)))
                    .max_by(|one, other| {
                        gap_s(*one)
                            .total_cmp(&gap_s(*other))
                            .then_with(|| other.abs_diff(cut * share).cmp(&one.abs_diff(cut * share)))
                    })
                    .unwrap_or(cut * share)
            })
            .collect();
        of_row.extend((0..*rows).map(|row| group + cuts.iter().filter(|cut| row >= **cut).count()));
        group += pieces;
        from += rows;
    }
    Grouping { of_row, count: group }
}
