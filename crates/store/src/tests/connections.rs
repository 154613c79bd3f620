use super::*;
use crate::domain::{Connection, ConnectionId, NewConnection, OutboxLog, OutboxMessage, SourceOffset};
use uuid::Uuid;

fn offset(topic: &str, partition: i32, next_offset: i64) -> SourceOffset {
    SourceOffset { topic: topic.to_owned(), partition, next_offset }
}

pub(super) async fn insert(store: &Store, name: &str) -> Connection {
    let profile = NewConnection {
        id: ConnectionId::new(name).expect("a slug"),
        display_name: name.to_owned(),
        paused: false,
        settings: "{}".to_owned(),
        secrets: "{}".to_owned(),
    };
    store.insert_connection(&profile, at(0)).await.expect("new")
}

#[tokio::test]
async fn offsets_of_a_source_are_replaced_and_end_with_its_connection() {
    let Fixture { store, folder, .. } = Fixture::new().await;
    let (first, second) = (insert(&store, "first").await, insert(&store, "second").await);
    let initial = [offset("boxes", 0, 7), offset("boxes", 1, 0), offset("other", 0, i64::MAX)];
    store.store_source_offsets(first.key, &initial, Durability::Synced).await.expect("stored");
    store.store_source_offsets(second.key, &initial[..1], Durability::Synced).await.expect("stored");
    let next = [offset("boxes", 1, 3), offset("boxes", 2, 1)];
    store.store_source_offsets(first.key, &next, Durability::Relaxed).await.expect("stored");
    let expected = vec![initial[0].clone(), next[0].clone(), next[1].clone(), initial[2].clone()];
    assert_eq!(store.source_offsets(first.key).await.expect("read"), expected);
    store.close().await;

    let store = folder.open().await;
    assert_eq!(store.source_offsets(first.key).await.expect("read"), expected, "after a restart");
    store.delete_connection(first.id(), None, at(1)).await.expect("known");
    store.store_source_offsets(first.key, &next, Durability::Relaxed).await.expect("stores none");
    assert_eq!(store.source_offsets(first.key).await.expect("read"), []);
    assert_eq!(store.source_offsets(second.key).await.expect("read"), initial[..1]);
}

fn log(number: u128) -> OutboxLog {
    OutboxLog { id: Uuid::from_u128(number), node: None }
}

/// Messages with their numbers in a log as their ids.
fn messages(numbers: std::ops::RangeInclusive<i64>) -> Vec<OutboxMessage> {
    let message = |number: i64| OutboxMessage {
        number,
        message_id: number.to_string(),
        subject: "yard".to_owned(),
        payload: Vec::new(),
        created_at: at(number),
    };
    numbers.map(message).collect()
}

#[tokio::test]
async fn what_an_outbox_has_of_a_log_is_not_appended_again() {
    let Fixture { store, folder: _folder, .. } = Fixture::new().await;
    let (first, second) = (insert(&store, "first").await.key, insert(&store, "second").await.key);
    let append = async |key, log: &OutboxLog, numbers| {
        assert_eq!(store.append_to_outbox(key, log, &messages(numbers)).await.expect("stored"), 0);
    };
    append(first, &log(1), 1..=3).await;
    // The answer was not heard, and more has come since.
    append(first, &log(1), 1..=5).await;
    append(second, &log(1), 1..=2).await;
    append(first, &log(2), 1..=1).await;
    let ids = async |key| {
        let stored = store.outbox(key, 100).await.expect("read");
        stored.into_iter().map(|message| message.message_id).collect::<Vec<_>>()
    };
    assert_eq!(ids(first).await, ["1", "2", "3", "4", "5", "1"]);
    assert_eq!(ids(second).await, ["1", "2"]);
    let delivered: Vec<_> = store
        .outbox(first, 100)
        .await
        .expect("read")
        .iter()
        .map(|message| (message.number, Ok(())))
        .collect();
    store.settle_outbox(first, &delivered).await.expect("stored");
    append(first, &log(1), 4..=6).await;
    assert_eq!(ids(first).await, ["6"], "also when they were delivered in between");
    store.delete_connection(&ConnectionId::new("first").expect("a slug"), None, at(9)).await.expect("known");
    append(first, &log(1), 7..=7).await;
    assert_eq!(ids(first).await, [""; 0]);
}
