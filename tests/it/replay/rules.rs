//! The client follows the stream's protocol whatever server and connection do.

use std::collections::BTreeSet;
use std::num::NonZeroU64;
use std::sync::Arc;
use std::time::Duration;

use jiff::SignedDuration;
use sightfix::domain::{CameraId, TimeBounds};
use sightfix::exchange::{Format, RowRules, read_live_items};
use sightfix::replay::{Counters, FaultShares, Pace, RecordedStream, ReplayOptions, ReplayReport, replay};
use tokio_util::sync::CancellationToken;
use tonic::Status;

use super::fake::{Fake, Script};

const BEGIN_S: i64 = 1_700_000_000;

/// That many boxes at intervals of a second.
fn recording(rows: i64) -> RecordedStream {
    let mut csv = "time,target_id,left,top,width,height\n".to_owned();
    for second in 0..rows {
        let time = jiff::Timestamp::from_second(BEGIN_S + second).expect("in range");
        csv.push_str(&format!("{time},person-1,10,20,30,40\n"));
    }
    let bounds = TimeBounds::at("2027-01-01T00:00:00Z".parse().expect("a time"));
    let rules = RowRules { time_bounds: bounds, image_size: None };
    let rows = read_live_items(csv.as_bytes(), Format::Csv, &rules).expect("a header");
    RecordedStream::from_rows(rows.map(|row| row.expect("a file").expect("a row"))).expect("rows")
}

fn options(fake: &Fake) -> ReplayOptions {
    ReplayOptions {
        key: None,
        server: format!("http://{}", fake.address),
        camera_ids: vec![CameraId::new("yard").expect("a slug")],
        cameras: 1,
        client_name: "test".to_owned(),
        pace: Pace::Unpaced,
        head_start: Duration::ZERO,
        repetitions: NonZeroU64::MIN,
        duration: None,
        shift: SignedDuration::ZERO,
        in_flight: 8,
        resend_buffer: 40,
        store_samples: true,
        faults: FaultShares::NONE,
        seed: 1,
        attempts: 5,
        response_timeout: Duration::from_secs(20),
    }
}

/// Replays 200 rows and checks the sums of the report.
async fn run(fake: &Fake, options: ReplayOptions) -> ReplayReport {
    let must_acknowledge = options.store_samples;
    let replaying = replay(
        Arc::new(recording(200)),
        Arc::new(options),
        Arc::new(Counters::default()),
        CancellationToken::new(),
    );
    let report = replaying.await.expect("an address");
    let refused: u64 = report.refused.values().sum();
    assert_eq!(
        report.answered + refused + report.lost_answers + report.unanswered,
        report.items,
        "{report:?}"
    );
    if must_acknowledge {
        let sum = report.acknowledged.expect("asked for") + report.unacknowledged.expect("asked for");
        assert_eq!(sum, report.items, "{report:?}");
    }
    assert_eq!(fake.received().violations, BTreeSet::new());
    assert!(!report.to_string().is_empty());
    report
}

/// The seqs of all committed items.
fn committed_seqs(fake: &Fake) -> BTreeSet<u64> {
    fake.received().committed.iter().map(|(seq, ..)| *seq).collect()
}

fn acknowledging(every: u64) -> Script {
    Script { acknowledge_every: every, ..Script::default() }
}

#[tokio::test]
async fn unacknowledged_items_are_sent_again_after_every_break() {
    let broken = [17, 1, 30].map(|items| Script { break_after: Some(items), ..acknowledging(5) });
    let fake = Fake::start(broken.into_iter().chain([acknowledging(5)])).await;
    let report = run(&fake, options(&fake)).await;
    assert!(report.is_complete(), "{report:?}");
    assert_eq!((report.items, report.answered, report.streams, report.reconnects), (200, 200, 4, 3));
    assert_eq!(report.broken.values().sum::<u64>(), 3);
    assert_eq!(committed_seqs(&fake), (1..=200).collect());
    let received = fake.received();
    assert_eq!(received.committed.len(), 200, "what was committed is not sent again");
    let resumed: Vec<_> = received.openings.iter().map(|opening| opening.resume_after_seq).collect();
    assert_eq!(resumed, [0, 15, 15, 40], "17 items, then 1 more, then 30 more, acknowledged by fives");
    assert!(report.resent >= 8, "{report:?}");
}

#[tokio::test]
async fn a_requested_reconnect_resends_nothing() {
    let fake =
        Fake::start([Script { request_reconnect_after: Some(50), ..acknowledging(7) }, acknowledging(7)])
            .await;
    let report = run(&fake, options(&fake)).await;
    assert!(report.is_complete(), "{report:?}");
    assert_eq!((report.invitations, report.reconnects, report.resent), (1, 1, 0));
    assert!(report.broken.is_empty(), "{report:?}");
    assert_eq!(fake.received().items, 200);
    assert_eq!(committed_seqs(&fake), (1..=200).collect());
}

#[tokio::test]
async fn without_acknowledgements_only_unanswered_items_are_sent_again() {
    let fake = Fake::start([Script { break_after: Some(60), ..Script::default() }]).await;
    let report = run(&fake, ReplayOptions { store_samples: false, ..options(&fake) }).await;
    assert!(report.is_complete(), "{report:?}");
    assert_eq!((report.answered, report.acknowledged, report.unacknowledged), (200, None, None));
    assert_eq!(fake.received().openings[1].resume_after_seq, 60);
    assert_eq!(fake.received().items, 200);
}

#[tokio::test]
async fn lost_answers_and_refused_items_are_counted_and_the_stream_goes_on() {
    let script = Script { lose_every: Some(10), refuse_every: Some(8), ..acknowledging(5) };
    let fake = Fake::start([script]).await;
    let report = run(&fake, options(&fake)).await;
    // Every 40th item is both refused and without an answer.
    assert_eq!((report.lost_answers, report.refused["invalid-argument"]), (19, 20), "{report:?}");
    // The answer to the last item is lost, and no later answer reports the loss.
    assert_eq!((report.unanswered, report.unacknowledged), (1, Some(0)), "{report:?}");
    assert!(!report.is_complete());
}

#[tokio::test]
async fn a_full_buffer_waits_for_acknowledgements() {
    let fake = Fake::start([acknowledging(40)]).await;
    let report = run(&fake, ReplayOptions { resend_buffer: 40, ..options(&fake) }).await;
    assert!(report.is_complete(), "{report:?}");
    assert_eq!(committed_seqs(&fake), (1..=200).collect());
}

#[tokio::test]
async fn a_server_that_does_not_respond_is_reconnected_to() {
    let silent = Script { silent: true, ..Script::default() };
    let fake = Fake::start([silent.clone(), acknowledging(5)]).await;
    let response_timeout = Duration::from_millis(300);
    let report = run(&fake, ReplayOptions { response_timeout, ..options(&fake) }).await;
    assert!(report.is_complete(), "{report:?}");
    assert_eq!(report.broken.get("silence"), Some(&1), "{report:?}");

    let fake = Fake::start(vec![silent; 10]).await;
    let report = run(&fake, ReplayOptions { response_timeout, attempts: 1, ..options(&fake) }).await;
    assert!(!report.is_complete());
    assert_eq!((report.given_up, report.broken["silence"], report.unanswered), (1, 2, 8), "{report:?}");
}

#[tokio::test]
async fn a_permanent_refusal_is_not_retried() {
    let refuse = Some(Status::not_found("there is no such camera"));
    let fake = Fake::start([Script { refuse, ..Script::default() }]).await;
    let report = run(&fake, options(&fake)).await;
    assert!(!report.is_complete());
    assert_eq!((report.given_up, report.streams, report.items), (1, 0, 0), "{report:?}");
    assert!(report.reasons[0].contains("no such camera"), "{report:?}");
}

#[tokio::test]
async fn simulated_cameras_that_share_one_are_distinct_clients_with_distinct_targets() {
    let fake = Fake::start(vec![acknowledging(5); 5]).await;
    let ids = ["yard", "gate"].map(|id| CameraId::new(id).expect("a slug")).to_vec();
    let repetitions = NonZeroU64::new(2).expect("not 0");
    let report =
        run(&fake, ReplayOptions { cameras: 5, camera_ids: ids, repetitions, ..options(&fake) }).await;
    assert!(report.is_complete(), "{report:?}");
    assert_eq!((report.items, report.streams), (2_000, 5));
    let received = fake.received();
    let clients: BTreeSet<_> = received.openings.iter().map(|opening| opening.client_name.clone()).collect();
    assert_eq!(clients.len(), 5);
    assert_eq!(received.openings.iter().filter(|opening| opening.camera_id == "yard").count(), 3);
    // Target and time are unique within each of the two cameras: 3 targets in one, 2 in the other.
    let targets: BTreeSet<_> = received.committed.iter().map(|(_, target, _)| target.as_str()).collect();
    assert_eq!(targets, BTreeSet::from(["person-1", "person-1@1", "person-1@2"]));
    let times: BTreeSet<_> = received.committed.iter().map(|(_, target, time)| (target, time)).collect();
    assert_eq!(times.len(), 3 * 400, "times are unique per target");
}

#[tokio::test]
async fn injected_faults_change_only_what_is_sent() {
    let fake = Fake::start([acknowledging(5)]).await;
    let faults = FaultShares { lose: 0.1, duplicate: 0.1, reorder: 0.2, max_delay: 3 };
    let report = run(&fake, ReplayOptions { faults, ..options(&fake) }).await;
    assert!(report.is_complete(), "{report:?}");
    let injected = report.injected;
    assert!(injected.lost > 0 && injected.duplicated > 0 && injected.reordered > 0, "{report:?}");
    assert_eq!(report.items, 200 - injected.lost + injected.duplicated);
    let received = fake.received();
    let times: BTreeSet<_> = received.committed.iter().map(|(_, _, time)| *time).collect();
    assert_eq!(times.len() as u64, 200 - injected.lost);
    let in_order = received.committed.is_sorted_by_key(|(_, _, time)| *time);
    assert!(!in_order, "some came late");
}

#[tokio::test]
async fn after_a_stop_the_streams_are_closed_in_order() {
    let fake = Fake::start([acknowledging(5)]).await;
    let stop = CancellationToken::new();
    let counters = Arc::new(Counters::default());
    let slow = ReplayOptions { pace: Pace::ConstantRate { items_per_s: 100.0 }, ..options(&fake) };
    let replaying =
        tokio::spawn(replay(Arc::new(recording(2_000)), Arc::new(slow), counters.clone(), stop.clone()));
    while counters.answered.load(std::sync::atomic::Ordering::Relaxed) < 3 {
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
    stop.cancel();
    let report = replaying.await.expect("no panic").expect("an address");
    assert!(report.is_complete(), "{report:?}");
    assert!((3..2_000).contains(&report.items), "{report:?}");
    assert_eq!(report.acknowledged, Some(report.items));
}
