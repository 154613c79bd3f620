//! Messages of `values.proto` to values and back. What must be there and is not is refused here, by
//! the path of its field; all else is checked by the same constructors that REST uses.

use jiff::Timestamp;

use super::proto;
use super::proto::track_scope::Scope;
use crate::domain::{
    self, CameraId, Error, ErrorKind, LiveItem, Observation, ReceiverId, Refusal, Result, RunId, Score,
    SiteId, StoredSample, TargetClass, TargetId, TimeRange, TrackScope, TrackerId,
};
use crate::exchange::wire;
use crate::exchange::{RowError, RowRules};
use crate::geo;
use crate::store::SampleFilter;

/// The value of a field that must be set.
pub(super) fn required<T>(value: Option<T>, field: &str) -> Result<T> {
    value.ok_or_else(|| Error::invalid(field, "is required"))
}

fn required_text<'a>(text: &'a str, field: &str) -> Result<&'a str> {
    required(Some(text).filter(|text| !text.is_empty()), field)
}

/// The camera that a request names. What is no slug names no camera.
pub(super) fn camera_id(id: &str) -> Result<CameraId> {
    CameraId::new(required_text(id, "camera_id")?).map_err(|_| {
        let shown: String = id.chars().take(80).collect();
        Error::refused(ErrorKind::CameraNotFound, format!("`{shown}` is not the id of a camera"))
    })
}

/// The site that a request names. What is no slug names no site.
pub(super) fn site_id(id: &str) -> Result<SiteId> {
    SiteId::new(required_text(id, "site_id")?).map_err(|_| {
        let shown: String = id.chars().take(80).collect();
        Error::refused(ErrorKind::SiteNotFound, format!("`{shown}` is not the id of a site"))
    })
}

/// The camera or site whose tracks a request means; `None` if it names none.
pub(super) fn track_scope(scope: Option<proto::TrackScope>) -> Result<Option<TrackScope>> {
    let of = |scope| match scope {
        Scope::SiteId(id) => site_id(&id).map(TrackScope::Site),
        Scope::CameraId(id) => camera_id(&id).map(TrackScope::Camera),
    };
    scope.and_then(|scope| scope.scope).map(of).transpose()
}

impl From<&TrackScope> for proto::TrackScope {
    fn from(scope: &TrackScope) -> Self {
        let scope = match scope {
            TrackScope::Site(id) => Scope::SiteId(id.to_string()),
            TrackScope::Camera(id) => Scope::CameraId(id.to_string()),
        };
        Self { scope: Some(scope) }
    }
}

/// The training run that a request names.
pub(super) fn run_id(id: &str) -> Result<RunId> {
    required_text(id, "run_id")?.parse()
}

/// Prefix of the recipes' names in `values.proto`; the rest is the name of the recipe in capitals.
const RECIPE: &str = "RECIPE_";

/// The recipe, if it is not left open.
pub(super) fn recipe(recipe: i32) -> Result<Option<domain::Recipe>> {
    match proto::Recipe::try_from(recipe) {
        Ok(proto::Recipe::Unspecified) => Ok(None),
        Ok(recipe) => recipe.as_str_name().trim_start_matches(RECIPE).to_ascii_lowercase().parse().map(Some),
        Err(_) => Err(Error::invalid("recipe", format!("has no value {recipe}"))),
    }
}

pub(super) fn durability(durability: i32) -> Result<domain::Durability> {
    match proto::Durability::try_from(durability) {
        Ok(proto::Durability::Unspecified) => Ok(domain::Durability::default()),
        Ok(proto::Durability::Synced) => Ok(domain::Durability::Synced),
        Ok(proto::Durability::Relaxed) => Ok(domain::Durability::Relaxed),
        Err(_) => Err(Error::invalid("durability", format!("has no value {durability}"))),
    }
}

impl From<geo::PlaneCovariance> for proto::PlaneCovariance {
    fn from(covariance: geo::PlaneCovariance) -> Self {
        let geo::PlaneCovariance { east_m2, north_m2, east_north_m2 } = covariance;
        Self { east_m2, north_m2, east_north_m2 }
    }
}

impl From<domain::Motion> for proto::Motion {
    fn from(motion: domain::Motion) -> Self {
        let interval = |[low, high]: [f64; 2]| proto::Interval { low, high };
        Self {
            speed_mps: motion.speed_mps,
            speed_interval_mps: Some(interval(motion.speed_interval_mps)),
            course_deg: motion.course.map(|course| course.deg),
            course_interval_deg: motion.course.map(|course| interval(course.interval_deg)),
            stationary_probability: motion.stationary_probability,
        }
    }
}

/// Reads the rule for samples that are stored already.
pub(super) fn on_conflict(on_conflict: i32) -> Result<domain::OnConflict> {
    match proto::OnConflict::try_from(on_conflict) {
        Ok(proto::OnConflict::Unspecified | proto::OnConflict::Keep) => Ok(domain::OnConflict::Keep),
        Ok(proto::OnConflict::Replace) => Ok(domain::OnConflict::Replace),
        Err(_) => Err(Error::invalid("on_conflict", format!("has no value {on_conflict}"))),
    }
}

impl From<domain::Durability> for proto::Durability {
    fn from(durability: domain::Durability) -> Self {
        match durability {
            domain::Durability::Synced => Self::Synced,
            domain::Durability::Relaxed => Self::Relaxed,
        }
    }
}

impl From<domain::Recipe> for proto::Recipe {
    fn from(recipe: domain::Recipe) -> Self {
        let name = format!("{RECIPE}{}", recipe.as_str().to_ascii_uppercase());
        Self::from_str_name(&name).unwrap_or_default()
    }
}

/// An instant, if it is set; its refusal names the field.
pub(super) fn instant(time: Option<prost_types::Timestamp>, field: &str) -> Result<Option<Timestamp>> {
    let Some(prost_types::Timestamp { seconds, nanos }) = time else { return Ok(None) };
    if !(0..1_000_000_000).contains(&nanos) {
        return Err(Error::invalid(format!("{field}.nanos"), "must be from 0 to 999999999"));
    }
    match Timestamp::new(seconds, nanos) {
        Ok(time) => Ok(Some(time)),
        Err(_) => {
            Err(Error::invalid(format!("{field}.seconds"), "must be an instant of the years 1 to 9999"))
        }
    }
}

/// An instant as a message.
pub(super) fn timestamp(time: Timestamp) -> prost_types::Timestamp {
    let (seconds, nanos) = (time.as_second(), time.subsec_nanosecond());
    // Before 1970 jiff counts both downwards, the message only the seconds.
    if nanos < 0 {
        prost_types::Timestamp { seconds: seconds - 1, nanos: nanos + 1_000_000_000 }
    } else {
        prost_types::Timestamp { seconds, nanos }
    }
}

/// A time that a row or an observation may have.
fn checked_time(time: Option<prost_types::Timestamp>, rules: &RowRules) -> Result<Timestamp> {
    rules.time_bounds.check(required(instant(time, "time")?, "time")?)
}

fn bounding_box(sides: proto::BoundingBox, rules: &RowRules) -> Result<domain::BoundingBox> {
    let side = |side_px, field| required(side_px, field).map_err(|error| error.under("bounding_box"));
    let sides = wire::BoundingBox {
        left_px: side(sides.left_px, "left_px")?,
        top_px: side(sides.top_px, "top_px")?,
        width_px: side(sides.width_px, "width_px")?,
        height_px: side(sides.height_px, "height_px")?,
    };
    wire::box_within(sides, rules.image_size)
}

/// A fix; refusals name its fields, not the fix.
pub(super) fn fix(fix: proto::Fix) -> Result<domain::Fix> {
    wire::Fix {
        longitude_deg: required(fix.longitude_deg, "longitude_deg")?,
        latitude_deg: required(fix.latitude_deg, "latitude_deg")?,
        sigma_m: fix.sigma_m,
    }
    .to_domain()
}

pub(super) fn position(position: proto::Position) -> Result<geo::Position> {
    wire::Position {
        longitude_deg: required(position.longitude_deg, "longitude_deg")?,
        latitude_deg: required(position.latitude_deg, "latitude_deg")?,
    }
    .to_domain()
}

fn target_id(id: Option<&str>) -> Result<Option<TargetId>> {
    id.map(TargetId::new).transpose()
}

/// A sample that keeps the rules of its camera.
pub(super) fn sample(sample: proto::Sample, rules: &RowRules) -> Result<StoredSample> {
    Ok(StoredSample {
        time: checked_time(sample.time, rules)?,
        target_id: TargetId::new(required_text(&sample.target_id, "target_id")?)?,
        bounding_box: bounding_box(required(sample.bounding_box, "bounding_box")?, rules)?,
        fix: sample.fix.map(|it| fix(*it)).transpose().map_err(|error| error.under("fix"))?,
        class: sample.class.as_deref().map(TargetClass::new).transpose()?,
        score: sample.score.map(Score::new).transpose()?,
        truth: sample.truth.map(|it| position(*it)).transpose().map_err(|error| error.under("truth"))?,
    })
}

/// An observation that keeps the rules of its camera.
pub(super) fn observation(observation: proto::Observation, rules: &RowRules) -> Result<Observation> {
    Observation::new(
        checked_time(observation.time, rules)?,
        target_id(observation.target_id.as_deref())?,
        observation.bounding_box.map(|sides| bounding_box(sides, rules)).transpose()?,
        observation.fix.map(fix).transpose().map_err(|error| error.under("fix"))?,
    )
}

/// An item of a live stream that keeps the rules of its camera.
pub(super) fn live_item(item: proto::StreamItem, rules: &RowRules) -> Result<LiveItem> {
    Ok(LiveItem {
        time: checked_time(item.time, rules)?,
        target_id: target_id(item.target_id.as_deref())?,
        tracker_id: item.tracker_id.as_deref().map(TrackerId::new).transpose()?,
        receiver_id: item.receiver_id.as_deref().map(ReceiverId::new).transpose()?,
        bounding_box: item.bounding_box.map(|sides| bounding_box(sides, rules)).transpose()?,
        fix: item.fix.map(fix).transpose().map_err(|error| error.under("fix"))?,
        class: item.class.as_deref().map(TargetClass::new).transpose()?,
        score: item.score.map(Score::new).transpose()?,
    })
}

/// Which samples are meant; all, if left out.
pub(super) fn sample_filter(filter: Option<proto::SampleFilter>) -> Result<SampleFilter> {
    let Some(filter) = filter else { return Ok(SampleFilter::default()) };
    let read = || {
        let range = TimeRange::new(instant(filter.from, "from")?, instant(filter.until, "until")?)?;
        let target_id = target_id(filter.target_id.as_deref())?;
        Ok(SampleFilter { target_id, has_fix: filter.has_fix, ..SampleFilter::within(range) })
    };
    read().map_err(|error: Error| error.under("filter"))
}

/// A refusal of values at fault, its paths below a parent; other refusals as they are.
pub(super) fn of_field(error: Error, parent: &str) -> Error {
    match &error {
        Error::Refused(Refusal { kind: ErrorKind::InvalidArgument, .. }) => error.under(parent),
        Error::Refused(_) | Error::Fault(_) => error,
    }
}

impl From<geo::Position> for proto::Position {
    fn from(position: geo::Position) -> Self {
        Self { longitude_deg: Some(position.longitude_deg()), latitude_deg: Some(position.latitude_deg()) }
    }
}

impl From<domain::Fix> for proto::Fix {
    fn from(fix: domain::Fix) -> Self {
        Self {
            longitude_deg: Some(fix.position.longitude_deg()),
            latitude_deg: Some(fix.position.latitude_deg()),
            sigma_m: fix.sigma_m.map(domain::SigmaM::metres),
        }
    }
}

impl From<domain::BoundingBox> for proto::BoundingBox {
    fn from(bounding_box: domain::BoundingBox) -> Self {
        let [left_px, top_px, width_px, height_px] = bounding_box.sides_px().map(Some);
        Self { left_px, top_px, width_px, height_px }
    }
}

impl From<RowError> for proto::RejectedRow {
    fn from(RowError { line, field, reason }: RowError) -> Self {
        Self { line, field, reason }
    }
}

impl From<StoredSample> for proto::Sample {
    fn from(sample: StoredSample) -> Self {
        Self {
            time: Some(timestamp(sample.time)),
            target_id: sample.target_id.as_str().to_owned(),
            bounding_box: Some(sample.bounding_box.into()),
            fix: sample.fix.map(|it| Box::new(it.into())),
            class: sample.class.map(|class| class.as_str().to_owned()),
            score: sample.score.map(Score::value),
            truth: sample.truth.map(|it| Box::new(it.into())),
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn rules() -> RowRules {
        let now = "2026-01-01T00:00:00Z".parse().expect("a time");
        RowRules {
            time_bounds: domain::TimeBounds::at(now),
            image_size: Some(domain::ImageSize::new(640, 480).expect("a size")),
        }
    }

    fn good() -> proto::Sample {
        proto::Sample {
            time: Some(prost_types::Timestamp { seconds: 1_600_000_000, nanos: 0 }),
            target_id: "person-1".to_owned(),
            bounding_box: Some(proto::BoundingBox {
                left_px: Some(0.0),
                top_px: Some(11.5),
                width_px: Some(28.0),
                height_px: Some(77.0),
            }),
            fix: Some(Box::new(proto::Fix {
                longitude_deg: Some(103.98678),
                latitude_deg: Some(30.628),
                sigma_m: Some(2.0),
            })),
            class: Some("person".to_owned()),
            score: Some(0.5),
            truth: Some(Box::new(proto::Position { longitude_deg: Some(0.0), latitude_deg: Some(-90.0) })),
        }
    }

    #[test]
    fn a_sample_comes_back_as_it_went() {
        for sent in [good(), proto::Sample { fix: None, ..good() }] {
            assert_eq!(proto::Sample::from(sample(sent.clone(), &rules()).expect("good")), sent);
        }
    }

    #[test]
    fn what_is_left_out_is_named_by_its_path() {
        let without = |change: fn(&mut proto::Sample)| {
            let mut changed = good();
            change(&mut changed);
            let Err(Error::Refused(refusal)) = sample(changed, &rules()) else { panic!("not refused") };
            assert_eq!(refusal.kind, ErrorKind::InvalidArgument);
            refusal.violations[0].field.clone()
        };
        assert_eq!(without(|sample| sample.time = None), "time");
        assert_eq!(without(|sample| sample.target_id.clear()), "target_id");
        assert_eq!(without(|sample| sample.bounding_box = None), "bounding_box");
        let fix = |sample: &mut proto::Sample| sample.fix = Some(Box::default());
        assert_eq!(without(fix), "fix.longitude_deg");
        let sides = |sample: &mut proto::Sample| sample.bounding_box.as_mut().expect("set").top_px = None;
        assert_eq!(without(sides), "bounding_box.top_px");
        let truth = |sample: &mut proto::Sample| sample.truth = Some(Box::default());
        assert_eq!(without(truth), "truth.longitude_deg");
        let nanos = |sample: &mut proto::Sample| sample.time.as_mut().expect("set").nanos = -1;
        assert_eq!(without(nanos), "time.nanos");
        let seconds = |sample: &mut proto::Sample| sample.time.as_mut().expect("set").seconds = i64::MAX;
        assert_eq!(without(seconds), "time.seconds");
    }

    #[test]
    fn recipes_and_their_numbers_correspond() {
        let numbers = domain::Recipe::ALL.iter().map(|own| proto::Recipe::from(*own) as i32);
        let mut numbers: Vec<i32> = numbers.collect();
        for (own, number) in domain::Recipe::ALL.iter().zip(&numbers) {
            assert_eq!(recipe(*number).expect("has a name"), Some(*own));
        }
        numbers.sort_unstable();
        let of_proto: Vec<i32> = (1..100).filter(|number| proto::Recipe::try_from(*number).is_ok()).collect();
        assert_eq!(numbers, of_proto);
    }

    proptest! {
        #[test]
        fn times_come_back(seconds in -60_000_000_000_i64..200_000_000_000, nanos in 0..1_000_000_000) {
            let sent = prost_types::Timestamp { seconds, nanos };
            let read = instant(Some(sent), "time").expect("in range").expect("set");
            prop_assert_eq!(timestamp(read), sent);
        }
    }
}
