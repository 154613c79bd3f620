//! Addresses of connections: what is reached, and how.

use std::borrow::Cow;

use crate::domain::{Error, Result, check_text};

/// Longest address, bytes.
const MAX_ADDRESS_BYTES: usize = 512;

/// The part of an address before the host, and what follows it.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Scheme {
    name: &'static str,
    form: Form,
    is_encrypted: bool,
}

/// The text after the name of a scheme.
#[derive(Debug, Clone, Copy)]
enum Form {
    /// Nothing.
    Bare,
    /// The path of a device.
    Device,
    /// A host with its port, or the default one.
    Host { default_port: Option<u16>, rest: Rest },
}

/// The text after a host and its port.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Rest {
    Nothing,
    Path,
    Hosts,
}

impl Scheme {
    /// A scheme that is a complete address.
    pub(crate) const fn bare(name: &'static str) -> Self {
        Self { name, form: Form::Bare, is_encrypted: false }
    }

    /// The scheme of a device of this machine.
    pub(crate) const fn device(name: &'static str) -> Self {
        Self { name, form: Form::Device, is_encrypted: false }
    }

    /// A scheme of `HOST:PORT`, where the port may be left out if there is a default.
    pub(crate) const fn host(name: &'static str, default_port: Option<u16>) -> Self {
        Self { name, form: Form::Host { default_port, rest: Rest::Nothing }, is_encrypted: false }
    }

    /// A scheme of `HOST[:PORT]/PATH`.
    pub(crate) const fn url(name: &'static str, default_port: u16) -> Self {
        let form = Form::Host { default_port: Some(default_port), rest: Rest::Path };
        Self { name, form, is_encrypted: false }
    }

    /// A scheme of several `HOST[:PORT]` with commas between them.
    pub(crate) const fn hosts(name: &'static str, default_port: u16) -> Self {
        let form = Form::Host { default_port: Some(default_port), rest: Rest::Hosts };
        Self { name, form, is_encrypted: false }
    }

    /// The same with TLS.
    pub(crate) const fn encrypted(self) -> Self {
        Self { is_encrypted: true, ..self }
    }

    /// The text after its name, if an address has this scheme.
    fn rest_of<'a>(&self, text: &'a str) -> Option<&'a str> {
        let rest = text.strip_prefix(self.name)?.strip_prefix(':')?;
        match self.form {
            Form::Bare => rest.is_empty().then_some(rest),
            Form::Device | Form::Host { .. } => rest.strip_prefix("//"),
        }
    }
}

/// Where a peer is.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Address {
    /// How it is reached: the part before the colon.
    pub scheme: &'static str,
    /// True if the scheme is one with TLS.
    pub is_encrypted: bool,
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
    /// Reads an address by one of these schemes; with the value that belongs to it.
    ///
    /// # Errors
    /// `InvalidArgument` naming `address`.
    pub(crate) fn parse<T: Copy>(text: &str, kinds: &[(&'static [Scheme], T)]) -> Result<(Self, T)> {
        check_text("address", text, MAX_ADDRESS_BYTES)?;
        let mut schemes = kinds.iter().flat_map(|(schemes, kind)| schemes.iter().map(move |it| (it, *kind)));
        let found = schemes.find_map(|(scheme, kind)| Some((scheme, scheme.rest_of(text)?, kind)));
        let Some((scheme, rest, kind)) = found else {
            let schemes = kinds.iter().flat_map(|(schemes, _)| schemes.iter());
            let known: Vec<String> = schemes.map(|it| format!("{}:", it.name)).collect();
            return Err(invalid(&format!("must begin with one of {}", known.join(", "))));
        };
        Ok((Self::after_scheme(*scheme, rest)?, kind))
    }

    fn after_scheme(scheme: Scheme, text: &str) -> Result<Self> {
        let Scheme { name, form, is_encrypted } = scheme;
        let Form::Host { default_port, rest } = form else {
            let (host, path, others) = (String::new(), text.to_owned(), Vec::new());
            return Ok(Self { scheme: name, is_encrypted, host, port: 0, others, path });
        };
        let (authority, path) = text.split_at(text.find('/').unwrap_or(text.len()));
        if authority.contains('@') {
            return Err(invalid("must not contain a user; give username and the secret password"));
        }
        if rest != Rest::Path && !matches!(path, "" | "/") {
            return Err(invalid("must end after the port"));
        }
        if path.contains(|it: char| it.is_whitespace() || !it.is_ascii()) {
            return Err(invalid("must be ASCII without spaces"));
        }
        let mut hosts = authority.split(',').map(|authority| host_and_port(authority, default_port));
        let (host, port) = hosts.next().ok_or_else(|| invalid("has no host"))??;
        let others = hosts.collect::<Result<Vec<_>>>()?;
        if !others.is_empty() && rest != Rest::Hosts {
            return Err(invalid("may name several hosts for Kafka alone"));
        }
        let path = if path.is_empty() { "/".to_owned() } else { path.to_owned() };
        Ok(Self { scheme: name, is_encrypted, host, port, others, path })
    }
}

/// The refusal of an address.
pub(crate) fn invalid(message: &str) -> Error {
    Error::invalid("address", message)
}

/// A host without the brackets of IPv6, and its port or the default one.
fn host_and_port(authority: &str, default_port: Option<u16>) -> Result<(String, u16)> {
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
    let port = port.or(default_port);
    Ok((host.to_owned(), port.ok_or_else(|| invalid("must name a port, as in HOST:PORT"))?))
}
