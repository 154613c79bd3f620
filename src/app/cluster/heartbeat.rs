//! The periodic work of a node: it renews its registration, ends the registrations of silent nodes, releases unused
//! leases, and hands over at its end.

use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

use super::Nodes;
use super::history::DatabaseHistory;
use super::membership::Membership;
use super::registration::Registration;
use super::watches::Watched;
use crate::config::NodeRole;
use crate::domain::{Error, ErrorKind, NodeId, Result};
use crate::shutdown::Shutdown;
use crate::store::Renewed;

/// Renewals per lease.
const RENEWALS: u32 = 4;
/// How long a camera without streams and observations keeps its owner: as long as its tracks last.
const UNUSED_TIME: Duration = Duration::from_secs(60);
/// How often a node that shuts down looks whether it can give up more.
const DRAIN_PAUSE: Duration = Duration::from_millis(50);
const LEAST_PAUSE: Duration = Duration::from_millis(10);

impl Nodes<'_> {
    /// Keeps this node registered and its ownerships up to date until the server shuts down, then hands over what it
    /// owns as soon as nobody uses it here. A server that shares its database with no other has nothing to do.
    pub async fn keep_registered(self, shutdown: Shutdown) {
        let Some(membership) = self.membership() else { return };
        tokio::select! {
            // Renewals never wait for what else is to be done.
            ((), ()) = async { tokio::join!(renew_on(self, membership), tend_on(self, membership)) } => {}
            () = hand_over(membership, &shutdown) => {}
        }
        let registration = membership.registration.load_full();
        registration.invalidate();
        if let Err(error) = membership.leases.end(registration.id).await {
            tracing::warn!(%error, "the registration of this node will end by its lease");
        }
    }
}

async fn renew_on(nodes: Nodes<'_>, membership: &Membership) {
    let interval = membership.profile.lease / RENEWALS;
    loop {
        let renewed = tokio::time::timeout(membership.profile.lease / 2, renew(nodes, membership)).await;
        let now = nodes.clock.monotonic();
        let pause = match renewed.unwrap_or_else(|_| Err(no_answer())) {
            Ok(()) => membership.next_silence().map_or(interval, |at| at.saturating_sub(now).min(interval)),
            Err(error) => {
                tracing::warn!(%error, "the registration of this node could not be renewed");
                interval / RENEWALS
            }
        };
        tokio::select! {
            () = tokio::time::sleep(pause.max(LEAST_PAUSE)) => {}
            () = membership.drain_begun.notified() => {}
        }
    }
}

/// One renewal; a node that was not heard of for too long registers again and owns nothing.
async fn renew(nodes: Nodes<'_>, membership: &Membership) -> Result<()> {
    let sent_at = nodes.clock.monotonic();
    let registration = membership.registration.load_full();
    if !registration.is_valid(sent_at) {
        membership.lose(nodes);
        return register_again(nodes, membership, &registration).await;
    }
    let is_draining = membership.is_draining.load(Ordering::Acquire);
    let renewed = membership.leases.renew(registration.id, random(nodes), is_draining).await?;
    let Some(Renewed { nodes: registered, keys, mark }) = renewed else {
        membership.lose(nodes);
        return register_again(nodes, membership, &registration).await;
    };
    if membership.history.observe(nodes, mark) {
        // Acquisitions may be among what was lost, and others have made them again.
        membership.lose(nodes);
        membership.is_outdated.notify_one();
        return register_again(nodes, membership, &registration).await;
    }
    registration.extend(membership.valid_until(sent_at));
    if !nodes.access.confirm(&keys, sent_at) {
        membership.has_other_keys.store(true, Ordering::Release);
        membership.is_outdated.notify_one();
    }
    nodes.metrics.nodes(registered.len());
    let silent = membership.observe(registered, registration.id, nodes.clock.monotonic());
    for (id, renewal) in silent {
        if membership.leases.end_unrenewed(id, renewal).await? {
            tracing::warn!(node = %id, "a node has ended without releasing its cameras: they are free");
        }
    }
    Ok(())
}

async fn register_again(nodes: Nodes<'_>, membership: &Membership, before: &Registration) -> Result<()> {
    membership.leases.end(before.id).await?;
    let sent_at = nodes.clock.monotonic();
    let id = NodeId(nodes.randomness.uuid_v7(nodes.clock.now()));
    let mark = membership.leases.register(id, &membership.profile, random(nodes)).await?;
    if membership.history.observe(nodes, mark) {
        membership.is_outdated.notify_one();
    }
    membership.registration.store(Arc::new(Registration::new(id, membership.valid_until(sent_at))));
    tracing::info!(node = %id, "this node is registered again");
    Ok(())
}

/// Reads what has changed, gives up what is not used any more, and ends readers whose camera or site another node owns.
async fn tend_on(nodes: Nodes<'_>, membership: &Membership) {
    loop {
        tokio::select! {
            () = tokio::time::sleep(membership.profile.lease / RENEWALS) => {}
            () = membership.is_outdated.notified() => {}
        }
        let now = nodes.clock.monotonic();
        membership.give_up(|lease, is_used| {
            let camera = nodes.registry.get(&lease.camera).filter(|camera| camera.key == lease.key);
            // A camera that goes to another site goes to the node of that site.
            let has_left = camera.is_none_or(|camera| camera.site != lease.site);
            has_left || (!is_used && lease.unused_for(now) >= UNUSED_TIME)
        });
        nodes.metrics.owned_cameras(membership.owned());
        let tended = async {
            catch_up(nodes, membership).await?;
            give_up_wanted(membership).await?;
            membership.release().await?;
            end_watches(membership).await
        };
        if let Err(error) = tended.await {
            tracing::warn!(%error, "cannot look for changed keys and for cameras that other nodes own");
        }
    }
}

/// Reads what a renewal found to be outdated.
async fn catch_up(nodes: Nodes<'_>, membership: &Membership) -> Result<()> {
    let (breaks, is_broken) =
        (membership.history.breaks(), membership.history.state() == DatabaseHistory::Reading);
    if membership.has_other_keys.swap(false, Ordering::AcqRel) || is_broken {
        nodes.access.refresh(nodes.store, nodes.clock).await?;
    }
    if is_broken {
        // A process that only works on jobs reads a camera when it needs it.
        if membership.profile.role != NodeRole::Train.as_str() {
            nodes.refresh_registries().await?;
        }
        membership.history.has_read_after(breaks);
        tracing::info!("everything was read again from the database");
    }
    Ok(())
}

/// Gives up the cameras that sources of other nodes feed; who streams to them goes there.
async fn give_up_wanted(membership: &Membership) -> Result<()> {
    let wanted = membership.leases.wanted_by_others(membership.registration.load().id).await?;
    if !wanted.is_empty() {
        membership.give_up(|lease, _| wanted.contains(&lease.key));
    }
    Ok(())
}

async fn end_watches(membership: &Membership) -> Result<()> {
    let (cameras, sites) = membership.watches.watched();
    if cameras.is_empty() && sites.is_empty() {
        return Ok(());
    }
    let own = membership.registration.load().id;
    let (cameras, sites) = membership.leases.owned_by_others(own, &cameras, &sites).await?;
    cameras.into_iter().map(Watched::Camera).for_each(|watched| membership.watches.end(watched));
    sites.into_iter().map(Watched::Site).for_each(|watched| membership.watches.end(watched));
    Ok(())
}

/// Once the drain has started: releases each camera once its last stream has been settled. Returns when nothing is
/// left, or no time.
async fn hand_over(membership: &Membership, shutdown: &Shutdown) {
    shutdown.draining().await;
    membership.begin_drain();
    loop {
        membership.give_up(|_, is_used| !is_used);
        let cameras = membership.release().await;
        let connections = membership.release_connections(|_| true).await;
        if cameras.and(connections).is_ok() && membership.owned() == 0 && !membership.holds_connections() {
            return;
        }
        tokio::select! {
            () = membership.let_go.notified() => {}
            () = tokio::time::sleep(DRAIN_PAUSE) => {}
            () = shutdown.forced() => return,
        }
    }
}

fn no_answer() -> Error {
    Error::refused(ErrorKind::Overloaded, "the database did not answer in time")
}

pub(super) fn random(nodes: Nodes<'_>) -> i64 {
    let mut number = [0; 8];
    nodes.randomness.fill(&mut number);
    i64::from_le_bytes(number)
}
