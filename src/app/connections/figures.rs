//! Figures of connections for the metrics.

use super::Connections;
use crate::domain::Result;
use crate::telemetry::OutsideFigures;

impl Connections<'_> {
    /// The figures of the connections of this node.
    ///
    /// # Errors
    /// A fault of the store.
    pub async fn figures(&self) -> Result<Vec<OutsideFigures>> {
        let mut figures = Vec::new();
        for (id, key, status) in self.board.all() {
            let outbox = self.store.outbox_counts(key).await?;
            let waits_since = outbox.oldest_at.map(|oldest_at| self.clock.now().duration_since(oldest_at));
            figures.push(OutsideFigures {
                id: id.as_str().to_owned(),
                state: status.state.into(),
                messages: status.messages,
                items: status.items,
                skipped: status.skipped,
                rejected: status.rejected,
                dropped: status.dropped + status.lost,
                queued: status.unsettled + outbox.queued,
                dead_letters: outbox.dead,
                lag_s: waits_since.map_or(status.lag_s, |lag| Some(lag.as_secs_f64().max(0.0))),
            });
        }
        figures.sort_by(|one, other| one.id.cmp(&other.id));
        Ok(figures)
    }
}
