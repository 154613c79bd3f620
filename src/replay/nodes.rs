//! Connections to the nodes of a server that redirections name.

use std::collections::HashMap;
use std::sync::{Mutex, PoisonError};

use crate::domain::KeySecret;
use crate::grpc::client::{ClientError, Connection};

/// Connections by address. A server names as many as it has nodes.
#[derive(Default)]
pub(super) struct NodeConnections(Mutex<HashMap<String, Connection>>);

impl NodeConnections {
    /// The connection to a node.
    ///
    /// # Errors
    /// An address that this client cannot reach.
    pub(super) fn to(&self, url: &str, key: Option<&KeySecret>) -> Result<Connection, ClientError> {
        let mut nodes = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(known) = nodes.get(url) {
            return Ok(known.clone());
        }
        let connection = Connection::to(url, key)?;
        nodes.insert(url.to_owned(), connection.clone());
        Ok(connection)
    }
}
