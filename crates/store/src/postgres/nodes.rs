//! Nodes, and which of them has the live state of each camera.
//!
//! A node renews its registration with a number that it draws each time. Nothing is decided by a clock that two machines
//! would have to agree on: an observer that has seen the same number for as long as the node's lease, by its own
//! monotonic clock, deletes the registration if the number is still the same. From the commit of that deletion on
//! every camera of the node is free. A node knows by its own monotonic clock, from the instant at which it sent its last
//! successful renewal, until when nobody can have done that.

use std::time::Duration;

use jiff::Timestamp;
use sqlx::{AssertSqlSafe, PgConnection, PgPool, Postgres, Transaction};
use uuid::Uuid;

use super::connection::{DATABASE_NOW_US, begin_read, begin_write};
use super::errors::{failed, repeated};
use super::history::{self, HistoryMark};
use crate::domain::{CameraKey, Durability, Error, ErrorKind, Node, NodeId, NodeProfile, Result, SiteKey};
use crate::rows::keys::KeysVersion;
use crate::statements::versions::keys_version;

/// The registrations and ownerships of the nodes of one database.
#[derive(Clone)]
pub struct NodeLeases {
    /// For renewals alone: they must not wait for statements that use all other connections.
    pub(super) renewals: PgPool,
    pub(super) pool: PgPool,
}

/// The outcome of an attempt to own a camera.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Acquired {
    /// The node owns it.
    Owned {
        /// Above the fence of every owner before.
        fence: i64,
        /// True if the owner before has ended without releasing it.
        is_takeover: bool,
    },
    /// Another registered node owns it, or another camera of its site.
    OtherNode(NodeId),
    /// The node that asks is not registered any more.
    NotRegistered,
}

/// The columns of a node, read by [`read_node`].
const COLUMNS: &str = "id, url, role, version, lease_ms, renewal, is_draining, started_at_us, renewed_at_us";
type NodeRow = (String, Option<String>, String, String, i64, i64, bool, i64, i64);

/// The findings of a renewal.
#[derive(Debug, Clone, PartialEq)]
pub struct Renewed {
    /// All registered nodes.
    pub nodes: Vec<Node>,
    /// Tells whether keys have changed.
    pub keys: KeysVersion,
    /// Where the renewal is in the history of the database.
    pub mark: HistoryMark,
}

impl NodeLeases {
    /// Registers a node under an id that was never used before; where the registration is in the history of the database.
    ///
    /// # Errors
    /// Faults; `Overloaded` where the database does not answer.
    pub async fn register(&self, id: NodeId, profile: &NodeProfile, renewal: i64) -> Result<HistoryMark> {
        let mut transaction = self.renewing().await?;
        let sql = format!(
            "INSERT INTO nodes (id, url, role, version, lease_ms, renewal, started_at_us, renewed_at_us) \
             VALUES ($1, $2, $3, $4, $5, $6, $7, {DATABASE_NOW_US}) RETURNING {}",
            history::COLUMNS
        );
        let row = sqlx::query(AssertSqlSafe(sql))
            .bind(id.to_string())
            .bind(&profile.url)
            .bind(&profile.role)
            .bind(&profile.version)
            .bind(i64::try_from(profile.lease.as_millis()).unwrap_or(i64::MAX))
            .bind(renewal)
            .bind(profile.started_at.as_microsecond())
            .fetch_one(&mut *transaction)
            .await
            .map_err(failed)?;
        transaction.commit().await.map_err(failed)?;
        HistoryMark::read(&row)
    }

    /// Renews a registration, and reads all of them; `None` if there is none any more. `renewal` is a number that no
    /// renewal of the node had before.
    ///
    /// # Errors
    /// As [`NodeLeases::register`].
    pub async fn renew(&self, id: NodeId, renewal: i64, is_draining: bool) -> Result<Option<Renewed>> {
        let mut transaction = self.renewing().await?;
        let sql = format!(
            "UPDATE nodes SET renewal = $2, is_draining = $3, renewed_at_us = {DATABASE_NOW_US} WHERE id = $1 \
             RETURNING {}",
            history::COLUMNS
        );
        let row = sqlx::query(AssertSqlSafe(sql))
            .bind(id.to_string())
            .bind(renewal)
            .bind(is_draining)
            .fetch_optional(&mut *transaction)
            .await
            .map_err(failed)?;
        let Some(row) = row else { return Ok(None) };
        let nodes = read_nodes(&mut transaction).await?;
        let keys = keys_version(&mut *transaction).await?;
        transaction.commit().await.map_err(failed)?;
        Ok(Some(Renewed { nodes, keys, mark: HistoryMark::read(&row)? }))
    }

    /// Ends the registration of a node that has not renewed it since; whether it was there.
    ///
    /// # Errors
    /// As [`NodeLeases::register`].
    pub async fn end_unrenewed(&self, id: NodeId, renewal: i64) -> Result<bool> {
        let mut transaction = self.renewing().await?;
        let ended = sqlx::query("DELETE FROM nodes WHERE id = $1 AND renewal = $2")
            .bind(id.to_string())
            .bind(renewal)
            .execute(&mut *transaction)
            .await
            .map_err(failed)?;
        transaction.commit().await.map_err(failed)?;
        Ok(ended.rows_affected() > 0)
    }

    /// Ends a node's own registration.
    ///
    /// # Errors
    /// As [`NodeLeases::register`].
    pub async fn end(&self, id: NodeId) -> Result<()> {
        let mut transaction = self.renewing().await?;
        sqlx::query("DELETE FROM nodes WHERE id = $1")
            .bind(id.to_string())
            .execute(&mut *transaction)
            .await
            .map_err(failed)?;
        transaction.commit().await.map_err(failed)
    }

    /// All nodes, by the time of their start, each with how many cameras it owns.
    ///
    /// # Errors
    /// As [`NodeLeases::register`].
    pub async fn nodes(&self) -> Result<Vec<(Node, u64)>> {
        let mut reader = begin_read(&self.pool).await?;
        let nodes = read_nodes(&mut reader).await?;
        let owned: Vec<(String, i64)> = sqlx::query_as(
            "SELECT node_id, count(*) FROM camera_owners WHERE node_id IN (SELECT id FROM nodes) GROUP BY node_id",
        )
        .fetch_all(&mut *reader)
        .await
        .map_err(failed)?;
        let of = |node: &Node| {
            let id = node.id.to_string();
            owned.iter().find(|(owner, _)| *owner == id).map_or(0, |(_, count)| count.cast_unsigned())
        };
        Ok(nodes.into_iter().map(|node| (node.clone(), of(&node))).collect())
    }

    /// Makes a node the owner of a camera, unless another registered node owns it or another camera of its site.
    ///
    /// Rows that decide are locked by statements of their own before they are compared, for a statement that waits for
    /// a lock compares what was there before it began.
    ///
    /// # Errors
    /// `CameraNotFound`; as [`NodeLeases::register`].
    pub async fn acquire(&self, camera: CameraKey, id: NodeId) -> Result<Acquired> {
        repeated!(self.try_acquire(camera, id))
    }

    async fn try_acquire(&self, camera: CameraKey, id: NodeId) -> Result<Acquired> {
        let mut transaction = begin_write(&self.pool, Durability::Synced).await?;
        let (before, fence, site) = lock_ownership(&mut transaction, camera).await?;
        let registered: Option<i32> = sqlx::query_scalar("SELECT 1 FROM nodes WHERE id = $1 FOR KEY SHARE")
            .bind(id.to_string())
            .fetch_optional(&mut *transaction)
            .await
            .map_err(failed)?;
        if registered.is_none() {
            return Ok(Acquired::NotRegistered);
        }
        if let Some(other) = owner(&mut transaction, camera, site, Some(id)).await? {
            return Ok(Acquired::OtherNode(other));
        }
        sqlx::query(
            "UPDATE camera_owners SET node_id = $2, fence = $3, wanted_by = NULL WHERE camera_key = $1",
        )
        .bind(camera.0)
        .bind(id.to_string())
        .bind(fence + 1)
        .execute(&mut *transaction)
        .await
        .map_err(failed)?;
        transaction.commit().await.map_err(failed)?;
        let is_takeover = before.is_some_and(|before| before != id.to_string());
        Ok(Acquired::Owned { fence: fence + 1, is_takeover })
    }

    /// Asks the owner of a camera, and of all cameras of its site, to give them up for a node; until that node owns them,
    /// no other acquires them.
    ///
    /// # Errors
    /// `CameraNotFound`; as [`NodeLeases::register`].
    pub async fn want(&self, camera: CameraKey, id: NodeId) -> Result<()> {
        repeated!(self.try_want(camera, id))
    }

    async fn try_want(&self, camera: CameraKey, id: NodeId) -> Result<()> {
        let mut transaction = begin_write(&self.pool, Durability::Synced).await?;
        let (_, _, site) = lock_ownership(&mut transaction, camera).await?;
        sqlx::query(
            "UPDATE camera_owners SET wanted_by = $3 WHERE wanted_by IS DISTINCT FROM $3 AND camera_key = ANY(ARRAY( \
             SELECT $1::BIGINT UNION SELECT key FROM cameras WHERE site_key = $2))",
        )
        .bind(camera.0)
        .bind(site)
        .bind(id.to_string())
        .execute(&mut *transaction)
        .await
        .map_err(failed)?;
        transaction.commit().await.map_err(failed)
    }

    /// Cameras of a node that another registered node has asked for.
    ///
    /// # Errors
    /// As [`NodeLeases::register`].
    pub async fn wanted_by_others(&self, id: NodeId) -> Result<Vec<CameraKey>> {
        let mut reader = begin_read(&self.pool).await?;
        let wanted: Vec<i64> = sqlx::query_scalar(
            "SELECT camera_key FROM camera_owners JOIN nodes ON nodes.id = wanted_by \
             WHERE node_id = $1 AND wanted_by IS NOT NULL AND wanted_by <> $1",
        )
        .bind(id.to_string())
        .fetch_all(&mut *reader)
        .await
        .map_err(failed)?;
        Ok(wanted.into_iter().map(CameraKey).collect())
    }

    /// Releases cameras that a node still owns under these fences.
    ///
    /// # Errors
    /// As [`NodeLeases::register`].
    pub async fn release(&self, id: NodeId, cameras: &[(CameraKey, i64)]) -> Result<()> {
        repeated!(self.try_release(id, cameras))
    }

    async fn try_release(&self, id: NodeId, cameras: &[(CameraKey, i64)]) -> Result<()> {
        let (keys, fences): (Vec<i64>, Vec<i64>) = cameras.iter().map(|(key, fence)| (key.0, *fence)).unzip();
        let mut transaction = begin_write(&self.pool, Durability::Synced).await?;
        sqlx::query(
            "UPDATE camera_owners SET node_id = NULL FROM UNNEST($2::BIGINT[], $3::BIGINT[]) AS held (key, fence) \
             WHERE camera_key = held.key AND camera_owners.fence = held.fence AND node_id = $1",
        )
        .bind(id.to_string())
        .bind(keys)
        .bind(fences)
        .execute(&mut *transaction)
        .await
        .map_err(failed)?;
        transaction.commit().await.map_err(failed)
    }

    /// The registered node that owns a camera, or another camera of its site.
    ///
    /// # Errors
    /// As [`NodeLeases::register`].
    pub async fn camera_owner(&self, camera: CameraKey) -> Result<Option<NodeId>> {
        let mut reader = begin_read(&self.pool).await?;
        let site: Option<Option<i64>> = sqlx::query_scalar("SELECT site_key FROM cameras WHERE key = $1")
            .bind(camera.0)
            .fetch_optional(&mut *reader)
            .await
            .map_err(failed)?;
        owner(&mut reader, camera, site.flatten(), None).await
    }

    /// The fences of the latest owners of a camera and of the cameras of a site.
    ///
    /// # Errors
    /// As [`NodeLeases::register`].
    pub async fn latest_fences(
        &self,
        camera: Option<CameraKey>,
        site: Option<SiteKey>,
    ) -> Result<Vec<(CameraKey, i64)>> {
        let mut reader = begin_read(&self.pool).await?;
        let fences: Vec<(i64, i64)> = sqlx::query_as(
            "SELECT camera_key, fence FROM camera_owners \
             WHERE camera_key = $1 OR camera_key IN (SELECT key FROM cameras WHERE site_key = $2)",
        )
        .bind(camera.map(|key| key.0))
        .bind(site.map(|key| key.0))
        .fetch_all(&mut *reader)
        .await
        .map_err(failed)?;
        Ok(fences.into_iter().map(|(key, fence)| (CameraKey(key), fence)).collect())
    }

    /// The registered node that owns cameras of a site.
    ///
    /// # Errors
    /// As [`NodeLeases::register`].
    pub async fn site_owner(&self, site: SiteKey) -> Result<Option<NodeId>> {
        let mut reader = begin_read(&self.pool).await?;
        // No camera has the key 0.
        owner(&mut reader, CameraKey(0), Some(site.0), None).await
    }

    /// Among some cameras and sites, those that another registered node owns.
    ///
    /// # Errors
    /// As [`NodeLeases::register`].
    pub async fn owned_by_others(
        &self,
        id: NodeId,
        cameras: &[CameraKey],
        sites: &[SiteKey],
    ) -> Result<(Vec<CameraKey>, Vec<SiteKey>)> {
        let mut reader = begin_read(&self.pool).await?;
        let others: Vec<(i64, Option<i64>)> = sqlx::query_as(
            "SELECT owned.camera_key, cameras.site_key FROM camera_owners owned \
             JOIN cameras ON cameras.key = owned.camera_key JOIN nodes ON nodes.id = owned.node_id \
             WHERE nodes.id <> $1 AND owned.camera_key = ANY(ARRAY( \
             SELECT UNNEST($2::BIGINT[]) UNION SELECT key FROM cameras WHERE site_key = ANY($3::BIGINT[])))",
        )
        .bind(id.to_string())
        .bind(cameras.iter().map(|key| key.0).collect::<Vec<_>>())
        .bind(sites.iter().map(|key| key.0).collect::<Vec<_>>())
        .fetch_all(&mut *reader)
        .await
        .map_err(failed)?;
        Ok((
            others.iter().map(|(camera, _)| CameraKey(*camera)).collect(),
            others.iter().filter_map(|(_, site)| site.map(SiteKey)).collect(),
        ))
    }

    /// A renewal that a crash of the database undoes would let others end a registration that its node counts on.
    async fn renewing(&self) -> Result<Transaction<'static, Postgres>> {
        begin_write(&self.renewals, Durability::Synced).await
    }
}

async fn read_nodes(connection: &mut PgConnection) -> Result<Vec<Node>> {
    let sql = AssertSqlSafe(format!("SELECT {COLUMNS} FROM nodes ORDER BY started_at_us, id"));
    let rows: Vec<NodeRow> = sqlx::query_as(sql).fetch_all(connection).await.map_err(failed)?;
    rows.into_iter().map(read_node).collect()
}

fn read_node(row: NodeRow) -> Result<Node> {
    let (id, url, role, version, lease_ms, renewal, is_draining, started_at_us, renewed_at_us) = row;
    let instant = |us| Timestamp::from_microsecond(us).map_err(Error::fault);
    Ok(Node {
        id: node_id(&id)?,
        profile: NodeProfile {
            url,
            role,
            version,
            lease: Duration::from_millis(lease_ms.cast_unsigned()),
            started_at: instant(started_at_us)?,
        },
        renewal,
        is_draining,
        renewed_at: instant(renewed_at_us)?,
    })
}

pub(super) fn node_id(text: &str) -> Result<NodeId> {
    Uuid::parse_str(text).map(NodeId).map_err(Error::fault)
}

/// Locks the site of a camera and the row of its owner; the owner before, its fence, and the site.
async fn lock_ownership(
    connection: &mut PgConnection,
    camera: CameraKey,
) -> Result<(Option<String>, i64, Option<i64>)> {
    let site: Option<Option<i64>> =
        sqlx::query_scalar("SELECT site_key FROM cameras WHERE key = $1 FOR KEY SHARE")
            .bind(camera.0)
            .fetch_optional(&mut *connection)
            .await
            .map_err(failed)?;
    let Some(site) = site else {
        return Err(Error::refused(ErrorKind::CameraNotFound, "the camera was deleted"));
    };
    if let Some(site) = site {
        // Cameras of one site are acquired one after another, so that all of them have one owner.
        sqlx::query("SELECT key FROM sites WHERE key = $1 FOR NO KEY UPDATE")
            .bind(site)
            .execute(&mut *connection)
            .await
            .map_err(failed)?;
    }
    sqlx::query("INSERT INTO camera_owners (camera_key, fence) VALUES ($1, 0) ON CONFLICT DO NOTHING")
        .bind(camera.0)
        .execute(&mut *connection)
        .await
        .map_err(failed)?;
    let (before, fence): (Option<String>, i64) =
        sqlx::query_as("SELECT node_id, fence FROM camera_owners WHERE camera_key = $1 FOR UPDATE")
            .bind(camera.0)
            .fetch_one(&mut *connection)
            .await
            .map_err(failed)?;
    Ok((before, fence, site))
}

/// The registered node, other than one, that owns a camera, or else another camera of its site, or else has asked for them.
async fn owner(
    connection: &mut PgConnection,
    camera: CameraKey,
    site: Option<i64>,
    except: Option<NodeId>,
) -> Result<Option<NodeId>> {
    let owner: Option<String> = sqlx::query_scalar(
        "SELECT nodes.id FROM camera_owners owned \
         CROSS JOIN LATERAL (VALUES (owned.node_id, TRUE), (owned.wanted_by, FALSE)) AS named (id, owns) \
         JOIN nodes ON nodes.id = named.id \
         WHERE owned.camera_key = ANY(ARRAY(SELECT $1::BIGINT UNION SELECT key FROM cameras WHERE site_key = $2)) \
         AND named.id IS DISTINCT FROM $3 ORDER BY named.owns DESC, owned.camera_key = $1 DESC LIMIT 1",
    )
    .bind(camera.0)
    .bind(site)
    .bind(except.map(|id| id.to_string()))
    .fetch_optional(connection)
    .await
    .map_err(failed)?;
    owner.as_deref().map(node_id).transpose()
}
