//! This process as one of the nodes of a database: its registration, the cameras that it owns, the nodes beside it.

use std::collections::HashMap;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use arc_swap::ArcSwap;
use tokio::sync::Notify;

use super::Nodes;
use super::camera_lease::{CameraLease, HeldLease, between_nodes, camera_text};
use super::connection_lease::HeldConnection;
use super::history::HistoryWatch;
use super::registration::Registration;
use super::watches::{Watched, Watches};
use crate::app::live::sync::lock;
use crate::app::registry::ActiveCamera;
use crate::config::NodeRole;
use crate::domain::{CameraKey, ConnectionKey, Error, Node, NodeId, NodeProfile, Result, SiteId};
use crate::store::{Acquired, HistoryMark, NodeLeases};

/// Acquisitions of one camera follow one another; those of others share these locks.
const ACQUISITION_LOCKS: usize = 64;

pub(super) struct Membership {
    pub(super) leases: NodeLeases,
    pub(super) profile: NodeProfile,
    pub(super) registration: ArcSwap<Registration>,
    pub(super) history: HistoryWatch,
    /// A renewal found other keys than those in memory.
    pub(super) has_other_keys: AtomicBool,
    /// Notified when something of the database is to be read at once.
    pub(super) is_outdated: Notify,
    pub(super) is_draining: AtomicBool,
    /// Notified when the drain begins, which the others are to hear at once.
    pub(super) drain_begun: Notify,
    /// Notified when something that held a lease is gone.
    pub(super) let_go: Notify,
    pub(super) watches: Watches,
    /// Connections that this node runs.
    pub(super) connections: Mutex<HashMap<ConnectionKey, Arc<HeldConnection>>>,
    held: Mutex<HashMap<CameraKey, Arc<HeldLease>>>,
    /// Given up here, but not yet in the database.
    unreleased: Mutex<Vec<(CameraKey, i64)>>,
    others: Mutex<HashMap<NodeId, ObservedNode>>,
    acquiring: [tokio::sync::Mutex<()>; ACQUISITION_LOCKS],
}

/// Another node, and since when its renewal has been the same.
pub(super) struct ObservedNode {
    pub(super) node: Node,
    pub(super) same_since: Duration,
}

impl Membership {
    pub(super) fn new(
        leases: NodeLeases,
        profile: NodeProfile,
        registration: Registration,
        mark: HistoryMark,
    ) -> Self {
        Self {
            leases,
            profile,
            registration: ArcSwap::from_pointee(registration),
            history: HistoryWatch::new(mark),
            has_other_keys: AtomicBool::new(false),
            is_outdated: Notify::new(),
            is_draining: AtomicBool::new(false),
            drain_begun: Notify::new(),
            let_go: Notify::new(),
            watches: Watches::default(),
            connections: Mutex::default(),
            held: Mutex::default(),
            unreleased: Mutex::default(),
            others: Mutex::default(),
            acquiring: std::array::from_fn(|_| tokio::sync::Mutex::default()),
        }
    }

    /// From now on cameras are given up, and none is acquired.
    pub(super) fn begin_drain(&self) {
        self.is_draining.store(true, Ordering::Release);
        self.drain_begun.notify_one();
    }

    /// How long a renewal that was sent at some instant makes the registration valid: shorter than the lease, after
    /// which others end it, by a quarter. That is the time for an answer under way to leave, and for monotonic clocks
    /// of different rates.
    pub(super) fn valid_until(&self, sent_at: Duration) -> Duration {
        sent_at + self.profile.lease * 3 / 4
    }

    /// The lease of a camera, acquired now if nobody has it.
    ///
    /// # Errors
    /// `CameraOnOtherNode`, `CameraBetweenNodes`, `CameraNotFound`; `Overloaded` where the database does not answer.
    pub(super) async fn own(&self, nodes: Nodes<'_>, camera: &ActiveCamera) -> Result<CameraLease> {
        if let Some(lease) = self.held(camera.key, nodes.clock.monotonic()) {
            return Ok(lease);
        }
        let _acquiring =
            self.acquiring[camera.key.0.cast_unsigned() as usize % ACQUISITION_LOCKS].lock().await;
        let now = nodes.clock.monotonic();
        if let Some(lease) = self.held(camera.key, now) {
            return Ok(lease);
        }
        let registration = self.registration.load_full();
        if !registration.is_valid(now) || self.is_draining.load(Ordering::Acquire) {
            return Err(between_nodes(&camera_text(&camera.id)));
        }
        match self.leases.acquire(camera.key, registration.id).await? {
            Acquired::Owned { fence, is_takeover } => {
                if is_takeover {
                    nodes.metrics.camera_taken_over();
                }
                if nodes.registry.begin_tenure(&camera.id, camera.key, fence).await {
                    self.clear_site(nodes, camera).await?;
                }
                Ok(self.hold(HeldLease::new(camera, fence, registration, now)))
            }
            Acquired::OtherNode(other) => {
                Err(self.elsewhere(&camera_text(&camera.id), other, nodes.clock.monotonic()))
            }
            Acquired::NotRegistered => Err(between_nodes(&camera_text(&camera.id))),
        }
    }

    /// Clears the live state of what other nodes have owned since this one did: of a camera or of all of a site, and
    /// that of the site.
    ///
    /// # Errors
    /// The database does not answer.
    pub(super) async fn clear_former(&self, nodes: Nodes<'_>, read: Watched) -> Result<()> {
        let fences = match read {
            Watched::Camera(key) => self.leases.latest_fences(Some(key), None).await?,
            Watched::Site(key) => self.leases.latest_fences(None, Some(key)).await?,
        };
        for (key, fence) in fences {
            if let Some(camera) = nodes.registry.clear_before(key, fence).await {
                self.clear_site(nodes, &camera).await?;
            }
        }
        Ok(())
    }

    /// Clears the live state of the site of a camera whose own was cleared.
    async fn clear_site(&self, nodes: Nodes<'_>, camera: &ActiveCamera) -> Result<()> {
        match camera.site.as_ref().filter(|site| !self.holds_camera_of(site)) {
            Some(site) => nodes.site_registry.reset(nodes.store, site).await,
            None => Ok(()),
        }
    }

    /// True if this node surely owns a camera; does not count as a use of its lease.
    pub(super) fn holds(&self, key: CameraKey, now: Duration) -> bool {
        lock(&self.held).get(&key).is_some_and(|lease| lease.is_valid(now))
    }

    /// The lease of a camera that this node surely owns.
    pub(super) fn held(&self, key: CameraKey, now: Duration) -> Option<CameraLease> {
        let held = lock(&self.held);
        let lease = held.get(&key).filter(|lease| lease.is_valid(now))?;
        lease.touch(now);
        Some(CameraLease(Some(lease.clone())))
    }

    fn hold(&self, lease: HeldLease) -> CameraLease {
        let lease = Arc::new(lease);
        if let Some(before) = lock(&self.held).insert(lease.key, lease.clone()) {
            before.ended.cancel();
        }
        CameraLease(Some(lease))
    }

    fn holds_camera_of(&self, site: &SiteId) -> bool {
        lock(&self.held).values().any(|lease| lease.site.as_ref() == Some(site))
    }

    /// Cameras that this node owns.
    pub(super) fn owned(&self) -> usize {
        lock(&self.held).len()
    }

    /// Gives up the leases of which this is true, given whether anything but this node itself holds them.
    pub(super) fn give_up(&self, is_over: impl Fn(&HeldLease, bool) -> bool) {
        let mut held = lock(&self.held);
        let over: Vec<_> = held
            .extract_if(|_, lease| is_over(lease, Arc::strong_count(lease) > 1))
            .map(|(_, lease)| lease)
            .collect();
        drop(held);
        over.iter().for_each(|lease| lease.ended.cancel());
        let id = self.registration.load().id;
        let of_now = over.iter().filter(|lease| lease.registration.id == id);
        lock(&self.unreleased).extend(of_now.map(|lease| (lease.key, lease.fence)));
    }

    /// Stores what was given up.
    ///
    /// # Errors
    /// The database does not answer; it is tried again with the next call.
    pub(super) async fn release(&self) -> Result<()> {
        let released = std::mem::take(&mut *lock(&self.unreleased));
        if released.is_empty() {
            return Ok(());
        }
        let id = self.registration.load().id;
        let stored = self.leases.release(id, &released).await;
        if stored.is_err() {
            lock(&self.unreleased).extend(released);
        }
        stored
    }

    /// Ends everything that this node owned, and what reads it: another one may own it from now on.
    pub(super) fn lose(&self, nodes: Nodes<'_>) {
        if !self.registration.load().invalidate() {
            return;
        }
        let lost = std::mem::take(&mut *lock(&self.held));
        lock(&self.unreleased).clear();
        lost.values().for_each(|lease| lease.ended.cancel());
        lock(&self.connections).drain().for_each(|(_, lease)| lease.ended.cancel());
        self.watches.end_all();
        tracing::warn!(
            cameras = lost.len(),
            "this node has lost its registration: its live streams end here"
        );
        nodes.metrics.node_registration_lost();
    }

    /// Takes the nodes as they were just read; those of which nothing was heard for their lease.
    pub(super) fn observe(&self, nodes: Vec<Node>, own: NodeId, now: Duration) -> Vec<(NodeId, i64)> {
        let mut others = lock(&self.others);
        let mut before = std::mem::take(&mut *others);
        for node in nodes.into_iter().filter(|node| node.id != own) {
            let known = before.remove(&node.id).filter(|known| known.node.renewal == node.renewal);
            let same_since = known.map_or(now, |known| known.same_since);
            others.insert(node.id, ObservedNode { node, same_since });
        }
        let silent = others.values().filter(|other| other.is_silent_for(other.node.profile.lease, now));
        silent.map(|other| (other.node.id, other.node.renewal)).collect()
    }

    /// When the first of the other nodes will have been silent for its lease.
    pub(super) fn next_silence(&self) -> Option<Duration> {
        lock(&self.others).values().map(|other| other.same_since + other.node.profile.lease).min()
    }

    /// Nodes that answer clients and go on doing so, this one among them.
    pub(super) fn serving_nodes(&self) -> usize {
        let is_serving = |other: &&ObservedNode| {
            !other.node.is_draining && other.node.profile.role != NodeRole::Train.as_str()
        };
        1 + lock(&self.others).values().filter(is_serving).count()
    }

    /// The refusal for a camera or site that another node owns. It has that node's address, unless the node seems to be
    /// gone or is shutting down.
    pub(super) fn elsewhere(&self, owned: &str, owner: NodeId, now: Duration) -> Error {
        let others = lock(&self.others);
        let reachable = others.get(&owner).filter(|other| {
            !other.node.is_draining && !other.is_silent_for(other.node.profile.lease / 2, now)
        });
        match reachable.and_then(|other| other.node.profile.url.as_ref()) {
            Some(url) => Error::on_other_node(format!("{owned} is live on the node at {url}"), url.as_str()),
            None => between_nodes(owned),
        }
    }
}

impl ObservedNode {
    fn is_silent_for(&self, time: Duration, now: Duration) -> bool {
        now.saturating_sub(self.same_since) >= time
    }
}
