use super::*;
use crate::domain::{
    ConnectionId, NewConnection, NewPlace, NewPlaceEvent, NewSite, OutboxMessage, Place, PlaceCount,
    PlaceEventFilter, PlaceId, SiteId, StoredPlaceEvents, TrackScope,
};
use crate::limits::StoreLimits;

fn place(name: &str, scope: TrackScope) -> NewPlace {
    NewPlace { id: PlaceId::new(name).expect("a slug"), scope, settings: "{}".to_owned() }
}

fn event(place: &Place, id: &str, kind: &'static str) -> NewPlaceEvent {
    NewPlaceEvent {
        place: place.key,
        id: id.to_owned(),
        kind,
        content: format!("\"{id}\""),
        messages: Vec::new(),
    }
}

fn count(place: &Place, from_s: i64, figure: &str, value: f64) -> PlaceCount {
    PlaceCount { place: place.key, from_s, class: "car".to_owned(), figure: figure.to_owned(), value }
}

fn hook() -> NewConnection {
    NewConnection {
        id: ConnectionId::new("hook").expect("a slug"),
        display_name: String::new(),
        paused: false,
        settings: "{}".to_owned(),
        secrets: "{}".to_owned(),
    }
}

fn message(id: &str) -> OutboxMessage {
    OutboxMessage {
        number: 0,
        message_id: id.to_owned(),
        subject: "gate".to_owned(),
        payload: b"{}".to_vec(),
        created_at: at(1),
    }
}

async fn stored(store: &Store, events: &[NewPlaceEvent], second: i64) -> StoredPlaceEvents {
    store.insert_place_events(events, &[], at(second)).await.expect("stored")
}

async fn contents(store: &Store, filter: &PlaceEventFilter, after: i64) -> Vec<String> {
    let events = store.place_events(filter, after, 100).await.expect("read");
    events.into_iter().map(|event| event.content).collect()
}

#[tokio::test]
async fn places_are_listed_by_scope_and_go_with_it() {
    let Fixture { store, camera, folder: _folder } = Fixture::new().await;
    let site = SiteId::new("harbour").expect("a slug");
    store.insert_site(&NewSite::named(site.clone()), at(0)).await.expect("new");
    let of_camera = place("gate", TrackScope::Camera(camera.clone()));
    let of_site = place("quay", TrackScope::Site(site.clone()));
    let mark = store.places_mark().await.expect("read");
    let gate = store.insert_place(&of_camera, at(1)).await.expect("new");
    store.insert_place(&of_site, at(2)).await.expect("new");
    assert_ne!(store.places_mark().await.expect("read"), mark);
    let error = store.insert_place(&of_camera, at(3)).await.expect_err("exists");
    assert_eq!(error.kind(), ErrorKind::PlaceExists);
    let nowhere = place("nowhere", TrackScope::Camera(id("none")));
    let error = store.insert_place(&nowhere, at(3)).await.expect_err("no such camera");
    assert_eq!(error.kind(), ErrorKind::InvalidArgument);

    let listed = async |scope: Option<&TrackScope>| {
        let places = store.places(scope, None, 10).await.expect("read");
        places.iter().map(|place| place.id().to_string()).collect::<Vec<_>>()
    };
    assert_eq!(listed(None).await, ["gate", "quay"]);
    assert_eq!(listed(Some(&of_site.scope)).await, ["quay"]);
    let changed = NewPlace { settings: "[]".to_owned(), ..of_camera.clone() };
    let mark = store.places_mark().await.expect("read");
    let replaced = store.replace_place(&changed, Some(gate.version()), at(4)).await.expect("current");
    assert_eq!((replaced.revision.0, &*replaced.profile.settings), (2, "[]"));
    assert_ne!(store.places_mark().await.expect("read"), mark);
    let error = store.replace_place(&changed, Some(gate.version()), at(5)).await.expect_err("changed");
    assert_eq!(error.kind(), ErrorKind::RevisionMismatch);

    store.insert_place_events(&[event(&replaced, "a", "enter")], &[], at(6)).await.expect("stored");
    store.delete_camera(&camera, None, at(7)).await.expect("known");
    store.delete_site(&site, None, at(7)).await.expect("known");
    assert_eq!(listed(None).await, [""; 0]);
    assert_eq!(contents(&store, &PlaceEventFilter::default(), 0).await, [""; 0]);
}

#[tokio::test]
async fn an_event_is_stored_once_and_with_it_what_sinks_are_to_have() {
    let Fixture { store, camera, folder: _folder } = Fixture::new().await;
    let scope = TrackScope::Camera(camera);
    let gate = store.insert_place(&place("gate", scope.clone()), at(0)).await.expect("new");
    let yard = store.insert_place(&place("yard", scope.clone()), at(0)).await.expect("new");
    let hook = store.insert_connection(&hook(), at(0)).await.expect("new").key;
    let first = NewPlaceEvent { messages: vec![(hook, message("a"))], ..event(&gate, "a", "enter") };
    let events = [first.clone(), event(&yard, "b", "cross")];
    assert_eq!(stored(&store, &events, 1).await, StoredPlaceEvents { stored: 2, dropped: 0 });
    let again = [first, event(&yard, "c", "cross")];
    assert_eq!(stored(&store, &again, 2).await, StoredPlaceEvents { stored: 1, dropped: 0 });
    assert_eq!(store.outbox(hook, 10).await.expect("read").len(), 1);

    let all = PlaceEventFilter { scope: Some(scope), ..PlaceEventFilter::default() };
    assert_eq!(contents(&store, &all, 0).await, ["\"a\"", "\"b\"", "\"c\""]);
    assert_eq!(contents(&store, &all, 1).await, ["\"b\"", "\"c\""]);
    let of_yard = PlaceEventFilter { place: Some(yard.id().clone()), kind: Some("cross"), scope: None };
    assert_eq!(contents(&store, &of_yard, 0).await, ["\"b\"", "\"c\""]);
    store.delete_place(gate.id(), None, at(3)).await.expect("known");
    assert_eq!(stored(&store, &[event(&gate, "d", "enter")], 4).await, StoredPlaceEvents::default());
}

#[tokio::test]
async fn messages_of_events_beyond_the_limit_of_an_outbox_are_counted() {
    let home = Home::new().await;
    let limits = StoreLimits { outbox_messages: 2, ..StoreLimits::default() };
    let options = StoreOptions { limits, ..StoreOptions::default() };
    let store = Store::open_at(&home.location(), options).await.expect("opens");
    store.insert_camera(&NewCamera::named(id("square")), at(0)).await.expect("new");
    let gate =
        store.insert_place(&place("gate", TrackScope::Camera(id("square"))), at(0)).await.expect("new");
    let hook = store.insert_connection(&hook(), at(0)).await.expect("new").key;
    let events = ["a", "b", "c", "d", "e"]
        .map(|id| NewPlaceEvent { messages: vec![(hook, message(id))], ..event(&gate, id, "enter") });
    assert_eq!(stored(&store, &events, 1).await, StoredPlaceEvents { stored: 5, dropped: 3 });
    let waiting = store.outbox(hook, 10).await.expect("read");
    assert_eq!(waiting.iter().map(|it| it.message_id.as_str()).collect::<Vec<_>>(), ["d", "e"]);
}

#[tokio::test]
async fn counts_are_added_up_by_minutes_and_hours_and_kept_for_a_time() {
    let home = Home::new().await;
    let limits =
        StoreLimits { place_events: 2, place_minute_days: 1, place_hour_days: 30, ..StoreLimits::default() };
    let options = StoreOptions { limits, ..StoreOptions::default() };
    let store = Store::open_at(&home.location(), options).await.expect("opens");
    store.insert_camera(&NewCamera::named(id("square")), at(0)).await.expect("new");
    let gate =
        store.insert_place(&place("gate", TrackScope::Camera(id("square"))), at(0)).await.expect("new");
    let counts = [count(&gate, 3_600, "enters.count", 1.0), count(&gate, 3_660, "enters.count", 2.0)];
    store.insert_place_events(&[], &counts, at(1)).await.expect("stored");
    store.insert_place_events(&[], &counts[1..], at(1)).await.expect("stored");
    let values = async |step_s, class| {
        let counts = store.place_counts(gate.key, step_s, (0, i64::MAX), class).await.expect("read");
        counts.into_iter().map(|count| (count.from_s, count.value)).collect::<Vec<_>>()
    };
    assert_eq!(values(60, None).await, [(3_600, 1.0), (3_660, 4.0)]);
    assert_eq!(values(3_600, Some("car")).await, [(3_600, 5.0)]);
    assert_eq!(values(3_600, Some("")).await, []);
    let later = count(&gate, 3_660 + 86_400, "enters.count", 1.0);
    store.insert_place_events(&[], &[later], at(2)).await.expect("stored");
    assert_eq!(
        values(60, None).await,
        [(3_660, 4.0), (90_060, 1.0)],
        "those of more than a day before are gone"
    );
    assert_eq!(values(3_600, None).await.len(), 2);

    let events = ["a", "b", "c"].map(|id| event(&gate, id, "enter"));
    store.insert_place_events(&events, &[], at(3)).await.expect("stored");
    assert_eq!(contents(&store, &PlaceEventFilter::default(), 0).await, ["\"b\"", "\"c\""]);
}
