//! Costs of attacks for a well-behaved client, of a refusal, and of an idle connection:
//! the second part of docs/explanation/reliability.md.
//!
//! Attackers and the measured client share the machine with the server, so what attackers cost the processor
//! counts against the server.

use std::net::SocketAddr;
use std::time::{Duration, Instant};

use sightfix::config::Limits;
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::{TcpSocket, TcpStream};
use tokio::task::JoinSet;

use crate::load;
use crate::ratio::{self, in_turn};
use crate::served::{Served, runtime};
use crate::tables;
use crate::transports::request_body;

/// Requests of each connection of the measured client in a round.
const EACH: usize = 300;
/// Requests that are worked on at a time, and the connections that take all of the machine. A request that only computes
/// holds its place for as long as a core works on it, so that as many places as cores would never all be taken: with many
/// places the cores are the limit, with one of them refusals are.
const PLACES: [(usize, usize); 2] = [(8, 2), (1, 1)];
/// Connections that offer three times the capacity together.
const OFFERING_CONNECTIONS: usize = 24;
/// Observations of a request whose cost is that of its work, not of its transport.
const ITEMS: usize = 1_000;
/// Both ends are descriptors of this process, of which many systems allow 20,000.
const IDLE_CONNECTIONS: usize = 9_600;

pub(crate) fn run() {
    // First: what others leave to the allocator would not count.
    idle_connections();
    beside_attacks();
    let columns = [
        "places",
        "capacity (requests/s)",
        "goodput / capacity",
        "refusals",
        "their median (ms)",
        "their 99 % (ms)",
    ];
    tables::head(&format!("Three times the capacity, {ITEMS} observations per request"), &columns);
    for (places, connections) in PLACES {
        at_three_times_the_capacity(places, connections);
    }
}

/// A connection from an address of the attack's own, so that limits tell attackers from the measured client, and one
/// attack from the next.
async fn connect(server: SocketAddr, attack: u8) -> Option<TcpStream> {
    let socket = TcpSocket::new_v4().ok()?;
    socket.bind(SocketAddr::from(([127, 0, 0, 2 + attack], 0))).ok()?;
    socket.connect(server).await.ok()
}

/// An attacker's connection, begun again whenever the server closes it. What the server writes is read, or the
/// connection would stall for that.
async fn attack_forever(server: SocketAddr, attack: u8, begin: Vec<u8>, flood: Vec<u8>) {
    loop {
        let Some(stream) = connect(server, attack).await else { continue };
        let (mut read, mut write) = stream.into_split();
        if write.write_all(&begin).await.is_err() {
            continue;
        }
        let mut sink = tokio::io::sink();
        let reading = tokio::io::copy(&mut read, &mut sink);
        let flooding = async {
            while !flood.is_empty() && write.write_all(&flood).await.is_ok() {}
            if flood.is_empty() {
                std::future::pending::<()>().await;
            }
        };
        tokio::select! {
            _ = reading => {}
            () = flooding => {}
        }
    }
}

const PREFACE: &[u8] = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n\0\0\0\x04\0\0\0\0\0";

/// An upload of which one byte comes.
const STALLED_UPLOAD: &[u8] =
    b"POST /v1/cameras HTTP/1.1\r\nhost: localhost\r\ncontent-type: application/json\r\n\
                                content-length: 1000\r\n\r\n{";

/// Requests that are reset at once, as many as one connection has numbers for in a while.
fn rapid_resets() -> Vec<u8> {
    let headers = [&[0x82, 0x86, 0x04, 6][..], b"/livez", &[0x41, 9], b"localhost"].concat();
    let mut flood = PREFACE.to_vec();
    for stream in (1_u32..20_000).step_by(2) {
        flood.extend([0, 0, headers.len() as u8, 1, 5]);
        flood.extend(stream.to_be_bytes());
        flood.extend(&headers);
        flood.extend([0, 0, 4, 3, 0]);
        flood.extend(stream.to_be_bytes());
        flood.extend(8_u32.to_be_bytes());
    }
    flood
}

/// The attacks by name: how many connections, what each begins with, and what it repeats.
fn attacks(camera: &str) -> Vec<(&'static str, usize, Vec<u8>, Vec<u8>)> {
    let garbage = "x,".repeat(1 << 19);
    let import = load::post(&format!("/v1/cameras/{camera}/samples"), "text/csv", &garbage);
    vec![
        ("500 uploads that send one byte", 500, STALLED_UPLOAD.to_vec(), Vec::new()),
        ("500 silent connections", 500, Vec::new(), Vec::new()),
        ("half a header, 500 times", 500, b"GET / HTTP/1.1\r\nx: ".to_vec(), Vec::new()),
        ("PING flood, 2 connections", 2, PREFACE.to_vec(), b"\0\0\x08\x06\0\0\0\0\0abcdefgh".repeat(1_000)),
        ("rapid reset, 2 connections", 2, Vec::new(), rapid_resets()),
        ("imports of 1 MB of garbage, 2 connections", 2, Vec::new(), import),
    ]
}

fn beside_attacks() {
    let runtime = runtime();
    let served = runtime.block_on(Served::start());
    ratio::head(
        "Rate of a client of 16 connections beside an attack, compared with itself alone",
        "requests/s",
    );
    let path = format!("/v1/cameras/{}/fusions", served.camera);
    let request = load::post(&path, "application/json", &request_body(&served.observations[..1]));
    let rate = || runtime.block_on(load::send(served.address, &request, EACH)).0;
    for (attack, (name, connections, begin, flood)) in (0_u8..).zip(attacks(served.camera.as_str())) {
        let attacked = || {
            let mut attackers = JoinSet::new();
            for _ in 0..connections {
                let attacker = attack_forever(served.address, attack, begin.clone(), flood.clone());
                attackers.spawn_on(attacker, runtime.handle());
            }
            std::thread::sleep(Duration::from_millis(300));
            rate()
        };
        ratio::row(name, &in_turn(attacked, rate));
    }
    served.end();
}

/// Sends a request and reads its answer; the status, and the time that it took.
async fn timed(stream: &mut TcpStream, request: &[u8]) -> (u16, Duration) {
    let sent = Instant::now();
    stream.write_all(request).await.expect("the server reads");
    let mut answer = Vec::with_capacity(1 << 16);
    loop {
        assert_ne!(stream.read_buf(&mut answer).await.expect("the server answers"), 0, "the server closed");
        let Some(head) = answer.windows(4).position(|four| four == b"\r\n\r\n") else { continue };
        let text = String::from_utf8_lossy(&answer[..head]).to_ascii_lowercase();
        let length = text.lines().find_map(|line| line.strip_prefix("content-length: "));
        let length: usize = length.and_then(|length| length.parse().ok()).expect("a content length");
        if answer.len() >= head + 4 + length {
            let status = text[9..12].parse().expect("a status");
            return (status, sent.elapsed());
        }
    }
}

/// Requests per second that succeed, and the sorted times of refusals in ms, where every connection sends a
/// request each `pause`, or the next at once if it is late.
async fn offered(
    address: SocketAddr,
    request: &[u8],
    connections: usize,
    pause: Duration,
) -> (f64, Vec<f64>) {
    const TIME: Duration = Duration::from_secs(4);
    let (began, mut clients) = (Instant::now(), JoinSet::new());
    for index in 0..connections {
        let request = request.to_vec();
        clients.spawn(async move {
            let mut stream = TcpStream::connect(address).await.expect("the server listens");
            stream.set_nodelay(true).expect("a TCP stream");
            let mut next = tokio::time::Instant::now() + pause.mul_f64(index as f64 / connections as f64);
            let (mut done, mut refusals_ms) = (0, Vec::new());
            while began.elapsed() < TIME {
                tokio::time::sleep_until(next).await;
                next += pause;
                match timed(&mut stream, &request).await {
                    (200, _) => done += 1,
                    (_, time) => refusals_ms.push(time.as_secs_f64() * 1e3),
                }
            }
            (done, refusals_ms)
        });
    }
    let all = clients.join_all().await;
    let done: i32 = all.iter().map(|(done, _)| done).sum();
    let mut refusals_ms: Vec<f64> = all.into_iter().flat_map(|(_, refusals_ms)| refusals_ms).collect();
    refusals_ms.sort_by(f64::total_cmp);
    (f64::from(done) / began.elapsed().as_secs_f64(), refusals_ms)
}

fn at_three_times_the_capacity(places: usize, connections: usize) {
    let runtime = runtime();
    let limits = Limits { requests: places, reserved_requests: 0, client_share: 1.0, ..Limits::default() };
    let served = runtime.block_on(Served::start_limited(1, limits));
    let observations: Vec<_> = served.observations.iter().cycle().take(ITEMS).cloned().collect();
    let path = format!("/v1/cameras/{}/fusions", served.camera);
    let request = load::post(&path, "application/json", &request_body(&observations));
    let rate = |connections, pause| runtime.block_on(offered(served.address, &request, connections, pause));
    let (capacity, _) = rate(connections, Duration::ZERO);
    let pause = Duration::from_secs_f64(OFFERING_CONNECTIONS as f64 / (3.0 * capacity));
    let (goodput, refusals_ms) = rate(OFFERING_CONNECTIONS, pause);
    let quantile = |share: f64| refusals_ms.get((refusals_ms.len() as f64 * share) as usize);
    let numbers = [
        (capacity, 0),
        (goodput / capacity, 2),
        (refusals_ms.len() as f64, 0),
        (quantile(0.5).copied().unwrap_or_default(), 2),
        (quantile(0.99).copied().unwrap_or_default(), 2),
    ];
    tables::row(places, &numbers);
    served.end();
}

/// Resident memory of this process, bytes.
fn resident_bytes() -> f64 {
    let status = std::fs::read_to_string("/proc/self/status").expect("Linux has it");
    let line = status.lines().find(|line| line.starts_with("VmRSS:")).expect("it is there");
    line.split_whitespace().nth(1).and_then(|text| text.parse::<f64>().ok()).expect("kB") * 1024.0
}

/// The clients' ends are plain descriptors, whose memory is the kernel's.
fn idle_connections() {
    let runtime = runtime();
    let limits = Limits {
        connections: 2 * IDLE_CONNECTIONS,
        connections_per_s: 0,
        client_share: 1.0,
        idle_s: 3_600,
        ..Limits::default()
    };
    let served = runtime.block_on(Served::start_limited(1, limits));
    tables::head(
        "Idle connections, each after one request",
        &["connections", "bytes of resident memory each"],
    );
    let mut held = Vec::new();
    let mut before = resident_bytes();
    for begin in [b"GET /livez HTTP/1.1\r\nhost: localhost\r\n\r\n".to_vec(), PREFACE.to_vec()] {
        for _ in 0..IDLE_CONNECTIONS / 2 {
            let mut stream = std::net::TcpStream::connect(served.address).expect("the server listens");
            std::io::Write::write_all(&mut stream, &begin).expect("the server reads");
            std::io::Read::read(&mut stream, &mut [0; 1_024]).expect("an answer");
            held.push(stream);
        }
        let after = resident_bytes();
        let protocol = if begin == PREFACE { "HTTP/2" } else { "HTTP/1.1" };
        let each = (after - before) / (IDLE_CONNECTIONS / 2) as f64;
        tables::row(format!("{} of {protocol}", IDLE_CONNECTIONS / 2), &[(each, 0)]);
        before = after;
    }
    drop(held);
    served.end();
}
