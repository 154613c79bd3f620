//! The decision to activate a new model version automatically.
//!
//! Two versions are compared by their mean distance to the fixes of held-out samples, that is, samples
//! predicted by a fit that had not seen them. With each version a sample of its held-out errors is stored,
//! so a later version is measured on what the earlier one was good at, whatever its own training samples
//! are. Both versions of a comparison choose their samples by the same hash of time and target, so
//! that a sample that both have trained on is in both choices or in none.

use std::collections::{HashMap, HashSet};

use jiff::Timestamp;
use sha2::{Digest, Sha256};

use crate::app::App;
use crate::domain::{
    BoundingBox, CameraId, HeldOutSampleError, ModelMetadata, Result, Sample, TargetId, TimeRange,
};
use crate::geo::Position;
use crate::model::{Artifact, KNOWN_POINTS, Regressor};
use crate::store::StoredHeldOutError;

/// Held-out errors that are stored with a version.
const STORED_ERRORS: usize = 2_000;
/// The mean distance on the active version's own held-out samples may grow by this factor, the scatter
/// between two fits of the same camera.
const TOLERANCE: f64 = 1.05;

/// The decision to activate, with a sentence for the operator.
pub(super) struct PromotionDecision {
    pub(super) activate: bool,
    pub(super) reason: String,
}

/// The decision to activate the new versions of all cameras of a site, with the finding per camera.
pub(super) struct SitePromotion {
    pub(super) activate: bool,
    /// A sentence for the operator.
    pub(super) reason: String,
    /// In the order of the candidates.
    pub(super) cameras: Vec<CameraPromotion>,
}

/// The finding of one camera of a site.
pub(super) struct CameraPromotion {
    /// The active version, if there is one.
    pub(super) compared_with: Option<u32>,
    /// A sentence for the operator.
    pub(super) comparison: String,
}

/// A fitted model that asks for promotion.
pub(super) struct PromotionCandidate<'a> {
    pub(super) artifact: &'a Artifact,
    /// Its training samples.
    pub(super) samples: &'a [Sample],
    /// Its held-out error on each of them.
    pub(super) held_out: &'a [HeldOutSampleError],
    /// The range of time that the run was asked to learn from.
    pub(super) range: TimeRange,
}

/// Identity of a sample within its camera.
type Key<'a> = (Timestamp, &'a TargetId);

/// Sums of the distances of both versions over the same samples, m.
#[derive(Default)]
struct Comparison {
    samples: f64,
    new_m: f64,
    active_m: f64,
}

impl Comparison {
    fn plus(&self, other: &Self) -> Self {
        Self {
            samples: self.samples + other.samples,
            new_m: self.new_m + other.new_m,
            active_m: self.active_m + other.active_m,
        }
    }

    fn add(&mut self, new_m: f64, active_m: f64) {
        self.samples += 1.0;
        self.new_m += new_m;
        self.active_m += active_m;
    }

    /// True if the new version is worse, by the means over all samples.
    fn new_is_worse(&self, tolerance: f64) -> bool {
        self.new_m > tolerance * self.active_m
    }

    /// Means in m: of the new version, then of the active one.
    fn describe(&self, number: u32) -> String {
        self.describe_against(&format!("version {number}"))
    }

    fn describe_against(&self, other: &str) -> String {
        format!(
            "{:.3} m from {} held-out fixes against {:.3} m of {other}",
            self.new_m / self.samples,
            self.samples,
            self.active_m / self.samples
        )
    }
}

/// The comparison of a new version with the active one.
enum Finding {
    /// No active version can be used, for this reason.
    NoRival(String),
    /// The version of this number is active, and the new one cannot be compared with it, for this reason.
    Incomparable(u32, &'static str),
    /// Both were measured.
    Measured(Measured),
}

/// A new version and the active one on held-out samples.
struct Measured {
    /// Number of the active version.
    number: u32,
    /// On the samples that the active version was held to.
    own: Comparison,
    /// On those and the new version's.
    all: Comparison,
}

impl Measured {
    fn decide(&self) -> PromotionDecision {
        let Self { number, own, all } = self;
        if own.new_is_worse(TOLERANCE) {
            keep(
                *number,
                &format!("on the samples that it was held to, the new one is {}", own.describe(*number)),
            )
        } else if all.new_is_worse(1.0) {
            keep(*number, &all.describe(*number))
        } else if all.samples == 0.0 {
            activate(&format!("version {number} has no held-out samples that count any more"))
        } else {
            activate(&all.describe(*number))
        }
    }
}

/// The held-out errors to be stored with a version: those with the least hashes.
pub(super) fn stored_errors(held_out: &[HeldOutSampleError]) -> Vec<HeldOutSampleError> {
    let mut hashed: Vec<(u64, &HeldOutSampleError)> =
        held_out.iter().map(|error| (hash_of((error.time, &error.target_id)), error)).collect();
    hashed.sort_by_key(|(hash, _)| *hash);
    hashed.into_iter().take(STORED_ERRORS).map(|(_, error)| error.clone()).collect()
}

fn hash_of((time, target_id): Key<'_>) -> u64 {
    let mut hash = Sha256::new();
    hash.update(time.as_microsecond().to_le_bytes());
    hash.update(target_id.as_str());
    let digest = hash.finalize();
    u64::from_le_bytes(std::array::from_fn(|at| digest[at]))
}

/// Compares a new version with the active one.
///
/// The new version must be no worse on the held-out samples of both together, repeated rows counted once,
/// nor (but for [`TOLERANCE`]) on those of the active version alone. Only samples count that the run was
/// asked to learn from and that the active version can be held to: after a camera was moved, those since.
pub(super) async fn decide(
    app: &App,
    id: &CameraId,
    new: &PromotionCandidate<'_>,
) -> Result<PromotionDecision> {
    Ok(match measure(app, id, app.store.camera(id).await?.active_model, new).await? {
        Finding::NoRival(why) => activate(&why),
        Finding::Incomparable(number, why) => keep(number, why),
        Finding::Measured(measured) => measured.decide(),
    })
}

/// Compares the new versions of all cameras of a site with the active ones, by the rule of [`decide`] for the set: on the
/// held-out samples of all cameras together the new versions must be no worse, and no camera's may be worse by more than
/// the scatter between two fits ([`TOLERANCE`]). Either all become active or none.
pub(super) async fn decide_site(
    app: &App,
    candidates: &[(&CameraId, PromotionCandidate<'_>)],
) -> Result<SitePromotion> {
    let mut cameras = Vec::with_capacity(candidates.len());
    let mut objection = None;
    let mut all = Comparison::default();
    for (id, candidate) in candidates {
        let active = app.store.camera(id).await?.active_model;
        let (is_worse, comparison) = match measure(app, id, active, candidate).await? {
            Finding::NoRival(why) => (false, why),
            Finding::Incomparable(_, why) => (true, why.to_owned()),
            Finding::Measured(measured) => {
                all = all.plus(&measured.all);
                let is_worse = measured.own.new_is_worse(TOLERANCE) || measured.all.new_is_worse(TOLERANCE);
                (is_worse, measured.all.describe(measured.number))
            }
        };
        if is_worse && objection.is_none() {
            objection = Some(format!("of camera {id}: {comparison}"));
        }
        cameras.push(CameraPromotion { compared_with: active, comparison });
    }
    let measured = all.describe_against("the active versions");
    if objection.is_none() && all.new_is_worse(1.0) {
        objection = Some(format!("over all cameras, {measured}"));
    }
    let count = cameras.len();
    let reason = match &objection {
        Some(objection) => format!(
            "no version became active: {objection}; activate them camera by camera if they are the better"
        ),
        None if all.samples == 0.0 => format!("the versions of all {count} cameras became active together"),
        None => format!("the versions of all {count} cameras became active together: {measured}"),
    };
    Ok(SitePromotion { activate: objection.is_none(), reason, cameras })
}

/// Measures a new version and the active one.
async fn measure(
    app: &App,
    id: &CameraId,
    active: Option<u32>,
    new: &PromotionCandidate<'_>,
) -> Result<Finding> {
    let Some(number) = active else {
        return Ok(Finding::NoRival("the camera had no model".to_owned()));
    };
    let Some((active, _)) = app.registry.refresh_camera(&app.store, id).await?.model.clone() else {
        return Ok(Finding::NoRival(format!("version {number} cannot be used")));
    };
    if new.held_out.is_empty() {
        return Ok(Finding::Incomparable(number, "the new one has no held-out errors to compare"));
    }
    let recorded = app.store.model(id, number).await?.metadata;
    if let Some(why) = by_other_known_points(number, &recorded, &new.artifact.metadata) {
        return Ok(Finding::NoRival(why));
    }
    let onset_at = app.store.camera_move(id, number).await?.map(|moved| moved.onset_at);
    let counts =
        |time: Timestamp| new.range.contains(time) && onset_at.is_none_or(|onset_at| time >= onset_at);
    let stored = app.store.held_out_errors(id, number).await?;
    if stored.is_empty() {
        let comparison = against_recorded(new, &active, &recorded);
        return Ok(Finding::Measured(Measured { number, own: Comparison::default(), all: comparison }));
    }
    let own = on_active_samples(new, &stored, &counts)?;
    let all = on_new_samples(new, &active, &stored, &counts).plus(&own);
    Ok(Finding::Measured(Measured { number, own, all }))
}

/// Why fixes cannot judge between two versions: they have the bias that known points take away.
fn by_other_known_points(number: u32, active: &ModelMetadata, new: &ModelMetadata) -> Option<String> {
    let [active, new] = [active, new].map(|it| it.parameters.get(KNOWN_POINTS).copied().unwrap_or_default());
    (new > 0.0 && new != active).then(|| {
        format!("it was trained with {new} known points and version {number} with {active}, and the fixes cannot judge that")
    })
}

/// Both versions on the stored held-out samples of the active one. The new version's error there is its own
/// held-out error where it has trained on the sample.
fn on_active_samples(
    new: &PromotionCandidate<'_>,
    stored: &[StoredHeldOutError],
    counts: &impl Fn(Timestamp) -> bool,
) -> Result<Comparison> {
    let regressor = new.artifact.load()?;
    let held_out: HashMap<Key<'_>, f64> =
        new.held_out.iter().map(|error| ((error.time, &error.target_id), error.distance_m)).collect();
    let mut comparison = Comparison::default();
    for StoredHeldOutError { error, sample } in stored {
        let Some((bounding_box, position)) = sample else { continue };
        if counts(error.time) {
            let own_m = held_out.get(&(error.time, &error.target_id)).copied();
            let new_m = own_m.unwrap_or_else(|| distance_m(&regressor, bounding_box, *position));
            comparison.add(new_m, error.distance_m);
        }
    }
    Ok(comparison)
}

/// Both versions on the new one's held-out samples that the active one has not trained on, repeated rows
/// counted once.
fn on_new_samples(
    new: &PromotionCandidate<'_>,
    active: &Regressor,
    stored: &[StoredHeldOutError],
    counts: &impl Fn(Timestamp) -> bool,
) -> Comparison {
    let trained_on: HashSet<Key<'_>> =
        stored.iter().map(|stored| (stored.error.time, &stored.error.target_id)).collect();
    // Beyond its greatest hash the active version may have trained on samples that were not stored.
    let greatest = if stored.len() < STORED_ERRORS {
        u64::MAX
    } else {
        trained_on.iter().map(|key| hash_of(*key)).max().unwrap_or(u64::MAX)
    };
    let samples: HashMap<Key<'_>, &Sample> =
        new.samples.iter().map(|sample| ((sample.time, &sample.target_id), sample)).collect();
    let mut seen = HashSet::new();
    let mut comparison = Comparison::default();
    for error in new.held_out {
        let key = (error.time, &error.target_id);
        let Some(sample) = samples.get(&key) else { continue };
        if !counts(error.time) || trained_on.contains(&key) || hash_of(key) > greatest {
            continue;
        }
        let (bounding_box, position) = (&sample.bounding_box, sample.fix.position);
        if seen.insert(bits_of(bounding_box, position)) {
            comparison.add(error.distance_m, distance_m(active, bounding_box, position));
        }
    }
    comparison
}

/// Against a version without stored held-out errors (an imported one): its error is the
/// larger of what its metadata state and what it shows on the new version's samples.
fn against_recorded(
    new: &PromotionCandidate<'_>,
    active: &Regressor,
    recorded: &ModelMetadata,
) -> Comparison {
    let everything = on_new_samples(new, active, &[], &|_| true);
    let recorded_m = recorded.held_out.as_ref().map_or(0.0, |held_out| held_out.mean_to_fix_m);
    let active_m = everything.active_m.max(recorded_m * everything.samples);
    Comparison { active_m, ..everything }
}

fn activate(why: &str) -> PromotionDecision {
    PromotionDecision { activate: true, reason: format!("became active: {why}") }
}

fn keep(number: u32, why: &str) -> PromotionDecision {
    let reason =
        format!("version {number} stays active: {why}; activate the new one by hand if it is the better");
    PromotionDecision { activate: false, reason }
}

/// From the box alone, as held-out errors are measured.
fn distance_m(regressor: &Regressor, bounding_box: &BoundingBox, position: Position) -> f64 {
    let fix = regressor.plane().to_plane(position);
    regressor.regress(bounding_box, None).regressed.distance_m(fix)
}

fn bits_of(bounding_box: &BoundingBox, position: Position) -> [u64; 6] {
    let [left, top, width, height] = bounding_box.sides_px();
    [left, top, width, height, position.longitude_deg(), position.latitude_deg()].map(f64::to_bits)
}
