//! Which node runs each connection with another system, and what the nodes know of it.
//!
//! As for cameras, a node owns a connection as long as it is registered, and every acquisition has a higher fence.

use std::collections::HashMap;

use super::connection::{begin_read, begin_write};
use super::errors::{failed, repeated};
use super::locks::{Limit, lock_limit};
use super::nodes::{NodeLeases, node_id};
use crate::domain::{ConnectionKey, Durability, NodeId, Result};

/// The owner of a connection, and what each registered node has stored of it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ConnectionReports {
    /// The node that runs it, and its address, if any does.
    pub owner: Option<(NodeId, Option<String>)>,
    /// Reports by the nodes that made them.
    pub statuses: Vec<(NodeId, String)>,
}

impl NodeLeases {
    /// The connections that registered nodes own.
    ///
    /// # Errors
    /// As [`NodeLeases::register`].
    pub async fn connection_owners(&self) -> Result<HashMap<ConnectionKey, NodeId>> {
        let mut reader = begin_read(&self.pool).await?;
        let owners: Vec<(i64, String)> = sqlx::query_as(
            "SELECT connection_key, node_id FROM connection_owners JOIN nodes ON nodes.id = node_id",
        )
        .fetch_all(&mut *reader)
        .await
        .map_err(failed)?;
        owners.into_iter().map(|(key, node)| Ok((ConnectionKey(key), node_id(&node)?))).collect()
    }

    /// Makes a node the owner of connections, each under the fence that is returned with it; of none if another registered
    /// node owns any of `group`, or the node is not registered any more.
    ///
    /// # Errors
    /// As [`NodeLeases::register`].
    pub async fn acquire_connections(
        &self,
        id: NodeId,
        group: &[ConnectionKey],
        wanted: &[ConnectionKey],
    ) -> Result<Vec<(ConnectionKey, i64)>> {
        repeated!(self.try_acquire_connections(id, group, wanted))
    }

    async fn try_acquire_connections(
        &self,
        id: NodeId,
        group: &[ConnectionKey],
        wanted: &[ConnectionKey],
    ) -> Result<Vec<(ConnectionKey, i64)>> {
        let keys = |keys: &[ConnectionKey]| keys.iter().map(|key| key.0).collect::<Vec<_>>();
        let mut transaction = begin_write(&self.pool, Durability::Synced).await?;
        lock_limit(&mut transaction, Limit::ConnectionOwners).await?;
        let registered: Option<i32> = sqlx::query_scalar("SELECT 1 FROM nodes WHERE id = $1 FOR KEY SHARE")
            .bind(id.to_string())
            .fetch_optional(&mut *transaction)
            .await
            .map_err(failed)?;
        let others: i64 = sqlx::query_scalar(
            "SELECT count(*) FROM connection_owners JOIN nodes ON nodes.id = node_id \
             WHERE connection_key = ANY($1) AND node_id <> $2",
        )
        .bind(keys(group))
        .bind(id.to_string())
        .fetch_one(&mut *transaction)
        .await
        .map_err(failed)?;
        if registered.is_none() || others > 0 {
            return Ok(Vec::new());
        }
        let acquired: Vec<(i64, i64)> = sqlx::query_as(
            "INSERT INTO connection_owners (connection_key, node_id, fence) \
             SELECT key, $1, 1 FROM connections WHERE key = ANY($2) ON CONFLICT (connection_key) \
             DO UPDATE SET node_id = excluded.node_id, fence = connection_owners.fence + 1 \
             RETURNING connection_key, fence",
        )
        .bind(id.to_string())
        .bind(keys(wanted))
        .fetch_all(&mut *transaction)
        .await
        .map_err(failed)?;
        transaction.commit().await.map_err(failed)?;
        Ok(acquired.into_iter().map(|(key, fence)| (ConnectionKey(key), fence)).collect())
    }

    /// Releases connections that a node still owns under these fences.
    ///
    /// # Errors
    /// As [`NodeLeases::register`].
    pub async fn release_connections(&self, id: NodeId, connections: &[(ConnectionKey, i64)]) -> Result<()> {
        repeated!(self.try_release_connections(id, connections))
    }

    async fn try_release_connections(&self, id: NodeId, connections: &[(ConnectionKey, i64)]) -> Result<()> {
        let (keys, fences): (Vec<i64>, Vec<i64>) =
            connections.iter().map(|(key, fence)| (key.0, *fence)).unzip();
        let mut transaction = begin_write(&self.pool, Durability::Synced).await?;
        sqlx::query(
            "UPDATE connection_owners SET node_id = NULL \
             FROM UNNEST($2::BIGINT[], $3::BIGINT[]) AS held (key, fence) \
             WHERE connection_key = held.key AND connection_owners.fence = held.fence AND node_id = $1",
        )
        .bind(id.to_string())
        .bind(keys)
        .bind(fences)
        .execute(&mut *transaction)
        .await
        .map_err(failed)?;
        transaction.commit().await.map_err(failed)
    }

    /// Stores what a node knows of connections, instead of what it has stored of them before.
    ///
    /// # Errors
    /// As [`NodeLeases::register`].
    pub async fn store_connection_statuses(
        &self,
        id: NodeId,
        statuses: &[(ConnectionKey, String)],
    ) -> Result<()> {
        repeated!(self.try_store_connection_statuses(id, statuses))
    }

    async fn try_store_connection_statuses(
        &self,
        id: NodeId,
        statuses: &[(ConnectionKey, String)],
    ) -> Result<()> {
        let (keys, texts): (Vec<i64>, Vec<&str>) =
            statuses.iter().map(|(key, status)| (key.0, status.as_str())).unzip();
        let mut transaction = begin_write(&self.pool, Durability::Relaxed).await?;
        sqlx::query("DELETE FROM connection_statuses WHERE node_id NOT IN (SELECT id FROM nodes)")
            .execute(&mut *transaction)
            .await
            .map_err(failed)?;
        sqlx::query(
            "INSERT INTO connection_statuses (connection_key, node_id, status) \
             SELECT connections.key, $1, reported.status FROM UNNEST($2::BIGINT[], $3::TEXT[]) AS reported (key, status) \
             JOIN connections ON connections.key = reported.key \
             ON CONFLICT (connection_key, node_id) DO UPDATE SET status = excluded.status",
        )
        .bind(id.to_string())
        .bind(keys)
        .bind(texts)
        .execute(&mut *transaction)
        .await
        .map_err(failed)?;
        transaction.commit().await.map_err(failed)
    }

    /// Who owns a connection, and what registered nodes know of it.
    ///
    /// # Errors
    /// As [`NodeLeases::register`].
    pub async fn connection_reports(&self, key: ConnectionKey) -> Result<ConnectionReports> {
        let mut reader = begin_read(&self.pool).await?;
        let owner: Option<(String, Option<String>)> = sqlx::query_as(
            "SELECT id, url FROM nodes JOIN connection_owners ON node_id = id WHERE connection_key = $1",
        )
        .bind(key.0)
        .fetch_optional(&mut *reader)
        .await
        .map_err(failed)?;
        let statuses: Vec<(String, String)> = sqlx::query_as(
            "SELECT node_id, status FROM connection_statuses JOIN nodes ON nodes.id = node_id WHERE connection_key = $1",
        )
        .bind(key.0)
        .fetch_all(&mut *reader)
        .await
        .map_err(failed)?;
        Ok(ConnectionReports {
            owner: owner.map(|(id, url)| Ok::<_, crate::domain::Error>((node_id(&id)?, url))).transpose()?,
            statuses: statuses
                .into_iter()
                .map(|(id, status)| Ok((node_id(&id)?, status)))
                .collect::<Result<_>>()?,
        })
    }
}
