//! Connections with other systems.
//!
//! Here they are created, changed and watched; `connect` runs them.

mod figures;
mod groups;
mod outbox;
mod reports;
mod status;

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::{Arc, OnceLock};
use std::time::Duration;

use bytes::Bytes;
use tokio::sync::{mpsc, oneshot};

use super::access::Caller;
use super::active_cameras::ActiveCameras;
use super::cluster::Nodes;
use super::{App, Page, page_of};
use crate::clock::Clock;
use crate::domain::{
    Connection, ConnectionId, ConnectionKey, DeadLetter, Error, ErrorKind, ExpectedVersion, NewConnection,
    OutboxCounts, Result, check_text,
};
use crate::exchange::kinds::{SerialLine, SourceKind};
use crate::exchange::{ConnectionDraft, ConnectionSettings, Secrets, SourceSettings};
use crate::store::Store;

pub use groups::connection_groups;
pub use outbox::Outboxes;
pub use reports::{ConnectionNode, ReportedStatuses};
pub use status::{
    ConnectionBoard, ConnectionState, ConnectionStatus, CountedReason, LastMessage, LiveConnection,
    PushedMessage,
};

/// A pushed message waits at most this long for a source that was just created or resumed.
const SOURCE_START: Duration = Duration::from_secs(2);

/// A connection as a caller describes it.
#[derive(Debug, Clone)]
pub struct ConnectionRequest {
    pub id: ConnectionId,
    /// The name for people; the id if left out.
    pub display_name: Option<String>,
    /// True if it is paused.
    pub paused: bool,
    /// The settings of its source or sink.
    pub settings: ConnectionSettings,
    /// Secrets to be set, or removed.
    pub secrets: BTreeMap<String, Option<String>>,
}

impl TryFrom<ConnectionDraft> for ConnectionRequest {
    type Error = Error;

    fn try_from(draft: ConnectionDraft) -> Result<Self> {
        Ok(Self {
            id: ConnectionId::new(&draft.id)?,
            display_name: draft.display_name,
            paused: draft.paused,
            settings: ConnectionSettings { source: draft.source, sink: draft.sink },
            secrets: draft.secrets,
        })
    }
}

impl ConnectionRequest {
    fn into_profile(self, known: Secrets) -> Result<NewConnection> {
        let display_name = self.display_name.unwrap_or_else(|| self.id.as_str().to_owned());
        check_text("display_name", &display_name, 200)?;
        let secrets = known.changed(self.secrets)?;
        self.settings.check(&secrets)?;
        Ok(NewConnection {
            id: self.id,
            display_name,
            paused: self.paused,
            settings: serde_json::to_string(&self.settings).map_err(Error::fault)?,
            secrets: serde_json::to_string(&secrets).map_err(Error::fault)?,
        })
    }
}

fn not_receiving(id: &ConnectionId) -> Error {
    let message = format!("connection {id} takes no messages: it is paused, or its address is not push:");
    Error::refused(ErrorKind::ConnectionNotReceiving, message)
}

/// The stored settings of a connection.
///
/// # Errors
/// A fault if they cannot be read.
pub fn connection_settings(connection: &Connection) -> Result<(ConnectionSettings, Secrets)> {
    let settings = serde_json::from_str(&connection.profile.settings).map_err(Error::fault)?;
    Ok((settings, serde_json::from_str(&connection.profile.secrets).map_err(Error::fault)?))
}

/// Connections with other systems.
#[derive(Clone, Copy)]
pub struct Connections<'a> {
    cameras: ActiveCameras<'a>,
    store: &'a Store,
    board: &'a ConnectionBoard,
    nodes: Nodes<'a>,
    serial_devices: &'a OnceLock<Vec<PathBuf>>,
    clock: &'a Clock,
    caller: &'a Caller,
}

impl App {
    /// Connections with other systems.
    #[must_use]
    pub fn connections(&self) -> Connections<'_> {
        Connections {
            cameras: self.active_cameras(),
            store: &self.store,
            board: &self.connection_board,
            nodes: self.nodes(),
            serial_devices: &self.serial_devices,
            clock: &self.clock,
            caller: &self.caller,
        }
    }
}

impl Connections<'_> {
    /// Stores a new connection, which starts at once unless it is paused.
    ///
    /// # Errors
    /// `ConnectionExists`; `InvalidArgument` naming the field; `InsufficientStorage` beyond the limit.
    pub async fn create(&self, request: ConnectionRequest) -> Result<Connection> {
        self.check_device(&request)?;
        let settings = request.settings.clone();
        let profile = request.into_profile(Secrets::default())?;
        self.check_cameras(&settings).await?;
        let connection = self.store.insert_connection(&profile, self.clock.now()).await?;
        self.board.notify();
        Ok(connection)
    }

    /// Stores a connection that the settings declare: a new one, or a change of the stored one where it differs.
    ///
    /// # Errors
    /// `InvalidArgument` naming the field; `InsufficientStorage` beyond the limit.
    pub async fn declare(&self, request: ConnectionRequest) -> Result<()> {
        self.check_device(&request)?;
        let profile = request.into_profile(Secrets::default())?;
        let now = self.clock.now();
        match self.store.connection(&profile.id).await {
            Ok(stored) if stored.profile == profile => Ok(()),
            Ok(stored) => {
                self.store.replace_connection(&profile, Some(stored.version()), now).await.map(drop)
            }
            Err(error) if error.kind() == ErrorKind::ConnectionNotFound => {
                self.store.insert_connection(&profile, now).await.map(drop)
            }
            Err(error) => Err(error),
        }
    }

    /// Checks that the cameras exist that settings name.
    async fn check_cameras(&self, settings: &ConnectionSettings) -> Result<()> {
        for (field, camera) in settings.named_cameras()? {
            match self.cameras.get(&camera).await {
                Err(error) if error.kind() == ErrorKind::CameraNotFound => {
                    let message = format!("there is no camera {camera}; create it first");
                    return Err(Error::invalid(field, message));
                }
                known => drop(known?),
            }
        }
        Ok(())
    }

    /// Checks that a connection that is not paused may read its serial device, if it has one.
    fn check_device(&self, request: &ConnectionRequest) -> Result<()> {
        let source = request.settings.source.as_ref().filter(|_| !request.paused);
        let Some(source) = source else { return Ok(()) };
        let checked = source.kind().and_then(|kind| match kind {
            SourceKind::Serial(line) => self.check_serial_line(&line),
            _ => Ok(()),
        });
        checked.map_err(|error| error.under("source"))
    }

    /// Checks that the operator of the machine lets a serial device be read.
    ///
    /// # Errors
    /// `InvalidArgument` naming `address`.
    pub fn check_serial_line(&self, line: &SerialLine) -> Result<()> {
        if self.serial_devices.get().is_some_and(|devices| devices.contains(&line.path)) {
            return Ok(());
        }
        let path = line.path.display();
        let message = format!("{path} may not be read; name it in the setting serial_devices of the server");
        Err(Error::invalid("address", message))
    }

    /// One connection.
    ///
    /// # Errors
    /// `ConnectionNotFound`.
    pub async fn get(&self, id: &ConnectionId) -> Result<Connection> {
        self.store.connection(id).await
    }

    /// Connections by id, after a cursor.
    ///
    /// # Errors
    /// A fault of the store.
    pub async fn list(
        &self,
        after: Option<&ConnectionId>,
        limit: u32,
    ) -> Result<Page<Connection, ConnectionId>> {
        let connections = self.store.connections(after, limit + 1).await?;
        Ok(page_of(connections, limit, |connection| connection.id().clone()))
    }

    /// Replaces the stored description. Secrets that it does not name stay while scheme, host and port of the address do;
    /// else they are removed, for who may change an address need not know them. It starts again.
    ///
    /// # Errors
    /// `ConnectionNotFound`, `RevisionMismatch`, `InvalidArgument` naming the field.
    pub async fn change(
        &self,
        request: ConnectionRequest,
        expected: ExpectedVersion<ConnectionKey>,
    ) -> Result<Connection> {
        let stored = self.store.connection(&request.id).await?;
        let (settings, secrets) = connection_settings(&stored)?;
        self.check_device(&request)?;
        let kept = if settings.has_peer_of(&request.settings) { secrets } else { Secrets::default() };
        let wanted = request.settings.clone();
        let profile = request.into_profile(kept)?;
        // One whose camera was deleted since can still be paused.
        if wanted != settings {
            self.check_cameras(&wanted).await?;
        }
        let connection = self.store.replace_connection(&profile, Some(expected), self.clock.now()).await?;
        self.board.notify();
        Ok(connection)
    }

    /// Deletes a connection with its outbox.
    ///
    /// # Errors
    /// `ConnectionNotFound`, `RevisionMismatch`.
    pub async fn delete(
        &self,
        id: &ConnectionId,
        expected: Option<ExpectedVersion<ConnectionKey>>,
    ) -> Result<()> {
        self.store.delete_connection(id, expected, self.clock.now()).await?;
        self.board.forget(id);
        self.board.notify();
        Ok(())
    }

    /// The status of a connection, the node that runs it if several share the database, and the counts of its outbox.
    ///
    /// # Errors
    /// A fault of the store.
    pub async fn status(
        &self,
        connection: &Connection,
    ) -> Result<(ConnectionStatus, Option<ConnectionNode>, OutboxCounts)> {
        let (mut status, node) = self.status_on_any_node(connection).await?;
        let outbox = self.store.outbox_counts(connection.key).await?;
        if let Some(oldest_at) = outbox.oldest_at {
            status.lag_s = Some(self.clock.now().duration_since(oldest_at).as_secs_f64().max(0.0));
        }
        Ok((status, node, outbox))
    }

    /// The live part of a connection.
    #[must_use]
    pub fn live(&self, connection: &Connection) -> Arc<LiveConnection> {
        self.board.live(connection.id(), connection.key)
    }

    /// Dead letters of a connection, oldest first, after the number of one.
    ///
    /// # Errors
    /// `ConnectionNotFound`.
    pub async fn dead_letters(
        &self,
        id: &ConnectionId,
        after: i64,
        limit: u32,
    ) -> Result<Page<DeadLetter, i64>> {
        let connection = self.store.connection(id).await?;
        let letters = self.store.dead_letters(connection.key, after, limit + 1).await?;
        Ok(page_of(letters, limit, |letter| letter.message.number))
    }

    /// Tries all dead letters of a connection again; how many.
    ///
    /// # Errors
    /// `ConnectionNotFound`.
    pub async fn retry_dead_letters(&self, id: &ConnectionId) -> Result<u64> {
        let connection = self.store.connection(id).await?;
        self.store.retry_dead_letters(&connection, self.clock.now()).await
    }

    /// Deletes all dead letters of a connection; how many.
    ///
    /// # Errors
    /// `ConnectionNotFound`.
    pub async fn delete_dead_letters(&self, id: &ConnectionId) -> Result<u64> {
        let connection = self.store.connection(id).await?;
        self.store.delete_dead_letters(&connection, self.clock.now()).await
    }

    /// Hands a message to a source that takes them by HTTP; returns when what was to be stored is stored, with the JSON
    /// document that the sender expects as its answer, if any.
    ///
    /// # Errors
    /// `PermissionDenied` for a key that is restricted to other cameras than the source names;
    /// `ConnectionNotFound`; `ConnectionNotReceiving` if it is paused or has another kind of address; `Overloaded`
    /// while its queue is full; `MalformedBody` for a message that cannot be read; `CameraOnOtherNode`,
    /// `CameraBetweenNodes` where another node runs the source.
    pub async fn push(&self, id: &ConnectionId, payload: Bytes) -> Result<Option<&'static str>> {
        let connection = self.store.connection(id).await?;
        let (settings, _) = connection_settings(&connection)?;
        let source = settings.source.ok_or_else(|| not_receiving(id))?;
        self.authorize_source(&source)?;
        let inlet = self.inlet(&connection).await?;
        let (settled, settlement) = oneshot::channel();
        let sender = self.caller.actor().name.to_string();
        let message = PushedMessage { sender, payload: payload.clone(), settled };
        inlet.try_send(message).map_err(|_| {
            Error::refused(ErrorKind::Overloaded, format!("connection {id} has too many messages to do"))
        })?;
        match settlement.await {
            Ok(Ok(())) => Ok(source.format.answer(&payload)),
            Ok(Err(reason)) => Err(Error::refused(ErrorKind::MalformedBody, reason)),
            Err(_) => {
                self.check_receiving(&connection).await?;
                Err(not_receiving(id))
            }
        }
    }

    /// The way to the running source of a connection, which may only just begin.
    async fn inlet(&self, connection: &Connection) -> Result<mpsc::Sender<PushedMessage>> {
        let live = self.live(connection);
        if let Some(inlet) = live.inlet() {
            return Ok(inlet);
        }
        self.check_receiving(connection).await?;
        live.opened_inlet(SOURCE_START).await.ok_or_else(|| not_receiving(connection.id()))
    }

    /// Checks that a connection is a source that takes messages by HTTP, on this node.
    async fn check_receiving(&self, connection: &Connection) -> Result<()> {
        let (settings, _) = connection_settings(connection)?;
        let kind = settings.source.as_ref().map(|source| source.kind()).transpose()?;
        if connection.profile.paused || !matches!(kind, Some(SourceKind::Push)) {
            return Err(not_receiving(connection.id()));
        }
        self.nodes.source_elsewhere(connection.id(), connection.key).await?.map_or(Ok(()), Err)
    }

    /// Checks that the caller may reach every camera that a source feeds.
    fn authorize_source(&self, source: &SourceSettings) -> Result<()> {
        let is_restricted = self.caller.principal().scope().is_some_and(|scope| !scope.cameras().is_empty());
        if !is_restricted {
            return Ok(());
        }
        if source.names_any_camera() {
            let message = "the key is restricted to cameras, and the connection's messages may name any";
            return Err(Error::refused(ErrorKind::PermissionDenied, message));
        }
        let mapped = source.cameras.values().map(|mapping| mapping.camera());
        for camera in mapped.chain(source.fix_cameras()?.into_iter().map(Ok)) {
            self.caller.authorize_camera(&camera?)?;
        }
        Ok(())
    }
}
