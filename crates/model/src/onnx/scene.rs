//! Positions within the scene, and their errors: `uncertainty/scene.rs`.

use super::expression::Expr;
use crate::uncertainty::scene::{CREDIBLE_RATIO, Scene};

/// `Scene::limit`: position (east, north, m) and covariance (east, cross, north, m2).
pub(super) fn limit<'g>(
    scene: &Scene,
    position_m: [Expr<'g>; 2],
    covariance_m2: [Expr<'g>; 3],
    extrapolation_ratio: Expr<'g>,
    r95_scale: Expr<'g>,
) -> ([Expr<'g>; 2], [Expr<'g>; 3]) {
    let bounds_m = scene.bounds_m();
    let nearest_m = [0, 1].map(|axis: usize| position_m[axis].clamp(bounds_m[axis][0], bounds_m[axis][1]));
    let limited_m2 =
        (0..2).fold(position_m[0] * 0.0, |sum, axis| sum + (nearest_m[axis] - position_m[axis]).square());
    let credible_share = CREDIBLE_RATIO / extrapolation_ratio.max(CREDIBLE_RATIO);
    let weight = limited_m2.exceeds(0.0).choose(1.0, 1.0 - credible_share.square());
    let (centre_m, anywhere_m2) = (scene.centre_m(), scene.variance_m2());
    let from_centre_m = [0, 1].map(|axis: usize| nearest_m[axis] - centre_m[axis]);
    let [east_m2, cross_m2, north_m2] = covariance_m2;
    let covariance_m2 = [
        east_m2 + weight * (from_centre_m[0].square() + anywhere_m2[0]),
        cross_m2 + weight * from_centre_m[0] * from_centre_m[1],
        north_m2 + weight * (from_centre_m[1].square() + anywhere_m2[1]),
    ];
    let reach = |axis: usize| (nearest_m[axis] - bounds_m[axis][0]).max(-nearest_m[axis] + bounds_m[axis][1]);
    let r95_m2 = r95_scale.square() * (covariance_m2[0] + covariance_m2[2]) * 0.5;
    let factor = ((reach(0).square() + reach(1).square()) / r95_m2).min(1.0);
    (nearest_m, covariance_m2.map(|element| element * factor))
}
