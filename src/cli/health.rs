//! `sightfix health`

use std::io::{Read as _, Write as _};
use std::net::{IpAddr, Ipv4Addr, SocketAddr, TcpStream};
use std::path::Path;
use std::time::Duration;

use anyhow::Context as _;
use clap::Args;

use super::output::print_line;
use crate::config::{Config, Overrides};

const TIMEOUT: Duration = Duration::from_secs(2);

/// Check whether the server of these settings is alive; for the health check of a container
#[derive(Args)]
pub(super) struct Health {
    /// Address of the server
    #[arg(long, value_name = "ADDR")]
    listen: Option<SocketAddr>,
}

impl Health {
    pub(super) fn run(self, file: Option<&Path>) -> anyhow::Result<()> {
        let settings = Config::load(file, Overrides { listen: self.listen, ..Overrides::default() })?;
        let mut address = settings.listen;
        if address.ip().is_unspecified() {
            address.set_ip(IpAddr::V4(Ipv4Addr::LOCALHOST));
        }
        let answer = request_liveness(address).with_context(|| format!("no answer from {address}"))?;
        anyhow::ensure!(answer.starts_with("HTTP/1.1 200"), "{address} answered {answer:?}");
        print_line(&format_args!("{address} is alive"))?;
        Ok(())
    }
}

fn request_liveness(address: SocketAddr) -> std::io::Result<String> {
    let mut stream = TcpStream::connect_timeout(&address, TIMEOUT)?;
    stream.set_read_timeout(Some(TIMEOUT))?;
    stream.write_all(b"GET /livez HTTP/1.1\r\nhost: localhost\r\nconnection: close\r\n\r\n")?;
    let mut first = [0; 15];
    stream.read_exact(&mut first)?;
    Ok(String::from_utf8_lossy(&first).into_owned())
}
