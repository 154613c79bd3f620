//! Recorded items in their order of arrival.

use jiff::{SignedDuration, Timestamp};

use crate::domain::{Error, LiveItem, ReceiverId, Result, TargetId};

/// The owner of fixes that name no target.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum FixOwner {
    Target(TargetId),
    /// A receiver; the server knows its target.
    Receiver(ReceiverId),
}

/// Items to replay, at least one.
#[derive(Debug, Clone, PartialEq)]
pub struct RecordedStream {
    items: Vec<LiveItem>,
    first: Timestamp,
    last: Timestamp,
    interval: SignedDuration,
}

impl RecordedStream {
    /// Rows in the order of their file.
    ///
    /// # Errors
    /// Refuses an empty recording.
    pub fn from_rows(rows: impl IntoIterator<Item = LiveItem>) -> Result<Self> {
        Self::from_items(rows.into_iter().collect())
    }

    /// Boxes and fixes that were recorded separately, merged by time. Fixes that name neither target nor receiver belong
    /// to `fix_owner`, or to the only target among the boxes.
    ///
    /// # Errors
    /// Refuses an empty recording, and fixes that may belong to several targets; the field is `target_id`.
    pub fn from_detections_and_fixes(
        detections: impl IntoIterator<Item = LiveItem>,
        fixes: impl IntoIterator<Item = LiveItem>,
        fix_owner: Option<FixOwner>,
    ) -> Result<Self> {
        let mut items: Vec<LiveItem> = detections.into_iter().collect();
        let mut targets: Vec<_> = items.iter().filter_map(|item| item.target_id.clone()).collect();
        targets.sort_unstable();
        targets.dedup();
        let fix_owner = fix_owner.or_else(|| match targets.as_slice() {
            [only] => Some(FixOwner::Target(only.clone())),
            _ => None,
        });
        for mut item in fixes {
            match (&item.target_id, &fix_owner) {
                _ if item.receiver_id.is_some() => {}
                (Some(_), _) => {}
                (None, Some(FixOwner::Target(id))) => item.target_id = Some(id.clone()),
                (None, Some(FixOwner::Receiver(id))) => item.receiver_id = Some(id.clone()),
                (None, None) => {
                    let message = "the fixes name neither target nor receiver and there are several targets: name the target or the receiver of the fixes";
                    return Err(Error::invalid("target_id", message));
                }
            }
            items.push(item);
        }
        // A stable sort: the box stays before the fix of the same instant.
        items.sort_by_key(|item| item.time);
        Self::from_items(items)
    }

    fn from_items(items: Vec<LiveItem>) -> Result<Self> {
        let mut times: Vec<_> = items.iter().map(|item| item.time).collect();
        times.sort_unstable();
        times.dedup();
        let (Some(&first), Some(&last)) = (times.first(), times.last()) else {
            return Err(Error::invalid("", "there are no rows to replay"));
        };
        let interval = match i32::try_from(times.len() - 1) {
            Ok(gaps @ 1..) => last.duration_since(first) / gaps,
            _ => SignedDuration::from_secs(1),
        };
        // Times are stored in microseconds, and repetitions must not overlap.
        let interval = interval.max(SignedDuration::from_micros(1));
        Ok(Self { items, first, last, interval })
    }

    /// Rows in the order of time that are repeated with a period, which begins at `first`, may contain nothing at its
    /// beginning and end, and is a multiple of the interval between instants.
    ///
    /// # Errors
    /// Refuses an empty recording.
    pub fn periodic(
        rows: Vec<LiveItem>,
        first: Timestamp,
        period: SignedDuration,
        interval: SignedDuration,
    ) -> Result<Self> {
        let last = first.saturating_add(period - interval).unwrap_or(first);
        Ok(Self { first, last, interval, ..Self::from_items(rows)? })
    }

    /// The first instant of the first repetition.
    #[must_use]
    pub const fn first(&self) -> Timestamp {
        self.first
    }

    /// Number of items.
    #[must_use]
    pub const fn len(&self) -> usize {
        self.items.len()
    }

    /// Always false: a recording has at least one item.
    #[must_use]
    pub const fn is_empty(&self) -> bool {
        self.items.is_empty()
    }

    /// Mean interval between instants; one second if there is only one instant.
    #[must_use]
    pub const fn interval(&self) -> SignedDuration {
        self.interval
    }

    /// The shift of all times that moves the last item of the last repetition to `end`.
    #[must_use]
    pub fn shift_to_end_at(&self, end: Timestamp, repetitions: u64) -> SignedDuration {
        end.duration_since(self.last) - self.repetition_offset(repetitions.saturating_sub(1))
    }

    /// Time from the first instant of the first repetition to this item.
    pub(super) fn since_begin(&self, row: usize, repetition: u64) -> SignedDuration {
        self.items[row].time.duration_since(self.first) + self.repetition_offset(repetition)
    }

    /// The item in that repetition, with its time shifted.
    pub(super) fn item(&self, row: usize, repetition: u64, shift: SignedDuration) -> LiveItem {
        let mut item = self.items[row].clone();
        item.time = item.time.saturating_add(shift + self.repetition_offset(repetition)).unwrap_or(item.time);
        item
    }

    /// Time between the first repetition and another.
    fn repetition_offset(&self, repetition: u64) -> SignedDuration {
        let period = self.last.duration_since(self.first) + self.interval;
        let times = i32::try_from(repetition).unwrap_or(i32::MAX);
        period.checked_mul(times).unwrap_or(SignedDuration::ZERO)
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use crate::exchange::{Format, RowRules, read_live_items};

    const BEGIN_S: f64 = 1_700_000_000.0;

    pub(in crate::replay) fn rows(csv: &str) -> Vec<LiveItem> {
        let now = "2027-01-01T00:00:00Z".parse().expect("a time");
        let rules = RowRules { time_bounds: crate::domain::TimeBounds::at(now), image_size: None };
        let rows = read_live_items(csv.as_bytes(), Format::Csv, &rules).expect("a header");
        rows.map(|row| row.expect("a file").expect("a row")).collect()
    }

    fn time(seconds: f64) -> Timestamp {
        let nanos = ((BEGIN_S + seconds) * 1e3).round() as i64;
        Timestamp::from_millisecond(nanos).expect("in range")
    }

    /// One box per time given in seconds.
    pub(in crate::replay) fn recording(seconds: &[f64]) -> RecordedStream {
        let mut csv = "time,target_id,left,top,width,height\n".to_owned();
        for second in seconds {
            csv.push_str(&format!("{},a,1,2,3,4\n", time(*second)));
        }
        RecordedStream::from_rows(rows(&csv)).expect("rows")
    }

    #[test]
    fn repetitions_follow_each_other_in_time() {
        let recording = recording(&[0.0, 1.0, 3.0]);
        let at = |row, pass| recording.item(row, pass, SignedDuration::ZERO).time;
        assert_eq!([at(0, 0), at(2, 0), at(0, 1), at(2, 2)], [0.0, 3.0, 4.5, 12.0].map(time));
        let shift = recording.shift_to_end_at(time(1_000.0), 3);
        assert_eq!(recording.item(2, 2, shift).time, time(1_000.0));
    }

    #[test]
    fn a_single_instant_is_repeated_every_second() {
        let recording = recording(&[5.0]);
        assert_eq!(recording.item(0, 2, SignedDuration::ZERO).time, time(7.0));
    }

    #[test]
    fn boxes_and_fixes_are_merged_by_time() {
        let boxes = format!(
            "time,target_id,left,top,width,height\n{},a,1,2,3,4\n{},a,1,2,3,4\n",
            time(2.0),
            time(0.0)
        );
        let fixes = format!("time,longitude,latitude\n{},3,4\n{},3,4\n", time(1.0), time(2.0));
        let merged =
            RecordedStream::from_detections_and_fixes(rows(&boxes), rows(&fixes), None).expect("rows");
        let order: Vec<_> = merged.items.iter().map(|item| (item.time, item.fix.is_some())).collect();
        let expected = [(0.0, false), (1.0, true), (2.0, false), (2.0, true)];
        assert_eq!(order, expected.map(|(second, is_fix)| (time(second), is_fix)));
        assert!(merged.items.iter().all(|item| item.target_id.as_ref().is_some_and(|id| id.as_str() == "a")));

        let receiver = FixOwner::Receiver(ReceiverId::new("phone").expect("a name"));
        let merged = RecordedStream::from_detections_and_fixes(rows(&boxes), rows(&fixes), Some(receiver))
            .expect("rows");
        let receivers =
            merged.items.iter().filter(|item| item.receiver_id.is_some() && item.target_id.is_none());
        assert_eq!(receivers.count(), 2);
    }

    #[test]
    fn items_keep_the_ids_of_trackers_and_receivers() {
        let boxes = format!(
            "time,target_id,tracker_id,left,top,width,height\n{0},,7,1,2,3,4\n{0},a,8,1,2,3,4\n",
            time(0.0)
        );
        let fixes = format!("time,receiver_id,longitude,latitude\n{},phone,3,4\n", time(1.0));
        let merged =
            RecordedStream::from_detections_and_fixes(rows(&boxes), rows(&fixes), None).expect("rows");
        let ids: Vec<_> = merged
            .items
            .iter()
            .map(|item| {
                let target = item.target_id.as_ref().map(TargetId::as_str);
                let tracker = item.tracker_id.as_ref().map(crate::domain::TrackerId::as_str);
                (target, tracker, item.receiver_id.as_ref().map(ReceiverId::as_str))
            })
            .collect();
        assert_eq!(ids, [(None, Some("7"), None), (Some("a"), None, None), (None, None, Some("phone"))]);
    }

    #[test]
    fn fix_owner_nobody_are_refused() {
        let two = format!("time,target_id,left,top,width,height\n{0},a,1,2,3,4\n{0},b,1,2,3,4\n", time(0.0));
        let fixes = format!("time,longitude,latitude\n{},3,4\n", time(1.0));
        RecordedStream::from_detections_and_fixes(rows(&two), rows(&fixes), None).expect_err("no owner");
        RecordedStream::from_rows(Vec::new()).expect_err("no rows");
    }
}
