//! Extents of a target.

/// Extents of a target and the place of its receiver's antenna, m. The scene's outline is stretched to
/// these extents, so the antenna's distance from the foot of the box depends on the aspect.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TargetShape {
    /// Extent along the heading.
    pub length_m: f64,
    /// Extent across the heading.
    pub width_m: f64,
    /// Extent above the ground.
    pub height_m: f64,
    /// Antenna ahead of the middle of the length.
    pub antenna_ahead_m: f64,
    /// Antenna to the left of the middle of the width.
    pub antenna_left_m: f64,
}
