//! Who sends a request that comes through a proxy.

use std::borrow::Cow;
use std::net::{IpAddr, Ipv6Addr, SocketAddr};
use std::str::FromStr;

use anyhow::Context as _;
use hyper::HeaderMap;
use hyper::header::HeaderName;

use super::peer::Peer;

/// Addresses of the client and of the proxies that passed its request on, in this order.
pub(super) const X_FORWARDED_FOR: HeaderName = HeaderName::from_static("x-forwarded-for");
/// The scheme by which the first proxy got the request.
pub(super) const X_FORWARDED_PROTO: HeaderName = HeaderName::from_static("x-forwarded-proto");

/// The proxies whose statement of the client's address is used.
#[derive(Clone, Default)]
pub(super) struct TrustedProxies(Vec<Network>);

impl TrustedProxies {
    /// From the setting `trusted_proxies`.
    ///
    /// # Errors
    /// Names the entry that is no address and no network.
    pub(super) fn new(networks: &[String]) -> anyhow::Result<Self> {
        let parse = |text: &String| {
            text.parse().with_context(|| {
                format!("the setting trusted_proxies: `{text}` is no address and no network like 10.0.0.0/8")
            })
        };
        networks.iter().map(parse).collect::<anyhow::Result<_>>().map(Self)
    }

    /// The sender of a request, and whether the proxy got it over TLS: of the addresses that `X-Forwarded-For` names, the last that is not a trusted
    /// proxy's. Anybody can write the entries before it.
    pub(super) fn original<'p>(&self, peer: &'p Peer, headers: &HeaderMap) -> Cow<'p, Peer> {
        if !self.trusts(peer.address) {
            return Cow::Borrowed(peer);
        }
        let mut address = peer.address;
        let values = headers.get_all(X_FORWARDED_FOR).iter().filter_map(|value| value.to_str().ok());
        let entries: Vec<&str> = values.flat_map(|value| value.split(',')).collect();
        for entry in entries.into_iter().rev() {
            let Some(before) = address_of(entry.trim()) else { break };
            address = before;
            if !self.trusts(address) {
                break;
            }
        }
        let is_tls = headers.get(X_FORWARDED_PROTO).map_or(peer.is_tls, |scheme| scheme == "https");
        Cow::Owned(Peer { address, is_tls, ..peer.clone() })
    }

    /// True if an address, in its canonical form, is a trusted proxy's.
    pub(super) fn trusts(&self, address: IpAddr) -> bool {
        self.0.iter().any(|network| network.contains(address))
    }
}

/// An entry is an address, by some proxies with a port.
fn address_of(entry: &str) -> Option<IpAddr> {
    let address = entry.parse().ok();
    let address = address.or_else(|| entry.parse::<SocketAddr>().ok().map(|address| address.ip()));
    address.map(|address| address.to_canonical())
}

/// Addresses that begin with the same bits.
#[derive(Clone)]
struct Network {
    first: Ipv6Addr,
    /// Length of the prefix in the 128 bits of an IPv6 address, to which IPv4 addresses are mapped.
    prefix_bits: u32,
}

impl Network {
    fn contains(&self, address: IpAddr) -> bool {
        let difference = mapped(address).to_bits() ^ self.first.to_bits();
        difference.leading_zeros() >= self.prefix_bits
    }
}

fn mapped(address: IpAddr) -> Ipv6Addr {
    match address {
        IpAddr::V4(address) => address.to_ipv6_mapped(),
        IpAddr::V6(address) => address,
    }
}

impl FromStr for Network {
    type Err = anyhow::Error;

    fn from_str(text: &str) -> anyhow::Result<Self> {
        let (address, prefix) =
            text.split_once('/').map_or((text, None), |(address, prefix)| (address, Some(prefix)));
        let address: IpAddr = address.parse()?;
        let bits = if address.is_ipv4() { 32 } else { 128 };
        let prefix = prefix.map_or(Ok(bits), str::parse::<u32>)?;
        anyhow::ensure!(prefix <= bits, "the prefix is longer than the address");
        Ok(Self { first: mapped(address), prefix_bits: 128 - bits + prefix })
    }
}

#[cfg(test)]
mod tests {
    use hyper::http::HeaderValue;

    use super::*;

    /// The sender of a request from an address with these headers, where two networks are trusted.
    fn sender(from: &str, forwarded: &[&str]) -> String {
        let proxies = ["10.0.0.0/8".to_owned(), "fd00::1".to_owned()];
        let proxies = TrustedProxies::new(&proxies).expect("networks");
        let address: IpAddr = from.parse().expect("an address");
        let peer = Peer { address, certificate: None, is_tls: false, refusal: None };
        let mut headers = HeaderMap::new();
        for value in forwarded {
            headers.append(X_FORWARDED_FOR, HeaderValue::from_str(value).expect("a header"));
        }
        proxies.original(&peer, &headers).address.to_string()
    }

    #[test]
    fn the_header_is_read_of_trusted_proxies_only() {
        assert_eq!(sender("192.0.2.1", &["198.51.100.7"]), "192.0.2.1", "no trusted proxy");
        assert_eq!(sender("10.1.2.3", &["198.51.100.7"]), "198.51.100.7");
        assert_eq!(
            sender("10.1.2.3", &["203.0.113.9, 198.51.100.7"]),
            "198.51.100.7",
            "the first is made up"
        );
        assert_eq!(sender("fd00::1", &["198.51.100.7:4711, 10.9.9.9"]), "198.51.100.7", "two proxies");
        assert_eq!(sender("10.1.2.3", &["203.0.113.9", "2001:db8::5"]), "2001:db8::5");
        assert_eq!(sender("10.1.2.3", &[]), "10.1.2.3");
        assert_eq!(sender("10.1.2.3", &["unknown"]), "10.1.2.3");
        assert_eq!(sender("::ffff:10.1.2.3", &["198.51.100.7"]), "198.51.100.7");
    }

    #[test]
    fn what_is_no_network_is_refused() {
        for text in ["", "10.0.0.0/33", "host", "10.0.0.0/x", "::/129"] {
            let refused = TrustedProxies::new(&[text.to_owned()]).err().expect(text);
            assert!(format!("{refused:#}").contains("trusted_proxies"), "{refused:#}");
        }
    }
}
