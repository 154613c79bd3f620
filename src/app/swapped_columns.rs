//! Imported fixes that are not where the camera is, latitudes and longitudes that were swapped above all.
//!
//! Where both are below 90 degrees, as in Europe, either order is a position. Two things tell: a camera sees one place,
//! so positions that are far from its others, and near them when swapped, are wrong, or the others are; and the
//! boxes of swapped positions show the ground as a mirror would ([`is_mirrored`]), which needs nothing to compare with.
//! A camera whose profile states its location has that to compare with, and fixes of another city are told, too.

use super::registry::ActiveCamera;
use crate::domain::{Result, StoredSample};
use crate::geo::{Position, distance_m};
use crate::model::{FootPosition, is_mirrored, median_position};
use crate::store::{SampleFilter, Store};

/// Stored samples that tell where the camera's positions are.
const STORED_SAMPLES: u32 = 50;
/// Farther from itself than any camera sees, m.
const FAR_M: f64 = 50_000.0;
/// Rows of an import that are kept for the comparison with a mirror image.
const KEPT_ROWS: usize = 512;

/// The fixes of an import, as far as they are looked at.
#[derive(Default)]
pub(super) struct PlaceCheck {
    /// Where the camera is, or else where its positions are.
    reference: Option<Reference>,
    fixes: u64,
    /// Fixes that are far from the camera's location, swapped or not, and the distance of the first, m.
    far: u64,
    first_far_m: Option<f64>,
    /// Fixes that are near the reference only when they are swapped, and the first of them.
    swapped: u64,
    first_swapped: Option<Position>,
    kept: Vec<FootPosition>,
    /// One fix in this number of fixes is kept.
    stride: u64,
}

/// The position that fixes are compared with.
#[derive(Clone, Copy)]
struct Reference {
    place: Position,
    /// It is the location of the profile.
    is_location: bool,
}

impl PlaceCheck {
    /// Looks at a batch of a camera.
    ///
    /// # Errors
    /// A fault if the camera's samples cannot be read.
    pub(super) async fn see(
        &mut self,
        store: &Store,
        camera: &ActiveCamera,
        batch: &[StoredSample],
    ) -> Result<()> {
        let fixes = || {
            let fix = |it: &StoredSample| Some((it.bounding_box.foot_px(), it.fix.as_ref()?.position));
            batch.iter().filter_map(fix)
        };
        if self.reference.is_none() && fixes().next().is_some() {
            let of_fixes = || {
                let place = median_position(fixes().map(|(_, position)| position))?;
                Some(Reference { place, is_location: false })
            };
            self.reference = known_place(store, camera).await?.or_else(of_fixes);
        }
        for fix in fixes() {
            self.look_at(fix);
        }
        Ok(())
    }

    fn look_at(&mut self, (foot, position): FootPosition) {
        if let Some(Reference { place, is_location }) = self.reference {
            if position.is_swapped_at(place) {
                self.swapped += 1;
                self.first_swapped.get_or_insert(position);
            } else if is_location && distance_m(position, place) > FAR_M {
                self.far += 1;
                self.first_far_m.get_or_insert(distance_m(position, place));
            }
        }
        self.stride = self.stride.max(1);
        if self.fixes.is_multiple_of(self.stride) && position.swapped().is_some() {
            self.kept.push((foot, position));
        }
        self.fixes += 1;
        if self.kept.len() > KEPT_ROWS {
            let mut index = 0;
            self.kept.retain(|_| {
                index += 1;
                index % 2 == 1
            });
            self.stride *= 2;
        }
    }

    /// Returns the faults of the import as a whole, each with its remedy.
    pub(super) fn warnings(&self) -> Vec<String> {
        let far = self.first_far_m.map(|distance_m| {
            format!(
                "{} of {} fixes are far from the camera: the first is {:.0} km from the location of its profile; \
                 correct the location, or delete the samples and import those of this camera",
                self.far,
                self.fixes,
                distance_m / 1_000.0
            )
        });
        self.swapped_warning().into_iter().chain(far).collect()
    }

    fn swapped_warning(&self) -> Option<String> {
        const REMEDY: &str =
            "swap the two columns and import the rows again with on_conflict=replace (--replace)";
        if let Some((wrong, reference)) = self.first_swapped.zip(self.reference) {
            let (others, them, remedy) = match reference.is_location {
                true => ("the location of the camera's profile", "it", "correct the location"),
                false => ("the camera's other positions", "them", "delete the stored samples that are wrong"),
            };
            return Some(format!(
                "latitude and longitude are swapped in {} of {} fixes, or in {others}: the first such fix is {:.0} km from \
                 {them}, and would be near {them} with both swapped; {REMEDY}, or {remedy}",
                self.swapped,
                self.fixes,
                distance_m(wrong, reference.place) / 1_000.0
            ));
        }
        is_mirrored(&self.kept).then(|| {
            format!(
                "latitude and longitude seem to be swapped: the boxes show the positions as a mirror would, and no \
                 camera does unless its picture is mirrored; {REMEDY}"
            )
        })
    }
}

/// Where a camera is by its profile, else where its positions are by its model, else by some of its samples.
async fn known_place(store: &Store, camera: &ActiveCamera) -> Result<Option<Reference>> {
    if let Some(place) = store.camera(&camera.id).await?.profile.location {
        return Ok(Some(Reference { place, is_location: true }));
    }
    Ok(place_of_positions(store, camera).await?.map(|place| Reference { place, is_location: false }))
}

async fn place_of_positions(store: &Store, camera: &ActiveCamera) -> Result<Option<Position>> {
    if let Some((model, _)) = camera.model() {
        return Ok(Some(model.plane().origin()));
    }
    let filter = SampleFilter { has_fix: Some(true), ..SampleFilter::default() };
    let samples = store.samples(&camera.id, &filter, None, STORED_SAMPLES).await?;
    Ok(median_position(samples.iter().filter_map(|sample| Some(sample.fix.as_ref()?.position))))
}
