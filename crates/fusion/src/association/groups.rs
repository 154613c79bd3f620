//! Groups: several tracklets that are seen at one time and share a receiver.
//!
//! Who walks together has nearly the same likelihood, so none of them is sure, but the carrier is one of them. Tracklets
//! that are seen at one time exclude each other as the carrier's, so the probability of the group is the sum of theirs.

/// Members at most: more are a crowd.
const MAX_MEMBERS: usize = 4;
/// A group is together for at least this time, s: tracklets overlap for less while a tracker changes an id.
const LEAST_S: f64 = 2.0;

/// A tracklet, or a part of it, that may be the carrier's.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Candidate {
    /// First and last instant, s.
    pub(super) span_s: [f64; 2],
    pub(super) probability: f64,
}

/// The members of a group, as indices of candidates with the most probable first, and the interval, s.
pub(super) type Together = (Vec<usize>, [f64; 2]);

/// The intervals in which one candidate alone does not reach a probability, but few of them together do.
pub(super) fn groups(candidates: &[Candidate], min_probability: f64) -> Vec<Together> {
    let mut instants_s: Vec<f64> = candidates.iter().flat_map(|own| own.span_s).collect();
    instants_s.sort_by(f64::total_cmp);
    let mut found: Vec<Together> = Vec::new();
    for step in instants_s.windows(2) {
        let [from_s, to_s] = [step[0], step[1]];
        let Some(members) = members(candidates, [from_s, to_s], min_probability) else { continue };
        match found.last_mut() {
            Some((before, [_, until_s])) if *before == members && *until_s == from_s => *until_s = to_s,
            _ => found.push((members, [from_s, to_s])),
        }
    }
    found.retain(|(_, [from_s, to_s])| to_s - from_s >= LEAST_S);
    found
}

/// The fewest candidates that are seen during a whole interval and together reach a probability; `None` if one does alone.
fn members(candidates: &[Candidate], [from_s, to_s]: [f64; 2], min_probability: f64) -> Option<Vec<usize>> {
    let is_seen = |own: &Candidate| own.span_s[0] <= from_s && own.span_s[1] >= to_s;
    let mut seen: Vec<usize> = (0..candidates.len()).filter(|at| is_seen(&candidates[*at])).collect();
    seen.sort_by(|one, other| candidates[*other].probability.total_cmp(&candidates[*one].probability));
    let sums = seen.iter().scan(0.0, |sum, at| {
        *sum += candidates[*at].probability;
        Some(*sum)
    });
    let count = 1 + sums.take(MAX_MEMBERS).position(|sum| sum >= min_probability)?;
    seen.truncate(count);
    (count > 1).then_some(seen)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn candidate(from_s: f64, to_s: f64, probability: f64) -> Candidate {
        Candidate { span_s: [from_s, to_s], probability }
    }

    #[test]
    fn companions_share_a_receiver_while_both_are_seen() {
        let candidates = [candidate(0.0, 40.0, 0.4), candidate(5.0, 30.0, 0.55), candidate(0.0, 50.0, 0.02)];
        assert_eq!(groups(&candidates, 0.9), [(vec![1, 0], [5.0, 30.0])]);
    }

    #[test]
    fn who_is_sure_alone_is_no_group() {
        let candidates = [candidate(0.0, 40.0, 0.95), candidate(0.0, 40.0, 0.04)];
        assert!(groups(&candidates, 0.9).is_empty());
    }

    #[test]
    fn a_companion_whose_id_breaks_is_in_two_groups() {
        let candidates = [candidate(0.0, 40.0, 0.5), candidate(0.0, 20.0, 0.45), candidate(20.0, 40.0, 0.42)];
        assert_eq!(groups(&candidates, 0.9), [(vec![0, 1], [0.0, 20.0]), (vec![0, 2], [20.0, 40.0])]);
    }

    #[test]
    fn many_with_little_each_and_those_together_for_a_moment_are_none() {
        let crowd = [candidate(0.0, 40.0, 0.19); 5];
        assert!(groups(&crowd, 0.9).is_empty());
        let brief = [candidate(0.0, 20.0, 0.5), candidate(19.0, 40.0, 0.5)];
        assert!(groups(&brief, 0.9).is_empty());
    }
}
