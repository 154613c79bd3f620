//! What a match has found: which boxes show the carriers of which receivers.

use std::collections::BTreeSet;

use jiff::Timestamp;

use crate::domain::{
    Association, BoundingBox, ClockOffset, Detection, ReceivedFix, Receiver, ReceiverId, Receivers, TargetId,
};

/// Boxes of a member of a group that are further apart are not joined by a line, s.
const LONGEST_GAP_S: f64 = 1.0;

/// A part of a tracklet and the receiver that its target carries most probably.
#[derive(Debug, Clone, PartialEq)]
pub struct MatchedPiece {
    /// Id that the tracker gave it.
    pub tracker_id: TargetId,
    /// Indices of its detections, in order of time.
    pub detections: Vec<usize>,
    /// The receiver.
    pub receiver_id: ReceiverId,
    /// Posterior probability.
    pub probability: f64,
}

impl MatchedPiece {
    /// Left, top, width and height of its box, px, on the straight line between neighbours at most 1 s apart.
    fn sides_px(&self, detections: &[Detection], time: Timestamp) -> Option<[f64; 4]> {
        let next = self.detections.partition_point(|at| detections[*at].time < time);
        let after = &detections[*self.detections.get(next)?];
        if after.time == time {
            return Some(after.bounding_box.sides_px());
        }
        let before = &detections[self.detections[next.checked_sub(1)?]];
        let since_s = |until: Timestamp| until.duration_since(before.time).as_secs_f64();
        let share = since_s(time) / since_s(after.time);
        let (from, to) = (before.bounding_box.sides_px(), after.bounding_box.sides_px());
        let is_near = since_s(after.time) <= LONGEST_GAP_S;
        is_near.then(|| std::array::from_fn(|side| from[side] + share * (to[side] - from[side])))
    }
}

/// The tracklets of which one shows the carrier of a receiver while all of them are seen.
#[derive(Debug, Clone, PartialEq)]
pub struct MatchedGroup {
    /// The members with their boxes of that time, the most probable first; all have the same receiver.
    pub members: Vec<MatchedPiece>,
}

impl MatchedGroup {
    /// Posterior probability that one of the members shows the carrier.
    #[must_use]
    pub fn probability(&self) -> f64 {
        self.members.iter().map(|member| member.probability).sum()
    }

    /// The receiver of all members.
    #[must_use]
    pub fn receiver_id(&self) -> &ReceiverId {
        &self.members[0].receiver_id
    }

    /// The mean of the members' boxes, weighed by their probabilities, at each box of the most probable one: where the carrier is
    /// expected, whichever member it is.
    pub fn boxes<'a>(&'a self, detections: &'a [Detection]) -> impl Iterator<Item = CarrierBox> + 'a {
        let ids: Vec<&str> = self.members.iter().map(|member| member.tracker_id.as_str()).collect();
        let joined = TargetId::new(&ids.join("+"));
        let tracker_id = joined.unwrap_or_else(|_| self.members[0].tracker_id.clone());
        let association = Association { tracker_id, probability: self.probability() };
        self.members[0].detections.iter().filter_map(move |at| {
            let own = &detections[*at];
            let mut mean = [0.0; 4];
            for member in &self.members {
                let sides_px = member.sides_px(detections, own.time)?;
                let weight = member.probability / association.probability;
                mean.iter_mut().zip(sides_px).for_each(|(sum, side)| *sum += weight * side);
            }
            let [left_px, top_px, width_px, height_px] = mean;
            let bounding_box = BoundingBox::new(left_px, top_px, width_px, height_px).ok()?;
            let target_id = TargetId::from(self.receiver_id().clone());
            let detection = Detection { target_id, bounding_box, ..own.clone() };
            Some(CarrierBox { detection, association: association.clone(), at: None })
        })
    }
}

/// A box of the carrier of a receiver.
#[derive(Debug, Clone, PartialEq)]
pub struct CarrierBox {
    /// The box, with the receiver's id as its target.
    pub detection: Detection,
    /// The tracker's id, or those of a group joined by `+`, and the posterior probability.
    pub association: Association,
    /// Its index among the detections; `None` for the mean box of a group.
    pub at: Option<usize>,
}

/// Which boxes show the carriers of which receivers.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Matching {
    /// The posterior probability from which on pieces are sure and tracklets are a group.
    pub min_probability: f64,
    /// Pieces of tracklets with their most probable receivers, in order of tracker's id and time.
    pub pieces: Vec<MatchedPiece>,
    /// Tracklets that share a receiver, none of them sure, in order of receiver and time.
    pub groups: Vec<MatchedGroup>,
    /// Clock offsets found, beside those that were given.
    pub clock_offsets: Vec<(ReceiverId, ClockOffset)>,
    /// Tracklets and receivers that were compared.
    pub tracklets: usize,
    /// Receivers with fixes.
    pub receivers: usize,
    /// Cuts within tracklets where the tracker's id may have moved to another target.
    pub cuts: usize,
}

impl Matching {
    /// The receivers of fixes under their own ids, their given clock offsets corrected by those found.
    #[must_use]
    pub fn receivers_of(&self, fixes: &[ReceivedFix], given: &Receivers) -> Receivers {
        let ids: BTreeSet<&ReceiverId> = fixes.iter().filter_map(|fix| fix.receiver_id.as_ref()).collect();
        let receivers = ids.into_iter().map(|id| {
            let known = given.get(id);
            let given_s = known.map_or(0.0, |own| own.clock_offset.seconds());
            let found = self.clock_offsets.iter().find(|(own, _)| own == id);
            let found_s = found.map_or(0.0, |(_, own)| own.seconds());
            let clock_offset = ClockOffset::from_seconds(given_s + found_s).unwrap_or(ClockOffset::ZERO);
            let sigma = known.and_then(|own| own.sigma);
            Receiver { clock_offset, sigma, ..Receiver::named(id.clone()) }
        });
        // The bound on receivers is smaller than that of a list of receivers.
        Receivers::new(receivers).unwrap_or_default()
    }

    /// The sure pieces.
    pub fn sure(&self) -> impl Iterator<Item = &MatchedPiece> {
        self.pieces.iter().filter(|piece| piece.probability >= self.min_probability)
    }

    /// The boxes of sure pieces, and the mean boxes of groups. `detections` are those that were matched.
    #[must_use]
    pub fn carrier_boxes(&self, detections: &[Detection]) -> Vec<CarrierBox> {
        let of_piece = |piece: &MatchedPiece| {
            let association =
                Association { tracker_id: piece.tracker_id.clone(), probability: piece.probability };
            let target_id = TargetId::from(piece.receiver_id.clone());
            let own = |at: &usize| CarrierBox {
                detection: Detection { target_id: target_id.clone(), ..detections[*at].clone() },
                association: association.clone(),
                at: Some(*at),
            };
            piece.detections.iter().map(own).collect::<Vec<CarrierBox>>()
        };
        let of_groups = self.groups.iter().flat_map(|group| group.boxes(detections));
        self.sure().flat_map(of_piece).chain(of_groups).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A box of a tracker's id, 20 px wide.
    fn detection(time_s: f64, id: &str, left_px: f64) -> Detection {
        Detection {
            time: Timestamp::UNIX_EPOCH + jiff::SignedDuration::from_secs_f64(time_s),
            target_id: TargetId::new(id).expect("an id"),
            bounding_box: BoundingBox::new(left_px, 10.0, 20.0, 60.0).expect("a box"),
            class: None,
            score: None,
        }
    }

    fn piece(id: &str, detections: Vec<usize>, probability: f64) -> MatchedPiece {
        MatchedPiece {
            tracker_id: TargetId::new(id).expect("an id"),
            detections,
            receiver_id: ReceiverId::new("phone").expect("an id"),
            probability,
        }
    }

    #[test]
    fn a_group_has_the_mean_of_its_members_boxes_and_a_sure_piece_its_own() {
        let detections = [
            detection(0.0, "1", 100.0),
            detection(0.5, "2", 210.0),
            detection(1.0, "1", 100.0),
            detection(1.3, "2", 218.0),
            detection(2.0, "1", 100.0),
            detection(9.0, "3", 50.0),
        ];
        let group =
            MatchedGroup { members: vec![piece("1", vec![0, 2, 4], 0.57), piece("2", vec![1, 3], 0.38)] };
        let matching = Matching {
            min_probability: 0.9,
            pieces: vec![piece("3", vec![5], 0.93), piece("1", vec![0, 2, 4], 0.57)],
            groups: vec![group],
            ..Matching::default()
        };
        let carriers = matching.carrier_boxes(&detections);
        let shown: Vec<(Option<usize>, &str, f64, f64)> = carriers
            .iter()
            .map(|own| {
                let [left_px, ..] = own.detection.bounding_box.sides_px();
                (own.at, own.association.tracker_id.as_str(), own.association.probability, left_px)
            })
            .collect();
        // The second one has no box before 0.5 s and after 1.3 s; at 1 s it is at 215 px.
        let mean_px = 0.6 * 100.0 + 0.4 * 215.0;
        assert_eq!(shown.len(), 2, "{shown:?}");
        assert_eq!(shown[0], (Some(5), "3", 0.93, 50.0));
        assert_eq!((shown[1].0, shown[1].1), (None, "1+2"));
        assert!((shown[1].2 - 0.95).abs() < 1e-9 && (shown[1].3 - mean_px).abs() < 1e-9, "{shown:?}");
        assert!(carriers.iter().all(|own| own.detection.target_id.as_str() == "phone"));
    }
}
