//! Groups of whole targets that are held out together.
//!
//! Each target carries a receiver of its own, whose error outlasts its rows. Rows of one receiver on both
//! sides of a split would let a model be praised for having learned that error.

/// Number of targets from which whole targets are held out.
pub(crate) const MIN_TARGETS: usize = 5;

/// Group of each target, 0 to `count - 1`, from the targets' numbers of rows: the largest first, each into
/// the group that is the smallest so far.
pub(crate) fn groups_of_targets(rows_of_target: &[usize], count: usize) -> Vec<usize> {
    let mut order: Vec<usize> = (0..rows_of_target.len()).collect();
    order.sort_by_key(|target| std::cmp::Reverse(rows_of_target[*target]));
    let mut sizes = vec![0; count];
    let mut group_of = vec![0; rows_of_target.len()];
    for target in order {
        let smallest = (0..count).min_by_key(|group| sizes[*group]).unwrap_or(0);
        sizes[smallest] += rows_of_target[target];
        group_of[target] = smallest;
    }
    group_of
}
