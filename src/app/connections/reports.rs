//! The status of connections, as every node shows it.

use std::collections::HashMap;

use super::Connections;
use super::status::{ConnectionState, ConnectionStatus};
use crate::domain::{Connection, ConnectionKey, Error, NodeId, Result};
use crate::store::ConnectionReports;

/// The node that runs a connection.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ConnectionNode {
    pub id: NodeId,
    /// Where clients reach it, if that is known.
    pub url: Option<String>,
}

/// The statuses that this node has reported to the others.
#[derive(Default)]
pub struct ReportedStatuses {
    node: Option<NodeId>,
    statuses: HashMap<ConnectionKey, ConnectionStatus>,
}

impl Connections<'_> {
    /// Tells other nodes what has changed of the connections that run here, if there are other nodes.
    ///
    /// # Errors
    /// The database does not answer.
    pub async fn report(&self, reported: &mut ReportedStatuses) -> Result<()> {
        let Some(node) = self.nodes.reporting_node() else { return Ok(()) };
        if reported.node.replace(node) != Some(node) {
            reported.statuses.clear();
        }
        let mut statuses = self.board.statuses();
        // A status that equals the reported one needs no report.
        statuses.retain(|key, status| *reported.statuses.entry(*key).or_default() != *status);
        if statuses.is_empty() {
            return Ok(());
        }
        let texts = statuses.iter().map(|(key, status)| {
            serde_json::to_string(status).map(|text| (*key, text)).map_err(Error::fault)
        });
        self.nodes.store_connection_statuses(node, &texts.collect::<Result<Vec<_>>>()?).await?;
        reported.statuses.extend(statuses);
        Ok(())
    }

    /// The status of a connection, whichever node runs it, and that node. Counts are those of all nodes.
    ///
    /// # Errors
    /// The database does not answer.
    pub(super) async fn status_on_any_node(
        &self,
        connection: &Connection,
    ) -> Result<(ConnectionStatus, Option<ConnectionNode>)> {
        let own = self.live(connection).status();
        let (Some(reports), Some(node)) =
            (self.nodes.connection_reports(connection.key).await?, self.nodes.reporting_node())
        else {
            return Ok((own, None));
        };
        let ConnectionReports { owner, statuses } = reports;
        let others = statuses.into_iter().filter(|(reporter, _)| *reporter != node);
        // A report that another version wrote may be unreadable, which is no reason to show nothing.
        let others =
            others.filter_map(|(reporter, text)| Some((reporter, serde_json::from_str(&text).ok()?)));
        let all: HashMap<NodeId, ConnectionStatus> = others.chain([(node, own)]).collect();
        let of_owner = owner.as_ref().and_then(|(id, _)| all.get(id)).cloned();
        let mut shown = of_owner.unwrap_or_else(|| {
            let state =
                if connection.profile.paused { ConnectionState::Paused } else { ConnectionState::Waiting };
            ConnectionStatus { state, ..ConnectionStatus::default() }
        });
        shown.set_counts(all.values());
        Ok((shown, owner.map(|(id, url)| ConnectionNode { id, url })))
    }
}
