//! What a client may leave half done.

use std::io::{Read as _, Write as _};
use std::net::TcpStream;
use std::time::Duration;

use crate::harness::{TestServer, data_folder};

/// Far beyond the server's own limit: a read that takes as long was never answered.
const PATIENCE: Duration = Duration::from_secs(30);

fn left_half_done(sent: &[u8]) {
    let folder = data_folder();
    let server = TestServer::start_with(folder.path(), &[("SIGHTFIX_LIMITS__HEADER_S", "1")]);
    let mut stream = TcpStream::connect(server.address).expect("the server listens");
    stream.set_read_timeout(Some(PATIENCE)).expect("a timeout");
    stream.write_all(sent).expect("the server reads");
    let mut answer = Vec::new();
    // The server closes, with or without a word; a read that times out is an error.
    match stream.read_to_end(&mut answer) {
        Ok(_) => {}
        Err(error) => assert_eq!(error.kind(), std::io::ErrorKind::ConnectionReset, "{error}"),
    }
    assert!(!answer.starts_with(b"HTTP/1.1 200"), "{}", String::from_utf8_lossy(&answer));
}

#[test]
fn a_silent_connection_is_closed() {
    left_half_done(b"");
}

#[test]
fn half_a_header_is_closed() {
    left_half_done(b"GET /livez HTTP/1.1\r\nhost: localhost\r\nx-more: ");
}

#[test]
fn half_a_preface_is_closed() {
    left_half_done(b"PRI * HTTP");
}

#[test]
fn half_a_body_is_answered_or_closed() {
    let folder = data_folder();
    let server = TestServer::start_with(folder.path(), &[("SIGHTFIX_LIMITS__IDLE_S", "1")]);
    let mut stream = TcpStream::connect(server.address).expect("the server listens");
    stream.set_read_timeout(Some(PATIENCE)).expect("a timeout");
    stream
        .write_all(
            b"POST /v1/cameras HTTP/1.1\r\nhost: localhost\r\ncontent-type: application/json\r\n\
              content-length: 100\r\n\r\n{\"id\":",
        )
        .expect("the server reads");
    let mut first = [0; 12];
    stream.read_exact(&mut first).expect("an answer");
    assert!(first.starts_with(b"HTTP/1.1 4"), "{}", String::from_utf8_lossy(&first));
}
