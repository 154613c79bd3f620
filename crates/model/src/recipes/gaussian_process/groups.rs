//! Which rows are left out together: whole targets; where one target has nearly all rows whole sessions,
//! else intervals of time.

use super::noise::Epoch;
use crate::samples::rows::SESSION_GAP_S;
use crate::samples::target_groups::groups_of_targets;

/// Groups at most.
pub(crate) const GROUPS: usize = 8;

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

    /// True if some of these neighbouring rows are left out together without the others.
    pub(crate) fn cuts(&self, rows: std::ops::Range<usize>) -> bool {
        self.of_row[rows].windows(2).any(|pair| pair[0] != pair[1])
    }
}

/// Groups of rows that stand in the order of target and time.
pub(crate) fn groups(epochs: &[Epoch]) -> Grouping {
    let targets: Vec<usize> =
        epochs.chunk_by(|one, next| one.sequence == next.sequence).map(<[Epoch]>::len).collect();
    whole_targets(&targets).or_else(|| sessions(epochs)).unwrap_or_else(|| intervals(epochs, &targets))
}

/// Whole sessions, where there are at least two. An interval shares the bias of its session with its neighbours, so
/// leaving out an interval does not show how much sessions differ.
fn sessions(epochs: &[Epoch]) -> Option<Grouping> {
    let mut order: Vec<usize> = (0..epochs.len()).collect();
    order.sort_by(|one, other| epochs[*one].time_s.total_cmp(&epochs[*other].time_s));
    // So there are at most as many groups as may be.
    let least = epochs.len().div_ceil(GROUPS);
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

/// Intervals of the target that has nearly all rows, cut at the largest gaps near equal shares; the rows of all others
/// together are one more group.
fn intervals(epochs: &[Epoch], targets: &[usize]) -> Grouping {
    let others = usize::from(targets.len() > 1);
    let pieces = GROUPS - others;
    let largest = (0..targets.len()).max_by_key(|target| targets[*target]).unwrap_or(0);
    let mut of_row = Vec::with_capacity(epochs.len());
    for (target, rows) in targets.iter().enumerate() {
        if target == largest {
            let from = of_row.len();
            of_row.extend(interval_of_row(&epochs[from..from + rows], pieces));
        } else {
            of_row.extend(std::iter::repeat_n(pieces, *rows));
        }
    }
    Grouping { of_row, count: pieces + others }
}

/// The interval of each row of one target.
fn interval_of_row(own: &[Epoch], pieces: usize) -> impl Iterator<Item = usize> {
    let share = own.len() / pieces;
    let gap_s = |at: usize| own[at].time_s - own[at - 1].time_s;
    let cut_near = |middle: usize| {
        let (low, high) = (middle - share / 3, middle + share / 3);
        (low.max(1)..=high.min(own.len().saturating_sub(1)))
            .max_by(|one, other| {
                gap_s(*one)
                    .total_cmp(&gap_s(*other))
                    .then_with(|| other.abs_diff(middle).cmp(&one.abs_diff(middle)))
            })
            .unwrap_or(middle)
    };
    let cuts: Vec<usize> = (1..pieces).map(|cut| cut_near(cut * share)).collect();
    (0..own.len()).map(move |row| cuts.iter().filter(|cut| row >= **cut).count())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// When a session begins, s, and its rows, one per second.
    type Session = (f64, usize);

    /// Rows of targets by their sessions.
    fn epochs(targets: &[&[Session]]) -> Vec<Epoch> {
        let of_target = |(sequence, sessions): (usize, &&[Session])| {
            let row = move |time_s| Epoch { time_s, sequence: sequence as u32 };
            let of_session = |&(from_s, rows): &Session| (0..rows).map(move |at| from_s + at as f64);
            sessions.iter().flat_map(of_session).map(row).collect::<Vec<_>>()
        };
        targets.iter().enumerate().flat_map(of_target).collect()
    }

    #[test]
    fn there_are_at_most_as_many_groups_as_a_model_may_hold() {
        let (long, short): (&[Session], &[Session]) = (&[(0.0, 900)], &[(0.0, 5)]);
        let few = [long, short, short, short, short];
        let many: Vec<_> = std::iter::once(long).chain(std::iter::repeat_n(short, 30)).collect();
        let days: Vec<Session> = (0..12).map(|day| (86_400.0 * f64::from(day), 30)).collect();
        for (targets, expected) in [(few.as_slice(), 8), (&many, 8), (&[days.as_slice()], 8)] {
            let epochs = epochs(targets);
            let members = groups(&epochs).members();
            assert_eq!(members.len(), expected);
            assert_eq!(members.iter().map(Vec::len).sum::<usize>(), epochs.len());
        }
    }
}
