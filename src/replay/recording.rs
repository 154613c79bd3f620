//! What was recorded: items in the order in which they came.

use jiff::{SignedDuration, Timestamp};

use crate::domain::{Error, LiveItem, ReceiverId, Result, TargetId};
use crate::exchange::ObservedRow;

/// Whose the fixes of a file without targets are.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum FixesOf {
    /// This target's.
    Target(TargetId),
    /// This receiver's; the server knows whose it is.
    Receiver(ReceiverId),
}

/// Items to be replayed, at least one.
#[derive(Debug, Clone, PartialEq)]
pub struct Recording {
    items: Vec<LiveItem>,
    first: Timestamp,
    last: Timestamp,
    interval: SignedDuration,
}

impl Recording {
    /// Rows in the order of their file.
    ///
    /// # Errors
    /// No rows at all.
    pub fn of_rows(rows: impl IntoIterator<Item = ObservedRow>) -> Result<Self> {
        Self::of_items(rows.into_iter().map(item).collect())
    }

    /// Boxes and fixes that were recorded apart, in the order of their times. Fixes that name no
    /// target are `fixes_of` somebody, or of the only target that was seen.
    ///
    /// # Errors
    /// No rows at all, or fixes that may be of several targets; the field is `target_id`.
    pub fn of_both(
        detections: impl IntoIterator<Item = ObservedRow>,
        fixes: impl IntoIterator<Item = ObservedRow>,
        fixes_of: Option<FixesOf>,
    ) -> Result<Self> {
        let mut items: Vec<_> = detections.into_iter().map(item).collect();
        let mut targets: Vec<_> = items.iter().filter_map(|item| item.target_id.clone()).collect();
        targets.sort_unstable();
        targets.dedup();
        let fixes_of = fixes_of.or_else(|| match targets.as_slice() {
            [only] => Some(FixesOf::Target(only.clone())),
            _ => None,
        });
        for fix in fixes {
            let mut item = item(fix);
            match (&item.target_id, &fixes_of) {
                (Some(_), _) => {}
                (None, Some(FixesOf::Target(id))) => item.target_id = Some(id.clone()),
                (None, Some(FixesOf::Receiver(id))) => item.receiver_id = Some(id.clone()),
                (None, None) => {
                    let message = "the fixes name no target and there is more than one: say whose they are";
                    return Err(Error::invalid("target_id", message));
                }
            }
            items.push(item);
        }
        // Stable: a box and a fix of one instant stay in this order.
        items.sort_by_key(|item| item.time);
        Self::of_items(items)
    }

    fn of_items(items: Vec<LiveItem>) -> Result<Self> {
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
        // Stored times are exact to the microsecond, and passes must not meet.
        let interval = interval.max(SignedDuration::from_micros(1));
        Ok(Self { items, first, last, interval })
    }

    /// Number of items.
    #[must_use]
    pub const fn len(&self) -> usize {
        self.items.len()
    }

    /// Never: a recording has an item.
    #[must_use]
    pub const fn is_empty(&self) -> bool {
        self.items.is_empty()
    }

    /// The mean interval between instants; a second if there is only one.
    #[must_use]
    pub const fn interval(&self) -> SignedDuration {
        self.interval
    }

    /// What to add to every time so that the last item of the last of so many passes is at `end`.
    #[must_use]
    pub fn shift_to_end_at(&self, end: Timestamp, passes: u64) -> SignedDuration {
        end.duration_since(self.last) - self.later(passes.saturating_sub(1))
    }

    /// From the first instant of the first pass to this item's.
    pub(super) fn since_begin(&self, row: usize, pass: u64) -> SignedDuration {
        self.items[row].time.duration_since(self.first) + self.later(pass)
    }

    /// The item as it is in that pass, its time shifted.
    pub(super) fn item(&self, row: usize, pass: u64, shift: SignedDuration) -> LiveItem {
        let mut item = self.items[row].clone();
        item.time = item.time.saturating_add(shift + self.later(pass)).unwrap_or(item.time);
        item
    }

    /// How much later a pass is than the first.
    fn later(&self, pass: u64) -> SignedDuration {
        let period = self.last.duration_since(self.first) + self.interval;
        let times = i32::try_from(pass).unwrap_or(i32::MAX);
        period.checked_mul(times).unwrap_or(SignedDuration::ZERO)
    }
}

fn item(row: ObservedRow) -> LiveItem {
    let ObservedRow { observation, class, score, truth: _ } = row;
    LiveItem {
        time: observation.time,
        target_id: observation.target_id,
        receiver_id: None,
        bounding_box: observation.bounding_box,
        fix: observation.fix,
        class,
        score,
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use crate::exchange::{Format, RowRules, read_observations};

    const BEGIN_S: f64 = 1_700_000_000.0;

    pub(in crate::replay) fn rows(csv: &str) -> Vec<ObservedRow> {
        let now = "2027-01-01T00:00:00Z".parse().expect("a time");
        let rules = RowRules { time_bounds: crate::domain::TimeBounds::at(now), image_size: None };
        let rows = read_observations(csv.as_bytes(), Format::Csv, &rules).expect("a header");
        rows.map(|row| row.expect("a file").expect("a row")).collect()
    }

    fn time(seconds: f64) -> Timestamp {
        let nanos = ((BEGIN_S + seconds) * 1e3).round() as i64;
        Timestamp::from_millisecond(nanos).expect("in range")
    }

    /// One box per time given in seconds.
    pub(in crate::replay) fn recording(seconds: &[f64]) -> Recording {
        let mut csv = "time,target_id,left,top,width,height\n".to_owned();
        for second in seconds {
            csv.push_str(&format!("{},a,1,2,3,4\n", time(*second)));
        }
        Recording::of_rows(rows(&csv)).expect("rows")
    }

    #[test]
    fn passes_follow_each_other_in_time() {
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
        let merged = Recording::of_both(rows(&boxes), rows(&fixes), None).expect("rows");
        let told: Vec<_> = merged.items.iter().map(|item| (item.time, item.fix.is_some())).collect();
        let expected = [(0.0, false), (1.0, true), (2.0, false), (2.0, true)];
        assert_eq!(told, expected.map(|(second, is_fix)| (time(second), is_fix)));
        assert!(merged.items.iter().all(|item| item.target_id.as_ref().is_some_and(|id| id.as_str() == "a")));

        let receiver = FixesOf::Receiver(ReceiverId::new("phone").expect("a name"));
        let merged = Recording::of_both(rows(&boxes), rows(&fixes), Some(receiver)).expect("rows");
        let receivers =
            merged.items.iter().filter(|item| item.receiver_id.is_some() && item.target_id.is_none());
        assert_eq!(receivers.count(), 2);
    }

    #[test]
    fn fixes_of_nobody_are_refused() {
        let two = format!("time,target_id,left,top,width,height\n{0},a,1,2,3,4\n{0},b,1,2,3,4\n", time(0.0));
        let fixes = format!("time,longitude,latitude\n{},3,4\n", time(1.0));
        Recording::of_both(rows(&two), rows(&fixes), None).expect_err("whose?");
        Recording::of_rows(Vec::new()).expect_err("no rows");
    }
}
