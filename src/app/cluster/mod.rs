//! Which process has the live state of a camera.
//!
//! Tracks, pairing and the watch for moved cameras are in memory, so those of one camera, and of all cameras of one site,
//! are on one node at a time: the owner. A node is registered in the database and renews its registration; it owns
//! cameras as long as it is registered, so a renewal is one row however many cameras there are. Nobody has to be asked
//! whether the node still owns a camera: it knows by its own clock until when nobody can have ended its registration.
//! A server on a data folder owns everything. Connections with other systems have owners by the same rule.
//!
//! Samples need no fence: they are stored under the key of camera, target and time, so what two owners in turn, or a client
//! that sends again, bring twice is stored once.

mod camera_lease;
mod connection_lease;
mod connections;
mod heartbeat;
mod history;
mod membership;
mod registration;
mod watches;

use std::sync::{Arc, OnceLock};
use std::time::Duration;

use self::camera_lease::{between_nodes, camera_text};
use self::membership::Membership;
use self::registration::Registration;
use self::watches::Watched;
use super::App;
use super::access::Access;
use super::active_cameras::ActiveCameras;
use super::registry::{ActiveCamera, Registry};
use super::site_registry::SiteRegistry;
use crate::clock::{Clock, Randomness};
use crate::config::{Config, NodeRole};
use crate::domain::{CameraId, Error, Node, NodeId, NodeProfile, Result, SiteId, SiteKey};
use crate::store::Store;
use crate::telemetry::Metrics;

pub use camera_lease::CameraLease;
pub use connection_lease::ConnectionLease;
pub use history::DatabaseHistory;
pub use watches::Watch;

/// This process among those with the same database.
#[derive(Default)]
pub struct Cluster(OnceLock<Joined>);

enum Joined {
    Alone(NodeId, NodeProfile),
    Shared(Box<Membership>),
}

/// The description of a process for the others.
#[derive(Debug, Clone)]
pub struct NodeSettings {
    /// Where clients reach it.
    pub url: Option<String>,
    /// The role of the process.
    pub role: NodeRole,
    /// How long it counts as alive without another renewal.
    pub lease: Duration,
}

impl NodeSettings {
    /// Those of the settings; `url` is used where they name none.
    #[must_use]
    pub fn of(config: &Config, url: Option<String>) -> Self {
        let answers = config.role.answers_clients();
        Self {
            url: config.advertised_url.clone().or(url).filter(|_| answers),
            role: config.role,
            lease: Duration::from_secs(config.node_lease_s.into()),
        }
    }
}

/// A node, for operators.
#[derive(Debug, Clone)]
pub struct NodeStatus {
    pub node: Node,
    /// Cameras that it owns.
    pub cameras: u64,
    /// True if it is this process.
    pub is_this: bool,
}

impl Cluster {
    fn membership(&self) -> Option<&Membership> {
        match self.0.get() {
            Some(Joined::Shared(membership)) => Some(membership),
            Some(Joined::Alone(..)) | None => None,
        }
    }

    /// Tells that something which held a camera's lease is gone.
    pub(super) fn let_go(&self) {
        if let Some(membership) = self.membership() {
            membership.let_go.notify_one();
        }
    }
}

/// The nodes of a database, and what of it this one owns.
#[derive(Clone, Copy)]
pub struct Nodes<'a> {
    cluster: &'a Cluster,
    cameras: ActiveCameras<'a>,
    store: &'a Store,
    registry: &'a Registry,
    site_registry: &'a SiteRegistry,
    access: &'a Access,
    clock: &'a Clock,
    randomness: &'a Randomness,
    metrics: &'a Metrics,
}

impl App {
    /// The nodes of a database, and what of it this one owns.
    #[must_use]
    pub fn nodes(&self) -> Nodes<'_> {
        Nodes {
            cluster: &self.cluster,
            cameras: self.active_cameras(),
            store: &self.store,
            registry: &self.registry,
            site_registry: &self.site_registry,
            access: &self.access,
            clock: &self.clock,
            randomness: &self.randomness,
            metrics: &self.metrics,
        }
    }
}

impl<'a> Nodes<'a> {
    /// Registers this process where others share its database. [`Nodes::keep_registered`] must run from then on.
    ///
    /// # Errors
    /// The database does not answer.
    pub async fn join(&self, settings: NodeSettings) -> Result<()> {
        let id = NodeId(self.randomness.uuid_v7(self.clock.now()));
        let NodeSettings { url, role, lease } = settings;
        let profile = NodeProfile {
            url,
            role: role.as_str().to_owned(),
            version: env!("CARGO_PKG_VERSION").to_owned(),
            lease,
            started_at: self.clock.now(),
        };
        let joined = match self.store.node_leases() {
            None => {
                self.metrics.nodes(1);
                Joined::Alone(id, profile)
            }
            Some(leases) => {
                let sent_at = self.clock.monotonic();
                let mark = leases.register(id, &profile, heartbeat::random(*self)).await?;
                // Everything read from here on is of that history, or of a later one that a renewal notices.
                self.access.set_lease(lease);
                self.access.refresh(self.store, self.clock).await?;
                let registration = Registration::new(id, sent_at);
                let membership = Membership::new(leases.clone(), profile, registration, mark);
                membership.registration.load().extend(membership.valid_until(sent_at));
                Joined::Shared(Box::new(membership))
            }
        };
        self.cluster.0.set(joined).map_err(|_| Error::fault("the process has joined already"))
    }

    /// Brings sites and cameras up to date, including changes of other processes.
    ///
    /// # Errors
    /// A fault if the store cannot be read.
    pub async fn refresh_registries(&self) -> Result<()> {
        self.site_registry.refresh(self.store).await?;
        self.registry.refresh(self.store).await
    }

    /// A camera with the right to change its live state, which this node acquires if no other has it.
    ///
    /// # Errors
    /// As [`App::active_camera`]; `CameraOnOtherNode`, `CameraBetweenNodes`.
    pub async fn own_camera(&self, id: &CameraId) -> Result<(Arc<ActiveCamera>, CameraLease)> {
        let camera = self.cameras.get(id).await?;
        let Some(membership) = self.membership() else {
            return Ok((camera, CameraLease::of_only_node()));
        };
        let lease = membership.own(*self, &camera).await?;
        // A new owner begins with new live state.
        Ok((self.cameras.get(id).await?, lease))
    }

    /// Checks that the live state of a camera may be read here: this node owns it, or no other does. What is older than
    /// the latest owner's is cleared.
    ///
    /// # Errors
    /// `CameraOnOtherNode`, `CameraBetweenNodes`.
    pub(super) async fn check_readable(&self, camera: &ActiveCamera) -> Result<()> {
        let Some(membership) = self.membership() else { return Ok(()) };
        if membership.held(camera.key, self.clock.monotonic()).is_some() {
            return Ok(());
        }
        let owner = membership.leases.camera_owner(camera.key).await?;
        self.check_owner(membership, &camera_text(&camera.id), owner)?;
        membership.clear_former(*self, Watched::Camera(camera.key)).await
    }

    /// True if this node surely owns a camera.
    pub(super) fn owns_camera(&self, camera: &ActiveCamera) -> bool {
        self.membership().is_none_or(|it| it.holds(camera.key, self.clock.monotonic()))
    }

    /// Checks that the live state of a site may be read here.
    ///
    /// # Errors
    /// As [`Nodes::check_readable`].
    pub(super) async fn check_site_readable(&self, id: &SiteId, site: SiteKey) -> Result<()> {
        let Some(membership) = self.membership() else { return Ok(()) };
        let owner = membership.leases.site_owner(site).await?;
        self.check_owner(membership, &format!("site {id}"), owner)?;
        membership.clear_former(*self, Watched::Site(site)).await
    }

    fn membership(&self) -> Option<&'a Membership> {
        self.cluster.membership()
    }

    fn check_owner(&self, membership: &Membership, owned: &str, owner: Option<NodeId>) -> Result<()> {
        let (now, registration) = (self.clock.monotonic(), membership.registration.load());
        match owner {
            Some(other) if other != registration.id => Err(membership.elsewhere(owned, other, now)),
            _ if registration.is_valid(now) => Ok(()),
            _ => Err(between_nodes(owned)),
        }
    }

    /// Until when a reader of a camera's live state is right here.
    pub(super) fn watch_camera_owner(&self, camera: &ActiveCamera) -> Watch {
        let membership = self.membership();
        membership.map_or_else(Watch::default, |it| it.watches.begin(Watched::Camera(camera.key)))
    }

    /// Until when a reader of a site's live state is right here.
    pub(super) fn watch_site_owner(&self, site: SiteKey) -> Watch {
        let membership = self.membership();
        membership.map_or_else(Watch::default, |it| it.watches.begin(Watched::Site(site)))
    }

    /// Compares the history of what this process knows with that of the database.
    #[must_use]
    pub fn database_history(&self) -> DatabaseHistory {
        let membership = self.membership();
        membership.map_or(DatabaseHistory::Unbroken, |it| it.history.state())
    }

    /// The nodes that share the database, by the time of their start.
    ///
    /// # Errors
    /// The database does not answer.
    pub async fn list(&self) -> Result<Vec<NodeStatus>> {
        match self.cluster.0.get() {
            None => Ok(Vec::new()),
            Some(Joined::Alone(id, profile)) => {
                let node = Node {
                    id: *id,
                    profile: profile.clone(),
                    renewal: 0,
                    is_draining: false,
                    renewed_at: self.clock.now(),
                };
                let cameras = self.registry.select(|_| true).len() as u64;
                Ok(vec![NodeStatus { node, cameras, is_this: true }])
            }
            Some(Joined::Shared(membership)) => {
                let own = membership.registration.load().id;
                let nodes = membership.leases.nodes().await?.into_iter();
                let status =
                    |(node, cameras): (Node, u64)| NodeStatus { is_this: node.id == own, node, cameras };
                Ok(nodes.map(status).collect())
            }
        }
    }
}
