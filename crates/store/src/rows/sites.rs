//! Rows of sites.

use std::collections::BTreeMap;

use crate::domain::{Error, ErrorKind, ExpectedVersion, NewSite, Result, Site, SiteId, SiteKey};
use crate::geo::Position;
use crate::row_decoder::{RowDecoder, StoredRow};
use crate::rows::history::StoredHistory;

/// Columns to select, in the order of [`read_site`].
macro_rules! site_columns {
    () => {
        "key, id, display_name, labels, origin_longitude_deg, origin_latitude_deg, history, revision, \
         created_at_us, updated_at_us, (SELECT count(*) FROM cameras WHERE site_key = sites.key) AS cameras"
    };
}

pub(crate) fn check_version(site: &Site, expected: Option<ExpectedVersion<SiteKey>>) -> Result<()> {
    expected.map_or(Ok(()), |expected| expected.check("site", site.key, site.revision))
}

pub(crate) fn read_site(row: &StoredRow) -> Result<Site> {
    let mut fields = RowDecoder::new("sites", row);
    let key = SiteKey(fields.get()?);
    let id = fields.parse(SiteId::new)?;
    let display_name = fields.get()?;
    let labels = fields.parse(serde_json::from_str::<BTreeMap<String, String>>)?;
    let (longitude_deg, latitude_deg): (Option<f64>, Option<f64>) = (fields.get()?, fields.get()?);
    let origin = longitude_deg.zip(latitude_deg);
    let origin = fields.checked(origin.map(|(east, north)| Position::new(east, north)).transpose())?;
    let history = fields.parse_optional(|json: &str| {
        serde_json::from_str::<StoredHistory>(json).map_err(Error::fault)?.to_domain()
    })?;
    let revision = fields.revision()?;
    let (created_at, updated_at) = (fields.timestamp()?, fields.timestamp()?);
    let cameras = fields.count()?;
    Ok(Site {
        key,
        profile: NewSite { id, display_name, labels, origin, history },
        revision,
        created_at,
        updated_at,
        cameras,
    })
}

pub(crate) use site_columns;

/// The refusal of a site whose id is taken.
pub(crate) fn site_exists(id: &SiteId) -> Error {
    Error::field(ErrorKind::SiteExists, "id", format!("a site of the id {id} exists already"))
}

/// Refuses the deletion of a site that cameras belong to.
pub(crate) fn check_unused(site: &Site) -> Result<()> {
    if site.cameras == 0 {
        return Ok(());
    }
    let message = format!("the site has {} camera(s); give them another site, or none, first", site.cameras);
    Err(Error::refused(ErrorKind::SiteInUse, message))
}

/// Refuses the site that was just inserted if it is one too many.
pub(crate) fn check_limit(sites: i64, limit: u32) -> Result<()> {
    if sites <= i64::from(limit) {
        return Ok(());
    }
    let message =
        format!("limits.sites is {limit}; delete a site that is no longer needed, or raise the limit");
    Err(Error::refused(ErrorKind::InsufficientStorage, message))
}
