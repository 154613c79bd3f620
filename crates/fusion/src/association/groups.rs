//! Groups: several tracklets that are seen at one time and share a receiver.
//!
//! Who walks together has nearly the same likelihood, so none of them is sure, but the carrier is one of them. Tracklets
//! that are seen at one time exclude each other as the carrier's, so the probability of the group is the sum of theirs. Shares
//! are found for each pair of companions, so those of three who walk together have to be scaled to the sum of the posterior.

/// Members at most: more are a crowd.
const MAX_MEMBERS: usize = 4;
/// A group is together for at least this time, s: tracklets overlap for less while a tracker changes an id.
const LEAST_S: f64 = 2.0;

/// A tracklet, or a part of it, that may be the carrier's.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Candidate {
    /// First and last instant, s.
    pub(super) span_s: [f64; 2],
    /// Posterior probability before companions shared it: at one instant those of all have a sum of at most 1.
    pub(super) posterior: f64,
    /// Its share.
    pub(super) share: f64,
}

/// The members of a group, as indices of candidates with their probabilities and the most probable first, and the interval, s.
pub(super) type Together = (Vec<(usize, f64)>, [f64; 2]);

/// The intervals in which one candidate alone does not reach a probability, but few of them together do.
pub(super) fn groups(candidates: &[Candidate], min_probability: f64) -> Vec<Together> {
    let mut instants_s: Vec<f64> = candidates.iter().flat_map(|own| own.span_s).collect();
    instants_s.sort_by(f64::total_cmp);
    let mut found: Vec<Together> = Vec::new();
    for step in instants_s.windows(2) {
        let [from_s, to_s] = [step[0], step[1]];
        let Some(members) = members(candidates, [from_s, to_s], min_probability) else { continue };
        match found.last_mut() {
            Some((before, [_, until_s])) if *until_s == from_s && indices(before).eq(indices(&members)) => {
                for (own, (_, other)) in before.iter_mut().zip(members) {
                    own.1 = own.1.min(other);
                }
                *until_s = to_s;
            }
            _ => found.push((members, [from_s, to_s])),
        }
    }
    found.retain(|(_, [from_s, to_s])| to_s - from_s >= LEAST_S);
    found
}

fn indices(members: &[(usize, f64)]) -> impl Iterator<Item = usize> {
    members.iter().map(|(at, _)| *at)
}

/// The fewest candidates that are seen during a whole interval and together reach a probability; `None` if one does alone.
fn members(
    candidates: &[Candidate],
    [from_s, to_s]: [f64; 2],
    min_probability: f64,
) -> Option<Vec<(usize, f64)>> {
    let is_seen = |(_, own): &(usize, &Candidate)| own.span_s[0] <= from_s && own.span_s[1] >= to_s;
    let mut seen: Vec<(usize, &Candidate)> = candidates.iter().enumerate().filter(is_seen).collect();
    if seen.iter().any(|(_, own)| own.share >= min_probability) {
        return None;
    }
    seen.sort_by(|one, other| other.1.share.total_cmp(&one.1.share));
    let posterior: f64 = seen.iter().map(|(_, own)| own.posterior).sum();
    let shares: f64 = seen.iter().map(|(_, own)| own.share).sum();
    let scale = (posterior / shares).min(1.0);
    let mut members: Vec<(usize, f64)> = seen.iter().map(|(at, own)| (*at, scale * own.share)).collect();
    let sums = members.iter().scan(0.0, |sum, (_, own)| {
        *sum += own;
        Some(*sum)
    });
    let count = 1 + sums.take(MAX_MEMBERS).position(|sum| sum >= min_probability)?;
    members.truncate(count);
    (count > 1).then_some(members)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A candidate whose share is what it has.
    fn candidate(from_s: f64, to_s: f64, share: f64) -> Candidate {
        Candidate { span_s: [from_s, to_s], posterior: share, share }
    }

    /// Indices of the members, and the interval.
    fn found(candidates: &[Candidate]) -> Vec<(Vec<usize>, [f64; 2])> {
        groups(candidates, 0.9)
            .into_iter()
            .map(|(members, span_s)| (indices(&members).collect(), span_s))
            .collect()
    }

    #[test]
    fn companions_share_a_receiver_while_both_are_seen() {
        let candidates = [candidate(0.0, 40.0, 0.4), candidate(5.0, 30.0, 0.55), candidate(0.0, 50.0, 0.02)];
        assert_eq!(found(&candidates), [(vec![1, 0], [5.0, 30.0])]);
    }

    #[test]
    fn shares_of_more_than_the_posterior_are_scaled_to_it() {
        let share = |posterior: f64| Candidate { span_s: [0.0, 40.0], posterior, share: 0.45 };
        let shared = groups(&[share(0.97), share(0.0), share(0.0)], 0.9);
        let [(members, _)] = &shared[..] else { panic!("{shared:?}") };
        let sum: f64 = members.iter().map(|(_, own)| own).sum();
        assert!(members.len() == 3 && (sum - 0.97).abs() < 1e-9, "{members:?}");
        assert!(groups(&[share(0.6), share(0.1), share(0.1)], 0.9).is_empty());
    }

    #[test]
    fn who_is_sure_alone_is_no_group() {
        assert!(found(&[candidate(0.0, 40.0, 0.95), candidate(0.0, 40.0, 0.04)]).is_empty());
    }

    #[test]
    fn a_companion_whose_id_breaks_is_in_two_groups() {
        let candidates = [candidate(0.0, 40.0, 0.5), candidate(0.0, 20.0, 0.45), candidate(20.0, 40.0, 0.42)];
        assert_eq!(found(&candidates), [(vec![0, 1], [0.0, 20.0]), (vec![0, 2], [20.0, 40.0])]);
    }

    #[test]
    fn many_with_little_each_and_those_together_for_a_moment_are_none() {
        assert!(found(&[candidate(0.0, 40.0, 0.19); 5]).is_empty());
        assert!(found(&[candidate(0.0, 20.0, 0.5), candidate(19.0, 40.0, 0.5)]).is_empty());
    }
}
