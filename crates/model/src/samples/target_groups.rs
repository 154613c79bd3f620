//! Groups of whole targets that are held out together.
//!
//! Each target carries a receiver of its own, whose error outlasts its rows. Rows of one receiver on both
//! sides of a split would let a model be praised for having learned that error.

/// Share of the rows that the targets beside the largest one have at least; with fewer, one receiver has
/// nearly all fixes, and without it there is next to nothing to fit.
const MIN_OTHER_SHARE: f64 = 0.2;

/// Group of each target, from 0, and the number of groups (at most `most`), from the targets' numbers of
/// rows: the largest first, each into the group that is the smallest so far. `None` where one target has
/// nearly all rows.
pub(crate) fn groups_of_targets(rows_of_target: &[usize], most: usize) -> Option<(Vec<usize>, usize)> {
    let (largest, all) = (rows_of_target.iter().max()?, rows_of_target.iter().sum::<usize>());
    if ((all - largest) as f64) < MIN_OTHER_SHARE * all as f64 {
        return None;
    }
    let count = rows_of_target.len().min(most);
    let mut order: Vec<usize> = (0..rows_of_target.len()).collect();
    order.sort_by_key(|target| std::cmp::Reverse(rows_of_target[*target]));
    let mut sizes = vec![0; count];
    let mut group_of = vec![0; rows_of_target.len()];
    for target in order {
        let smallest = (0..count).min_by_key(|group| sizes[*group]).unwrap_or(0);
        sizes[smallest] += rows_of_target[target];
        group_of[target] = smallest;
    }
    Some((group_of, count))
}

#[cfg(test)]
mod tests {
    use super::groups_of_targets;

    #[test]
    fn whole_targets_are_held_out_unless_one_has_nearly_all_rows() {
        let (groups, count) = groups_of_targets(&[100, 60, 50], 4).expect("three receivers");
        assert_eq!((groups, count), (vec![0, 1, 2], 3));
        let (groups, count) = groups_of_targets(&[10, 40, 30, 20], 2).expect("four receivers");
        assert_eq!((groups, count), (vec![0, 0, 1, 1], 2));
        assert_eq!(groups_of_targets(&[100], 4), None);
        assert_eq!(groups_of_targets(&[100, 20], 4), None);
    }
}
