//! Admission control: how much of each bounded resource all clients together, and one client, may hold at
//! a time, and how many requests per second one client may send.
//!
//! Does not wait. A request beyond a quota is refused at once and may be tried again.

// Input of clients reaches this module: nothing in it may end the process.
#![warn(clippy::expect_used, clippy::panic, clippy::unreachable)]

mod rates;

use std::collections::HashMap;
use std::net::{IpAddr, Ipv4Addr, Ipv6Addr};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use crate::config::Limits;
use crate::domain::{Error, ErrorKind, KeyId, Result};

pub use rates::{RateLimit, RefusedBodies, TokenBucket};

/// Memory of a request while it is open, besides its body: connection buffers and its task. Charged
/// to [`Quotas::request_memory`].
const REQUEST_OVERHEAD_BYTES: u64 = 16 << 10;
/// Sign-ins that wait for the OpenID provider at a time.
const WAITING_SIGN_INS: usize = 16;

/// A client as limits count it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum ClientId {
    /// The holder of a key, from whatever address.
    Key(KeyId),
    /// Without a key, an IPv4 address, or the first 64 bits of an IPv6 address, of which one host commonly
    /// has all the rest.
    Address(IpAddr),
}

impl ClientId {
    /// Stands for requests that came over no connection.
    pub const UNKNOWN: Self = Self::Address(IpAddr::V4(Ipv4Addr::UNSPECIFIED));
}

impl From<IpAddr> for ClientId {
    fn from(address: IpAddr) -> Self {
        match address.to_canonical() {
            IpAddr::V6(address) => {
                let prefix = address.to_bits() & !u128::from(u64::MAX);
                Self::Address(IpAddr::V6(Ipv6Addr::from_bits(prefix)))
            }
            address @ IpAddr::V4(_) => Self::Address(address),
        }
    }
}

/// The class of a request, which decides the quotas that it needs before it is handled.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RequestClass {
    /// Health and metrics: always answered.
    Probe,
    /// Positions from observations: may also use the places reserved for them.
    Fusion,
    /// A file that is spooled before it is worked on.
    Import,
    /// Samples that are worked on while they are received.
    ImportStream,
    /// A live stream, which has quotas and timeouts of its own.
    LiveStream,
    /// Everything else.
    Other,
}

/// A resource of which all clients together and one client may hold so much at a time. Clones share it.
#[derive(Clone)]
pub struct Quota(Arc<QuotaState>);

struct QuotaState {
    /// The name of the counted unit, in the plural, for the refusal.
    what: &'static str,
    total: u64,
    per_client: u64,
    held: Mutex<Held>,
}

#[derive(Default)]
struct Held {
    total: u64,
    by_client: HashMap<ClientId, u64>,
}

impl Quota {
    /// A quota of `total`, of which one client may hold `client_share` (0 to 1), but at least 1.
    #[must_use]
    pub fn new(what: &'static str, total: usize, client_share: f64) -> Self {
        let total = total as u64;
        let per_client = ((total as f64 * client_share).ceil() as u64).clamp(1, total.max(1));
        Self(Arc::new(QuotaState { what, total, per_client, held: Mutex::default() }))
    }

    /// Takes an amount, which is given back when the lease is dropped.
    ///
    /// # Errors
    /// `Overloaded`, naming the limit that is reached.
    pub fn try_acquire(&self, client: ClientId, amount: u64) -> Result<Lease> {
        let mut lease = Lease { quota: self.clone(), client, amount: 0 };
        lease.try_grow(amount)?;
        Ok(lease)
    }

    fn usage(&self) -> QuotaUsage {
        QuotaUsage { held: self.lock().total, limit: self.0.total }
    }

    fn lock(&self) -> MutexGuard<'_, Held> {
        self.0.held.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn exceeded(&self, limit: u64, holder: &str) -> Error {
        let what = self.0.what;
        Error::refused(
            ErrorKind::Overloaded,
            format!("{holder} has reached its limit of {limit} {what}; try again in a second"),
        )
    }
}

/// How much of a [`Quota`] all clients hold.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct QuotaUsage {
    /// Units held now.
    pub held: u64,
    /// The largest number of units.
    pub limit: u64,
}

/// The share of a [`Quota`] that one holder has.
pub struct Lease {
    quota: Quota,
    client: ClientId,
    amount: u64,
}

impl Lease {
    /// Takes more.
    ///
    /// # Errors
    /// `Overloaded`, naming the limit that is reached; the lease stays as it was.
    pub fn try_grow(&mut self, amount: u64) -> Result<()> {
        let QuotaState { total, per_client, .. } = *self.quota.0;
        let mut held = self.quota.lock();
        if held.total + amount > total {
            return Err(self.quota.exceeded(total, "the server"));
        }
        let of_client = held.by_client.entry(self.client).or_default();
        if *of_client + amount > per_client {
            if *of_client == 0 {
                held.by_client.remove(&self.client);
            }
            return Err(self.quota.exceeded(per_client, "this client"));
        }
        *of_client += amount;
        held.total += amount;
        self.amount += amount;
        Ok(())
    }

    /// Gives all of it back.
    pub fn clear(&mut self) {
        if self.amount == 0 {
            return;
        }
        let mut held = self.quota.lock();
        held.total -= self.amount;
        if let Some(of_client) = held.by_client.get_mut(&self.client) {
            *of_client -= self.amount;
            if *of_client == 0 {
                held.by_client.remove(&self.client);
            }
        }
        self.amount = 0;
    }
}

impl Drop for Lease {
    fn drop(&mut self) {
        self.clear();
    }
}

/// The quotas of a server.
pub struct Quotas {
    /// Bodies that were refused, by client.
    pub refused_bodies: RefusedBodies,
    /// Requests per second of one client.
    pub request_rate: RateLimit,
    /// Requests per second of one address without a credential that works.
    pub anonymous_rate: RateLimit,
    /// Requests that are worked on, but for the reserved places.
    requests: Quota,
    /// Places that only fusions take.
    reserved_requests: Quota,
    import_streams: Quota,
    /// Bytes of requests under way, their bodies included.
    request_memory: Quota,
    /// Bytes of imports in memory until they are worked on.
    pub import_memory: Quota,
    /// Bytes of imports in temporary files.
    pub import_disk: Quota,
    /// Open live streams.
    pub live_streams: Quota,
    /// Open event streams, server-sent events and watched runs alike.
    pub event_streams: Quota,
    /// Sign-ins that wait for the OpenID provider.
    pub sign_ins: Quota,
}

impl Quotas {
    /// The quotas that the limits describe.
    #[must_use]
    pub fn new(limits: &Limits) -> Self {
        let quota = |what, total| Quota::new(what, total, limits.client_share);
        Self {
            refused_bodies: RefusedBodies::new(limits.refused_bytes_per_s),
            request_rate: RateLimit::new("requests", limits.requests_per_s),
            anonymous_rate: RateLimit::new("requests without a key", limits.anonymous_requests_per_s),
            requests: quota("requests at work", limits.requests.saturating_sub(limits.reserved_requests)),
            reserved_requests: quota("requests at work", limits.reserved_requests),
            import_streams: quota("import streams", limits.import_streams),
            request_memory: quota("bytes of requests under way", limits.request_memory_bytes),
            import_memory: quota("bytes of imports in memory", limits.spool_memory_bytes),
            import_disk: quota("bytes of imports in temporary files", limits.spool_disk_bytes),
            live_streams: quota("live streams", limits.live_streams),
            event_streams: quota("event streams", limits.event_streams),
            sign_ins: quota("sign-ins that wait for the provider", WAITING_SIGN_INS),
        }
    }

    /// Number of quotas.
    pub const COUNT: usize = 8;
    /// Their names in the metrics, in the order of [`Quotas::usages`].
    pub const NAMES: [&str; Self::COUNT] = [
        "requests",
        "reserved_requests",
        "import_streams",
        "request_memory_bytes",
        "import_memory_bytes",
        "import_disk_bytes",
        "live_streams",
        "event_streams",
    ];

    /// How much of each is held.
    #[must_use]
    pub fn usages(&self) -> [QuotaUsage; Self::COUNT] {
        [
            &self.requests,
            &self.reserved_requests,
            &self.import_streams,
            &self.request_memory,
            &self.import_memory,
            &self.import_disk,
            &self.live_streams,
            &self.event_streams,
        ]
        .map(Quota::usage)
    }

    /// Memory for a request that begins; grows with its body.
    ///
    /// # Errors
    /// `Overloaded`.
    pub fn open_request(&self, client: ClientId) -> Result<Lease> {
        self.request_memory.try_acquire(client, REQUEST_OVERHEAD_BYTES)
    }

    /// Memory for a message of that many bytes once it is decoded, besides the bytes of the request's body.
    ///
    /// # Errors
    /// `Overloaded`.
    pub fn decoded_memory(&self, client: ClientId, bytes: u64) -> Result<Lease> {
        self.request_memory.try_acquire(client, bytes)
    }

    /// The place of a request that begins to be worked on; `None` where the class needs none.
    ///
    /// # Errors
    /// `Overloaded`.
    pub fn begin_work(&self, class: RequestClass, client: ClientId) -> Result<Option<Lease>> {
        match class {
            RequestClass::Probe | RequestClass::LiveStream => Ok(None),
            RequestClass::ImportStream => self.import_streams.try_acquire(client, 1).map(Some),
            RequestClass::Import | RequestClass::Other => self.requests.try_acquire(client, 1).map(Some),
            RequestClass::Fusion => {
                let place = self.requests.try_acquire(client, 1);
                place.or_else(|_| self.reserved_requests.try_acquire(client, 1)).map(Some)
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn client(last: u8) -> ClientId {
        IpAddr::from([127, 0, 0, last]).into()
    }

    #[test]
    fn neither_all_clients_nor_one_get_more_than_their_limit() {
        let quota = Quota::new("things", 4, 0.5);
        let first = quota.try_acquire(client(1), 2).expect("half is free");
        let refused = quota.try_acquire(client(1), 1).err().expect("the client's share is used up");
        assert_eq!(refused.kind(), ErrorKind::Overloaded);
        assert!(refused.to_string().contains("this client"), "{refused}");
        let mut second = quota.try_acquire(client(2), 1).expect("another client");
        second.try_grow(1).expect("up to its share");
        assert!(quota.try_acquire(client(3), 1).is_err(), "all is used up");
        drop(first);
        quota.try_acquire(client(1), 2).expect("it was given back");
    }

    #[test]
    fn what_is_given_back_leaves_no_trace() {
        let quota = Quota::new("things", 4, 1.0);
        let mut lease = quota.try_acquire(client(1), 3).expect("free");
        assert!(lease.try_grow(2).is_err());
        lease.clear();
        lease.try_grow(4).expect("all is free again");
        drop(lease);
        let held = quota.lock();
        assert_eq!((held.total, held.by_client.len()), (0, 0));
    }

    #[test]
    fn fusions_find_a_place_when_others_do_not() {
        let limits = Limits { requests: 2, reserved_requests: 1, client_share: 1.0, ..Limits::default() };
        let quotas = Quotas::new(&limits);
        let _busy = quotas.begin_work(RequestClass::Other, client(1)).expect("the one place");
        assert!(quotas.begin_work(RequestClass::Import, client(2)).is_err());
        let _fusion = quotas.begin_work(RequestClass::Fusion, client(2)).expect("the reserved place");
        assert!(quotas.begin_work(RequestClass::Fusion, client(2)).is_err());
        assert!(quotas.begin_work(RequestClass::Probe, client(2)).expect("always").is_none());
    }

    #[test]
    fn one_host_is_one_client() {
        let of = |text: &str| ClientId::from(text.parse::<IpAddr>().expect("an address"));
        assert_eq!(of("::ffff:192.0.2.1"), of("192.0.2.1"));
        assert_eq!(of("2001:db8::1"), of("2001:db8::2:3:4:5"));
        assert_ne!(of("2001:db8::1"), of("2001:db8:0:1::1"));
    }
}
