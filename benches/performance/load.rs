//! A load of HTTP/1.1 requests over loopback, by a client that costs as little as can be.

use std::net::SocketAddr;
use std::time::Instant;

use tokio::io::{AsyncRead, AsyncReadExt as _, AsyncWrite, AsyncWriteExt as _};
use tokio::net::TcpStream;

/// Connections that send at the same time.
pub(crate) const CONNECTIONS: usize = 16;

/// A request as it goes over the wire.
pub(crate) fn post(path: &str, content_type: &str, body: &str) -> Vec<u8> {
    request(path, "", content_type, body)
}

/// The same with a key.
pub(crate) fn post_as(key: &str, path: &str, content_type: &str, body: &str) -> Vec<u8> {
    request(path, &format!("authorization: Bearer {key}\r\n"), content_type, body)
}

fn request(path: &str, headers: &str, content_type: &str, body: &str) -> Vec<u8> {
    format!(
        "POST {path} HTTP/1.1\r\nhost: localhost\r\n{headers}content-type: {content_type}\r\ncontent-length: {}\r\n\r\n{body}",
        body.len()
    )
    .into_bytes()
}

/// Sends the request `each` times on every connection, one after the other; gives requests per
/// second over all, and the time of each in seconds.
pub(crate) async fn send(address: SocketAddr, request: &[u8], each: usize) -> (f64, Vec<f64>) {
    let connect = move || async move {
        let stream = TcpStream::connect(address).await.expect("the server listens");
        stream.set_nodelay(true).expect("a TCP stream");
        stream
    };
    send_over(connect, request, each).await
}

/// The same over connections that a function opens.
pub(crate) async fn send_over<S, C>(connect: impl Fn() -> C, request: &[u8], each: usize) -> (f64, Vec<f64>)
where
    S: AsyncRead + AsyncWrite + Unpin + Send,
    C: Future<Output = S> + Send + 'static,
{
    let began = Instant::now();
    let mut clients = tokio::task::JoinSet::new();
    for _ in 0..CONNECTIONS {
        let (request, connecting) = (request.to_vec(), connect());
        clients.spawn(async move {
            let mut stream = connecting.await;
            let mut answer = Vec::with_capacity(1 << 16);
            let mut times = Vec::with_capacity(each);
            for _ in 0..each {
                let sent = Instant::now();
                stream.write_all(&request).await.expect("the server reads");
                stream.flush().await.expect("the server reads");
                read_answer(&mut stream, &mut answer).await;
                times.push(sent.elapsed().as_secs_f64());
            }
            times
        });
    }
    let times = clients.join_all().await.concat();
    ((CONNECTIONS * each) as f64 / began.elapsed().as_secs_f64(), times)
}

/// Reads one answer; gives where its body begins.
async fn read_answer(stream: &mut (impl AsyncRead + Unpin), answer: &mut Vec<u8>) -> usize {
    answer.clear();
    loop {
        assert_ne!(stream.read_buf(answer).await.expect("the server answers"), 0, "the server closed");
        let Some(head) = answer.windows(4).position(|four| four == b"\r\n\r\n") else { continue };
        assert!(answer.starts_with(b"HTTP/1.1 200"), "{}", String::from_utf8_lossy(answer));
        let text = std::str::from_utf8(&answer[..head]).expect("a head of text");
        let length = text
            .lines()
            .find_map(|line| {
                line.split_once(": ").filter(|(name, _)| name.eq_ignore_ascii_case("content-length"))
            })
            .map(|(_, length)| length.parse::<usize>().expect("a number"))
            .expect("a content length");
        while answer.len() < head + 4 + length {
            assert_ne!(stream.read_buf(answer).await.expect("the server answers"), 0, "the server closed");
        }
        return head + 4;
    }
}

/// Sends one request and gives the body of its answer.
pub(crate) async fn one(address: SocketAddr, request: &[u8]) -> Vec<u8> {
    let mut stream = TcpStream::connect(address).await.expect("the server listens");
    stream.write_all(request).await.expect("the server reads");
    let mut answer = Vec::new();
    let body = read_answer(&mut stream, &mut answer).await;
    answer.split_off(body)
}
