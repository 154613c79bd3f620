//! Where the features of the collections come from.

use serde::Serialize;
use serde_json::{Map, Value, json};

use super::collection::CollectionId;
use super::query::{Area, Selection};
use crate::app::{App, CameraStatus, TrackPoint};
use crate::domain::{CameraId, Error, ErrorKind, Result, Score, SigmaM, StoredSample, TargetId};
use crate::exchange::{read_cursor, write_cursor};
use crate::geo::Position;
use crate::http::resources::tracks::track_properties;
use crate::store::{SampleFilter, SampleKey};

/// Samples that one request looks at for those in an area.
const MOST_SCANNED: usize = 20_000;

/// A feature of a collection.
pub(super) struct Feature {
    pub(super) id: String,
    pub(super) geometry: Geometry,
    pub(super) properties: Map<String, Value>,
}

/// The geometry of a feature.
pub(super) enum Geometry {
    /// None is known.
    Unknown,
    Point(Position),
    /// A convex area, by its corners counterclockwise.
    Polygon(Vec<Position>),
}

/// Features, and where the next ones begin.
pub(super) struct FeaturePage {
    pub(super) features: Vec<Feature>,
    pub(super) next: Option<String>,
}

impl Geometry {
    /// As RFC 7946 has it.
    pub(super) fn to_geojson(&self) -> Value {
        match self {
            Self::Unknown => Value::Null,
            Self::Point(point) => json!({ "type": "Point", "coordinates": coordinates(*point) }),
            Self::Polygon(corners) => {
                let ring = corners.iter().chain(corners.first()).copied().map(coordinates);
                json!({ "type": "Polygon", "coordinates": [ring.collect::<Vec<_>>()] })
            }
        }
    }

    /// True if it shares a point with the area; also true where no geometry is known, as the standard requires.
    fn intersects(&self, area: Option<&Area>) -> bool {
        let Some(area) = area else { return true };
        match self {
            Self::Unknown => true,
            Self::Point(point) => area.contains(*point),
            Self::Polygon(corners) => area.intersects(corners),
        }
    }
}

/// A centimetre is the seventh decimal; more would only look precise.
fn coordinates(position: Position) -> [f64; 2] {
    [position.longitude_deg(), position.latitude_deg()].map(|degrees| (degrees * 1e7).round() / 1e7)
}

/// The page of a collection after a cursor.
///
/// # Errors
/// `CameraNotFound`; `InvalidArgument` for a cursor of another list.
pub(super) async fn page(
    app: &App,
    collection: &CollectionId,
    selection: &Selection,
    cursor: Option<&str>,
) -> Result<FeaturePage> {
    match collection {
        CollectionId::Cameras => cameras(app, selection, cursor).await,
        CollectionId::Samples(camera) => samples(app, camera, selection, cursor).await,
        CollectionId::Tracks(camera) => tracks(app, camera, selection, cursor).await,
    }
}

/// One feature of a collection.
///
/// # Errors
/// `CameraNotFound`; `RouteNotFound` for a feature that there is not.
pub(super) async fn one(app: &App, collection: &CollectionId, id: &str) -> Result<Feature> {
    let unknown = || Error::refused(ErrorKind::RouteNotFound, "there is no such feature in the collection");
    match collection {
        CollectionId::Cameras => {
            let camera = CameraId::new(id).map_err(|_| unknown())?;
            camera_feature(app.camera_statuses().get(&camera).await?)
        }
        CollectionId::Samples(camera) => {
            let key: SampleKey = read_cursor("feature", id).map_err(|_| unknown())?;
            let filter = SampleFilter {
                from: Some(key.time),
                target_id: Some(key.target_id.clone()),
                ..SampleFilter::default()
            };
            let found = app.samples().list(camera, &filter, None, 1).await?.items.into_iter().next();
            found.filter(|sample| SampleKey::of(sample) == key).map(sample_feature).ok_or_else(unknown)?
        }
        CollectionId::Tracks(camera) => {
            let latest = app.live().tracks(camera).await?;
            let own = latest.iter().find(|point| point.target_id.as_str() == id);
            own.map(|point| track_feature(point)).ok_or_else(unknown)?
        }
    }
}

async fn cameras(app: &App, selection: &Selection, cursor: Option<&str>) -> Result<FeaturePage> {
    let after: Option<CameraId> = cursor.map(|text| read_cursor("cursor", text)).transpose()?;
    let page = app.camera_statuses().list(after.as_ref(), selection.limit).await?;
    let features = page.items.into_iter().map(camera_feature).collect::<Result<Vec<_>>>()?;
    let area = selection.area.as_ref();
    Ok(FeaturePage {
        features: features.into_iter().filter(|feature| feature.geometry.intersects(area)).collect(),
        next: page.next.map(|id| write_cursor(&id)),
    })
}

async fn samples(
    app: &App,
    camera: &CameraId,
    selection: &Selection,
    cursor: Option<&str>,
) -> Result<FeaturePage> {
    let (from, until) = (selection.interval.from(), selection.interval.until());
    let filter = SampleFilter { from, until, ..SampleFilter::default() };
    let mut after: Option<SampleKey> = cursor.map(|text| read_cursor("cursor", text)).transpose()?;
    let mut features = Vec::new();
    let mut scanned = 0;
    loop {
        let wanted = selection.limit - features.len() as u32;
        // With an area most samples may be elsewhere, so more are read at once than are wanted.
        let read = if selection.area.is_some() { app.limits.page_items } else { wanted };
        let page = app.samples().list(camera, &filter, after, read).await?;
        scanned += page.items.len();
        let mut full_at = None;
        for sample in page.items {
            let key = SampleKey::of(&sample);
            let feature = sample_feature(sample)?;
            if feature.geometry.intersects(selection.area.as_ref()) {
                features.push(feature);
                if features.len() == selection.limit as usize {
                    full_at = Some(key);
                    break;
                }
            }
        }
        after = match (full_at, page.next) {
            (_, None) if features.len() < selection.limit as usize => None,
            (Some(key), _) => Some(key),
            (None, next) => next,
        };
        let Some(next) = &after else { return Ok(FeaturePage { features, next: None }) };
        if features.len() == selection.limit as usize || scanned >= MOST_SCANNED {
            return Ok(FeaturePage { next: Some(write_cursor(next)), features });
        }
    }
}

async fn tracks(
    app: &App,
    camera: &CameraId,
    selection: &Selection,
    cursor: Option<&str>,
) -> Result<FeaturePage> {
    let after: Option<TargetId> = cursor.map(|text| read_cursor("cursor", text)).transpose()?;
    let latest = app.live().tracks(camera).await?;
    let area = selection.area.as_ref();
    let mut selected = latest.iter().filter(|point| {
        after.as_ref().is_none_or(|after| point.target_id > *after)
            && selection.interval.contains(point.state.time)
            && area.is_none_or(|area| area.contains(point.position))
    });
    let features: Vec<_> = selected.by_ref().take(selection.limit as usize).collect();
    let last = features.last().map(|point| write_cursor(&point.target_id));
    Ok(FeaturePage {
        next: selected.next().and(last),
        features: features.into_iter().map(|point| track_feature(point)).collect::<Result<_>>()?,
    })
}

fn camera_feature(status: CameraStatus) -> Result<Feature> {
    let CameraStatus { camera, model_summary, activity, .. } = status;
    let hull = model_summary.as_ref().map(|summary| summary.view_area().hull.clone());
    let geometry = match hull {
        Some(hull) if hull.len() >= 3 => Geometry::Polygon(hull),
        Some(hull) => hull.first().copied().map_or(Geometry::Unknown, Geometry::Point),
        None => Geometry::Unknown,
    };
    let properties = json!({
        "camera_id": camera.id().as_str(),
        "display_name": camera.profile.display_name,
        "site": camera.profile.site.as_ref().map(|site| site.as_str()),
        "active_model": camera.active_model,
        "median_r95_m": model_summary.as_ref().map(|summary| summary.view_area().median_r95_m),
        "targets": activity.targets,
        "last_observed_at": activity.last_observed_at,
        "created_at": camera.created_at,
    });
    Ok(Feature { id: camera.id().to_string(), geometry, properties: object(&properties)? })
}

fn sample_feature(sample: StoredSample) -> Result<Feature> {
    let id = write_cursor(&SampleKey::of(&sample));
    let geometry = sample.fix.map_or(Geometry::Unknown, |fix| Geometry::Point(fix.position));
    let [left_px, top_px, width_px, height_px] = sample.bounding_box.sides_px();
    // Flat, since attributes of a GIS have no parts.
    let properties = json!({
        "time": sample.time,
        "target_id": sample.target_id.as_str(),
        "left_px": left_px,
        "top_px": top_px,
        "width_px": width_px,
        "height_px": height_px,
        "sigma_m": sample.fix.and_then(|fix| fix.sigma_m).map(SigmaM::metres),
        "class": sample.class.as_ref().map(|class| class.as_str()),
        "score": sample.score.map(Score::value),
    });
    Ok(Feature { id, geometry, properties: object(&properties)? })
}

fn track_feature(point: &TrackPoint) -> Result<Feature> {
    Ok(Feature {
        id: point.target_id.to_string(),
        geometry: Geometry::Point(point.position),
        properties: object(&track_properties(point))?,
    })
}

fn object(value: &impl Serialize) -> Result<Map<String, Value>> {
    match serde_json::to_value(value).map_err(Error::fault)? {
        Value::Object(map) => Ok(map),
        _ => Err(Error::fault("the properties of a feature are no object")),
    }
}
