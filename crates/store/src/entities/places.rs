//! Places.

use jiff::Timestamp;

use crate::database::Database;
use crate::domain::{AuditAction, ExpectedVersion, NewPlace, Place, PlaceId, PlaceKey, Result, TrackScope};
use crate::locks::{Limit, lock_limit};
use crate::query::{RowLock, Session, query, query_as, query_scalar};
use crate::refusals::no_place;
use crate::rows::audit::Change;
use crate::rows::places::{
    check_limit, check_version, place_columns as columns, place_exists, read_place, unknown_scope,
};

/// The version that a change of a place is based on, if the caller states it.
type Expected = Option<ExpectedVersion<PlaceKey>>;

impl Database {
    pub(crate) async fn insert_place(&self, profile: &NewPlace, now: Timestamp) -> Result<Place> {
        let mut writer = self.growing().await?;
        let mut transaction = writer.begin().await?;
        lock_limit(&mut transaction, Limit::Places).await?;
        let (site_key, camera_key) = scope_keys(&mut transaction, &profile.scope).await?;
        let row = query(concat!(
            "INSERT INTO places (id, site_key, camera_key, settings, revision, created_at_us, updated_at_us) \
             VALUES ($1, $2, $3, $4, 1, $5, $5) ON CONFLICT (id) DO NOTHING RETURNING ",
            columns!()
        ))
        .bind(profile.id.as_str())
        .bind(site_key)
        .bind(camera_key)
        .bind(&profile.settings)
        .bind(now.as_microsecond())
        .fetch_optional(&mut transaction)
        .await?;
        let place = read_place(&row.ok_or_else(|| place_exists(&profile.id))?)?;
        check_limit(count(&mut transaction).await?, self.limits().places)?;
        self.record_place(&mut transaction, AuditAction::PlaceCreated, &place, now).await?;
        transaction.commit().await?;
        Ok(place)
    }

    pub(crate) async fn place(&self, id: &PlaceId) -> Result<Place> {
        let mut reader = self.reader().await?;
        find_place(&mut reader, id).await
    }

    pub(crate) async fn places(
        &self,
        scope: Option<&TrackScope>,
        after: Option<&PlaceId>,
        limit: u32,
    ) -> Result<Vec<Place>> {
        let of_scope = match scope {
            Some(TrackScope::Site(_)) => "AND site_key = (SELECT key FROM sites WHERE id = $3)",
            Some(TrackScope::Camera(_)) => "AND camera_key = (SELECT key FROM cameras WHERE id = $3)",
            None => "",
        };
        let page = format!("SELECT {} FROM places WHERE id > $1 {of_scope} ORDER BY id LIMIT $2", columns!());
        let query = query(sqlx::AssertSqlSafe(page)).bind(after.map_or("", PlaceId::as_str)).bind(limit);
        let query = match scope {
            Some(TrackScope::Site(id)) => query.bind(id.as_str()),
            Some(TrackScope::Camera(id)) => query.bind(id.as_str()),
            None => query,
        };
        let mut reader = self.reader().await?;
        let rows = query.fetch_all(&mut reader).await?;
        rows.iter().map(read_place).collect()
    }

    pub(crate) async fn places_mark(&self) -> Result<[i64; 3]> {
        let mut reader = self.reader().await?;
        let (places, key, revisions): (i64, i64, i64) = query_as(
            "SELECT count(*), coalesce(max(key), 0), CAST(coalesce(sum(revision), 0) AS BIGINT) FROM places",
        )
        .fetch_one(&mut reader)
        .await?;
        Ok([places, key, revisions])
    }

    pub(crate) async fn replace_place(
        &self,
        profile: &NewPlace,
        expected: Expected,
        now: Timestamp,
    ) -> Result<Place> {
        let mut writer = self.synced().await?;
        let mut transaction = writer.begin().await?;
        lock_place(&mut transaction, &profile.id).await?;
        check_version(&find_place(&mut transaction, &profile.id).await?, expected)?;
        let row = query(concat!(
            "UPDATE places SET settings = $1, updated_at_us = $2, revision = revision + 1 WHERE id = $3 RETURNING ",
            columns!()
        ))
        .bind(&profile.settings)
        .bind(now.as_microsecond())
        .bind(profile.id.as_str())
        .fetch_one(&mut transaction)
        .await?;
        let place = read_place(&row)?;
        self.record_place(&mut transaction, AuditAction::PlaceChanged, &place, now).await?;
        transaction.commit().await?;
        Ok(place)
    }

    pub(crate) async fn delete_place(&self, id: &PlaceId, expected: Expected, now: Timestamp) -> Result<()> {
        let mut writer = self.deletion().await?;
        let mut transaction = writer.begin().await?;
        lock_place(&mut transaction, id).await?;
        let place = find_place(&mut transaction, id).await?;
        check_version(&place, expected)?;
        query("DELETE FROM places WHERE id = $1").bind(id.as_str()).execute(&mut transaction).await?;
        self.record_place(&mut transaction, AuditAction::PlaceDeleted, &place, now).await?;
        transaction.commit().await?;
        writer.reclaim().await;
        Ok(())
    }

    async fn record_place(
        &self,
        session: &mut dyn Session,
        action: AuditAction,
        place: &Place,
        now: Timestamp,
    ) -> Result<()> {
        let subject = match action {
            AuditAction::PlaceChanged => format!("place {}, revision {}", place.id(), place.revision.0),
            _ => format!("place {}", place.id()),
        };
        self.record(session, Change::of(action, subject), now).await
    }
}

/// Keys of the site or of the camera of a scope.
async fn scope_keys(session: &mut dyn Session, scope: &TrackScope) -> Result<(Option<i64>, Option<i64>)> {
    let (sql, id) = match scope {
        TrackScope::Site(id) => ("SELECT key FROM sites WHERE id = $1", id.as_str()),
        TrackScope::Camera(id) => ("SELECT key FROM cameras WHERE id = $1", id.as_str()),
    };
    let key: Option<i64> = query_scalar(sql).bind(id).fetch_optional(session).await?;
    let key = key.ok_or_else(|| unknown_scope(scope))?;
    Ok(match scope {
        TrackScope::Site(_) => (Some(key), None),
        TrackScope::Camera(_) => (None, Some(key)),
    })
}

async fn count(session: &mut dyn Session) -> Result<i64> {
    query_scalar("SELECT count(*) FROM places").fetch_one(session).await
}

/// Waits until no other transaction changes the place.
async fn lock_place(session: &mut dyn Session, id: &PlaceId) -> Result<()> {
    query("SELECT key FROM places WHERE id = $1")
        .locking(RowLock::Update)
        .bind(id.as_str())
        .execute(session)
        .await?;
    Ok(())
}

async fn find_place(session: &mut dyn Session, id: &PlaceId) -> Result<Place> {
    let row = query(concat!("SELECT ", columns!(), " FROM places WHERE id = $1"))
        .bind(id.as_str())
        .fetch_optional(session)
        .await?;
    read_place(&row.ok_or_else(|| no_place(id))?)
}
