//! Rows of connections with other systems, and of their outboxes.

use crate::domain::{
    Connection, ConnectionId, ConnectionKey, DeadLetter, Error, ErrorKind, ExpectedVersion, NewConnection,
    OutboxMessage, Result, SourceOffset,
};
use crate::row_decoder::{RowDecoder, StoredRow};

/// Columns to select, in the order of [`read_connection`].
macro_rules! connection_columns {
    () => {
        "key, id, display_name, paused, settings, secrets, revision, created_at_us, updated_at_us"
    };
}
pub(crate) use connection_columns;

/// The refusal of a connection whose id is taken.
pub(crate) fn connection_exists(id: &ConnectionId) -> Error {
    Error::field(ErrorKind::ConnectionExists, "id", format!("a connection of the id {id} exists already"))
}

/// Refuses the connection that was just inserted if it is one too many.
pub(crate) fn check_limit(connections: i64, limit: u32) -> Result<()> {
    if connections <= i64::from(limit) {
        return Ok(());
    }
    let message = format!(
        "limits.outside_connections is {limit}; delete a connection that is no longer needed, or raise the limit"
    );
    Err(Error::refused(ErrorKind::InsufficientStorage, message))
}

pub(crate) fn check_version(
    connection: &Connection,
    expected: Option<ExpectedVersion<ConnectionKey>>,
) -> Result<()> {
    expected.map_or(Ok(()), |expected| expected.check("connection", connection.key, connection.revision))
}

pub(crate) fn read_connection(row: &StoredRow) -> Result<Connection> {
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

pub(crate) fn read_message(fields: &mut RowDecoder<'_>) -> Result<OutboxMessage> {
    Ok(OutboxMessage {
        number: fields.get()?,
        message_id: fields.get()?,
        subject: fields.get()?,
        payload: fields.get()?,
        created_at: fields.timestamp()?,
    })
}

pub(crate) fn read_dead_letter(row: &StoredRow) -> Result<DeadLetter> {
    let mut fields = RowDecoder::new("outbox", row);
    Ok(DeadLetter { message: read_message(&mut fields)?, reason: fields.get()? })
}

pub(crate) fn read_source_offset(row: &StoredRow) -> Result<SourceOffset> {
    let mut fields = RowDecoder::new("source_offsets", row);
    Ok(SourceOffset {
        topic: fields.get()?,
        partition: fields.parse(|number: i64| i32::try_from(number))?,
        next_offset: fields.get()?,
    })
}
