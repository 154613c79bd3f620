//! Tests of PostgreSQL alone: several processes, connections that end, migrations at once.

use std::collections::{HashMap, HashSet};
use std::sync::Arc;
use std::time::Duration;

use sqlx::Connection as _;
use tempfile::TempDir;
use uuid::Uuid;

use crate::domain::{
    CameraId, ConnectionId, Durability, ErrorKind, NewCamera, NewConnection, NewSite, NodeId, NodeProfile,
    RunId, RunProgress, SiteId,
};
use crate::tests::copy::copy_and_compare;
use crate::tests::{Fixture, Home, at, connect, id, new_database, options, sample};
use crate::{Acquired, DatabaseUrl, Heartbeat, Location, SampleFilter, Store, StoreOptions};

const LEASE: Duration = Duration::from_secs(30);

async fn database() -> Home {
    let server = std::env::var("SIGHTFIX_TEST_POSTGRES").expect("the URL of a server's database");
    Home::Database(new_database(&server).await)
}

fn url(home: &Home) -> String {
    match home {
        Home::Database(url) => url.revealed().to_owned(),
        Home::Folder(_) => panic!("a database"),
    }
}

#[test]
fn a_url_is_shown_without_its_secrets() {
    let url =
        DatabaseUrl::new("postgres://someone:pass-word@db.example/fixes?sslmode=disable").expect("a URL");
    assert_eq!(url.to_string(), "postgres://db.example:5432/fixes");
    assert_eq!(format!("{url:?}"), "postgres://db.example:5432/fixes");
    let refused = DatabaseUrl::new("mysql://someone:pass-word@db").expect_err("another database");
    assert_eq!(refused.kind(), ErrorKind::InvalidArgument);
    assert!(!refused.to_string().contains("pass-word"), "{refused}");
    let several = [
        "someone:pass-word@one:5432,two:5432/fixes",
        "someone:pass-word@one,two/fixes",
        "one/fixes?host=one,two",
    ];
    for several in several {
        let refused =
            DatabaseUrl::new(&format!("postgres://{several}")).expect_err("several hosts").to_string();
        assert!(refused.contains("several hosts") && !refused.contains("pass-word"), "{refused}");
    }
    DatabaseUrl::new("postgres://someone:pass,word@one/fixes").expect("a comma in the password");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
#[ignore = "needs PostgreSQL: .ci/postgres"]
async fn several_may_open_one_new_database_at_once_and_write_side_by_side() {
    let home = Arc::new(database().await);
    let opening: Vec<_> = (0..6)
        .map(|_| {
            let home = Arc::clone(&home);
            tokio::spawn(async move { home.open().await })
        })
        .collect();
    let mut stores = Vec::new();
    for store in opening {
        stores.push(store.await.expect("no panic"));
    }
    for camera in ["a", "b", "c"] {
        stores[0].insert_camera(&NewCamera::named(id(camera)), at(0)).await.expect("new");
    }
    // Every store sends each sample for all cameras, in orders of its own, so groups meet in their keys.
    let writing = stores.iter().cloned().enumerate().map(|(index, store)| {
        tokio::spawn(async move {
            let mut accepted = 0;
            for n in 0..60 {
                let camera = id(["a", "b", "c"][(n + index) % 3]);
                let rows = (0..20).map(|second| sample(second + 20 * (n as i64 / 3), "x")).collect();
                let inserted = store.insert_samples(&camera, rows, Durability::Synced).await.expect("stored");
                accepted += inserted.accepted;
            }
            accepted
        })
    });
    let mut accepted = 0;
    for task in writing.collect::<Vec<_>>() {
        accepted += task.await.expect("no panic");
    }
    assert_eq!(accepted, 3 * 400, "each key was new to one store");
    for camera in ["a", "b", "c"] {
        let counted = stores[5].count_samples(&id(camera), &SampleFilter::default()).await.expect("counted");
        assert_eq!((counted, stores[5].camera(&id(camera)).await.expect("known").samples.all), (400, 400));
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
#[ignore = "needs PostgreSQL: .ci/postgres"]
async fn workers_of_several_processes_claim_each_run_once() {
    let home = database().await;
    let stores = [home.open().await, home.open().await, home.open().await];
    for n in 0..60 {
        let camera = CameraId::new(&format!("camera-{n}")).expect("a slug");
        stores[0].insert_camera(&NewCamera::named(camera.clone()), at(0)).await.expect("new");
        let run = RunId(Uuid::from_u128(n));
        stores[0].insert_run(run, &camera, &options(), 100, None, at(1)).await.expect("queued");
    }
    let workers: Vec<_> = (0..12)
        .map(|worker| {
            let store = stores[worker % 3].clone();
            tokio::spawn(async move {
                let mut claimed = Vec::new();
                while let Some(claim) = store.claim_run::<CameraId>(LEASE, at(2)).await.expect("works") {
                    claimed.push(claim.job.id);
                }
                claimed
            })
        })
        .collect();
    let (mut claims, mut runs) = (0, HashSet::new());
    for worker in workers {
        let claimed = worker.await.expect("no panic");
        claims += claimed.len();
        runs.extend(claimed);
    }
    assert_eq!((claims, runs.len()), (60, 60));
}

/// Leases are measured by the clock of the database, so those of workers may be wrong by any time.
#[tokio::test]
#[ignore = "needs PostgreSQL: .ci/postgres"]
async fn the_clocks_of_workers_decide_no_lease() {
    let fixture = Fixture::at(database().await).await;
    let store = &fixture.store;
    let run = RunId(Uuid::from_u128(1));
    store.insert_run(run, &fixture.camera, &options(), 9, None, at(0)).await.expect("queued");
    let fence = store.claim_run::<CameraId>(LEASE, at(0)).await.expect("works").expect("a run").fence;
    for second in [-86_400, -60, -1, 1, 60, 86_400] {
        assert_eq!(
            store.claim_run::<CameraId>(LEASE, at(second)).await.expect("works"),
            None,
            "at {second} s"
        );
        let beat =
            store.heartbeat_run::<CameraId>(run, fence, &RunProgress::default(), LEASE, at(-second)).await;
        assert_eq!(beat.expect("works"), Heartbeat::Continue);
    }
    // One that was taken a moment ago by the database's clock.
    fixture.tamper("UPDATE training_runs SET lease_until_us = lease_until_us - 30000000").await;
    assert_eq!(
        store.claim_run::<CameraId>(LEASE, at(0)).await.expect("works").map(|claim| claim.fence),
        Some(fence + 1)
    );
}

/// The database ends a transaction for a deadlock, or because it cannot be serialised, at whatever statement and call.
#[tokio::test]
#[ignore = "needs PostgreSQL: .ci/postgres"]
async fn a_transaction_that_the_database_ends_is_made_again() {
    let home = database().await;
    let (store, node) = registered(&home, 1).await;
    store.insert_camera(&NewCamera::named(id("a")), at(0)).await.expect("new");
    crate::on_backend!(store, store => store.tamper(
        "CREATE SEQUENCE statements; \
         CREATE FUNCTION refuse_two_of_three() RETURNS TRIGGER LANGUAGE plpgsql AS $$ DECLARE n BIGINT; BEGIN \
         n := nextval('statements'); \
         IF n % 3 = 1 THEN RAISE EXCEPTION 'deadlock' USING ERRCODE = '40P01'; END IF; \
         IF n % 3 = 2 THEN RAISE EXCEPTION 'serialization' USING ERRCODE = '40001'; END IF; \
         RETURN NULL; END $$; \
         CREATE TRIGGER refuse AFTER INSERT ON sample_counts FOR EACH STATEMENT EXECUTE FUNCTION refuse_two_of_three(); \
         CREATE TRIGGER refuse AFTER UPDATE ON cameras FOR EACH STATEMENT EXECUTE FUNCTION refuse_two_of_three(); \
         CREATE TRIGGER refuse AFTER UPDATE ON camera_owners FOR EACH STATEMENT EXECUTE FUNCTION refuse_two_of_three(); \
         CREATE TRIGGER refuse AFTER INSERT ON training_runs FOR EACH STATEMENT EXECUTE FUNCTION refuse_two_of_three()"
    ).await);
    let inserted = store.insert_samples(&id("a"), vec![sample(1, "x")], Durability::Synced).await;
    assert_eq!(inserted.expect("the shared writer tries again").accepted, 1);
    let changed = store.replace_camera(&NewCamera::named(id("a")), None, at(1)).await.expect("changed");
    assert_eq!(changed.revision.0, 2, "once");
    assert_eq!(acquire(&store, "a", node).await, Acquired::Owned { fence: 1, is_takeover: false });
    store.insert_run(RunId(Uuid::from_u128(1)), &id("a"), &options(), 9, None, at(1)).await.expect("queued");

    crate::on_backend!(store, store => store.tamper(
        "CREATE OR REPLACE FUNCTION refuse_two_of_three() RETURNS TRIGGER LANGUAGE plpgsql AS $$ BEGIN \
         RAISE EXCEPTION 'always' USING ERRCODE = '40001'; END $$"
    ).await);
    let refused = store.insert_samples(&id("a"), vec![sample(2, "x")], Durability::Synced).await;
    assert_eq!(refused.expect_err("not without end").kind(), ErrorKind::Overloaded);
    let refused = store.replace_camera(&NewCamera::named(id("a")), None, at(2)).await;
    assert_eq!(refused.expect_err("not without end").kind(), ErrorKind::Overloaded);
}

/// A copy beside servers would miss what they change after it.
#[tokio::test]
#[ignore = "needs PostgreSQL: .ci/postgres"]
async fn a_copy_is_refused_as_long_as_a_node_is_registered() {
    let home = database().await;
    let (store, node) = registered(&home, 1).await;
    let folder = TempDir::new().expect("a folder");
    let target = Store::open(folder.path()).await.expect("opens");
    for (from, to) in [(&store, &target), (&target, &store)] {
        let refused = from.copy_to(to).await.expect_err("a server runs");
        assert!(refused.to_string().contains("http://node-1"), "{refused}");
    }
    store.node_leases().expect("a database").end(node).await.expect("works");
    store.copy_to(&target).await.expect("copied");
}

#[tokio::test]
#[ignore = "needs PostgreSQL: .ci/postgres"]
async fn a_change_that_is_committed_after_a_later_one_is_not_missed() {
    let home = database().await;
    let store = home.open().await;
    for camera in ["a", "b"] {
        store.insert_camera(&NewCamera::named(id(camera)), at(0)).await.expect("new");
    }
    let listed = async |since| {
        let changes = store.camera_versions(since).await.expect("read");
        let mut ids: Vec<_> = changes.versions.into_iter().map(|version| version.id).collect();
        ids.sort();
        (ids, changes.upto)
    };
    let (_, start) = listed(None).await;
    let mut early = connect(&url(&home)).await;
    sqlx::raw_sql("BEGIN; UPDATE cameras SET revision = revision + 1 WHERE id = 'a'")
        .execute(&mut early)
        .await
        .expect("changed");
    store.replace_camera(&NewCamera::named(id("b")), None, at(1)).await.expect("changed");
    let (ids, upto) = listed(start).await;
    assert!(ids.contains(&id("b")) && upto.is_some(), "{ids:?}");
    sqlx::raw_sql("COMMIT").execute(&mut early).await.expect("committed");
    let (ids, upto) = listed(upto).await;
    assert!(ids.contains(&id("a")), "{ids:?}");
    // Nothing is under way that could hold the mark back but other databases of the server.
    assert!(listed(upto).await.0.len() <= ids.len());
}

/// Another transaction has the row of a camera's owner, which the deletion waits for, and then waits for the camera.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[ignore = "needs PostgreSQL: .ci/postgres"]
async fn a_deletion_that_the_database_ends_for_a_deadlock_is_made_again() {
    let home = database().await;
    let (store, node) = registered(&home, 1).await;
    store.insert_camera(&NewCamera::named(id("a")), at(0)).await.expect("new");
    acquire(&store, "a", node).await;
    let mut other = connect(&url(&home)).await;
    sqlx::raw_sql("BEGIN; UPDATE camera_owners SET fence = fence + 1")
        .execute(&mut other)
        .await
        .expect("locked");
    let deletion = tokio::spawn({
        let store = store.clone();
        async move { store.delete_camera(&id("a"), None, at(1)).await }
    });
    let waits = "SELECT count(*) FROM pg_stat_activity WHERE wait_event_type = 'Lock' AND datname = current_database()";
    while sqlx::query_scalar::<_, i64>(waits).fetch_one(&mut other).await.expect("read") == 0 {
        tokio::time::sleep(Duration::from_millis(10)).await;
    }
    // Whichever of the two the database ends, the deletion is made.
    let change = "UPDATE cameras SET revision = revision + 1 WHERE id = 'a'";
    let end = if sqlx::raw_sql(change).execute(&mut other).await.is_ok() { "COMMIT" } else { "ROLLBACK" };
    sqlx::raw_sql(end).execute(&mut other).await.expect("ended");
    deletion.await.expect("no panic").expect("deleted");
    let error = store.camera(&id("a")).await.expect_err("deleted");
    assert_eq!(error.kind(), ErrorKind::CameraNotFound);
}

/// Connections that the server ends, at any moment, cost an error at most; what was acknowledged stays.
#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
#[ignore = "needs PostgreSQL: .ci/postgres"]
async fn terminated_connections_lose_and_duplicate_nothing_that_was_acknowledged() {
    let fixture = Fixture::at(database().await).await;
    let (store, camera) = (fixture.store.clone(), fixture.camera.clone());
    let killing = {
        let url = url(&fixture.folder);
        tokio::spawn(async move {
            let mut connection = connect(&url).await;
            let mut killed = 0;
            for _ in 0..60 {
                tokio::time::sleep(Duration::from_millis(20)).await;
                let ended = sqlx::raw_sql(
                    "SELECT pg_terminate_backend(pid) FROM pg_stat_activity \
                     WHERE datname = current_database() AND pid <> pg_backend_pid()",
                )
                .fetch_all(&mut connection)
                .await
                .expect("works");
                killed += ended.len();
            }
            killed
        })
    };
    let (mut acknowledged, mut refused, mut second) = (0, 0, 0);
    while !killing.is_finished() {
        let rows = (0..5).map(|n| sample(second + n, "a")).collect();
        match store.insert_samples(&camera, rows, Durability::Synced).await {
            // A commit whose answer was lost is met again as duplicates.
            Ok(inserted) => {
                assert_eq!(inserted.accepted + inserted.duplicate, 5);
                acknowledged += 5;
                second += 5;
            }
            Err(error) => {
                assert_eq!(error.kind(), ErrorKind::Overloaded, "{error}");
                refused += 1;
            }
        }
    }
    let killed = killing.await.expect("no panic");
    let last = (0..5).map(|n| sample(second + n, "a")).collect::<Vec<_>>();
    while store.insert_samples(&camera, last.clone(), Durability::Synced).await.is_err() {}
    acknowledged += 5;
    println!("{killed} connections ended, {acknowledged} rows acknowledged, {refused} calls refused");
    assert!(killed > 0 && acknowledged > 0);
    assert_eq!(store.count_samples(&camera, &SampleFilter::default()).await.expect("counted"), acknowledged);
    assert_eq!(store.camera(&camera).await.expect("known").samples.all, acknowledged);
}

#[tokio::test]
#[ignore = "needs PostgreSQL: .ci/postgres"]
async fn what_cannot_be_opened_says_why() {
    let home = database().await;
    let store = home.open().await;
    crate::on_backend!(store, store => store.tamper(
        "INSERT INTO _sqlx_migrations (version, description, success, checksum, execution_time) \
         VALUES (9000, 'later', TRUE, '', 0)"
    ).await);
    let refusal = async |location: &Location| match Store::open_at(location, StoreOptions::default()).await {
        Ok(_) => panic!("opens"),
        Err(error) => error.to_string(),
    };
    let text = refusal(&home.location()).await;
    assert!(text.contains("newer version") && text.contains("9000"), "{text}");
    let absent = DatabaseUrl::new("postgres://someone:pass-word@127.0.0.1:1/fixes").expect("a URL");
    let text = refusal(&Location::Database(absent)).await;
    assert!(text.contains("postgres://127.0.0.1:1/fixes") && !text.contains("pass-word"), "{text}");
}

/// A migration that waits for another one holds no snapshot, which would keep an index from being built.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[ignore = "needs PostgreSQL: .ci/postgres"]
async fn a_waiting_start_does_not_block_an_index_that_is_built_concurrently() {
    let home = Arc::new(database().await);
    drop(home.open().await);
    let mut migrating = connect(&url(&home)).await;
    let mut holder = migrating.begin_with("BEGIN; DEALLOCATE ALL").await.expect("begins");
    assert!(super::locks::try_lock_limit(&mut holder, super::locks::Limit::Schema).await.expect("works"));
    let waiting = {
        let home = Arc::clone(&home);
        tokio::spawn(async move { home.open().await })
    };
    tokio::time::sleep(Duration::from_millis(300)).await;
    assert!(!waiting.is_finished(), "the schema is locked");
    let mut other = connect(&url(&home)).await;
    // The holder's own transaction has no snapshot either, once its statement has ended.
    sqlx::raw_sql("CREATE INDEX CONCURRENTLY by_name ON cameras (profile)")
        .execute(&mut other)
        .await
        .expect("is built");
    holder.rollback().await.expect("ends");
    waiting.await.expect("no panic");
}

/// Calls that are given up at any point leave no transaction open on a connection of the pool, whose next caller would
/// read the state of then.
#[tokio::test]
#[ignore = "needs PostgreSQL: .ci/postgres"]
async fn calls_that_are_given_up_leave_no_transaction_open() {
    let home = database().await;
    let store = home.open().await;
    let camera = id("gate");
    store.insert_camera(&NewCamera::named(camera.clone()), at(0)).await.expect("stored");
    for after_ms in 1..=20 {
        // More calls than connections, so that some are given up while they begin.
        let calls =
            (0..30).map(|_| tokio::time::timeout(Duration::from_millis(after_ms), store.camera(&camera)));
        futures_util::future::join_all(calls).await;
    }
    tokio::time::sleep(Duration::from_millis(300)).await;
    let open = "SELECT count(*) FROM pg_stat_activity \
                WHERE datname = current_database() AND state LIKE 'idle in transaction%'";
    let open: i64 =
        sqlx::query_scalar(open).fetch_one(&mut connect(&url(&home)).await).await.expect("a count");
    assert_eq!(open, 0);
}

#[tokio::test]
#[ignore = "needs PostgreSQL: .ci/postgres"]
async fn a_folder_is_copied_into_a_database_and_back() {
    let folder = Home::Folder(Arc::new(TempDir::new().expect("a folder")));
    copy_and_compare(&Fixture::at(folder).await, &database().await).await;
}

/// A node that is registered, with the store that it would use.
async fn registered(home: &Home, number: u128) -> (Store, NodeId) {
    let (store, id) = (home.open().await, NodeId(Uuid::from_u128(number)));
    let profile = NodeProfile {
        url: Some(format!("http://node-{number}")),
        role: "serve".to_owned(),
        version: "0".to_owned(),
        lease: LEASE,
        started_at: at(number as i64),
    };
    store.node_leases().expect("a database").register(id, &profile, 1).await.expect("registered");
    (store, id)
}

async fn acquire(store: &Store, camera: &str, node: NodeId) -> Acquired {
    let key = store.camera(&id(camera)).await.expect("known").key;
    store.node_leases().expect("a database").acquire(key, node).await.expect("works")
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
#[ignore = "needs PostgreSQL: .ci/postgres"]
async fn of_nodes_that_acquire_at_once_one_owns_a_camera_and_its_whole_site() {
    let home = database().await;
    let nodes = [registered(&home, 1).await, registered(&home, 2).await, registered(&home, 3).await];
    let store = &nodes[0].0;
    let site = SiteId::new("port").expect("a slug");
    store.insert_site(&NewSite::named(site.clone()), at(0)).await.expect("new");
    for number in 0..12 {
        let camera =
            NewCamera { site: Some(site.clone()), ..NewCamera::named(id(&format!("of-site-{number}"))) };
        store.insert_camera(&camera, at(0)).await.expect("new");
        store.insert_camera(&NewCamera::named(id(&format!("alone-{number}"))), at(0)).await.expect("new");
    }
    let acquiring = (0..72).map(|n| {
        let (store, node) = nodes[n % 3].clone();
        let camera = format!("{}-{}", if n < 36 { "of-site" } else { "alone" }, (n / 3) % 12);
        tokio::spawn(async move { (camera.clone(), node, acquire(&store, &camera, node).await) })
    });
    let mut owners: HashMap<String, HashSet<NodeId>> = HashMap::new();
    for task in acquiring.collect::<Vec<_>>() {
        let (camera, node, acquired) = task.await.expect("no panic");
        if matches!(acquired, Acquired::Owned { fence: 1, is_takeover: false }) {
            owners.entry(camera).or_default().insert(node);
        }
    }
    assert!(owners.values().all(|owners| owners.len() == 1), "{owners:?}");
    assert_eq!(owners.len(), 24, "every camera has an owner");
    let of_site = owners.iter().filter(|(camera, _)| camera.starts_with("of-site"));
    let of_site: HashSet<NodeId> = of_site.flat_map(|(_, owners)| owners.clone()).collect();
    assert_eq!(of_site.len(), 1, "a site has one owner");
}

#[tokio::test]
#[ignore = "needs PostgreSQL: .ci/postgres"]
async fn a_node_owns_until_its_registration_ends_and_every_owner_has_a_higher_fence() {
    let home = database().await;
    let ((first, one), (second, two)) = (registered(&home, 1).await, registered(&home, 2).await);
    first.insert_camera(&NewCamera::named(id("a")), at(0)).await.expect("new");
    let key = first.camera(&id("a")).await.expect("known").key;
    let (ours, others) =
        (first.node_leases().expect("a database"), second.node_leases().expect("a database"));
    let owned = |fence, is_takeover| Acquired::Owned { fence, is_takeover };
    assert_eq!(acquire(&first, "a", one).await, owned(1, false));
    assert_eq!(acquire(&second, "a", two).await, Acquired::OtherNode(one));
    assert_eq!(others.camera_owner(key).await.expect("works"), Some(one));

    // An observer that has not seen the latest renewal ends nothing.
    assert!(ours.renew(one, 2, false).await.expect("works").is_some());
    assert!(!others.end_unrenewed(one, 1).await.expect("works"));
    assert_eq!(acquire(&second, "a", two).await, Acquired::OtherNode(one));
    assert!(others.end_unrenewed(one, 2).await.expect("works"));
    assert_eq!(acquire(&second, "a", two).await, owned(2, true));
    // The node before learns of it whatever it tries.
    assert!(ours.renew(one, 3, false).await.expect("works").is_none());
    assert_eq!(acquire(&first, "a", one).await, Acquired::NotRegistered);
    ours.release(one, &[(key, 1)]).await.expect("works");
    assert_eq!(ours.camera_owner(key).await.expect("works"), Some(two));

    // A release under an old fence releases nothing.
    assert_eq!(acquire(&second, "a", two).await, owned(3, false));
    others.release(two, &[(key, 2)]).await.expect("works");
    assert_eq!(ours.camera_owner(key).await.expect("works"), Some(two));
    others.release(two, &[(key, 3)]).await.expect("works");
    assert_eq!(ours.camera_owner(key).await.expect("works"), None);
    second.delete_camera(&id("a"), None, at(1)).await.expect("deleted");
    assert_eq!(others.nodes().await.expect("works").iter().map(|(_, cameras)| *cameras).sum::<u64>(), 0);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
#[ignore = "needs PostgreSQL: .ci/postgres"]
async fn of_nodes_that_acquire_at_once_one_runs_a_group_of_connections() {
    let home = database().await;
    let nodes = [registered(&home, 1).await, registered(&home, 2).await, registered(&home, 3).await];
    let mut keys = Vec::new();
    for number in 0..20 {
        let profile = NewConnection {
            id: ConnectionId::new(&format!("source-{number}")).expect("a slug"),
            display_name: String::new(),
            paused: false,
            settings: "{}".to_owned(),
            secrets: "{}".to_owned(),
        };
        keys.push(nodes[0].0.insert_connection(&profile, at(0)).await.expect("new").key);
    }
    let acquiring = (0..60).map(|n| {
        let (store, node) = nodes[n % 3].clone();
        let group = keys[n / 3 / 4 * 4..][..4].to_vec();
        tokio::spawn(async move {
            let leases = store.node_leases().expect("a database");
            leases.acquire_connections(node, &group, &group).await.expect("works")
        })
    });
    for task in acquiring.collect::<Vec<_>>() {
        task.await.expect("no panic");
    }
    let leases = nodes[0].0.node_leases().expect("a database");
    let owners = leases.connection_owners().await.expect("works");
    for group in keys.chunks(4) {
        let owners: HashSet<_> = group.iter().map(|key| owners.get(key).expect("an owner")).collect();
        assert_eq!(owners.len(), 1, "{owners:?}");
    }

    // A report of a node counts as long as it is registered.
    let owner = owners[&keys[0]];
    leases.store_connection_statuses(owner, &[(keys[0], "one".to_owned())]).await.expect("works");
    leases.store_connection_statuses(owner, &[(keys[0], "two".to_owned())]).await.expect("works");
    let reports = leases.connection_reports(keys[0]).await.expect("works");
    assert_eq!(reports.statuses, [(owner, "two".to_owned())]);
    assert_eq!(reports.owner.map(|(node, _)| node), Some(owner));
    leases.end(owner).await.expect("works");
    let reports = leases.connection_reports(keys[0]).await.expect("works");
    assert_eq!((reports.owner, reports.statuses), (None, Vec::new()));
    let other = nodes.iter().map(|(_, node)| *node).find(|node| *node != owner).expect("another");
    let fences = leases.acquire_connections(other, &keys[..4], &keys[..2]).await.expect("works");
    let fences: [_; 2] = fences.try_into().expect("both");
    assert!(fences.iter().all(|(_, fence)| *fence >= 2), "{fences:?}");
    leases.release_connections(other, &[fences[0], (fences[1].0, 1)]).await.expect("works");
    let owners = leases.connection_owners().await.expect("works");
    let of_group = fences.map(|(key, _)| owners.get(&key));
    assert_eq!(of_group, [None, Some(&other)], "an old fence releases nothing");
}

#[tokio::test]
#[ignore = "needs PostgreSQL: .ci/postgres"]
async fn a_camera_that_is_wanted_goes_to_nobody_else() {
    let home = database().await;
    let ((first, one), (second, two)) = (registered(&home, 1).await, registered(&home, 2).await);
    let (third, three) = registered(&home, 3).await;
    first.insert_camera(&NewCamera::named(id("a")), at(0)).await.expect("new");
    let key = first.camera(&id("a")).await.expect("known").key;
    let leases = first.node_leases().expect("a database");
    assert_eq!(acquire(&first, "a", one).await, Acquired::Owned { fence: 1, is_takeover: false });
    leases.want(key, two).await.expect("works");
    assert_eq!(leases.wanted_by_others(one).await.expect("works"), [key]);
    assert_eq!(acquire(&second, "a", two).await, Acquired::OtherNode(one), "until it is given up");
    leases.release(one, &[(key, 1)]).await.expect("works");
    assert_eq!(acquire(&first, "a", one).await, Acquired::OtherNode(two));
    assert_eq!(acquire(&third, "a", three).await, Acquired::OtherNode(two));
    assert_eq!(acquire(&second, "a", two).await, Acquired::Owned { fence: 2, is_takeover: false });
    assert_eq!(leases.wanted_by_others(two).await.expect("works"), []);
    // Once it is owned, or the one that wants it is gone, it is as any other.
    leases.want(key, three).await.expect("works");
    leases.end(three).await.expect("works");
    assert_eq!(leases.wanted_by_others(two).await.expect("works"), []);
    leases.release(two, &[(key, 2)]).await.expect("works");
    assert_eq!(acquire(&first, "a", one).await, Acquired::Owned { fence: 3, is_takeover: false });
}
