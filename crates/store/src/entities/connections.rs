//! Connections with other systems.

use jiff::Timestamp;

use crate::database::Database;
use crate::domain::{
    AuditAction, Connection, ConnectionId, ConnectionKey, ExpectedVersion, NewConnection, Result,
};
use crate::locks::{Limit, lock_limit};
use crate::query::{RowLock, Session, query, query_scalar};
use crate::refusals::no_connection;
use crate::rows::audit::Change;
use crate::rows::connections::{
    check_limit, check_version, connection_columns as columns, connection_exists, read_connection,
};

/// The version that a change of a connection is based on, if the caller states it.
type Expected = Option<ExpectedVersion<ConnectionKey>>;

impl Database {
    pub(crate) async fn insert_connection(
        &self,
        profile: &NewConnection,
        now: Timestamp,
    ) -> Result<Connection> {
        let mut writer = self.growing().await?;
        let mut transaction = writer.begin().await?;
        lock_limit(&mut transaction, Limit::Connections).await?;
        let row = query(concat!(
            "INSERT INTO connections (id, display_name, paused, settings, secrets, revision, created_at_us, \
             updated_at_us) VALUES ($1, $2, $3, $4, $5, 1, $6, $6) ON CONFLICT (id) DO NOTHING RETURNING ",
            columns!()
        ))
        .bind(profile.id.as_str())
        .bind(&profile.display_name)
        .bind(profile.paused)
        .bind(&profile.settings)
        .bind(&profile.secrets)
        .bind(now.as_microsecond())
        .fetch_optional(&mut transaction)
        .await?;
        let connection = read_connection(&row.ok_or_else(|| connection_exists(&profile.id))?)?;
        check_limit(count(&mut transaction).await?, self.limits().outside_connections)?;
        self.record_connection(&mut transaction, AuditAction::ConnectionCreated, &connection, now).await?;
        transaction.commit().await?;
        Ok(connection)
    }

    pub(crate) async fn connection(&self, id: &ConnectionId) -> Result<Connection> {
        let mut reader = self.reader().await?;
        find_connection(&mut reader, id).await
    }

    pub(crate) async fn connections(
        &self,
        after: Option<&ConnectionId>,
        limit: u32,
    ) -> Result<Vec<Connection>> {
        let mut reader = self.reader().await?;
        let page = concat!("SELECT ", columns!(), " FROM connections WHERE id > $1 ORDER BY id LIMIT $2");
        let rows = query(page)
            .bind(after.map_or("", ConnectionId::as_str).to_owned())
            .bind(limit)
            .fetch_all(&mut reader)
            .await?;
        rows.iter().map(read_connection).collect()
    }

    pub(crate) async fn replace_connection(
        &self,
        profile: &NewConnection,
        expected: Expected,
        now: Timestamp,
    ) -> Result<Connection> {
        let mut writer = self.synced().await?;
        let mut transaction = writer.begin().await?;
        lock_connection(&mut transaction, &profile.id).await?;
        check_version(&find_connection(&mut transaction, &profile.id).await?, expected)?;
        let row = query(concat!(
            "UPDATE connections SET display_name = $1, paused = $2, settings = $3, secrets = $4, updated_at_us = $5, \
             revision = revision + 1 WHERE id = $6 RETURNING ",
            columns!()
        ))
        .bind(&profile.display_name)
        .bind(profile.paused)
        .bind(&profile.settings)
        .bind(&profile.secrets)
        .bind(now.as_microsecond())
        .bind(profile.id.as_str())
        .fetch_one(&mut transaction).await?;
        let connection = read_connection(&row)?;
        self.record_connection(&mut transaction, AuditAction::ConnectionChanged, &connection, now).await?;
        transaction.commit().await?;
        Ok(connection)
    }

    pub(crate) async fn delete_connection(
        &self,
        id: &ConnectionId,
        expected: Expected,
        now: Timestamp,
    ) -> Result<()> {
        let mut writer = self.deletion().await?;
        let mut transaction = writer.begin().await?;
        lock_connection(&mut transaction, id).await?;
        let connection = find_connection(&mut transaction, id).await?;
        check_version(&connection, expected)?;
        query("DELETE FROM outbox WHERE connection_key = $1")
            .bind(connection.key.0)
            .execute(&mut transaction)
            .await?;
        query("DELETE FROM connections WHERE key = $1")
            .bind(connection.key.0)
            .execute(&mut transaction)
            .await?;
        self.record_connection(&mut transaction, AuditAction::ConnectionDeleted, &connection, now).await?;
        transaction.commit().await?;
        writer.reclaim().await;
        Ok(())
    }

    async fn record_connection(
        &self,
        session: &mut dyn Session,
        action: AuditAction,
        connection: &Connection,
        now: Timestamp,
    ) -> Result<()> {
        let subject = match action {
            AuditAction::ConnectionChanged => {
                format!("connection {}, revision {}", connection.id(), connection.revision.0)
            }
            _ => format!("connection {}", connection.id()),
        };
        self.record(session, Change::of(action, subject), now).await
    }
}

async fn count(session: &mut dyn Session) -> Result<i64> {
    query_scalar("SELECT count(*) FROM connections").fetch_one(session).await
}

/// Waits until no other transaction changes the connection.
async fn lock_connection(session: &mut dyn Session, id: &ConnectionId) -> Result<()> {
    query("SELECT key FROM connections WHERE id = $1")
        .locking(RowLock::Update)
        .bind(id.as_str())
        .execute(session)
        .await?;
    Ok(())
}

async fn find_connection(session: &mut dyn Session, id: &ConnectionId) -> Result<Connection> {
    let row = query(concat!("SELECT ", columns!(), " FROM connections WHERE id = $1"))
        .bind(id.as_str())
        .fetch_optional(session)
        .await?;
    read_connection(&row.ok_or_else(|| no_connection(id))?)
}
