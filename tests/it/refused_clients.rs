//! Clients that cost more than they bring: floods, too many connections, bodies that are refused. They are served less,
//! others as before.

use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};

use crate::harness::{TestServer, connect_from, data_folder, run};

const ATTACKER: [u8; 4] = [127, 0, 0, 2];
const PREFACE: &[u8] = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n\0\0\0\x04\0\0\0\0\0";
const PING: &[u8] = b"\0\0\x08\x06\0\0\0\0\0abcdefgh";

/// Sends all of it, reads to the end; what came. A connection that the server breaks off ends, too.
async fn exchange(server: &TestServer, ip: [u8; 4], bytes: &[u8]) -> String {
    let mut stream = connect_from(ip, server.address).await;
    let _ = stream.write_all(bytes).await;
    let mut answer = Vec::new();
    let _ = stream.read_to_end(&mut answer).await;
    String::from_utf8_lossy(&answer).into_owned()
}

async fn is_served(server: &TestServer, ip: [u8; 4]) -> bool {
    let probe = b"GET /livez HTTP/1.1\r\nhost: localhost\r\nconnection: close\r\n\r\n";
    exchange(server, ip, probe).await.starts_with("HTTP/1.1 200")
}

async fn refused_connections(server: &TestServer) -> f64 {
    let metrics = server.get("/metrics").await.expect(200).text();
    let line = metrics.lines().find(|line| line.starts_with("sightfix_connections_refused_total "));
    line.and_then(|line| line.rsplit(' ').next()?.parse().ok()).unwrap_or_default()
}

/// Floods until the server ends the connection.
async fn flood(server: &TestServer, flood: &[u8]) {
    let (mut reader, mut writer) = connect_from(ATTACKER, server.address).await.into_split();
    let reading = tokio::spawn(async move { tokio::io::copy(&mut reader, &mut tokio::io::sink()).await });
    while !reading.is_finished() && writer.write_all(flood).await.is_ok() {}
    let _ = reading.await;
}

#[tokio::test]
async fn an_address_that_floods_is_refused_for_a_while() {
    let folder = data_folder();
    let settings =
        [("SIGHTFIX_LIMITS__CONTROL_FRAMES_PER_S", "100"), ("SIGHTFIX_LIMITS__FLOOD_PENALTY_S", "3")];
    let server = TestServer::start_with(folder.path(), &settings);
    assert!(is_served(&server, ATTACKER).await);
    flood(&server, &[PREFACE, &PING.repeat(100_000)].concat()).await;
    while refused_connections(&server).await == 0.0 {
        is_served(&server, ATTACKER).await;
        assert!(is_served(&server, [127, 0, 0, 3]).await, "another address");
    }
    while !is_served(&server, ATTACKER).await {}
}

#[tokio::test]
async fn streams_that_are_reset_at_once_are_a_flood() {
    let folder = data_folder();
    let settings =
        [("SIGHTFIX_LIMITS__CONTROL_FRAMES_PER_S", "4000000000"), ("SIGHTFIX_LIMITS__FLOOD_PENALTY_S", "3")];
    let server = TestServer::start_with(folder.path(), &settings);
    let headers = [&[0x82, 0x86, 0x04, 6][..], b"/livez", &[0x41, 9], b"localhost"].concat();
    let mut resets = PREFACE.to_vec();
    for stream in (1_u32..20_000).step_by(2) {
        resets.extend([0, 0, headers.len() as u8, 1, 5]);
        resets.extend(stream.to_be_bytes());
        resets.extend(&headers);
        resets.extend([0, 0, 4, 3, 0]);
        resets.extend(stream.to_be_bytes());
        resets.extend(8_u32.to_be_bytes());
    }
    while refused_connections(&server).await == 0.0 {
        flood(&server, &resets).await;
    }
    let metrics = server.get("/metrics").await.expect(200).text();
    let closed = "sightfix_connections_closed_total{reason=\"flooded\"}";
    assert!(metrics.lines().any(|line| line.starts_with(closed) && !line.ends_with(" 0")), "{metrics}");
}

#[tokio::test]
async fn connections_beyond_the_rate_of_an_address_are_refused() {
    let folder = data_folder();
    let server = TestServer::start_with(folder.path(), &[("SIGHTFIX_LIMITS__CONNECTIONS_PER_S", "5")]);
    let mut connections = Vec::new();
    for _ in 0..100 {
        connections.push(connect_from(ATTACKER, server.address).await);
    }
    assert!(is_served(&server, [127, 0, 0, 3]).await, "another address");
    let mut served = 0;
    for mut stream in connections {
        let mut answer = Vec::new();
        let _ =
            stream.write_all(b"GET /livez HTTP/1.1\r\nhost: localhost\r\nconnection: close\r\n\r\n").await;
        let _ = stream.read_to_end(&mut answer).await;
        served += usize::from(answer.starts_with(b"HTTP/1.1 200"));
    }
    assert!((5..100).contains(&served), "{served} of 100");
    while !is_served(&server, ATTACKER).await {}
}

#[tokio::test]
async fn bodies_that_are_refused_make_their_sender_wait() {
    let folder = data_folder();
    let server = TestServer::start_with(folder.path(), &[("SIGHTFIX_LIMITS__REFUSED_BYTES_PER_S", "1000")]);
    server.post("/v1/cameras", &serde_json::json!({ "id": "c" })).await.expect(201);
    let garbage = "x,".repeat(20_000);
    let import = async || {
        let headers = [("content-type", "text/csv")];
        server.send("POST", "/v1/cameras/c/samples", &headers, garbage.clone()).await
    };
    let first = import().await;
    assert!(matches!(first.status.as_u16(), 400 | 422), "{}", first.text());
    let second = import().await.expect(429);
    assert!(second.text().contains("refused_bytes_per_s"), "{}", second.text());
    assert_eq!(second.header("retry-after"), "1");
    server.get("/v1/cameras/c").await.expect(200);
    let other = "POST /v1/cameras HTTP/1.1\r\nhost: localhost\r\nconnection: close\r\n\
                 content-type: application/json\r\ncontent-length: 10\r\n\r\n{\"id\":\"d\"}";
    let answer = exchange(&server, ATTACKER, other.as_bytes()).await;
    assert!(answer.starts_with("HTTP/1.1 201"), "{answer}");
}

/// A server with a viewer's key, which it returns as its header.
fn with_viewer(settings: &[(&str, &str)]) -> (tempfile::TempDir, TestServer, String) {
    let folder = data_folder();
    let path = folder.path().to_str().expect("UTF-8").to_owned();
    let key = run(&["keys", "create", "--name", "v", "--role", "viewer", "--data", &path]);
    let server = TestServer::start_with(folder.path(), settings);
    (folder, server, format!("Bearer {}", key.trim()))
}

/// Sends a body that claims to be gzip, and is not, to each of these paths; the statuses.
async fn statuses(server: &TestServer, authorization: Option<&str>, paths: &[&str]) -> Vec<u16> {
    let mut headers = vec![("content-type", "application/json"), ("content-encoding", "gzip")];
    headers.extend(authorization.map(|key| ("authorization", key)));
    let mut statuses = Vec::new();
    for path in paths {
        statuses.push(server.send("POST", path, &headers, "x".repeat(40_000)).await.status.as_u16());
    }
    statuses
}

#[tokio::test]
async fn bodies_of_those_who_may_not_send_them_count_as_refused() {
    let rate = ("SIGHTFIX_LIMITS__REFUSED_BYTES_PER_S", "1000");
    for (has_key, path, status) in
        [(false, "/v1/cameras", 401), (true, "/v1/cameras", 403), (true, "/v1/nothing", 404)]
    {
        let (_folder, server, key) = with_viewer(&[rate]);
        let key = has_key.then_some(&*key);
        // Not 400: nobody tried to decode it.
        assert_eq!(statuses(&server, key, &[path, path]).await, [status, 429], "{path}");
        server.get("/livez").await.expect(200);
    }
}

#[tokio::test]
async fn an_address_without_a_key_has_its_rate_of_requests() {
    let (_folder, server, key) = with_viewer(&[("SIGHTFIX_LIMITS__ANONYMOUS_REQUESTS_PER_S", "2")]);
    let get = async |key: Option<&str>| {
        let headers: Vec<(&str, &str)> = key.map(|key| ("authorization", key)).into_iter().collect();
        server.send("GET", "/v1/cameras", &headers, "").await
    };
    for credential in [None, Some("Bearer sf_0000000000000000000000000000000000000"), Some("Basic x")] {
        let refused = loop {
            let answer = get(credential).await;
            if answer.status != 401 {
                break answer.expect(429);
            }
        };
        assert!(refused.text().contains("without a key"), "{}", refused.text());
    }
    for _ in 0..50 {
        get(Some(&key)).await.expect(200);
        server.get("/livez").await.expect(200);
    }
}
