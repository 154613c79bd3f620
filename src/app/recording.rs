//! Recorded detections and fixes that come apart, made into samples.
//!
//! Does not open files, and does not contain pairing rules (they are [`crate::fusion::pairing`]'s).

use std::collections::{BTreeMap, BTreeSet};

use jiff::Timestamp;

use crate::domain::{
    Detection, Error, ErrorKind, Fix, ReceivedFix, Receiver, ReceiverId, Receivers, Result, TargetId,
};
use crate::exchange::{FixFormat, RowError};
use crate::fusion::clock_offset::{OffsetEstimate, OffsetSearch, estimate_clock_offset};
use crate::fusion::pairing::{Paired, PairingSettings, pair};

/// Which of the two files.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Part {
    Detections,
    Fixes,
}

impl Part {
    /// The one name used everywhere.
    #[must_use]
    pub const fn as_str(self) -> &'static str {
        match self {
            Self::Detections => "detections",
            Self::Fixes => "fixes",
        }
    }
}

/// Rows of both files that are none.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct RejectedParts {
    pub count: u64,
    /// The first of each file, with their reasons.
    pub rows: Vec<(Part, RowError)>,
}

/// The rows of two files, in memory.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Recording {
    /// The boxes, in the file's order.
    pub detections: Vec<Detection>,
    /// The fixes, in the file's order.
    pub fixes: Vec<ReceivedFix>,
    /// The rows that could not be read.
    pub rejected: RejectedParts,
}

/// How much of a recording is read, and of its rejected rows reported.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct RecordingLimits {
    /// Good rows of each file.
    pub rows: usize,
    /// Rejected rows reported one by one, of each file.
    pub rejected_rows: usize,
}

type Row<T> = Result<std::result::Result<T, RowError>>;

impl Recording {
    /// Reads both files to their ends.
    ///
    /// # Errors
    /// `MalformedBody` for a file that breaks off; `TooLarge` for one of more rows than the limit.
    /// Both name the file.
    pub fn read(
        detections: impl Iterator<Item = Row<Detection>>,
        fixes: impl Iterator<Item = Row<ReceivedFix>>,
        limits: RecordingLimits,
    ) -> Result<Self> {
        let mut rejected = RejectedParts::default();
        Ok(Self {
            detections: gather(Part::Detections, detections, limits, &mut rejected)?,
            fixes: gather(Part::Fixes, fixes, limits, &mut rejected)?,
            rejected,
        })
    }

    /// Gives the fixes that name no receiver one: the given one; else the only one of the receivers;
    /// else that of the only target among the boxes. The names that gpsd gives are those of
    /// devices, so one that is not among the receivers counts as no name.
    ///
    /// Returns the receiver they were given, if there were any and there was one to give.
    ///
    /// # Errors
    /// Fixes of two devices that are not among the receivers, which cannot be one receiver's.
    pub fn name_fixes(
        &mut self,
        format: FixFormat,
        receivers: &Receivers,
        given: Option<ReceiverId>,
    ) -> Result<Option<Receiver>> {
        if format == FixFormat::Gpsd {
            self.forget_device(receivers)?;
        }
        if self.fixes.iter().all(|fix| fix.receiver_id.is_some()) {
            return Ok(None);
        }
        let only = || receivers.only().map(|receiver| receiver.receiver_id.clone());
        let Some(receiver_id) = given.or_else(only).or_else(|| self.only_target()) else { return Ok(None) };
        for fix in self.fixes.iter_mut().filter(|fix| fix.receiver_id.is_none()) {
            fix.receiver_id = Some(receiver_id.clone());
        }
        let named = receivers.get(&receiver_id).cloned();
        Ok(Some(named.unwrap_or_else(|| Receiver::named(receiver_id))))
    }

    fn forget_device(&mut self, receivers: &Receivers) -> Result<()> {
        let mut device: Option<ReceiverId> = None;
        for fix in &mut self.fixes {
            let Some(id) = fix.receiver_id.take_if(|id| receivers.get(id).is_none()) else { continue };
            if device.get_or_insert_with(|| id.clone()) != &id {
                return Err(Error::invalid(
                    "fixes.device",
                    format!("{id} is not the only device of the file; say whose each is among the receivers"),
                ));
            }
        }
        Ok(())
    }

    /// A receiver of which nothing is said carries its target's id.
    fn only_target(&self) -> Option<ReceiverId> {
        let first = &self.detections.first()?.target_id;
        let is_only = self.detections.iter().all(|detection| &detection.target_id == first);
        is_only.then(|| ReceiverId::new(first.as_str()).ok()).flatten()
    }

    /// The clock offset of every receiver that the fixes name, by its id; `None` where the files
    /// do not show it.
    #[must_use]
    pub fn clock_offsets(&self, receivers: &Receivers) -> Vec<(Receiver, Option<OffsetEstimate>)> {
        let named: BTreeSet<&ReceiverId> =
            self.fixes.iter().filter_map(|fix| fix.receiver_id.as_ref()).collect();
        let mut seen: BTreeMap<TargetId, Vec<Detection>> = BTreeMap::new();
        let estimated = named.into_iter().map(|id| {
            let receiver = receivers.get(id).cloned().unwrap_or_else(|| Receiver::named(id.clone()));
            let boxes = seen
                .entry(receiver.target_id.clone())
                .or_insert_with(|| in_order(&self.detections, &receiver.target_id));
            let of_receiver = self.fixes.iter().filter(|fix| fix.receiver_id.as_ref() == Some(id));
            let mut fixes: Vec<(Timestamp, Fix)> = of_receiver.map(|fix| (fix.time, fix.fix)).collect();
            fixes.sort_by_key(|(time, _)| *time);
            fixes.dedup_by_key(|(time, _)| *time);
            let estimate = estimate_clock_offset(boxes, &fixes, &OffsetSearch::default());
            (receiver, estimate)
        });
        estimated.collect()
    }

    /// Pairs what was read.
    #[must_use]
    pub fn paired(
        self,
        receivers: &Receivers,
        settings: &PairingSettings,
    ) -> (Paired, PairingCounts, RejectedParts) {
        let read = (self.detections.len() as u64, self.fixes.len() as u64);
        let paired = pair(self.detections, self.fixes, receivers, settings);
        let counts = PairingCounts::of(read, &paired);
        (paired, counts, self.rejected)
    }
}

fn in_order(detections: &[Detection], target_id: &TargetId) -> Vec<Detection> {
    let of_target = detections.iter().filter(|detection| &detection.target_id == target_id);
    let mut boxes: Vec<Detection> = of_target.cloned().collect();
    boxes.sort_by_key(|detection| detection.time);
    boxes.dedup_by_key(|detection| detection.time);
    boxes
}

fn gather<T>(
    part: Part,
    rows: impl Iterator<Item = Row<T>>,
    limits: RecordingLimits,
    rejected: &mut RejectedParts,
) -> Result<Vec<T>> {
    let (mut good, mut reported) = (Vec::new(), 0);
    for row in rows {
        match row.map_err(|error| of_part(part, error))? {
            Ok(_) if good.len() == limits.rows => {
                let message = format!("may have at most {} rows to be paired", limits.rows);
                return Err(Error::field(ErrorKind::TooLarge, part.as_str(), message));
            }
            Ok(row) => good.push(row),
            Err(fault) => {
                rejected.count += 1;
                if reported < limits.rejected_rows {
                    rejected.rows.push((part, fault));
                    reported += 1;
                }
            }
        }
    }
    Ok(good)
}

/// A refusal of one of two files says which.
#[must_use]
pub fn of_part(part: Part, error: Error) -> Error {
    match error.under(part.as_str()) {
        Error::Refused(mut refusal) if refusal.violations.is_empty() => {
            refusal.message = format!("{}: {}", part.as_str(), refusal.message);
            Error::Refused(refusal)
        }
        error => error,
    }
}

/// Counts of the rows of two files. Rejected rows are not counted here.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct PairingCounts {
    /// Number of boxes read.
    pub detections: u64,
    /// Number of fixes read.
    pub fixes: u64,
    /// Number of samples made.
    pub paired: u64,
    /// Boxes of targets that no fix belongs to.
    pub detections_without_fixes: u64,
    /// Boxes without a fix near in time, though others of their target have one.
    pub detections_far_from_fixes: u64,
    /// Boxes whose nearest fix is nearer to another box.
    pub detections_with_fix_claimed: u64,
    /// Boxes of a target and instant that was there already.
    pub detections_duplicate: u64,
    /// Fixes that name no receiver.
    pub fixes_without_receiver: u64,
    /// Fixes of targets that no box shows.
    pub fixes_without_detections: u64,
    /// Other fixes that no box took.
    pub fixes_unused: u64,
    /// Fixes of a target and instant that was there already.
    pub fixes_duplicate: u64,
}

impl PairingCounts {
    fn of((detections, fixes): (u64, u64), paired: &Paired) -> Self {
        let unpaired = paired.unpaired;
        let far = unpaired.detections - unpaired.fix_claimed_by_nearer_box - paired.detections_without_fixes;
        Self {
            detections,
            fixes,
            paired: paired.samples.len() as u64,
            detections_without_fixes: paired.detections_without_fixes,
            detections_far_from_fixes: far,
            detections_with_fix_claimed: unpaired.fix_claimed_by_nearer_box,
            detections_duplicate: unpaired.duplicates - unpaired.duplicate_fixes,
            fixes_without_receiver: unpaired.receiver_missing,
            fixes_without_detections: paired.fixes_without_detections,
            fixes_unused: unpaired.fixes - paired.fixes_without_detections,
            fixes_duplicate: unpaired.duplicate_fixes,
        }
    }
}

#[cfg(test)]
mod tests {
    use jiff::SignedDuration;

    use super::*;
    use crate::domain::BoundingBox;
    use crate::geo::Position;

    fn at(seconds: i64) -> Timestamp {
        Timestamp::UNIX_EPOCH + SignedDuration::from_secs(1_600_000_000 + seconds)
    }

    fn fix(receiver_id: Option<&str>, seconds: i64) -> ReceivedFix {
        let position = Position::new(8.0, 47.0).expect("a place");
        let receiver_id = receiver_id.map(|id| ReceiverId::new(id).expect("a name"));
        ReceivedFix { time: at(seconds), receiver_id, fix: Fix { position, sigma_m: None } }
    }

    fn seen(target_id: &str, seconds: i64) -> Detection {
        Detection {
            time: at(seconds),
            target_id: TargetId::new(target_id).expect("a name"),
            bounding_box: BoundingBox::new(1.0, 2.0, 3.0, 4.0).expect("a box"),
            class: None,
            score: None,
        }
    }

    fn bound(receivers: &[(&str, &str)]) -> Receivers {
        let receivers = receivers.iter().map(|(receiver_id, target_id)| Receiver {
            target_id: TargetId::new(target_id).expect("a name"),
            ..Receiver::named(ReceiverId::new(receiver_id).expect("a name"))
        });
        Receivers::new(receivers).expect("good")
    }

    fn named(
        detections: &[Detection],
        fixes: &[ReceivedFix],
        format: FixFormat,
        receivers: &Receivers,
        given: Option<&str>,
    ) -> Result<Option<String>> {
        let rejected = RejectedParts::default();
        let mut recording = Recording { detections: detections.to_vec(), fixes: fixes.to_vec(), rejected };
        let given = given.map(|id| ReceiverId::new(id).expect("a name"));
        let named = recording.name_fixes(format, receivers, given)?;
        Ok(named.map(|receiver| format!("{} {}", receiver.receiver_id, receiver.target_id)))
    }

    #[test]
    fn fixes_without_a_name_get_the_given_the_only_receiver_or_the_only_target() {
        let (one, two) = (bound(&[("phone", "a")]), bound(&[("phone", "a"), ("watch", "b")]));
        let nobody = Receivers::default();
        let (boxes, others) = ([seen("a", 0), seen("a", 1)], [seen("a", 0), seen("b", 0)]);
        let fixes = [fix(None, 0), fix(Some("x"), 1)];
        let name = |boxes: &[Detection], receivers: &Receivers, given| {
            named(boxes, &fixes, FixFormat::Csv, receivers, given).expect("good")
        };
        assert_eq!(name(&boxes, &two, Some("watch")).as_deref(), Some("watch b"));
        assert_eq!(name(&boxes, &two, Some("tag")).as_deref(), Some("tag tag"));
        assert_eq!(name(&others, &one, None).as_deref(), Some("phone a"));
        assert_eq!(name(&boxes, &nobody, None).as_deref(), Some("a a"));
        assert_eq!(name(&others, &nobody, None), None);
        let all_named = [fix(Some("x"), 1)];
        assert_eq!(named(&boxes, &all_named, FixFormat::Csv, &one, None).expect("good"), None);
    }

    #[test]
    fn a_device_is_a_receiver_only_where_it_is_bound() {
        let boxes = [seen("a", 0)];
        let (usb, other) = (fix(Some("/dev/ttyUSB0"), 0), fix(Some("/dev/ttyUSB1"), 1));
        let name = |fixes: &[ReceivedFix], receivers: &Receivers| {
            named(&boxes, fixes, FixFormat::Gpsd, receivers, None)
        };
        let nobody = Receivers::default();
        assert_eq!(name(std::slice::from_ref(&usb), &nobody).expect("one").as_deref(), Some("a a"));
        let refused = name(&[usb.clone(), other.clone()], &nobody).expect_err("two").to_string();
        assert!(refused.contains("/dev/ttyUSB1"), "{refused}");
        let both = bound(&[("/dev/ttyUSB0", "a"), ("/dev/ttyUSB1", "b")]);
        assert_eq!(name(&[usb, other], &both).expect("bound"), None);
    }

    #[test]
    fn a_file_beyond_the_limit_is_refused_by_its_name() {
        let limits = RecordingLimits { rows: 2, rejected_rows: 1 };
        let fault = |line| RowError { line, field: String::new(), reason: "bad".to_owned() };
        let detections = [Ok(Ok(seen("a", 0))), Ok(Err(fault(2))), Ok(Err(fault(3)))];
        let fixes = (0..2).map(|n| Ok(Ok(fix(None, n))));
        let read = Recording::read(detections.into_iter(), fixes, limits).expect("within");
        assert_eq!((read.rejected.count, read.rejected.rows), (2, vec![(Part::Detections, fault(2))]));
        let fixes = (0..3).map(|n| Ok(Ok(fix(None, n))));
        let refused = Recording::read(std::iter::empty(), fixes, limits).expect_err("too many");
        assert_eq!(refused.kind(), ErrorKind::TooLarge);
        assert!(refused.to_string().starts_with("fixes"), "{refused}");
    }
}
