//! Latitudes and longitudes that were swapped in an import.
//!
//! Where both are below 90 degrees, as in Europe, either order is a position. Two things tell: a camera sees one place,
//! so positions that are far from its others, and near them when swapped, are wrong, or the others are; and the
//! boxes of swapped positions show the ground as a mirror would ([`is_mirrored`]), which needs nothing to compare with.

use super::App;
use crate::domain::{CameraId, Result, StoredSample};
use crate::geo::{Position, distance_m};
use crate::model::{FootPosition, is_mirrored, median_position};
use crate::store::SampleFilter;

/// Stored samples that tell where the camera's positions are.
const STORED_SAMPLES: u32 = 50;
/// Rows of an import that are kept for the comparison with a mirror image.
const KEPT_ROWS: usize = 512;

/// The fixes of an import, as far as they are looked at.
#[derive(Default)]
pub(super) struct PlaceCheck {
    /// Where the camera's positions are.
    reference: Option<Position>,
    fixes: u64,
    /// Fixes that are near the reference only when they are swapped, and the first of them.
    swapped: u64,
    first_swapped: Option<Position>,
    kept: Vec<FootPosition>,
    /// One fix in this number of fixes is kept.
    stride: u64,
}

impl PlaceCheck {
    /// Looks at a batch.
    ///
    /// # Errors
    /// A fault if the camera's samples cannot be read.
    pub(super) async fn see(&mut self, app: &App, id: &CameraId, batch: &[StoredSample]) -> Result<()> {
        let fixes = || {
            batch.iter().filter_map(|sample| {
                let position = sample.fix.as_ref()?.position;
                position.swapped().map(|_| (sample.bounding_box.foot_px(), position))
            })
        };
        if self.reference.is_none() && fixes().next().is_some() {
            self.reference = match known_place(app, id).await? {
                Some(place) => Some(place),
                None => median_position(fixes().map(|(_, position)| position)),
            };
        }
        for fix in fixes() {
            self.look_at(fix);
        }
        Ok(())
    }

    fn look_at(&mut self, (foot, position): FootPosition) {
        if self.reference.is_some_and(|reference| position.is_swapped_at(reference)) {
            self.swapped += 1;
            self.first_swapped.get_or_insert(position);
        }
        self.stride = self.stride.max(1);
        if self.fixes.is_multiple_of(self.stride) {
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
        const REMEDY: &str =
            "swap the two columns and import the rows again with on_conflict=replace (--replace)";
        if let Some((wrong, reference)) = self.first_swapped.zip(self.reference) {
            return vec![format!(
                "latitude and longitude are swapped in {} of {} fixes, or in the camera's other positions: the first \
                 such fix is {:.0} km from them, and would be near them with both swapped; {REMEDY}, or delete the \
                 stored samples that are wrong",
                self.swapped,
                self.fixes,
                distance_m(wrong, reference) / 1_000.0
            )];
        }
        if is_mirrored(&self.kept) {
            return vec![format!(
                "latitude and longitude seem to be swapped: the boxes show the positions as a mirror would, and no \
                 camera does unless its picture is mirrored; {REMEDY}"
            )];
        }
        Vec::new()
    }
}

/// Where a camera's positions are: by its model, else by some of its samples.
async fn known_place(app: &App, id: &CameraId) -> Result<Option<Position>> {
    let active = app.active_camera(id).await?;
    if let Some((model, _)) = active.model() {
        return Ok(Some(model.plane().origin()));
    }
    let filter = SampleFilter { has_fix: Some(true), ..SampleFilter::default() };
    let samples = app.store.samples(id, &filter, None, STORED_SAMPLES).await?;
    Ok(median_position(samples.iter().filter_map(|sample| Some(sample.fix.as_ref()?.position))))
}
