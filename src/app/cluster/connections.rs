//! Which connections this node runs.
//!
//! Sources that feed the same cameras, or cameras of one site, are a group, which one node runs: live state is on one node,
//! and so must be what feeds it. A group that nobody runs is taken by a node that runs less than its share of them.

use std::collections::HashMap;
use std::sync::Arc;
use std::sync::atomic::Ordering;

use tokio_util::sync::CancellationToken;

use super::Nodes;
use super::camera_lease::between_nodes;
use super::connection_lease::{ConnectionLease, HeldConnection};
use super::membership::Membership;
use crate::app::live::sync::lock;
use crate::domain::{CameraId, ConnectionId, ConnectionKey, Error, NodeId, Result};
use crate::store::ConnectionReports;

impl Nodes<'_> {
    /// The connections of these groups that this node runs: those it owns, and those of groups without an owner up to
    /// its share. What it owned besides is given up as soon as nothing here uses it.
    ///
    /// # Errors
    /// The database does not answer; leases that are held go on as long as the registration.
    pub async fn own_connections(
        &self,
        groups: &[Vec<ConnectionKey>],
    ) -> Result<HashMap<ConnectionKey, ConnectionLease>> {
        let Some(membership) = self.membership() else {
            return Ok(groups.iter().flatten().map(|key| (*key, ConnectionLease::of_every_node())).collect());
        };
        let registration = membership.registration.load_full();
        if !registration.is_valid(self.clock.monotonic()) || membership.is_draining.load(Ordering::Acquire) {
            return Ok(HashMap::new());
        }
        let owners = membership.leases.connection_owners().await?;
        let mine = groups_of_node(groups, &owners, registration.id, membership.serving_nodes());
        let is_mine = |key: ConnectionKey| mine.iter().any(|group| group.contains(&key));
        membership.release_connections(|key| !is_mine(key)).await?;
        for group in mine {
            let wanted = membership.connections_to_acquire(group, &owners, registration.id);
            if wanted.is_empty() {
                continue;
            }
            let acquired = membership.leases.acquire_connections(registration.id, group, &wanted).await?;
            let held = acquired.into_iter().map(|(key, fence)| {
                let registration = registration.clone();
                (key, Arc::new(HeldConnection { fence, registration, ended: CancellationToken::new() }))
            });
            lock(&membership.connections).extend(held);
        }
        let now = self.clock.monotonic();
        let held = lock(&membership.connections);
        let valid = held.iter().filter(|(_, lease)| lease.is_valid(now));
        Ok(valid.map(|(key, lease)| (*key, ConnectionLease(Some(lease.clone())))).collect())
    }

    /// Asks the owner of a camera to give it up for a source that this node runs.
    ///
    /// # Errors
    /// `CameraNotFound`; the database does not answer.
    pub async fn want_camera(&self, id: &CameraId) -> Result<()> {
        let Some(membership) = self.membership() else { return Ok(()) };
        let camera = self.cameras.get(id).await?;
        membership.leases.want(camera.key, membership.registration.load().id).await
    }

    /// Stores what this node knows of connections, for the others.
    ///
    /// # Errors
    /// The database does not answer.
    pub(in crate::app) async fn store_connection_statuses(
        &self,
        node: NodeId,
        statuses: &[(ConnectionKey, String)],
    ) -> Result<()> {
        match self.membership() {
            Some(membership) => membership.leases.store_connection_statuses(node, statuses).await,
            None => Ok(()),
        }
    }

    /// The id under which this node reports to others; `None` if there are none.
    pub(in crate::app) fn reporting_node(&self) -> Option<NodeId> {
        self.membership().map(|membership| membership.registration.load().id)
    }

    /// The nodes' reports of a connection; `None` for a server that shares its database with no other.
    ///
    /// # Errors
    /// The database does not answer.
    pub(in crate::app) async fn connection_reports(
        &self,
        key: ConnectionKey,
    ) -> Result<Option<ConnectionReports>> {
        match self.membership() {
            Some(membership) => Ok(Some(membership.leases.connection_reports(key).await?)),
            None => Ok(None),
        }
    }

    /// Where a source of messages by HTTP runs, as the error of a request that met this node; `None` if that is here.
    ///
    /// # Errors
    /// The database does not answer.
    pub(in crate::app) async fn source_elsewhere(
        &self,
        id: &ConnectionId,
        key: ConnectionKey,
    ) -> Result<Option<Error>> {
        let Some(membership) = self.membership() else { return Ok(None) };
        let source = format!("the source {id}");
        let owner = membership.leases.connection_reports(key).await?.owner;
        Ok(Some(match owner {
            Some((node, _)) if node != membership.registration.load().id => {
                membership.elsewhere(&source, node, self.clock.monotonic())
            }
            Some(_) | None => between_nodes(&source),
        }))
    }
}

/// The groups that a node runs, or may run now.
fn groups_of_node<'a>(
    groups: &'a [Vec<ConnectionKey>],
    owners: &HashMap<ConnectionKey, NodeId>,
    node: NodeId,
    nodes: usize,
) -> Vec<&'a [ConnectionKey]> {
    // Where sources of several nodes have become one group, it goes to the node that has the first of them.
    let owner = |group: &[ConnectionKey]| group.iter().find_map(|key| owners.get(key)).copied();
    let (mut mine, mut free) = (Vec::new(), Vec::new());
    for group in groups {
        match owner(group) {
            Some(owner) if owner == node => mine.push(group.as_slice()),
            Some(_) => {}
            None => free.push(group.as_slice()),
        }
    }
    let share = groups.len().div_ceil(nodes);
    let room = share.saturating_sub(mine.len());
    mine.extend(free.into_iter().take(room));
    mine
}

impl Membership {
    /// Those of a group that nobody owns, and that no task of before still uses here.
    fn connections_to_acquire(
        &self,
        group: &[ConnectionKey],
        owners: &HashMap<ConnectionKey, NodeId>,
        node: NodeId,
    ) -> Vec<ConnectionKey> {
        let held = lock(&self.connections);
        let is_free = |key: &ConnectionKey| owners.get(key).is_none_or(|owner| *owner == node);
        group.iter().copied().filter(|key| is_free(key) && !held.contains_key(key)).collect()
    }

    /// Ends the connections of which this is true, and releases those that no task uses any more.
    ///
    /// # Errors
    /// The database does not answer; it is tried again with the next call.
    pub(super) async fn release_connections(&self, is_over: impl Fn(ConnectionKey) -> bool) -> Result<()> {
        let unused: Vec<_> = {
            let held = lock(&self.connections);
            held.iter().filter(|(key, _)| is_over(**key)).for_each(|(_, lease)| lease.ended.cancel());
            let unused =
                held.iter().filter(|(_, lease)| lease.ended.is_cancelled() && Arc::strong_count(lease) == 1);
            unused.map(|(key, lease)| (*key, lease.fence)).collect()
        };
        if unused.is_empty() {
            return Ok(());
        }
        self.leases.release_connections(self.registration.load().id, &unused).await?;
        let mut held = lock(&self.connections);
        unused.iter().for_each(|(key, _)| drop(held.remove(key)));
        Ok(())
    }

    /// True if a connection is left that was not released.
    pub(super) fn holds_connections(&self) -> bool {
        !lock(&self.connections).is_empty()
    }
}

#[cfg(test)]
mod tests {
    use uuid::Uuid;

    use super::*;

    #[test]
    fn free_groups_are_shared_and_a_joined_group_goes_to_the_owner_of_its_first_source() {
        let key = ConnectionKey;
        let (one, two) = (NodeId(Uuid::from_u128(1)), NodeId(Uuid::from_u128(2)));
        let groups = [vec![key(1), key(4)], vec![key(2)], vec![key(3)], vec![key(5)]];
        let mine = |owners: &[(i64, NodeId)], node, nodes| -> Vec<i64> {
            let owners = owners.iter().map(|(number, node)| (key(*number), *node)).collect();
            groups_of_node(&groups, &owners, node, nodes).into_iter().map(|group| group[0].0).collect()
        };
        assert_eq!(mine(&[], one, 2), [1, 2]);
        assert_eq!(mine(&[(1, one), (2, one)], two, 2), [3, 5]);
        assert_eq!(mine(&[(1, one), (2, one), (3, one)], one, 2), [1, 2, 3], "nothing is taken back");
        assert_eq!(mine(&[(1, one), (2, one)], one, 1), [1, 2, 3, 5], "all of a node that has gone");
        assert_eq!(mine(&[(1, two), (4, one)], one, 1), [2, 3, 5]);
    }
}
