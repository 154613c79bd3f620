//! Floods of HTTP/2 frames that are part of requests: rapid reset, endless headers, too many streams. The
//! server's own limit on control frames is out of the way here, so this is what the library does by itself.

use std::io::{ErrorKind, Read as _, Write as _};
use std::net::TcpStream;
use std::time::Duration;

use crate::harness::{TestServer, data_folder};

/// Far beyond every time of the server's own: a read that takes as long was never answered.
const LONGEST_READ: Duration = Duration::from_secs(30);
const PREFACE: &[u8] = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n\0\0\0\x04\0\0\0\0\0";

const HEADERS: u8 = 1;
const RST_STREAM: u8 = 3;
const SETTINGS: u8 = 4;
const GO_AWAY: u8 = 7;
const CONTINUATION: u8 = 9;
const END_STREAM: u8 = 1;
const END_HEADERS: u8 = 4;
const REFUSED_STREAM: u32 = 7;
const MAX_CONCURRENT_STREAMS: u16 = 3;

/// `GET /livez` from `localhost`, by the static table of RFC 7541.
fn probe() -> Vec<u8> {
    [&[0x82, 0x86, 0x04, 6][..], b"/livez", &[0x41, 9], b"localhost"].concat()
}

/// `POST /v1/cameras`, which is open until its body has come.
fn creation() -> Vec<u8> {
    [&[0x83, 0x86, 0x04, 11][..], b"/v1/cameras", &[0x41, 9], b"localhost"].concat()
}

fn frame(kind: u8, flags: u8, stream: u32, payload: &[u8]) -> Vec<u8> {
    let length = u32::try_from(payload.len()).expect("short").to_be_bytes();
    let head = [length[1], length[2], length[3], kind, flags];
    [&head[..], &stream.to_be_bytes(), payload].concat()
}

/// A frame of the server.
struct Received {
    kind: u8,
    stream: u32,
    payload: Vec<u8>,
}

fn connect(server: &TestServer) -> TcpStream {
    let mut stream = TcpStream::connect(server.address).expect("the server listens");
    stream.set_read_timeout(Some(LONGEST_READ)).expect("a timeout");
    stream.write_all(PREFACE).expect("the server reads");
    stream
}

/// The next frame; `None` at the end of the connection.
fn receive(stream: &mut TcpStream) -> Option<Received> {
    let mut exactly = |length: usize| {
        let mut bytes = vec![0; length];
        match stream.read_exact(&mut bytes) {
            Ok(()) => Some(bytes),
            Err(error) => {
                let ended = [ErrorKind::UnexpectedEof, ErrorKind::ConnectionReset, ErrorKind::BrokenPipe];
                assert!(ended.contains(&error.kind()), "the connection never ends: {error}");
                None
            }
        }
    };
    let head = exactly(9)?;
    let payload = exactly(u32::from_be_bytes([0, head[0], head[1], head[2]]) as usize)?;
    let stream = u32::from_be_bytes([head[5], head[6], head[7], head[8]]);
    Some(Received { kind: head[3], stream, payload })
}

/// Sends a flood until the server takes no more, and asserts that the connection ends, mostly with GOAWAY.
fn ends(server: &TestServer, begin: &[u8], mut flood: impl FnMut(u32) -> Vec<u8>) {
    let mut stream = connect(server);
    let mut reader = stream.try_clone().expect("a second handle");
    let reading = std::thread::spawn(move || {
        let mut codes = Vec::new();
        while let Some(frame) = receive(&mut reader) {
            if frame.kind == GO_AWAY {
                codes.push(u32::from_be_bytes(frame.payload[4..8].try_into().expect("4 bytes")));
            }
        }
        codes
    });
    stream.write_all(begin).expect("the server reads");
    let rounds = (0..2_000).find(|&round| stream.write_all(&flood(round)).is_err());
    drop(stream.shutdown(std::net::Shutdown::Write));
    let codes = reading.join().expect("no panic");
    assert!(rounds.is_some() || !codes.is_empty(), "the flood was taken to its end");
    println!("ended in round {rounds:?} with GOAWAY {codes:?}");
}

fn server(folder: &std::path::Path, settings: &[(&str, &str)]) -> TestServer {
    let unlimited =
        [("SIGHTFIX_LIMITS__CONTROL_FRAMES_PER_S", "4000000000"), ("SIGHTFIX_LIMITS__FLOOD_PENALTY_S", "0")];
    TestServer::start_with(folder, &[&unlimited[..], settings].concat())
}

#[tokio::test]
async fn requests_that_are_reset_at_once_end_the_connection() {
    let folder = data_folder();
    let server = server(folder.path(), &[]);
    ends(&server, &[], |round| {
        let streams = (0..500).map(|index| 2 * (500 * round + index) + 1);
        let reset = |stream| {
            let opened = frame(HEADERS, END_HEADERS | END_STREAM, stream, &probe());
            [opened, frame(RST_STREAM, 0, stream, &8_u32.to_be_bytes())].concat()
        };
        streams.flat_map(reset).collect()
    });
    server.get("/livez").await.expect(200);
}

#[tokio::test]
async fn headers_without_end_end_the_connection() {
    let folder = data_folder();
    let server = server(folder.path(), &[]);
    // Literal fields that are not indexed, so that each costs memory; and empty frames.
    let field = [&[0x00, 1, b'x', 100][..], &[b'y'; 100]].concat().repeat(100);
    for payload in [field, Vec::new()] {
        let begin = frame(HEADERS, 0, 1, &probe());
        ends(&server, &begin, |_| frame(CONTINUATION, 0, 1, &payload).repeat(50));
        server.get("/livez").await.expect(200);
    }
}

#[test]
fn streams_beyond_the_limit_of_a_connection_are_refused() {
    let folder = data_folder();
    let server = server(folder.path(), &[("SIGHTFIX_LIMITS__STREAMS_PER_CONNECTION", "2")]);
    let mut stream = connect(&server);
    let settings = receive(&mut stream).expect("its settings come first");
    assert_eq!(settings.kind, SETTINGS);
    let announced = settings.payload.chunks(6).find_map(|entry| {
        let id = u16::from_be_bytes([entry[0], entry[1]]);
        (id == MAX_CONCURRENT_STREAMS).then(|| u32::from_be_bytes(entry[2..6].try_into().expect("4 bytes")))
    });
    assert_eq!(announced, Some(2));
    // Open requests, whose bodies do not come.
    for id in [1, 3, 5] {
        stream.write_all(&frame(HEADERS, END_HEADERS, id, &creation())).expect("the server reads");
    }
    let reset = std::iter::from_fn(|| receive(&mut stream)).find(|frame| frame.kind == RST_STREAM);
    let reset = reset.expect("one stream is refused");
    assert_eq!((reset.stream, reset.payload), (5, REFUSED_STREAM.to_be_bytes().to_vec()));
}
