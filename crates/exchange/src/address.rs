//! Addresses of connections: what is reached, and how.

use std::borrow::Cow;

use crate::domain::{Error, Result, check_text};

/// Longest address, bytes.
const MAX_ADDRESS_BYTES: usize = 512;

/// The part of an address before the host.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[expect(missing_docs, reason = "each is the scheme of its name")]
pub enum Scheme {
    Mqtt,
    Mqtts,
    Tcp,
    Tls,
    TcpListen,
    Udp,
    Gpsd,
    Rtsp,
    Rtsps,
    Push,
    Http,
    Https,
    Nats,
    Kafka,
    Kafkas,
    Serial,
    File,
}

impl Scheme {
    pub(super) const SOURCES: &[Self] = &[
        Self::Mqtt,
        Self::Mqtts,
        Self::Kafka,
        Self::Kafkas,
        Self::Tcp,
        Self::Tls,
        Self::TcpListen,
        Self::Udp,
        Self::Serial,
        Self::Gpsd,
        Self::Rtsp,
        Self::Rtsps,
        Self::Push,
    ];
    pub(super) const SINKS: &[Self] = &[
        Self::Mqtt,
        Self::Mqtts,
        Self::Kafka,
        Self::Kafkas,
        Self::Nats,
        Self::Tcp,
        Self::Tls,
        Self::Udp,
        Self::Http,
        Self::Https,
        Self::File,
    ];
    /// The schemes that are complete without an address.
    const BARE: [Self; 2] = [Self::Push, Self::File];
    /// Kinds whose messages have topics that are subscribed to.
    const SUBSCRIBED: [Self; 4] = [Self::Mqtt, Self::Mqtts, Self::Kafka, Self::Kafkas];

    const fn as_str(self) -> &'static str {
        match self {
            Self::Mqtt => "mqtt",
            Self::Mqtts => "mqtts",
            Self::Tcp => "tcp",
            Self::Tls => "tls",
            Self::TcpListen => "tcp-listen",
            Self::Udp => "udp",
            Self::Gpsd => "gpsd",
            Self::Rtsp => "rtsp",
            Self::Rtsps => "rtsps",
            Self::Push => "push",
            Self::Http => "http",
            Self::Https => "https",
            Self::Nats => "nats",
            Self::Kafka => "kafka",
            Self::Kafkas => "kafkas",
            Self::Serial => "serial",
            Self::File => "file",
        }
    }

    const fn default_port(self) -> Option<u16> {
        match self {
            Self::Mqtt => Some(1883),
            Self::Mqtts => Some(8883),
            Self::Gpsd => Some(2947),
            Self::Rtsp => Some(554),
            Self::Rtsps => Some(322),
            Self::Http => Some(80),
            Self::Https => Some(443),
            Self::Nats => Some(4222),
            Self::Kafka => Some(9092),
            Self::Kafkas => Some(9093),
            Self::Tcp | Self::Tls | Self::TcpListen | Self::Udp | Self::Push | Self::Serial | Self::File => {
                None
            }
        }
    }

    /// True if a source of this kind subscribes to topics.
    pub(super) fn subscribes(self) -> bool {
        Self::SUBSCRIBED.contains(&self)
    }

    /// True if it is MQTT, plain or encrypted.
    pub(super) const fn is_mqtt(self) -> bool {
        matches!(self, Self::Mqtt | Self::Mqtts)
    }

    /// True if it is RTSP, plain or encrypted.
    pub(super) const fn is_rtsp(self) -> bool {
        matches!(self, Self::Rtsp | Self::Rtsps)
    }

    /// True if an address of this kind goes on after the port.
    const fn has_path(self) -> bool {
        self.is_rtsp() || matches!(self, Self::Http | Self::Https)
    }

    /// True if it is Kafka, plain or encrypted.
    pub(super) const fn is_kafka(self) -> bool {
        matches!(self, Self::Kafka | Self::Kafkas)
    }
}

/// Where a peer is.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Address {
    /// How it is reached.
    pub scheme: Scheme,
    /// Name or address of its machine; without the brackets of IPv6.
    pub host: String,
    /// The port of that host.
    pub port: u16,
    /// Further machines of a cluster of Kafka, each with its port.
    pub others: Vec<(String, u16)>,
    /// Path and query, from `/` on, of a webhook, an RTSP stream or a serial device.
    pub path: String,
}

/// A host as it stands before a port: IPv6 in brackets.
#[must_use]
pub fn bracketed(host: &str) -> Cow<'_, str> {
    if host.contains(':') { Cow::Owned(format!("[{host}]")) } else { Cow::Borrowed(host) }
}

impl Address {
    /// Reads an address of HTTP or HTTPS.
    ///
    /// # Errors
    /// `InvalidArgument` naming `address`.
    pub fn of_http(text: &str) -> Result<Self> {
        Self::parse(text, &[Scheme::Http, Scheme::Https])
    }

    /// Reads an address of one of these schemes.
    ///
    /// # Errors
    /// `InvalidArgument` naming `address`.
    pub(super) fn parse(text: &str, schemes: &[Scheme]) -> Result<Self> {
        let invalid = |message: String| Error::invalid("address", message);
        check_text("address", text, MAX_ADDRESS_BYTES)?;
        let mut bare = Scheme::BARE.into_iter().filter(|scheme| schemes.contains(scheme));
        if let Some(scheme) = bare.find(|scheme| text == format!("{}:", scheme.as_str())) {
            return Ok(Self::without_host(scheme, String::new()));
        }
        let named = text.split_once("://").and_then(|(name, rest)| {
            Some((
                schemes.iter().copied().find(|it| it.as_str() == name && !Scheme::BARE.contains(it))?,
                rest,
            ))
        });
        let Some((scheme, rest)) = named else {
            let known: Vec<String> = schemes.iter().map(|it| format!("{}:", it.as_str())).collect();
            return Err(invalid(format!("must begin with one of {}", known.join(", "))));
        };
        if scheme == Scheme::Serial {
            let address = Self::without_host(scheme, rest.to_owned());
            return address.serial_line().map(|_| address);
        }
        let (authority, path) = rest.split_at(rest.find('/').unwrap_or(rest.len()));
        if authority.contains('@') {
            return Err(invalid("must not contain a user; give username and the secret password".to_owned()));
        }
        if !scheme.has_path() && !matches!(path, "" | "/") {
            return Err(invalid("must end after the port".to_owned()));
        }
        if path.contains(|it: char| it.is_whitespace() || !it.is_ascii()) {
            return Err(invalid("must be ASCII without spaces".to_owned()));
        }
        let mut hosts = authority.split(',').map(|authority| host_and_port(authority, scheme));
        let (host, port) = hosts.next().ok_or_else(|| invalid("has no host".to_owned()))??;
        let others = hosts.collect::<Result<Vec<_>>>()?;
        if !others.is_empty() && !scheme.is_kafka() {
            return Err(invalid("may name several hosts for Kafka alone".to_owned()));
        }
        let path = if path.is_empty() { "/".to_owned() } else { path.to_owned() };
        Ok(Self { scheme, host, port, others, path })
    }

    const fn without_host(scheme: Scheme, path: String) -> Self {
        Self { scheme, host: String::new(), port: 0, others: Vec::new(), path }
    }

    /// The serial device of an address such as `serial:///dev/ttyUSB0?baud=4800`.
    ///
    /// # Errors
    /// `InvalidArgument` naming `address`.
    pub fn serial_line(&self) -> Result<SerialLine> {
        let invalid = |message: &str| Error::invalid("address", message);
        let (path, query) =
            self.path.split_once('?').map_or((self.path.as_str(), None), |(path, query)| (path, Some(query)));
        let is_device = path.strip_prefix("/dev/").is_some_and(|rest| {
            !rest.is_empty() && rest.split('/').all(|part| !matches!(part, "" | "." | ".."))
        });
        if !is_device || path.contains(char::is_control) {
            return Err(invalid("must name a device below /dev/, such as serial:///dev/ttyUSB0?baud=4800"));
        }
        let baud = match query {
            None => Some(SerialLine::NMEA_BAUD),
            Some(query) => query.strip_prefix("baud=").and_then(|baud| baud.parse().ok()),
        };
        let baud = baud.filter(|baud| SerialLine::BAUDS.contains(baud));
        let baud = baud.ok_or_else(|| {
            let known: Vec<String> = SerialLine::BAUDS.iter().map(u32::to_string).collect();
            invalid(&format!("must end after the device, or with ?baud= and one of {}", known.join(", ")))
        })?;
        Ok(SerialLine { path: path.into(), baud })
    }
}

/// A host without the brackets of IPv6, and its port or that of the scheme.
fn host_and_port(authority: &str, scheme: Scheme) -> Result<(String, u16)> {
    let invalid = |message: &str| Error::invalid("address", message);
    let (host, port) = match authority.rsplit_once(':') {
        Some((host, port)) if !port.ends_with(']') => {
            let port = port.parse().ok().filter(|port| *port > 0);
            (host, Some(port.ok_or_else(|| invalid("has no port from 1 to 65535"))?))
        }
        _ => (authority, None),
    };
    let host = host.strip_prefix('[').and_then(|host| host.strip_suffix(']')).unwrap_or(host);
    let is_host = |byte: u8| byte.is_ascii_alphanumeric() || b".-_:".contains(&byte);
    if host.is_empty() || !host.bytes().all(is_host) {
        return Err(invalid("has no host"));
    }
    let port = port.or(scheme.default_port());
    Ok((host.to_owned(), port.ok_or_else(|| invalid("must name a port, as in HOST:PORT"))?))
}

/// A serial device with the speed of its line.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SerialLine {
    /// Its path, below `/dev/`.
    pub path: std::path::PathBuf,
    /// Bits per second.
    pub baud: u32,
}

impl SerialLine {
    /// Speed of NMEA 0183; AIS receivers have 38400.
    const NMEA_BAUD: u32 = 4_800;
    const BAUDS: [u32; 9] = [4_800, 9_600, 19_200, 38_400, 57_600, 115_200, 230_400, 460_800, 921_600];
}
