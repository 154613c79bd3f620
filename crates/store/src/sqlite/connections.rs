//! Connections with other systems.

use jiff::Timestamp;
use sqlx::{SqliteConnection, SqliteExecutor};

use super::Store;
use super::errors::failed;
use crate::domain::{
    AuditAction, Connection, ConnectionId, ConnectionKey, ExpectedVersion, NewConnection, Result,
};
use crate::refusals::no_connection;
use crate::rows::audit::Change;
use crate::rows::connections::{
    check_limit, check_version, connection_columns as columns, connection_exists, read_connection,
};

/// What a change of a connection is based on, if the caller states it.
type Expected = Option<ExpectedVersion<ConnectionKey>>;

impl Store {
    pub(crate) async fn insert_connection(
        &self,
        profile: &NewConnection,
        now: Timestamp,
    ) -> Result<Connection> {
        let mut writer = self.growing().await?;
        let mut transaction = writer.begin().await?;
        let row = sqlx::query(concat!(
            "INSERT INTO connections (id, display_name, paused, settings, secrets, revision, created_at_us, \
             updated_at_us) VALUES (?, ?, ?, ?, ?, 1, ?6, ?6) ON CONFLICT (id) DO NOTHING RETURNING ",
            columns!()
        ))
        .bind(profile.id.as_str())
        .bind(&profile.display_name)
        .bind(profile.paused)
        .bind(&profile.settings)
        .bind(&profile.secrets)
        .bind(now.as_microsecond())
        .fetch_optional(&mut *transaction)
        .await
        .map_err(failed)?;
        let connection = read_connection(&row.ok_or_else(|| connection_exists(&profile.id))?)?;
        check_limit(count(&mut transaction).await?, self.limits().outside_connections)?;
        self.record_connection(&mut transaction, AuditAction::ConnectionCreated, &connection, now).await?;
        transaction.commit().await.map_err(failed)?;
        Ok(connection)
    }

    pub(crate) async fn connection(&self, id: &ConnectionId) -> Result<Connection> {
        find_connection(self.readers(), id).await
    }

    pub(crate) async fn connections(
        &self,
        after: Option<&ConnectionId>,
        limit: u32,
    ) -> Result<Vec<Connection>> {
        let page = concat!("SELECT ", columns!(), " FROM connections WHERE id > ? ORDER BY id LIMIT ?");
        let rows = sqlx::query(page)
            .bind(after.map_or("", ConnectionId::as_str).to_owned())
            .bind(limit)
            .fetch_all(self.readers())
            .await
            .map_err(failed)?;
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
        check_version(&find_connection(&mut *transaction, &profile.id).await?, expected)?;
        let row = sqlx::query(concat!(
            "UPDATE connections SET display_name = ?, paused = ?, settings = ?, secrets = ?, updated_at_us = ?, \
             revision = revision + 1 WHERE id = ? RETURNING ",
            columns!()
        ))
        .bind(&profile.display_name)
        .bind(profile.paused)
        .bind(&profile.settings)
        .bind(&profile.secrets)
        .bind(now.as_microsecond())
        .bind(profile.id.as_str())
        .fetch_one(&mut *transaction)
        .await
        .map_err(failed)?;
        let connection = read_connection(&row)?;
        self.record_connection(&mut transaction, AuditAction::ConnectionChanged, &connection, now).await?;
        transaction.commit().await.map_err(failed)?;
        Ok(connection)
    }

    pub(crate) async fn delete_connection(
        &self,
        id: &ConnectionId,
        expected: Expected,
        now: Timestamp,
    ) -> Result<()> {
        let mut deletion = self.deletion().await?;
        let mut transaction = deletion.begin().await?;
        let connection = find_connection(&mut *transaction, id).await?;
        check_version(&connection, expected)?;
        sqlx::query("DELETE FROM outbox WHERE connection_key = ?")
            .bind(connection.key.0)
            .execute(&mut *transaction)
            .await
            .map_err(failed)?;
        sqlx::query("DELETE FROM connections WHERE key = ?")
            .bind(connection.key.0)
            .execute(&mut *transaction)
            .await
            .map_err(failed)?;
        self.record_connection(&mut transaction, AuditAction::ConnectionDeleted, &connection, now).await?;
        transaction.commit().await.map_err(failed)?;
        deletion.reclaim().await;
        Ok(())
    }

    async fn record_connection(
        &self,
        transaction: &mut SqliteConnection,
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
        self.record(transaction, Change::of(action, subject), now).await
    }
}

async fn count(connection: &mut SqliteConnection) -> Result<i64> {
    sqlx::query_scalar("SELECT count(*) FROM connections").fetch_one(connection).await.map_err(failed)
}

async fn find_connection(executor: impl SqliteExecutor<'_>, id: &ConnectionId) -> Result<Connection> {
    let row = sqlx::query(concat!("SELECT ", columns!(), " FROM connections WHERE id = ?"))
        .bind(id.as_str())
        .fetch_optional(executor)
        .await
        .map_err(failed)?;
    read_connection(&row.ok_or_else(|| no_connection(id))?)
}
