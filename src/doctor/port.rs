//! Check that the port is free, or that a server answers on it.

use std::io::{self, Read as _, Write as _};
use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr, TcpListener, TcpStream};
use std::time::Duration;

use super::Check;
use crate::config::Config;

const TIMEOUT: Duration = Duration::from_secs(2);
/// First bytes of the answer of a server that is alive.
const ALIVE: &str = "HTTP/1.1 200";

pub(super) async fn check(config: &Config) -> Check {
    let address = config.listen;
    let checked = tokio::task::spawn_blocking(move || check_blocking(address)).await;
    checked
        .unwrap_or_else(|error| Check::failed("port", format!("cannot be checked: {error}"), "report this"))
}

fn check_blocking(address: SocketAddr) -> Check {
    const NAME: &str = "port";
    match TcpListener::bind(address) {
        Ok(_) => Check::ok(NAME, format!("{address} is free")),
        Err(error) if error.kind() == io::ErrorKind::AddrInUse => match request_liveness(address) {
            Ok(answer) if answer.starts_with(ALIVE) => {
                Check::ok(NAME, format!("a server answers on {address}"))
            }
            _ => Check::failed(
                NAME,
                format!("{address} is in use by a program that does not answer as a server"),
                "stop that program (`ss -ltnp` names it), or choose another port with --listen",
            ),
        },
        Err(error) => Check::failed(
            NAME,
            format!("{address} cannot be listened on: {error}"),
            "choose an address of this machine, and a port above 1023 or the capability CAP_NET_BIND_SERVICE",
        ),
    }
}

/// The address by which this machine reaches a server of its own that listens on another one.
#[must_use]
pub fn reachable(mut address: SocketAddr) -> SocketAddr {
    if address.ip().is_unspecified() {
        address.set_ip(match address.ip() {
            IpAddr::V4(_) => Ipv4Addr::LOCALHOST.into(),
            IpAddr::V6(_) => Ipv6Addr::LOCALHOST.into(),
        });
    }
    address
}

/// Asks a server for `/livez`; the first bytes of its answer, which for one that is alive begin with
/// `HTTP/1.1 200`.
///
/// # Errors
/// Nobody answers within two seconds.
pub fn request_liveness(address: SocketAddr) -> io::Result<String> {
    let mut stream = TcpStream::connect_timeout(&reachable(address), TIMEOUT)?;
    stream.set_read_timeout(Some(TIMEOUT))?;
    stream.write_all(b"GET /livez HTTP/1.1\r\nhost: localhost\r\nconnection: close\r\n\r\n")?;
    let mut first = [0; 15];
    stream.read_exact(&mut first)?;
    Ok(String::from_utf8_lossy(&first).into_owned())
}
