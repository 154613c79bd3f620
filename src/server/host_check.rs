//! Check that a request was meant for this server, and by whom: `Host` and `Origin`.
//!
//! A web page can make its visitor's browser send requests to a server that only the visitor reaches:
//! directly (`Origin` gives it away), or through a name of its own that it points at the server's
//! address (DNS rebinding; `Host` gives it away). Clients that are no browsers send no `Origin`.

use std::net::{IpAddr, SocketAddr};

use hyper::header::{HOST, HeaderName, ORIGIN};
use hyper::{Method, Request, Version};

use crate::domain::{Error, ErrorKind, Result};

/// The hosts that a server answers for.
pub(super) struct HostCheck {
    configured: Vec<String>,
    /// Origins whose pages may ask for changes, with a key.
    origins: Vec<String>,
    accepts_all: bool,
    /// Only this machine reaches the server.
    is_loopback: bool,
}

impl HostCheck {
    /// From the settings `allowed_hosts` and `cors_origins`, and the address that the server listens on.
    pub(super) fn new(allowed_hosts: &[String], cors_origins: &[String], listen: SocketAddr) -> Self {
        Self {
            configured: allowed_hosts.to_vec(),
            origins: cors_origins.to_vec(),
            accepts_all: allowed_hosts.iter().any(|host| host == "*"),
            is_loopback: listen.ip().is_loopback(),
        }
    }

    /// # Errors
    /// `MalformedBody` without one host, `HostNotAllowed`, `OriginNotAllowed`.
    pub(super) fn check<B>(&self, request: &Request<B>) -> Result<()> {
        let host = self.host(request)?;
        if !matches!(*request.method(), Method::GET | Method::HEAD | Method::OPTIONS) {
            self.check_origin(request, host)?;
        }
        Ok(())
    }

    /// Checks that a request that a browser's cookie vouches for comes from a page of this server, if it is
    /// to change anything: `allowed_hosts = *` does not extend to cookies.
    ///
    /// # Errors
    /// `OriginNotAllowed`.
    pub(super) fn check_same_origin<B>(&self, request: &Request<B>) -> Result<()> {
        if matches!(*request.method(), Method::GET | Method::HEAD | Method::OPTIONS) {
            return Ok(());
        }
        let origin = only_value(request, &ORIGIN)?.and_then(|origin| origin.split_once("://"));
        let host = self.host(request)?;
        let is_own = |origin: &str| {
            host.is_some_and(|host| origin.eq_ignore_ascii_case(host)) || self.is_configured(origin)
        };
        if origin.is_some_and(|(_, origin)| is_own(origin)) {
            return Ok(());
        }
        let message = "changes with a session's cookie must come from a page of this server itself";
        Err(Error::field(ErrorKind::OriginNotAllowed, "origin", message))
    }

    /// The host that the request names, where it may.
    fn host<'r, B>(&self, request: &'r Request<B>) -> Result<Option<&'r str>> {
        let header = only_value(request, &HOST)?;
        let authority = request.uri().authority().map(hyper::http::uri::Authority::as_str);
        if header.is_none() && authority.is_none() && request.version() == Version::HTTP_11 {
            return Err(Error::field(ErrorKind::MalformedBody, "host", "the header is required"));
        }
        for host in [authority, header].into_iter().flatten() {
            if !self.allows_host(host) {
                let shown: String = host.chars().take(80).collect();
                let message = format!(
                    "the server does not answer for `{shown}`; add the name to the setting allowed_hosts"
                );
                return Err(Error::field(ErrorKind::HostNotAllowed, "host", message));
            }
        }
        Ok(authority.or(header))
    }

    fn allows_host(&self, host: &str) -> bool {
        if self.accepts_all || self.is_configured(host) {
            return true;
        }
        let name = without_port(host).trim_end_matches('.');
        let address = name.trim_start_matches('[').trim_end_matches(']').parse::<IpAddr>();
        match address {
            Ok(address) => !self.is_loopback || address.is_loopback(),
            // A name that somebody else can point here has a dot: it is one of the public DNS.
            Err(_) => name.eq_ignore_ascii_case("localhost") || !self.is_loopback && !name.contains('.'),
        }
    }

    fn is_configured(&self, host: &str) -> bool {
        let is_host = |allowed: &String| {
            allowed.eq_ignore_ascii_case(host) || allowed.eq_ignore_ascii_case(without_port(host))
        };
        self.configured.iter().any(is_host)
    }

    fn check_origin<B>(&self, request: &Request<B>, host: Option<&str>) -> Result<()> {
        let Some(origin) = only_value(request, &ORIGIN)? else { return Ok(()) };
        let authority = origin.split_once("://").map(|(_, authority)| authority);
        let is_own = authority.is_some_and(|authority| {
            host.is_some_and(|host| authority.eq_ignore_ascii_case(host)) || self.is_configured(authority)
        });
        if is_own || self.accepts_all || self.origins.iter().any(|allowed| allowed == origin) {
            return Ok(());
        }
        let shown: String = origin.chars().take(80).collect();
        let message = format!(
            "pages of `{shown}` may not ask for changes; add it to the setting cors_origins, or its host to allowed_hosts, if they may"
        );
        Err(Error::field(ErrorKind::OriginNotAllowed, "origin", message))
    }
}

fn only_value<'r, B>(request: &'r Request<B>, name: &HeaderName) -> Result<Option<&'r str>> {
    let mut values = request.headers().get_all(name).iter();
    let Some(value) = values.next() else { return Ok(None) };
    match value.to_str() {
        Ok(text) if values.next().is_none() => Ok(Some(text)),
        _ => Err(Error::field(ErrorKind::MalformedBody, name.as_str(), "the header must have one value")),
    }
}

fn without_port(host: &str) -> &str {
    match host.rsplit_once(':') {
        // The colons of an IPv6 address are within brackets.
        Some((name, port)) if port.bytes().all(|digit| digit.is_ascii_digit()) && !name.ends_with(':') => {
            name
        }
        _ => host,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn check(listen: &str, allowed: &[&str]) -> HostCheck {
        let allowed: Vec<String> = allowed.iter().map(|&host| host.to_owned()).collect();
        HostCheck::new(&allowed, &[], listen.parse().expect("an address"))
    }

    #[test]
    fn a_loopback_server_answers_for_this_machine_alone() {
        let check = check("127.0.0.1:8080", &["Sight.example.org"]);
        for host in ["localhost", "LOCALHOST:8080", "127.0.0.1:9000", "[::1]:8080", "localhost."] {
            assert!(check.allows_host(host), "{host}");
        }
        for host in ["sight.example.org", "sight.example.org:443"] {
            assert!(check.allows_host(host), "{host}");
        }
        for host in ["evil.example", "192.0.2.1:8080", "camera-server", "localhost.evil.example", "", ":80"] {
            assert!(!check.allows_host(host), "{host}");
        }
    }

    #[test]
    fn a_server_on_the_network_answers_for_addresses_and_local_names() {
        let check = check("0.0.0.0:8080", &["sight.example.org:8443"]);
        for host in ["192.0.2.1:8080", "[2001:db8::1]:8080", "2001:db8::1", "sightfix:8080", "localhost"] {
            assert!(check.allows_host(host), "{host}");
        }
        assert!(check.allows_host("sight.example.org:8443"));
        for host in ["sight.example.org", "evil.example:8080", "127.0.0.1.evil.example"] {
            assert!(!check.allows_host(host), "{host}");
        }
    }

    #[test]
    fn pages_of_other_origins_may_not_change_anything() {
        let allowed = ["sight.example.org"];
        let post = |origin: &str| {
            let request = Request::post("/").header(HOST, "localhost:8080").header(ORIGIN, origin);
            check("127.0.0.1:8080", &allowed).check(&request.body(()).expect("a request"))
        };
        assert!(post("http://localhost:8080").is_ok());
        assert!(post("https://sight.example.org").is_ok());
        for origin in ["http://localhost:3000", "http://evil.example", "null", "http://127.0.0.1:8080"] {
            let error = post(origin).expect_err(origin);
            assert_eq!(error.kind(), ErrorKind::OriginNotAllowed);
        }
    }
}
