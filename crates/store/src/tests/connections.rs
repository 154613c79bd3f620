use super::*;
use crate::domain::{Connection, ConnectionId, NewConnection, SourceOffset};

fn offset(topic: &str, partition: i32, next_offset: i64) -> SourceOffset {
    SourceOffset { topic: topic.to_owned(), partition, next_offset }
}

async fn insert(store: &Store, name: &str) -> Connection {
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
