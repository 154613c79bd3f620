//! Rows of places.

use crate::domain::{
    CameraId, Error, ErrorKind, ExpectedVersion, NewPlace, Place, PlaceId, PlaceKey, Result, SiteId,
    TrackScope,
};
use crate::row_decoder::{RowDecoder, StoredRow};

/// Columns to select, in the order of [`read_place`].
macro_rules! place_columns {
    () => {
        "key, id, (SELECT id FROM sites WHERE sites.key = places.site_key) AS site_id, \
         (SELECT id FROM cameras WHERE cameras.key = places.camera_key) AS camera_id, settings, revision, \
         created_at_us, updated_at_us"
    };
}
pub(crate) use place_columns;

pub(crate) fn check_version(place: &Place, expected: Option<ExpectedVersion<PlaceKey>>) -> Result<()> {
    expected.map_or(Ok(()), |expected| expected.check("place", place.key, place.revision))
}

pub(crate) fn read_place(row: &StoredRow) -> Result<Place> {
    let mut fields = RowDecoder::new("places", row);
    let key = PlaceKey(fields.get()?);
    let id = fields.parse(PlaceId::new)?;
    let site = fields.parse_optional(|id: &str| SiteId::new(id))?;
    let camera = fields.parse_optional(|id: &str| CameraId::new(id))?;
    let scope = site.map(TrackScope::Site).or(camera.map(TrackScope::Camera));
    let scope = fields.checked(scope.ok_or("a place belongs to a site or a camera"))?;
    Ok(Place {
        key,
        profile: NewPlace { id, scope, settings: fields.get()? },
        revision: fields.revision()?,
        created_at: fields.timestamp()?,
        updated_at: fields.timestamp()?,
    })
}

/// The refusal of a place whose id is taken.
pub(crate) fn place_exists(id: &PlaceId) -> Error {
    Error::field(ErrorKind::PlaceExists, "id", format!("a place of the id {id} exists already"))
}

/// The refusal of a place of a site or camera that does not exist.
pub(crate) fn unknown_scope(scope: &TrackScope) -> Error {
    let field = match scope {
        TrackScope::Site(_) => "site_id",
        TrackScope::Camera(_) => "camera_id",
    };
    Error::invalid(field, format!("there is no {scope}; create it first"))
}

/// Refuses the place that was just inserted if it is one too many.
pub(crate) fn check_limit(places: i64, limit: u32) -> Result<()> {
    if places <= i64::from(limit) {
        return Ok(());
    }
    let message =
        format!("limits.places is {limit}; delete a place that is no longer needed, or raise the limit");
    Err(Error::refused(ErrorKind::InsufficientStorage, message))
}
