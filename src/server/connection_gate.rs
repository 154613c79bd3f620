//! Which addresses may open connections: a limited number per second, and none for a while after a flood.
//!
//! A client that is refused would connect again at once, which costs this machine more than the refusal. So refused
//! connections are held open for a while and nothing is read of them, as far as there are places; the others are closed.

use std::collections::HashMap;
use std::net::IpAddr;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use tokio::net::TcpStream;
use tokio::time::Instant;

use super::proxies::TrustedProxies;
use crate::admission::{ClientId, Quota, RateLimit};
use crate::config::Limits;
use crate::shutdown::Shutdown;

/// Refused connections that are held at a time. What a client sends meanwhile stays in the kernel's buffers.
const HELD_CONNECTIONS: usize = 256;
/// Share of these that one address may have.
const HELD_SHARE: f64 = 1.0 / 16.0;
/// Time for which a connection beyond the rate is held.
const RATE_HOLD_TIME: Duration = Duration::from_secs(1);
/// Addresses that are refused at a time; of more, the one whose time is over next is served again.
const MAX_PENALTIES: usize = 4_096;

/// Bounds how often an address connects.
pub(super) struct ConnectionGate {
    rate: RateLimit,
    penalty: Duration,
    /// Until when addresses are refused.
    penalties: Mutex<HashMap<ClientId, Instant>>,
    held: Quota,
    /// All clients behind a proxy have its address, so it is exempt.
    proxies: TrustedProxies,
}

impl ConnectionGate {
    pub(super) fn new(limits: &Limits, proxies: TrustedProxies) -> Arc<Self> {
        Arc::new(Self {
            rate: RateLimit::new("connections", limits.connections_per_s),
            penalty: Duration::from_secs(limits.flood_penalty_s),
            penalties: Mutex::default(),
            held: Quota::new("held connections", HELD_CONNECTIONS, HELD_SHARE),
            proxies,
        })
    }

    /// Decides about a new connection; until when it is refused, if it is.
    pub(super) fn refused_until(&self, address: IpAddr, now: Instant) -> Option<Instant> {
        if self.proxies.trusts(address.to_canonical()) {
            return None;
        }
        let client = ClientId::from(address);
        let penalty = self.penalties.lock().unwrap_or_else(PoisonError::into_inner).get(&client).copied();
        penalty.filter(|until| *until > now).or_else(|| {
            let is_beyond_rate = self.rate.count(client, now).is_err();
            is_beyond_rate.then(|| now + RATE_HOLD_TIME)
        })
    }

    /// An address has flooded a connection.
    pub(super) fn flooded(&self, address: IpAddr, now: Instant) {
        if self.penalty.is_zero() || self.proxies.trusts(address) {
            return;
        }
        let mut penalties = self.penalties.lock().unwrap_or_else(PoisonError::into_inner);
        if penalties.len() >= MAX_PENALTIES {
            penalties.retain(|_, until| *until > now);
        }
        if penalties.len() >= MAX_PENALTIES {
            let next = penalties.iter().min_by_key(|(_, until)| **until).map(|(client, _)| *client);
            next.and_then(|next| penalties.remove(&next));
        }
        penalties.insert(ClientId::from(address), now + self.penalty);
    }

    /// Keeps a refused connection from being opened again at once, if there is a place.
    pub(super) fn hold(&self, stream: TcpStream, client: ClientId, until: Instant, shutdown: &Shutdown) {
        let Ok(place) = self.held.try_acquire(client, 1) else { return };
        let ended = shutdown.clone();
        shutdown.spawn(async move {
            tokio::select! {
                () = tokio::time::sleep_until(until) => {}
                () = ended.draining() => {}
            }
            drop((stream, place));
        });
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn gate(limits: &Limits) -> Arc<ConnectionGate> {
        let proxies = TrustedProxies::new(&["10.0.0.0/8".to_owned()]).expect("a network");
        ConnectionGate::new(limits, proxies)
    }

    fn address(text: &str) -> IpAddr {
        text.parse().expect("an address")
    }

    #[test]
    fn an_address_connects_so_often_and_others_as_before() {
        let gate = gate(&Limits { connections_per_s: 3, ..Limits::default() });
        let now = Instant::now();
        let served = |text, now| (0..9).filter(|_| gate.refused_until(address(text), now).is_none()).count();
        assert_eq!(served("192.0.2.1", now), 3);
        assert_eq!(served("192.0.2.2", now), 3);
        assert_eq!(served("::ffff:10.1.2.3", now), 9, "a trusted proxy");
        assert_eq!(served("192.0.2.1", now + RATE_HOLD_TIME), 3, "a second later");
    }

    #[test]
    fn a_flood_is_followed_by_refusals_of_its_address_alone() {
        let gate = gate(&Limits { flood_penalty_s: 10, ..Limits::default() });
        let now = Instant::now();
        gate.flooded(address("192.0.2.1"), now);
        gate.flooded(address("10.1.2.3"), now);
        let is_served = |text, now| gate.refused_until(address(text), now).is_none();
        assert!(!is_served("192.0.2.1", now + Duration::from_secs(9)));
        assert!(is_served("192.0.2.2", now) && is_served("10.1.2.3", now));
        assert!(is_served("192.0.2.1", now + Duration::from_secs(10)));
    }

    #[test]
    fn penalties_are_bounded() {
        let gate = gate(&Limits::default());
        let now = Instant::now();
        for number in 0..2 * MAX_PENALTIES as u32 {
            gate.flooded(IpAddr::from((0xC000_0000 + number).to_be_bytes()), now);
        }
        assert_eq!(gate.penalties.lock().expect("no panic").len(), MAX_PENALTIES);
    }
}
