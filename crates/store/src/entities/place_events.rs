//! Events of places.

use std::collections::BTreeSet;

use jiff::Timestamp;

use super::outbox::{insert_message, trim_queued};
use super::place_counts::{add_counts, prune_counts};
use crate::database::Database;
use crate::domain::{
    NewPlaceEvent, PlaceCount, PlaceEventFilter, Result, StoredPlaceEvent, StoredPlaceEvents, TrackScope,
};
use crate::locks::{Limit, lock_limit};
use crate::query::{Session, query, query_as};

impl Database {
    pub(crate) async fn insert_place_events(
        &self,
        events: &[NewPlaceEvent],
        counts: &[PlaceCount],
        now: Timestamp,
    ) -> Result<StoredPlaceEvents> {
        let mut writer = self.growing().await?;
        let mut transaction = writer.begin().await?;
        lock_limit(&mut transaction, Limit::PlaceEvents).await?;
        let mut outcome = StoredPlaceEvents::default();
        let mut sinks = BTreeSet::new();
        for event in events {
            if insert_event(&mut transaction, event, now).await? {
                outcome.stored += 1;
                sinks.extend(event.messages.iter().map(|(sink, _)| *sink));
            }
        }
        for sink in sinks {
            outcome.dropped += trim_queued(&mut transaction, sink, self.limits().outbox_messages).await?;
        }
        if outcome.stored > 0 {
            query("DELETE FROM place_events WHERE number <= (SELECT max(number) FROM place_events) - $1")
                .bind(self.limits().place_events)
                .execute(&mut transaction)
                .await?;
        }
        add_counts(&mut transaction, counts).await?;
        prune_counts(&mut transaction, counts, self.limits()).await?;
        transaction.commit().await?;
        Ok(outcome)
    }

    pub(crate) async fn place_events(
        &self,
        filter: &PlaceEventFilter,
        after: i64,
        limit: u32,
    ) -> Result<Vec<StoredPlaceEvent>> {
        let mut conditions = String::new();
        let mut values = Vec::new();
        let mut add = |condition: &str, value: &str| {
            values.push(value.to_owned());
            conditions.push_str(&condition.replace('?', &format!("${}", values.len() + 2)));
        };
        match &filter.scope {
            Some(TrackScope::Site(id)) => {
                add(" AND places.site_key = (SELECT key FROM sites WHERE id = ?)", id.as_str())
            }
            Some(TrackScope::Camera(id)) => {
                add(" AND places.camera_key = (SELECT key FROM cameras WHERE id = ?)", id.as_str());
            }
            None => {}
        }
        if let Some(id) = &filter.place {
            add(" AND places.id = ?", id.as_str());
        }
        if let Some(kind) = filter.kind {
            add(" AND kind = ?", kind);
        }
        let sql = format!(
            "SELECT number, content FROM place_events JOIN places ON places.key = place_key \
             WHERE number > $1{conditions} ORDER BY number LIMIT $2"
        );
        let page = query_as(sqlx::AssertSqlSafe(sql)).bind(after).bind(limit);
        let page = values.into_iter().fold(page, |page, value| page.bind(value));
        let mut reader = self.reader().await?;
        let rows: Vec<(i64, String)> = page.fetch_all(&mut reader).await?;
        Ok(rows.into_iter().map(|(number, content)| StoredPlaceEvent { number, content }).collect())
    }

    pub(crate) async fn place_event_bounds(&self) -> Result<(i64, i64)> {
        let mut reader = self.reader().await?;
        query_as("SELECT coalesce(max(number), 0), coalesce(min(number), 0) FROM place_events")
            .fetch_one(&mut reader)
            .await
    }
}

/// Stores an event with its messages, unless it was stored before; true if it is new.
async fn insert_event(session: &mut dyn Session, event: &NewPlaceEvent, now: Timestamp) -> Result<bool> {
    let inserted = query(
        "INSERT INTO place_events (event_id, place_key, kind, stored_at_us, content) \
         SELECT $1, key, $2, $3, $4 FROM places WHERE key = $5 ON CONFLICT (event_id) DO NOTHING",
    )
    .bind(&event.id)
    .bind(event.kind)
    .bind(now.as_microsecond())
    .bind(&event.content)
    .bind(event.place.0)
    .execute(session)
    .await?;
    if inserted == 0 {
        return Ok(false);
    }
    for (connection, message) in &event.messages {
        insert_message(session, *connection, message).await?;
    }
    Ok(true)
}
