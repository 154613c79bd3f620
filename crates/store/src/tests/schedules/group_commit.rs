//! Group commit over a backend that fails now and then.

use std::collections::BTreeSet;
use std::pin::pin;
use std::sync::{Arc, Mutex};

use futures_util::FutureExt as _;
use futures_util::future::{BoxFuture, Either, select};

use crate::domain::{Actor, Durability, Error, ErrorKind, Result, Sample};
use crate::group_commit::{
    Committing, Failure, GroupCommit, Inserted, SampleBatch, SampleWriter, WriteSession,
};
use crate::tests::{at, id, sample};
use sightfix_schedules::{below, explore, explore_planted, pause};

const CALLERS: usize = 4;
const CALLS: usize = 3;
/// Calls draw their rows from so many.
const ROWS: usize = 6;
const POISON: &str = "poison";

/// An error of a backend.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Planted {
    None,
    /// It answers before it has stored.
    AnswersFirst,
    /// It keeps what it has stored of a transaction that fails.
    IsNotAtomic,
}

/// Stored rows by target and second.
#[derive(Default)]
struct Table(Mutex<BTreeSet<(String, i64)>>);

struct Model {
    table: Arc<Table>,
    planted: Planted,
}

struct ModelSession<'m>(&'m Model);

impl SampleWriter for Model {
    fn session(&self) -> BoxFuture<'_, Result<Box<dyn WriteSession + '_>>> {
        async move {
            pause().await;
            if below(32) == 0 {
                return Err(Error::refused(ErrorKind::Overloaded, "the writer cannot be had"));
            }
            Ok(Box::new(ModelSession(self)) as Box<dyn WriteSession + '_>)
        }
        .boxed()
    }
}

impl WriteSession for ModelSession<'_> {
    fn commit<'a>(&'a mut self, _: Durability, group: &'a [SampleBatch]) -> Committing<'a> {
        async move {
            pause().await;
            let is_poisoned = group.iter().any(|batch| rows(batch).any(|(target, _)| target == POISON));
            let fails = below(16) == 0;
            if (is_poisoned || fails) && self.0.planted != Planted::IsNotAtomic {
                return Err(failure(is_poisoned));
            }
            if self.0.planted == Planted::AnswersFirst {
                let table = Arc::clone(&self.0.table);
                let stored: Vec<_> = group.iter().flat_map(rows).collect();
                drop(sightfix_schedules::spawn(async move {
                    pause().await;
                    for row in stored {
                        table.add(row);
                    }
                }));
                return Ok(group.iter().map(|batch| Ok(all_new(batch))).collect());
            }
            let outcomes = group.iter().map(|batch| Ok(self.0.table.insert(batch))).collect();
            if is_poisoned || fails {
                return Err(failure(is_poisoned));
            }
            pause().await;
            Ok(outcomes)
        }
        .boxed()
    }
}

fn failure(is_poisoned: bool) -> Failure {
    if is_poisoned {
        Failure::Statement(Error::fault("a row cannot be stored"))
    } else {
        Failure::Transaction(Error::fault("the transaction cannot be committed"))
    }
}

fn rows(batch: &SampleBatch) -> impl Iterator<Item = (String, i64)> + '_ {
    batch.samples.iter().map(|sample| row(sample.target_id.as_str(), sample.time.as_second()))
}

fn row(target: &str, second: i64) -> (String, i64) {
    (target.to_owned(), second)
}

fn all_new(batch: &SampleBatch) -> Inserted {
    Inserted { accepted: batch.samples.len() as u64, ..Inserted::default() }
}

impl Table {
    fn add(&self, row: (String, i64)) -> bool {
        self.0.lock().expect("no panic").insert(row)
    }

    fn insert(&self, batch: &SampleBatch) -> Inserted {
        let accepted = rows(batch).map(|row| u64::from(self.add(row))).sum();
        Inserted { accepted, duplicate: batch.samples.len() as u64 - accepted, ..Inserted::default() }
    }

    fn has(&self, row: &(String, i64)) -> bool {
        self.0.lock().expect("no panic").contains(row)
    }

    fn len(&self) -> u64 {
        self.0.lock().expect("no panic").len() as u64
    }
}

/// Rows that a caller was told are new, and whether it has left a call without hearing its outcome.
#[derive(Default)]
struct Heard {
    accepted: u64,
    has_left: bool,
}

async fn caller(queue: Arc<GroupCommit>, table: Arc<Table>, number: usize) -> Heard {
    let mut heard = Heard::default();
    for call in 0..CALLS {
        // A row of the call's own tells whether any of it was stored.
        let own = (ROWS + number * CALLS + call) as i64;
        let mut samples: Vec<Sample> = vec![sample(own, "a"), sample(below(ROWS) as i64, "a")];
        let is_poisoned = below(8) == 0;
        if is_poisoned {
            samples.push(sample(own, POISON));
        }
        let expected: Vec<_> =
            samples.iter().map(|one| row(one.target_id.as_str(), one.time.as_second())).collect();
        let count = samples.len() as u64;
        let samples = samples.into_iter().map(Into::into).collect();
        let actor = Arc::new(Actor::program("test"));
        let insert = queue.insert((id("square"), None), samples, Durability::Synced.into(), actor);
        let patience = async {
            match below(6) {
                0 => pause().await,
                _ => std::future::pending().await,
            }
        };
        match select(pin!(insert), pin!(patience)).await {
            Either::Left((Ok(inserted), _)) => {
                assert!(!is_poisoned, "a row that cannot be stored is acknowledged");
                assert_eq!(inserted.accepted + inserted.duplicate, count, "each row has one outcome");
                assert!(expected.iter().all(|row| table.has(row)), "acknowledged and not stored");
                heard.accepted += inserted.accepted;
            }
            Either::Left((Err(_), _)) => {
                assert!(!table.has(&expected[0]), "refused and stored");
            }
            Either::Right(_) => heard.has_left = true,
        }
        pause().await;
    }
    heard
}

fn scenario(planted: Planted) {
    sightfix_schedules::block_on(async move {
        let table = Arc::new(Table::default());
        let (queue, task) = GroupCommit::new(Arc::new(Model { table: Arc::clone(&table), planted }));
        let task = sightfix_schedules::spawn(task);
        let queue = Arc::new(queue);
        let callers: Vec<_> = (0..CALLERS)
            .map(|number| sightfix_schedules::spawn(caller(Arc::clone(&queue), Arc::clone(&table), number)))
            .collect();
        // Some schedules close the queue under its callers.
        if below(3) == 0 {
            for _ in 0..below(40) {
                sightfix_schedules::yield_now().await;
            }
            queue.close().await;
            let stored = table.len();
            pause().await;
            assert_eq!(table.len(), stored, "stored after the end");
        }
        let (mut accepted, mut has_left) = (0, false);
        for caller in callers {
            let heard = caller.await.expect("no panic");
            accepted += heard.accepted;
            has_left |= heard.has_left;
        }
        queue.close().await;
        task.await.expect("no panic");
        let late = queue.insert(
            (id("square"), None),
            vec![sample(0, "late").into()],
            Durability::Synced.into(),
            Arc::new(Actor::program("test")),
        );
        assert_eq!(late.await.expect_err("closed").kind(), ErrorKind::ShuttingDown);
        assert!(!table.has(&row("late", at(0).as_second())));
        let stored = table.len();
        assert!(
            if has_left { accepted <= stored } else { accepted == stored },
            "{accepted} rows were acknowledged as new, {stored} are stored"
        );
    });
}

#[test]
fn groups_store_what_they_acknowledge_and_nothing_else() {
    explore(|| scenario(Planted::None));
}

#[test]
fn an_answer_before_the_commit_is_found() {
    explore_planted("acknowledged and not stored", || scenario(Planted::AnswersFirst));
}

#[test]
fn a_transaction_that_is_kept_in_part_is_found() {
    explore_planted("refused and stored", || scenario(Planted::IsNotAtomic));
}
