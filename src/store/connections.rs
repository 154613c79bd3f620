//! Connections with other systems.

use jiff::Timestamp;
use sqlx::sqlite::SqliteRow;
use sqlx::{SqliteConnection, SqliteExecutor};

use super::Store;
use super::audit::Change;
use super::errors::{failed, no_connection};
use super::row_decoder::RowDecoder;
use crate::domain::{
    AuditAction, Connection, ConnectionId, ConnectionKey, Error, ErrorKind, ExpectedVersion, NewConnection,
    Result,
};

macro_rules! columns {
    () => {
        "key, id, display_name, paused, settings, secrets, revision, created_at_us, updated_at_us"
    };
}

/// What a change of a connection is based on, if the caller states it.
type Expected = Option<ExpectedVersion<ConnectionKey>>;

impl Store {
    /// Stores a new connection with revision 1.
    ///
    /// # Errors
    /// [`ErrorKind::ConnectionExists`]; [`ErrorKind::InsufficientStorage`] beyond the limit of connections.
    pub async fn insert_connection(&self, profile: &NewConnection, now: Timestamp) -> Result<Connection> {
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
        let Some(row) = row else {
            let taken = format!("a connection of the id {} exists already", profile.id);
            return Err(Error::field(ErrorKind::ConnectionExists, "id", taken));
        };
        let connection = read_connection(&row)?;
        check_limit(&mut transaction, self.limits().outside_connections).await?;
        self.record_connection(&mut transaction, AuditAction::ConnectionCreated, &connection, now).await?;
        transaction.commit().await.map_err(failed)?;
        Ok(connection)
    }

    /// One connection, with its secrets.
    ///
    /// # Errors
    /// [`ErrorKind::ConnectionNotFound`].
    pub async fn connection(&self, id: &ConnectionId) -> Result<Connection> {
        find_connection(self.readers(), id).await
    }

    /// A page of connections ordered by id, after an id.
    ///
    /// # Errors
    /// Faults only.
    pub async fn connections(&self, after: Option<&ConnectionId>, limit: u32) -> Result<Vec<Connection>> {
        let page = concat!("SELECT ", columns!(), " FROM connections WHERE id > ? ORDER BY id LIMIT ?");
        let rows = sqlx::query(page)
            .bind(after.map_or("", ConnectionId::as_str).to_owned())
            .bind(limit)
            .fetch_all(self.readers())
            .await
            .map_err(failed)?;
        rows.iter().map(read_connection).collect()
    }

    /// Puts a profile in the place of the stored one and counts its revision up, if the stored revision is the
    /// expected one.
    ///
    /// # Errors
    /// [`ErrorKind::ConnectionNotFound`], [`ErrorKind::RevisionMismatch`].
    pub async fn replace_connection(
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

    /// Deletes a connection with its outbox, if its revision is the expected one.
    ///
    /// # Errors
    /// [`ErrorKind::ConnectionNotFound`], [`ErrorKind::RevisionMismatch`].
    pub async fn delete_connection(
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

/// Refuses the connection that was just inserted if it is one too many.
async fn check_limit(connection: &mut SqliteConnection, limit: u32) -> Result<()> {
    let count: i64 =
        sqlx::query_scalar("SELECT count(*) FROM connections").fetch_one(connection).await.map_err(failed)?;
    if count > i64::from(limit) {
        let message = format!(
            "limits.outside_connections is {limit}; delete a connection that is no longer needed, or raise the limit"
        );
        return Err(Error::refused(ErrorKind::InsufficientStorage, message));
    }
    Ok(())
}

async fn find_connection(executor: impl SqliteExecutor<'_>, id: &ConnectionId) -> Result<Connection> {
    let row = sqlx::query(concat!("SELECT ", columns!(), " FROM connections WHERE id = ?"))
        .bind(id.as_str())
        .fetch_optional(executor)
        .await
        .map_err(failed)?;
    read_connection(&row.ok_or_else(|| no_connection(id))?)
}

fn check_version(connection: &Connection, expected: Expected) -> Result<()> {
    expected.map_or(Ok(()), |expected| expected.check("connection", connection.key, connection.revision))
}

fn read_connection(row: &SqliteRow) -> Result<Connection> {
    let mut fields = RowDecoder::new("connections", row);
    let key = ConnectionKey(fields.get()?);
    let profile = NewConnection {
        id: fields.parse(ConnectionId::new)?,
        display_name: fields.get()?,
        paused: fields.get()?,
        settings: fields.get()?,
        secrets: fields.get()?,
    };
    Ok(Connection {
        key,
        profile,
        revision: fields.revision()?,
        created_at: fields.timestamp()?,
        updated_at: fields.timestamp()?,
    })
}
